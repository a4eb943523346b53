"""Machine code of loops: compiled once by numba in a process of its own, kept on disk, loaded without numba.

To import numba takes a program half a second of the processor and 60 MB; to load what it has compiled takes a tenth of
the one and half of the other. A loop is one function of one record of numbers (:mod:`numpy.dtype`), which all that it
reads and writes is in, and of symbols that its caller names.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.programs.kept_kernels import source_of
from pendulum_msgs_py.whole_file import write_whole

__all__ = ["Loop", "NoMachineCodeError", "compile_loop", "load_loop"]

Loop = Callable[[NDArray[Any]], int]
"""Runs on one record, an array of shape (1,); returns what the loop returns."""

_LIBRARIES = {
    "libm.so.6": ("sin", "cos", "sincos", "tan", "exp", "expm1", "log", "sqrt", "tanh", "pow", "fmod", "floor"),
    "libc.so.6": ("memcpy", "memmove", "memset", "clock_gettime", "clock_nanosleep", "ppoll", "read"),
}
"""What every loop may call beside what its caller names."""
_PATIENCE = 120.0
"""Longest time that a compiler may take on a busy machine [s]."""
_COMPILER = "pendulum_msgs_py.loops.compile_loop"


class NoMachineCodeError(PendulumError):
    """A loop cannot be had compiled; the message says why, and its caller runs interpreted."""


def load_loop(builder: str, *choice: str, symbols: Mapping[str, int]) -> Loop:
    """Return a loop; the first time on this computer, or after a change of its source, it is compiled for seconds.

    Args:
        builder: ``module:function``; called with the choice, it returns the loop compiled by numba for one record.
        choice: Which variant of it, such as a method.
        symbols: Addresses of the functions that it calls, by name.

    Raises:
        NoMachineCodeError: It cannot be had here.
    """
    return _load(builder, choice, tuple(sorted(symbols.items())))


@cache
def _load(builder: str, choice: tuple[str, ...], symbols: tuple[tuple[str, int], ...]) -> Loop:
    if sys.platform != "linux" or struct.calcsize("P") != 8:
        raise NoMachineCodeError(f"compiled loops are for Linux of 64 bits; this is {platform.platform()}")
    for library in ("numba", "llvmlite"):
        if importlib.util.find_spec(library) is None:
            raise NoMachineCodeError(f"{library} is not installed")
    path = _path(builder, choice)
    kept = _read(path)
    if kept is None:
        _compile_apart(path, builder, choice)
        kept = _read(path)
        if kept is None:
            raise NoMachineCodeError(f"{path} cannot be read back")
    head, code = kept
    return _Linked(head["name"], head["symbols"], code, dict(symbols))


class _Linked:
    """Machine code in this process."""

    def __init__(self, name: str, needed: list[str], code: bytes, symbols: dict[str, int]) -> None:
        import llvmlite.binding as llvm

        known = {**_addresses(), **symbols}
        missing = [symbol for symbol in needed if not known.get(symbol)]
        if missing:
            raise NoMachineCodeError(f"{', '.join(missing)} is not there to be called")
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        for symbol in needed:
            llvm.add_symbol(symbol, known[symbol])
        machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
        # The engine owns the memory that the code is in: it lives as long as the loop.
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        address = self._engine.get_function_address(name)
        if not address:
            raise NoMachineCodeError(f"the code has no function {name}")
        # Numba's convention (its manual, "calling conventions"): status = f(result, exception, arguments). Called
        # through ctypes, without Python's lock.
        pointer = ctypes.c_void_p
        self._call = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, pointer)(address)

    def __call__(self, record: NDArray[Any]) -> int:
        result, exception = ctypes.c_int64(), ctypes.c_void_p()
        status = self._call(ctypes.byref(result), ctypes.byref(exception), record.ctypes.data)
        if status:
            raise RuntimeError(f"compiled loop ended with status {status}; expected 0")
        return result.value


@cache
def _addresses() -> dict[str, int]:
    found = {}
    for library, names in _LIBRARIES.items():
        with contextlib.suppress(OSError):
            loaded = ctypes.CDLL(library)
            for name in names:
                with contextlib.suppress(AttributeError):
                    found[name] = ctypes.cast(getattr(loaded, name), ctypes.c_void_p).value or 0
    return found


# --- on disk -------------------------------------------------------------------------------------------------


def _path(builder: str, choice: tuple[str, ...]) -> Path:
    """Return where the code of a loop is kept: a file for each choice, source, compiler and kind of processor."""
    import llvmlite.binding as llvm

    module, _, function = builder.partition(":")
    packages = sorted({"pendulum_msgs_py", module.partition(".")[0]})
    for package in packages:
        importlib.import_module(package)
    versions = [importlib.metadata.version(each) for each in ("numba", "llvmlite", "numpy")]
    processor = [llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()]
    known = json.dumps([builder, choice, [source_of(each) for each in packages], versions, processor, sys.version])
    digest = hashlib.sha256(known.encode()).hexdigest()[:24]
    home = Path(str(sys.modules[packages[-1]].__file__)).parent / "__pycache__"
    if not os.access(home if home.exists() else home.parent, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pendulum"
    return home / f"{function}-{'-'.join(choice)}-{digest}.loop"


def _read(path: Path) -> tuple[dict[str, Any], bytes] | None:
    """Return what is known of the code and the code itself; None where none is kept, or what is kept is damaged."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        line, _, code = path.read_bytes().partition(b"\n")
        head = json.loads(line)
        if head["digest"] == hashlib.sha256(code).hexdigest():
            return head, code
    return None


