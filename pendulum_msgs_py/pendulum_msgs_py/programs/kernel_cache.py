"""A cache on disk of what numba compiles, so that a restarted program need not compile for seconds.

Numba's own ``cache=True`` identifies a function by its file alone. Kernels here are made of functions from several
files, for a method or a mechanism: their key is that choice and all source of the packages that they come from.
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
from types import FunctionType, ModuleType
from typing import Any

from pendulum_msgs_py.whole_file import write_whole

__all__ = ["KernelStore", "drop_stale_code", "keep_kernel", "name_symbols_apart"]

_COUNTED = re.compile(rb"B\dv\d{1,8}B")
"""Part of a symbol that bears a number of numba's own count."""


@cache
def name_symbols_apart() -> None:
    """Number what numba compiles at random from here on.

    Numba numbers functions of one name from 1 in each process: those made again for each method or mechanism. Two
    processes may cache different functions under one symbol; a process that loads both is linked to the first for all,
    and gets wrong numbers or invalid writes (numba, issue 10486). A child by ``fork`` would continue its parent's
    numbers.
    """
    identity = sys.modules["numba.core.bytecode"].FunctionIdentity
    identity._unique_ids = iter(partial(secrets.randbits, 64), None)


def keep_kernel(dispatcher: Any, name: str, *choice: object) -> Any:
    """Return a compiled function that loads its machine code from disk, or stores it there.

    Args:
        dispatcher: What ``numba.njit`` returned. Of the project's functions it may call those of its own package and of
            ``pendulum_msgs_py``.
        name: The kernel's name, unique in its package.
        choice: All that the function was made for: functions that it calls, by their code, the rest by ``repr``.
    """
    with contextlib.suppress(RuntimeError):  # there is no folder to write to: it compiles each time
        dispatcher._cache = KernelStore(dispatcher.py_func, name, choice)
    return dispatcher


class KernelStore:
    """The machine code of one kernel on disk, a file for each type of arguments and kind of processor.

    Args:
        function: The kernel in Python.
        name: What it is called.
        choice: What it was made for.

    Raises:
        RuntimeError: No folder can be written.
    """

    def __init__(self, function: Any, name: str, choice: tuple[object, ...]) -> None:
        # A program that compiles has numba installed; this package needs none otherwise.
        self._numba = sys.modules["numba.core"]
        name_symbols_apart()
        self._folder = Path(self._numba.caching.CompileResultCacheImpl(function).locator.get_cache_path())
        self._name = name
        made_of = [function, *(each for each in choice if isinstance(each, FunctionType))]
        packages = sorted({"pendulum_msgs_py", *(each.__module__.partition(".")[0] for each in made_of)})
        versions = (sys.version, sys.modules["numba"].__version__, sys.modules["llvmlite"].__version__)
        self._known = (name, packages, tuple(map(_words, choice)), versions)
        self._source = _digest("".join(map(_source_of, packages)).encode())

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(self._folder)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the kernel for these types of arguments; None where none is cached, or it is damaged."""
        target.refresh()
        # A damaged file is replaced by compiling again.
        with contextlib.suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):
            head, _, content = self._path(signature, target.codegen()).read_bytes().partition(b"\n")
            # Of other source it is not even read: what it names may be gone.
            if head == self._head(content):
                payload = pickle.loads(content)  # noqa: S301  (our own, as the compiled modules next to it)
                return self._numba.compiler.CompileResult._rebuild(target, *payload)
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a kernel, unless its code has addresses of this process, or symbols that another may have as well."""
        if compiled.library.has_dynamic_globals or compiled.lifted:
            return
        content = self._numba.serialize.dumps(compiled._reduce())
        if _COUNTED.search(content):
            return
        # Whole or not at all: others may compile the same at this moment.
        with contextlib.suppress(OSError):
            write_whole(self._path(signature, compiled.library.codegen), self._head(content) + b"\n" + content)

    def enable(self) -> None:
        """Do nothing: a store is always on."""

    def disable(self) -> None:
        """Do nothing: a store is always on."""

    def flush(self) -> None:
        """Do nothing: what is old is not taken, and written over."""

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


@cache
def _source_of(package: str) -> str:
    """Return what identifies all Python source of a package, or of a single module."""
    module = sys.modules[package]
    folders = [Path(each) for each in getattr(module, "__path__", ())]
    files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    if not folders and (alone := getattr(module, "__file__", None)):
        files = [Path(alone)]
    total = hashlib.sha256()
    for path in files:
        total.update(f"{path}\n".encode() + path.read_bytes())
    return total.hexdigest()


def drop_stale_code(kernel: Any, modules: Iterable[ModuleType]) -> None:
    """Delete numba's own cache of a kernel where it is older than what the kernel calls.

    Numba checks the kernel's own file only; an edited equation would be ignored silently.

    Args:
        kernel: The compiled function.
        modules: Those whose functions and tables it was compiled from, besides its own.
    """
    folder = getattr(getattr(kernel, "_cache", None), "cache_path", None)
    if folder is None or not Path(folder).is_dir():
        return
    newest = max(Path(str(module.__file__)).stat().st_mtime for module in modules)
    for file in Path(folder).glob(f"{Path(kernel.py_func.__code__.co_filename).stem}.*.nb[ic]"):
        # Another process was faster, or the folder is read-only: numba copes with both.
        with contextlib.suppress(OSError):
            if file.stat().st_mtime < newest:
                file.unlink()
