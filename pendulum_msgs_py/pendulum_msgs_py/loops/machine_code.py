"""Machine code of loops: compiled once by numba in its own process, cached on disk, loaded without numba.

Importing numba costs a program 0.5 s of CPU and 60 MB. A loop is a function of one record of numbers
(:class:`numpy.dtype`), which holds all its data, and of symbols named by its caller.
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
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pendulum_msgs_py.atomic_write import write_atomically
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.loops.object_file import link, undefined_symbols

__all__ = ["Loop", "NoMachineCodeError", "compile_loop", "keep_loop", "load_loop"]

Loop = Callable[[NDArray[Any]], int]
"""Runs on one record, an array of shape (1,)."""

_LIBRARIES = {
    "libm.so.6": ("sin", "cos", "sincos", "tan", "exp", "expm1", "log", "sqrt", "tanh", "pow", "fmod", "floor"),
    "libc.so.6": ("memcpy", "memmove", "memset", "clock_gettime", "clock_nanosleep", "ppoll", "read"),
}
"""What every loop may call in addition to the caller's symbols."""
_PATIENCE = 120.0
"""Timeout of the compiler on a busy machine [s]."""
_COMPILER = "pendulum_msgs_py.loops.compile_loop"


class NoMachineCodeError(PendulumError):
    """A loop cannot be compiled, for the reason in the message; the caller runs interpreted."""


def load_loop(builder: str, *choice: str, symbols: Mapping[str, int]) -> Loop:
    """Return a loop; the first time on a computer, or after a change of its source, compiling takes seconds.

    ``builder`` is ``module:function``, which returns the loop compiled by numba for one record and the given choice;
    ``symbols`` are addresses of the functions that it calls.

    Raises:
        NoMachineCodeError: It cannot be compiled here.
    """
    return _load(builder, choice, tuple(sorted(symbols.items())))


@cache
def _load(builder: str, choice: tuple[str, ...], symbols: tuple[tuple[str, int], ...]) -> Loop:
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise NoMachineCodeError(
            f"loops are compiled on Linux for x86_64; this is {sys.platform}, {platform.machine()}"
        )
    head, code = keep_loop(builder, *choice)
    return _LoadedLoop(head["name"], code, dict(symbols))


def keep_loop(builder: str, *choice: str) -> tuple[dict[str, Any], bytes]:
    """Return head and code of a loop from the cache; compile first if missing or if its source has changed.

    Raises:
        NoMachineCodeError: It cannot be compiled here.
    """
    path = _path(builder, choice)
    kept = _read(path)
    if kept is None:
        _compile_apart(path, builder, choice)
        kept = _read(path)
        if kept is None:
            raise NoMachineCodeError(f"{path} cannot be read back")
    return kept


class _LoadedLoop:
    def __init__(self, name: str, code: bytes, symbols: Mapping[str, int]) -> None:
        known = {**_addresses(), **symbols}
        try:
            missing = sorted(symbol for symbol in undefined_symbols(code) if not known.get(symbol))
            if missing:
                raise NoMachineCodeError(f"{', '.join(missing)} is not there to be called")
            self._code = link(code, known)
            address = self._code.addresses[name]
        except KeyError as error:
            raise NoMachineCodeError(f"the code has no function {error}") from error
        except (OSError, ValueError) as error:
            raise NoMachineCodeError(f"the code cannot be loaded: {error}") from error
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
    """Return the cache file: one for each choice, compiler and processor."""
    module, _, function = builder.partition(":")
    try:
        versions = [importlib.metadata.version(each) for each in ("numba", "llvmlite", "numpy")]
    except importlib.metadata.PackageNotFoundError as error:
        raise NoMachineCodeError(f"{error.name} is not installed") from error
    known = json.dumps([builder, choice, versions, _processor(), sys.version])
    digest = hashlib.sha256(known.encode()).hexdigest()[:24]
    home = _folder(module.partition(".")[0]) / "__pycache__"
    if not os.access(home if home.exists() else home.parent, os.W_OK):
        try:
            home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pendulum"
        except RuntimeError as error:  # a user without a name, as in a container
            raise NoMachineCodeError(f"no folder for machine code: {error}") from error
    name = "-".join((function, *choice, digest)).replace(":", ".")
    return home / f"{name}.loop"


@cache
def _processor() -> str:
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").partition("\n\n")[0].splitlines()
        return "\n".join(line for line in lines if line.startswith(("model name", "flags")))
    return platform.processor()


def _read(path: Path) -> tuple[dict[str, Any], bytes] | None:
    """Return head and code; None if missing, damaged, or of other source."""
    # Another program's file is ignored.
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        line, _, code = path.read_bytes().partition(b"\n")
        head = json.loads(line)
        if (
            head["digest"] == _digest(code)
            and isinstance(head["name"], str)
            and all(_digest(_source(name).read_bytes()) == digest for name, digest in head["sources"].items())
        ):
            return head, code
    return None


def _source(name: str) -> Path:
    # Relative to the imported package, also for code compiled from another copy.
    package, _, rest = name.partition("/")
    return _folder(package) / rest


@cache
def _folder(package: str) -> Path:
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise LookupError(f"no package {package}")
    return Path(spec.origin).parent


def _compile_apart(path: Path, builder: str, choice: tuple[str, ...]) -> None:
    with _alone(path):
        if _read(path) is not None:
            return
        # The first start takes seconds and must not seem to hang.
        print(f"compiling {builder} {' '.join(choice)}: ten seconds or so, this once", file=sys.stderr, flush=True)
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
    """Compile a loop of :func:`load_loop` into a file."""
    module, _, function = builder.partition(":")
    dispatcher = getattr(importlib.import_module(module), function)(*choice)
    (signature,) = dispatcher.signatures
    compiled = dispatcher.overloads[signature]
    code = compiled.library._get_compiled_object()
    head = {
        "name": compiled.fndesc.llvm_func_name,
        "digest": _digest(code),
        # All imported modules: nothing else can have changed the loop.
        "sources": {name: _digest(_source(name).read_bytes()) for name in _own_sources()},
    }
    write_atomically(path, json.dumps(head).encode() + b"\n" + code)


def _own_sources() -> list[str]:
    found = []
    for name, module in sorted(sys.modules.items()):
        package = name.partition(".")[0]
        if package.startswith("pendulum_") and getattr(module, "__file__", None):
            found.append(f"{package}/{Path(str(module.__file__)).relative_to(_folder(package)).as_posix()}")
    return found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
