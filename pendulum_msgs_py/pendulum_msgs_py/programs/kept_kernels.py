"""Keeps what numba compiles on disk, so that a program that starts again need not compile for seconds.

Numba's own ``cache=True`` knows a function by its file alone. Kernels here are made of functions from several files,
for a method or a mechanism: they are known by that choice and by all source of the packages that they come from.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType
from typing import Any

__all__ = ["KernelStore", "keep_kernel"]


def keep_kernel(dispatcher: Any, name: str, *choice: object) -> Any:
    """Return a compiled function that looks on disk for its machine code first, and leaves it there.

    Args:
        dispatcher: What ``numba.njit`` returned. Of the project's functions it may call those of its own package and of
            ``pendulum_msgs_py``.
        name: What the kernel is called; no other one of its package is called so.
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
        # Who has something compiled has numba; this package needs none otherwise.
        self._numba = sys.modules["numba.core"]
        self._folder = Path(self._numba.caching.CompileResultCacheImpl(function).locator.get_cache_path())
        self._name = name
        packages = ("pendulum_msgs_py", function.__module__.partition(".")[0])
        versions = (sys.version, sys.modules["numba"].__version__, sys.modules["llvmlite"].__version__)
        self._known = (name, packages, tuple(map(_words, choice)), versions)
        self._source = tuple(_source_of(package) for package in packages)

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(self._folder)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the kernel for these types of arguments; None where none was kept, or what was is damaged."""
        target.refresh()
        # Whatever a damaged file holds, compiling again mends it.
        with contextlib.suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):
            digest, _, content = self._path(signature, target.codegen()).read_bytes().partition(b"\n")
            if digest == _digest(content):
                source, payload = pickle.loads(content)  # noqa: S301  (our own, as the compiled modules beside it)
                if source == self._source:
                    return self._numba.compiler.CompileResult._rebuild(target, *payload)
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a kernel, unless its code has addresses of this process."""
        if compiled.library.has_dynamic_globals or compiled.lifted:
            return
        content = self._numba.serialize.dumps((self._source, compiled._reduce()))
        path = self._path(signature, compiled.library.codegen)
        with contextlib.suppress(OSError):
            # Whole or not at all: others may compile the same at this moment.
            with tempfile.NamedTemporaryFile(dir=self._folder, prefix=path.name, delete=False) as file:
                file.write(_digest(content) + b"\n" + content)
            os.replace(file.name, path)

    def enable(self) -> None:
        """Do nothing: a store is always on."""

    def disable(self) -> None:
        """Do nothing: a store is always on."""

    def flush(self) -> None:
        """Do nothing: what is old is not taken, and written over."""

    def _path(self, signature: Any, codegen: Any) -> Path:
        asked = repr((self._known, str(signature), codegen.magic_tuple()))
        return self._folder / f"{self._name}-{hashlib.sha256(asked.encode()).hexdigest()[:24]}.nbk"


def _words(choice: object) -> str:
    if isinstance(choice, FunctionType):
        code = hashlib.sha256(choice.__code__.co_code + repr(choice.__code__.co_consts).encode())
        return f"{choice.__module__}.{choice.__qualname__} {code.hexdigest()}"
    return repr(choice)


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


@cache
def _source_of(package: str) -> str:
    """Return what identifies all Python source of a package."""
    spec = find_spec(package)
    total = hashlib.sha256()
    for folder in spec.submodule_search_locations or () if spec else ():
        for path in sorted(Path(folder).rglob("*.py")):
            total.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return total.hexdigest()