def _compile_apart(path: Path, builder: str, choice: tuple[str, ...]) -> None:
    """Have a loop compiled by a process of its own; of several who want it one compiles, the others wait."""
    with _alone(path):
        if _read(path) is not None:
            return
        command = [sys.executable, "-m", _COMPILER, str(path), builder, *choice]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoMachineCodeError(f"the compiler of {builder} did not come to its end: {error}") from error
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            raise NoMachineCodeError(f"the compiler of {builder} ended with: {said[-1]}")


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path.with_suffix(".lock"), os.O_CREAT | os.O_RDWR, 0o644)
    except OSError as error:
        raise NoMachineCodeError(f"no folder for machine code: {error}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        with contextlib.suppress(OSError):
            path.with_suffix(".lock").unlink()
        os.close(lock)


# --- the compiler's process ----------------------------------------------------------------------------------


def compile_loop(path: Path, builder: str, *choice: str) -> None:
    """Compile a loop and keep it.

    Args:
        path: Where.
        builder: As in :func:`load_loop`.
        choice: Likewise.
    """
    module, _, function = builder.partition(":")
    dispatcher = getattr(importlib.import_module(module), function)(*choice)
    (signature,) = dispatcher.signatures
    compiled = dispatcher.overloads[signature]
    code = compiled.library._get_compiled_object()
    head = {
        "name": compiled.fndesc.llvm_func_name,
        "symbols": sorted(undefined_symbols(code)),
        "digest": hashlib.sha256(code).hexdigest(),
    }
    write_whole(path, json.dumps(head).encode() + b"\n" + code)


_ELF = b"\x7fELF\x02\x01"
"""Magic of an object file of 64 bits, little endian (System V ABI, chapter 4)."""
_HEADER = struct.Struct("<40xQ10xHHH")
_SECTION = struct.Struct("<IIQQQQII16x")
_SYMBOL = struct.Struct("<IBBHQQ")
_SYMBOL_TABLE = 2


def undefined_symbols(code: bytes) -> set[str]:
    """Return the names that an object file leaves to be found by who loads it.

    Raises:
        ValueError: It is no such file.
    """
    if not code.startswith(_ELF):
        raise ValueError(f"object file begins with {code[:6]!r}; expected {_ELF!r}")
    table_at, size, count, _ = _HEADER.unpack_from(code)
    sections = [_SECTION.unpack_from(code, table_at + size * index) for index in range(count)]
    found = set()
    for _, kind, _, _, at, length, link, _ in sections:
        if kind != _SYMBOL_TABLE:
            continue
        names_at = sections[link][4]
        for offset in range(at, at + length, _SYMBOL.size):
            name, _, _, section, _, _ = _SYMBOL.unpack_from(code, offset)
            if section == 0 and name:
                found.add(code[names_at + name : code.index(b"\0", names_at + name)].decode())
    return found
