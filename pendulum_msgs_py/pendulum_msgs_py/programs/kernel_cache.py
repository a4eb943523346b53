"""A disk cache of numba kernels, so that a restarted program need not compile for seconds.

Numba's own ``cache=True`` identifies a function by its file alone. These kernels combine functions of several files for
one method or mechanism: their key is that choice, the modules of all functions that they reach, and the values of those
functions' globals and closures.
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
import re
import secrets
import sys
from collections.abc import Iterable
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from pendulum_msgs_py.atomic_write import write_atomically

__all__ = ["KernelStore", "drop_stale_code", "keep_kernel", "name_symbols_apart"]

_COUNTED = re.compile(rb"B\dv\d{1,8}B")
"""Part of a symbol with a number of numba's own count."""
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_COMPILERS = ("pendulum_msgs_py.loops.trees", __name__)
"""Modules that decide how kernels are compiled."""


@cache
def name_symbols_apart() -> None:
    """Number what numba compiles at random from here on.

    Numba numbers functions of one name from 1 in each process. Two processes may cache different functions under one
    symbol; a process that loads both is linked to the first for all, with wrong numbers or invalid writes (numba, issue
    10486). A forked child would continue its parent's numbers.
    """
    identity = sys.modules["numba.core.bytecode"].FunctionIdentity
    identity._unique_ids = iter(partial(secrets.randbits, 64), None)


def keep_kernel(dispatcher: Any, name: str, *choice: object) -> Any:
    """Return a function compiled by ``numba.njit`` that loads its machine code from disk, or stores it there.

    ``name`` is unique in the package; ``choice`` is all that it was made for: functions by their code, the rest by
    ``repr``.
    """
    with contextlib.suppress(RuntimeError):  # no writable folder: it compiles each time
        dispatcher._cache = KernelStore(dispatcher.py_func, name, choice)
    return dispatcher


class KernelStore:
    """The cache of one kernel: a file per argument types and processor; a RuntimeError if no folder is writable."""

    def __init__(self, function: Any, name: str, choice: tuple[object, ...]) -> None:
        self._numba = sys.modules["numba.core"]
        name_symbols_apart()
        self._folder = Path(self._numba.caching.CompileResultCacheImpl(function).locator.get_cache_path())
        self._name = name
        versions = (sys.version, *(sys.modules[each].__version__ for each in ("numba", "llvmlite", "numpy")))
        self._known = (name, function.__module__, tuple(map(_words, choice)), versions)
        self._source = _digest("\n".join(sorted(_made_of((function, *choice)))).encode())

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(self._folder)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the kernel for these types of arguments; None if missing or damaged."""
        target.refresh()
        with contextlib.suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):
            head, _, content = self._path(signature, target.codegen()).read_bytes().partition(b"\n")
            # Code of other source is not unpickled: its names may be gone.
            if head == self._head(content):
                payload = pickle.loads(content)  # noqa: S301  (our own, as the compiled modules next to it)
                return self._numba.compiler.CompileResult._rebuild(target, *payload)
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store a kernel, unless its code has addresses of this process or ambiguous symbols."""
        if compiled.library.has_dynamic_globals or compiled.lifted:
            return
        content = self._numba.serialize.dumps(compiled._reduce())
        if _COUNTED.search(content):
            return
        with contextlib.suppress(OSError):
            write_atomically(self._path(signature, compiled.library.codegen), self._head(content) + b"\n" + content)

    def enable(self) -> None:
        """Do nothing: a store is always on."""

    def disable(self) -> None:
        """Do nothing: a store is always on."""

    def flush(self) -> None:
        """Do nothing: stale entries are overwritten."""

    def _head(self, content: bytes) -> bytes:
        return self._source + b" " + _digest(content)

    def _path(self, signature: Any, codegen: Any) -> Path:
        asked = repr((self._known, str(signature), codegen.magic_tuple()))
        return self._folder / f"{self._name}-{hashlib.sha256(asked.encode()).hexdigest()[:24]}.nbk"


def _words(choice: object) -> str:
    if isinstance(choice, FunctionType):
        code = choice.__code__
        kept = [_words(cell.cell_contents) for cell in choice.__closure__ or ()]
        text = repr((code.co_code, code.co_consts, code.co_names, choice.__defaults__, kept))
        return f"{choice.__module__}.{choice.__qualname__} {_digest(text.encode()).decode()}"
    return repr(choice)


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _made_of(values: Iterable[Any]) -> set[str]:
    """Return the source of all modules that functions reach by name, and the values they use."""
    found, waiting, seen = set[str](), [*values, *map(sys.modules.get, _COMPILERS)], dict[int, Any]()
    while waiting:
        value = waiting.pop()
        if hasattr(value, "py_func"):
            found.add(_ADDRESS.sub("", repr(sorted(value.targetoptions.items()))))
            value = value.py_func
        if id(value) in seen:
            continue
        seen[id(value)] = value
        if isinstance(value, FunctionType):
            if _ours(value.__module__):
                found.add(_source_of(value.__module__))
                waiting += _reached(value)
        elif isinstance(value, ModuleType):
            if _ours(value.__name__):
                found.add(_source_of(value.__name__))
        elif isinstance(value, (tuple, list, dict)):
            waiting += value.values() if isinstance(value, dict) else value
        else:
            kind = value if isinstance(value, type) else type(value)
            if _ours(kind.__module__):
                found.add(_source_of(kind.__module__))
            found.add(value.tobytes().hex() if hasattr(value, "tobytes") else _ADDRESS.sub("", repr(value)))
    return found


def _reached(function: FunctionType) -> list[Any]:
    """Return what the code of a function and its inner functions may find by name."""
    codes, names = [function.__code__], set[str]()
    for code in codes:
        names |= set(code.co_names)
        codes += [each for each in code.co_consts if isinstance(each, CodeType)]
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    values = [*cells, *(function.__globals__[name] for name in names if name in function.__globals__)]
    for each in values:
        if isinstance(each, ModuleType) and _ours(each.__name__):
            inside = [vars(each)[name] for name in names if name in vars(each)]
            values += [part for part in inside if not any(part is value for value in values)]
    return [*values, *(function.__defaults__ or ())]


def _ours(module: str) -> bool:
    return module.partition(".")[0] not in {*sys.stdlib_module_names, "numba", "numpy", "llvmlite"}


@cache
def _source_of(name: str) -> str:
    file = getattr(sys.modules.get(name), "__file__", None)
    return f"{name} {_digest(Path(file).read_bytes()).decode() if file else ''}"


def drop_stale_code(kernel: Any, modules: Iterable[ModuleType]) -> None:
    """Delete numba's own cache of a kernel if older than the modules that it was compiled from.

    Numba checks the kernel's own file only; an edited equation would be ignored silently.
    """
    folder = getattr(getattr(kernel, "_cache", None), "cache_path", None)
    if folder is None or not Path(folder).is_dir():
        return
    newest = max(Path(str(module.__file__)).stat().st_mtime for module in modules)
    for file in Path(folder).glob(f"{Path(kernel.py_func.__code__.co_filename).stem}.*.nb[ic]"):
        # Another process was faster, or the folder is read-only; numba handles both.
        with contextlib.suppress(OSError):
            if file.stat().st_mtime < newest:
                file.unlink()
