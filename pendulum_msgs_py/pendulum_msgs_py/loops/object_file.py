"""A minimal linker: loads object files of LLVM's large code model.

llvmlite can do this too, for 50 MB and 0.1 s in each program. Numba's code refers to everything by whole addresses, so
one kind of relocation suffices; any other is refused.

Source: System V ABI, chapters 4 and 5; its AMD64 supplement, table 4.9 (``R_X86_64_64``: S + A).
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import struct
from collections.abc import Iterator, Mapping
from typing import NamedTuple

__all__ = ["LinkedCode", "link", "undefined_symbols"]

_MAGIC = b"\x7fELF\x02\x01"
"""ELF, 64 bits, little endian."""
_X86_64, _AT_MACHINE = 62, 18
_HEADER = struct.Struct("<40xQ10xHHH")
_SECTION = struct.Struct("<IIQQQQIIQQ")
_SYMBOL = struct.Struct("<IBBHQQ")
_RELOCATION = struct.Struct("<QQq")
_ADDRESS = struct.Struct("<Q")
_SYMBOL_TABLE, _RELOCATIONS, _EMPTY, _UNWINDING = 2, 4, 8, 0x70000001
_WRITABLE, _ALLOCATED = 1, 2
_UNDEFINED, _COMMON = 0, 0xFFF2
_ABSOLUTE = 1
_READ_AND_EXECUTE = mmap.PROT_READ | mmap.PROT_EXEC


class _Section(NamedTuple):
    name: int
    kind: int
    flags: int
    address: int
    at: int
    size: int
    link: int
    info: int
    alignment: int
    entry_size: int


class _Symbol(NamedTuple):
    name: str
    section: int
    value: int
    size: int


class LinkedCode:
    """Executable, read-only code in memory as long as this object lives, with the addresses of its symbols."""

    def __init__(self, memory: mmap.mmap, addresses: Mapping[str, int]) -> None:
        self._memory = memory
        self.addresses = addresses


def undefined_symbols(code: bytes) -> set[str]:
    """Return the undefined symbols of an object file; raise a ValueError if it is none."""
    with _damage_as_value_error():
        sections = _sections(code)
        return {symbol.name for symbol in _symbols(code, sections) if symbol.section == _UNDEFINED and symbol.name}


def link(code: bytes, known: Mapping[str, int]) -> LinkedCode:
    """Load an object file, given the addresses of its undefined symbols.

    Raises:
        ValueError: It is of another kind, or a symbol is unknown.
        OSError: This system forbids programs to make code.
    """
    with _damage_as_value_error():
        return _link(code, known)


def _link(code: bytes, known: Mapping[str, int]) -> LinkedCode:
    sections = _sections(code)
    symbols = _symbols(code, sections)
    places, constant, size = _places(sections, symbols)
    memory = mmap.mmap(-1, size, prot=mmap.PROT_READ | mmap.PROT_WRITE)
    base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    for index, at in places.items():
        if isinstance(index, int) and sections[index].kind != _EMPTY:
            section = sections[index]
            memory[at : at + section.size] = code[section.at : section.at + section.size]
    addresses = [_address_of(symbol, places, base, known) for symbol in symbols]
    for section in sections:
        if section.kind == _RELOCATIONS and section.info in places:
            _relocate(code, section, memory, places[section.info], addresses)
    if ctypes.CDLL(None, use_errno=True).mprotect(ctypes.c_void_p(base), ctypes.c_size_t(constant), _READ_AND_EXECUTE):
        raise OSError(ctypes.get_errno(), "memory cannot be made executable")
    found = {symbol.name: address for symbol, address in zip(symbols, addresses, strict=True) if address}
    return LinkedCode(memory, found)


@contextlib.contextmanager
def _damage_as_value_error() -> Iterator[None]:
    try:
        yield
    except (struct.error, LookupError, OverflowError, MemoryError) as error:
        raise ValueError(f"object file is damaged: {error}") from error


def _sections(code: bytes) -> list[_Section]:
    if not code.startswith(_MAGIC) or len(code) < _HEADER.size:
        raise ValueError(f"object file begins with {code[:6]!r}; expected {_MAGIC!r}")
    (machine,) = struct.unpack_from("<H", code, _AT_MACHINE)
    if machine != _X86_64:
        raise ValueError(f"object file is for machine {machine}; expected {_X86_64}, x86-64")
    table_at, size, count, _ = _HEADER.unpack_from(code)
    return [_Section(*_SECTION.unpack_from(code, table_at + size * index)) for index in range(count)]


def _symbols(code: bytes, sections: list[_Section]) -> list[_Symbol]:
    table = next((section for section in sections if section.kind == _SYMBOL_TABLE), None)
    if table is None:
        raise ValueError("object file has no table of symbols")
    names_at = sections[table.link].at

    def read() -> Iterator[_Symbol]:
        for offset in range(table.at, table.at + table.size, _SYMBOL.size):
            name, _, _, section, value, size = _SYMBOL.unpack_from(code, offset)
            begin = names_at + name
            yield _Symbol(code[begin : code.index(b"\0", begin)].decode(), section, value, size)

    return list(read())


def _places(sections: list[_Section], symbols: list[_Symbol]) -> tuple[dict[int | str, int], int, int]:
    """Return the offset of each loaded section and common symbol, the size of the code pages, and the size of all."""
    places: dict[int | str, int] = {}

    def place(key: int | str, size: int, alignment: int, end: int) -> int:
        places[key] = end + -end % max(1, alignment)
        return places[key] + size

    # No exception passes through a loop: unwind tables are not needed.
    loaded = [
        (index, section)
        for index, section in enumerate(sections)
        if section.flags & _ALLOCATED and section.size and section.kind != _UNWINDING
    ]
    end = 0
    for index, section in loaded:
        if not section.flags & _WRITABLE:
            end = place(index, section.size, section.alignment, end)
    constant = end = end + -end % mmap.PAGESIZE
    for index, section in loaded:
        if section.flags & _WRITABLE:
            end = place(index, section.size, section.alignment, end)
    for symbol in symbols:
        if symbol.section == _COMMON:
            # Its value is its alignment.
            end = place(symbol.name, symbol.size, symbol.value, end)
    return places, constant, end + -end % mmap.PAGESIZE


def _address_of(symbol: _Symbol, places: Mapping[int | str, int], base: int, known: Mapping[str, int]) -> int:
    if symbol.section == _COMMON:
        return base + places[symbol.name]
    if symbol.section != _UNDEFINED:
        return base + places[symbol.section] + symbol.value if symbol.section in places else 0
    return known.get(symbol.name, 0)


def _relocate(code: bytes, section: _Section, memory: mmap.mmap, begin: int, addresses: list[int]) -> None:
    for at in range(section.at, section.at + section.size, _RELOCATION.size):
        offset, info, addend = _RELOCATION.unpack_from(code, at)
        symbol, kind = info >> 32, info & 0xFFFFFFFF
        if kind != _ABSOLUTE or not addresses[symbol]:
            raise ValueError(f"relocation {kind} of symbol {symbol}; expected {_ABSOLUTE}, of a symbol that is known")
        _ADDRESS.pack_into(memory, begin + offset, addresses[symbol] + addend)
