"""Compiles the project's scalar functions with numba, from the code that is also interpreted."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

from pendulum_msgs_py.programs.kernel_cache import name_symbols_apart

__all__ = ["WITHIN", "compile_by_type", "compile_tree", "tuple_loader"]

# Installed by the packages that compile, simulator and control.
numba = importlib.import_module("numba")
# What is compiled here becomes part of cached kernels.
name_symbols_apart()

WITHIN = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""``numba.njit`` options of functions called by compiled ones only: wrappers take time to compile."""
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
    """Return a plain function of scalars, tuples and ``math``, and all of this project's that it calls, compiled.

    Args:
        function: The function.
        exact: Give the bits that Python gives; else a fused multiply-add may change the last one.
        inline: Inline each function: machine code without function arguments can be cached on disk.
        substitutes: Replacements of modules that the functions use.
        within: Only compiled functions call it.
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
        allowed = False if exact else {"contract"}
        # Loops borrow their arrays: no reference counting (_nrt). C wrappers, never called, would take time to compile.
        wrappers = WITHIN if within else {"no_cfunc_wrapper": True}
        options = {"fastmath": allowed, "error_model": "numpy", "forceinline": inline, "_nrt": not exact}
        _cache[key] = numba.njit(copy, **wrappers, **options)
    return _cache[key]


def compile_by_type(function: Callable[..., Any]) -> Any:
    """Return a compiled function that compiled code passes by its type.

    Numba passes a function by its address, and machine code with addresses cannot be cached on disk unless each
    function that takes one is inlined.
    """
    compiled = compile_tree(function)

    def by_type(*arguments: Any) -> Any:
        return function(*arguments)

    options = {key: compiled.targetoptions[key] for key in ("fastmath", "error_model")}
    numba.extending.overload(by_type, jit_options=options, strict=False)(lambda *_: compiled.py_func)
    return by_type


@cache
def tuple_loader(length: int, stride: int) -> Any:
    """Return compiled (array, start) -> (array[start], array[start + stride], ...), of ``length`` >= 1 values."""
    if length == 1:

        def load(array: Any, start: int) -> Any:
            return (array[start],)

    else:
        # By halves: few lengths, and each is a function to compile.
        half = length // 2
        first, second = tuple_loader(half, stride), tuple_loader(length - half, stride)
        offset = half * stride

        def load(array: Any, start: int) -> Any:
            # Not (*first, *second): its bytecode differs between Python 3.10 and 3.12, and numba follows late.
            return first(array, start) + second(array, start + offset)

    return numba.njit(load, forceinline=True, **WITHIN)
