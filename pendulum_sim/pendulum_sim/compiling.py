"""Compiles the project's scalar functions with numba, from the very code that is also interpreted.

The equations stand once, in plain Python with ``math``. ``compile_tree`` takes such a function with everything it
calls and returns it compiled; on request with another module in the place of ``math``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

import numba

from pendulum_msgs_py.programs.kept_kernels import name_symbols_apart
from pendulum_sim import vector_math

__all__ = ["compile_tree", "tuple_loader"]

# What is compiled here becomes part of kernels that are kept.
name_symbols_apart()

_OWN = ("pendulum_msgs_py", "pendulum_sim")
_cache: dict[tuple[Any, bool, bool], Any] = {}

# What compiled code finds under the name ``math``; its attributes must be compiled themselves.
_vector_module = ModuleType("vector_math_compiled")
_vector_module.sin = numba.njit(vector_math.sin, fastmath={"contract"}, forceinline=True)  # type: ignore[attr-defined]
_vector_module.cos = numba.njit(vector_math.cos, fastmath={"contract"}, forceinline=True)  # type: ignore[attr-defined]
_vector_module.exp = math.exp  # type: ignore[attr-defined]


def compile_tree(function: Callable[..., Any], *, vector: bool = False, inline: bool = False) -> Any:
    """Return a function, and those it calls, compiled.

    Args:
        function: A plain function of this project that uses scalars, tuples and ``math``.
        vector: Take ``pendulum_sim.vector_math`` in the place of ``math``, and write each function into its caller.
        inline: Write each function into its caller: machine code that is told no functions can be kept on disk.
    """
    inline = inline or vector
    key = (function, vector, inline)
    if key not in _cache:
        assert isinstance(function, FunctionType)
        scope = dict(function.__globals__)
        for name in function.__code__.co_names:
            value = scope.get(name)
            if isinstance(value, FunctionType) and value.__module__.startswith(_OWN):
                scope[name] = compile_tree(value, vector=vector, inline=inline)
            elif vector and isinstance(value, ModuleType) and value is math:
                scope[name] = _vector_module
        copy = FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
        # Contraction (a fused multiply-add) changes the last bit at most; nothing else of fastmath is allowed. C code
        # calls none of these: a wrapper for it would only cost time to compile.
        _cache[key] = numba.njit(
            copy, fastmath={"contract"}, error_model="numpy", forceinline=inline, no_cfunc_wrapper=True
        )
    return _cache[key]


@cache
def tuple_loader(length: int, stride: int) -> Any:
    """Return a compiled function (array, start) -> (array[start], array[start + stride], ...).

    Args:
        length: Values to load, >= 1; compiled code needs to know it.
        stride: Distance between two of them.
    """
    offset = (length - 1) * stride
    if length == 1:

        def load(array: Any, start: int) -> Any:
            return (array[start],)

    else:
        others = tuple_loader(length - 1, stride)

        def load(array: Any, start: int) -> Any:
            # Not (*others, x): compilers of Python 3.10 to 3.12 spell that differently, and numba follows late.
            return others(array, start) + (array[start + offset],)  # noqa: RUF005

    return numba.njit(load, forceinline=True, no_cfunc_wrapper=True)
