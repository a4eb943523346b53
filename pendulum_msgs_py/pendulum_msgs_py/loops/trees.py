"""Compiles the project's scalar functions with numba, from the very code that is also interpreted.

Equations and rules stand once, in plain Python with ``math``. :func:`compile_tree` takes such a function with
everything it calls and returns it compiled; on request with another module in place of one that it uses.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

from pendulum_msgs_py.programs.kernel_cache import name_symbols_apart

__all__ = ["WITHIN", "compile_by_type", "compile_tree", "tuple_loader"]

# Simulator and control, which compile, install it; this package needs it nowhere else.
numba = importlib.import_module("numba")
# What is compiled here becomes part of cached kernels.
name_symbols_apart()

WITHIN = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options for ``numba.njit`` of a function that compiled ones alone call: wrappers for others take time to compile."""
_OWN = "pendulum_"
_NO_SUBSTITUTES: Mapping[ModuleType, ModuleType] = {}
_cache: dict[tuple[Any, ...], Any] = {}


def compile_tree(
    function: Callable[..., Any],
    *,
    exact: bool = False,
    inline: bool = False,
    substitutes: Mapping[ModuleType, ModuleType] = _NO_SUBSTITUTES,
    within: bool = False,
) -> Any:
    """Return a function, and those it calls, compiled.

    Args:
        function: A plain function of this project that uses scalars, tuples and ``math``.
        exact: Give the very bits that Python gives; else a fused multiply-add may change the last one.
        inline: Inline each function: machine code without function arguments can be cached on disk.
        substitutes: Modules that are found in place of those that the functions name.
        within: Compiled functions alone call it, as they do what it calls.
    """
    key = (function, exact, inline, within, *substitutes.items())
    if key not in _cache:
        assert isinstance(function, FunctionType)
        scope = dict(function.__globals__)
        for name in function.__code__.co_names:
            value = scope.get(name)
            if isinstance(value, FunctionType) and value.__module__.startswith(_OWN):
                scope[name] = compile_tree(value, exact=exact, inline=inline, substitutes=substitutes, within=True)
            elif isinstance(value, ModuleType) and value in substitutes:
                scope[name] = substitutes[value]
        copy = FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
        # Of fastmath nothing but contraction is allowed. C code calls none of these: a wrapper for it would only cost
        # time to compile.
        allowed = False if exact else {"contract"}
        # Loops borrow their arrays; without the option numba would count references in a law with a loop.
        wrappers = WITHIN if within else {"no_cfunc_wrapper": True}
        options = {"fastmath": allowed, "error_model": "numpy", "forceinline": inline, "_nrt": not exact}
        _cache[key] = numba.njit(copy, **wrappers, **options)
    return _cache[key]


def compile_by_type(function: Callable[..., Any]) -> Any:
    """Return a function, compiled by :func:`compile_tree`, for compiled functions to call or to take as an argument.

    Numba passes a compiled function by its address in this process, and machine code with addresses cannot be cached on
    disk unless each function that takes one is inlined: much to compile. What this returns is passed by its type alone.
    """
    compiled = compile_tree(function)

    def by_type(*arguments: Any) -> Any:
        return function(*arguments)

    options = {key: compiled.targetoptions[key] for key in ("fastmath", "error_model")}
    numba.extending.overload(by_type, jit_options=options, strict=False)(lambda *_: compiled.py_func)
    return by_type


@cache
def tuple_loader(length: int, stride: int) -> Any:
    """Return a compiled function (array, start) -> (array[start], array[start + stride], ...).

    Args:
        length: Values to load, >= 1; a constant of the compiled code.
        stride: Distance between two of them.
    """
    if length == 1:

        def load(array: Any, start: int) -> Any:
            return (array[start],)

    else:
        # By halves: each length that comes is a function to compile, and so they are few.
        half = length // 2
        first, second = tuple_loader(half, stride), tuple_loader(length - half, stride)
        offset = half * stride

        def load(array: Any, start: int) -> Any:
            # Not (*first, *second): compilers of Python 3.10 to 3.12 spell that differently, and numba follows late.
            return first(array, start) + second(array, start + offset)

    return numba.njit(load, forceinline=True, **WITHIN)
