"""Code put into memory: by hand-made object files, whose every byte is known."""

from __future__ import annotations

import contextlib
import ctypes
import platform
import struct
import sys
from pathlib import Path

import pytest

from pendulum_msgs_py.loops.object_file import link, undefined_symbols

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="object files of Linux for x86_64"
)

_ADD_ONE = 64  # where the code stands, behind the header
_CODE = bytes.fromhex(
    "48b80000000000000000"  # movabs rax, <value>: its address is at 2
    "488b00"  # mov rax, [rax]
    "48b90000000000000000"  # movabs rcx, <counter>: at 15
    "48ff01"  # inc qword [rcx]
    "480301"  # add rax, [rcx]
    "c3"  # ret
)
_NAMES = b"\0answer\0value\0counter\0"


def _object(
    *, machine: int = 62, kind: int = 1, symbol: int = 2, magic: bytes = b"\x7fELF\x02\x01", table: int = 2
) -> bytes:
    """Return an object file: answer() = *value + ++counter, where the value is somebody else's."""
    symbols = b"".join(
        struct.pack("<IBBHQQ", *each)
        for each in (
            (0, 0, 0, 0, 0, 0),
            (1, 0x12, 0, 1, 0, len(_CODE)),
            (8, 0x10, 0, 0, 0, 0),
            (14, 0x11, 0, 0xFFF2, 8, 8),
        )
    )
    relocations = struct.pack("<QQq", 2, symbol << 32 | kind, 8) + struct.pack("<QQq", 15, 3 << 32 | 1, 0)
    pieces = [_CODE, relocations, symbols, _NAMES]
    places, at = [], _ADD_ONE
    for piece in pieces:
        places.append((at, len(piece)))
        at += len(piece)
    header = magic + bytes(10) + struct.pack("<HHIQQQIHHHHHH", 1, machine, 1, 0, 0, at, 0, 64, 0, 0, 64, 5, 0)
    sections = [bytes(64)]
    for kind_of, flags, (begin, size), link_to, info, align in (
        (1, 6, places[0], 0, 0, 16),
        (4, 0, places[1], 3, 1, 8),
        (table, 0, places[2], 4, 1, 8),
        (3, 0, places[3], 0, 0, 1),
    ):
        sections.append(struct.pack("<IIQQQQIIQQ", 0, kind_of, flags, 0, begin, size, link_to, info, align, 24))
    return header + b"".join(pieces) + b"".join(sections)


def test_code_runs_with_what_it_was_linked_to() -> None:
    values = (ctypes.c_int64 * 2)(0, 40)
    linked = link(_object(), {"value": ctypes.addressof(values)})
    answer = ctypes.CFUNCTYPE(ctypes.c_int64)(linked.addresses["answer"])
    # The addend says: the second of the two.
    assert [answer(), answer()] == [41, 42]
    assert linked.addresses["counter"] % 8 == 0
    assert ctypes.c_int64.from_address(linked.addresses["counter"]).value == 2


def test_it_says_what_it_needs() -> None:
    assert undefined_symbols(_object()) == {"value"}


def test_code_cannot_be_written_once_it_runs() -> None:
    linked = link(_object(), {"value": 1})
    assert _rights(linked.addresses["answer"]) == "r-x"
    assert _rights(linked.addresses["counter"]) == "rw-"


def _rights(address: int) -> str:
    for line in Path("/proc/self/maps").read_text(encoding="ascii").splitlines():
        span, rights = line.split()[:2]
        begin, end = (int(each, 16) for each in span.split("-"))
        if begin <= address < end:
            return rights[:3]
    return "nothing"


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"magic": b"\x7fELF\x01\x01"}, "begins with"),
        ({"magic": b"#!/bin"}, "begins with"),
        ({"machine": 183}, "machine 183; expected 62"),
        ({"kind": 2}, "relocation 2"),
        ({"symbol": 0}, "symbol 0"),
        ({"table": 7}, "no table of symbols"),
    ],
)
def test_what_is_of_another_kind_is_refused(changed: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        link(_object(**changed), {"value": 1})  # type: ignore[arg-type]


def test_a_symbol_that_nobody_knows_is_refused() -> None:
    with pytest.raises(ValueError, match="of a symbol that is known"):
        link(_object(), {})


@pytest.mark.parametrize("size", [0, 3, 40, 63])
def test_a_file_that_is_cut_short_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match="begins with"):
        link(_object()[:size], {"value": 1})


def test_no_cut_and_no_damaged_byte_of_its_tables_is_more_than_refused() -> None:
    whole = _object()
    for size in range(64, len(whole)):
        with pytest.raises(ValueError, match="object file"):
            link(whole[:size], {"value": 1})
    # Only what says how the file is made: code that is damaged is kept out by its digest.
    for at in [*range(18, 64), *range(_ADD_ONE + len(_CODE), len(whole))]:
        for value in (0, 0x7F, 0xFF):
            damaged = whole[:at] + bytes([value]) + whole[at + 1 :]
            for use in (undefined_symbols, lambda code: link(code, {"value": 1})):
                with contextlib.suppress(ValueError, OSError):
                    use(damaged)
