"""Compiles the plant's scalar functions with numba, on request for many plants at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any

import numba
import numpy as np

from pendulum_msgs_py.loops.trees import WITHIN, compile_by_type, tuple_loader
from pendulum_msgs_py.loops.trees import compile_tree as _compile_tree
from pendulum_sim.batches import vector_math

__all__ = ["WITHIN", "compile_by_type", "compile_tree", "tuple_loader"]


def compile_tree(function: Callable[..., Any], *, vector: bool = False, inline: bool = False, gpu: bool = False) -> Any:
    """Return a function, and those it calls, compiled.

    Args:
        function: A plain function of this project that uses scalars, tuples and ``math``.
        vector: Take ``pendulum_sim.batches.vector_math`` in place of ``math``, and inline each function.
        inline: Inline each function, a compiled one: machine code without function arguments can be cached on disk.
        gpu: Take the GPU's functions in place of the three of numpy that ``vector_math`` uses.
    """
    substitutes = (_gpu_numpy() if gpu else {}) | (_vector_math(gpu=gpu) if vector else {})
    return _compile_tree(function, inline=inline or vector, substitutes=substitutes, within=inline)


@cache
def _vector_math(*, gpu: bool) -> dict[ModuleType, ModuleType]:
    """Return what compiled code finds under the name ``math``; its attributes must be compiled themselves."""
    sin, cos = (
        _compile_tree(function, inline=True, substitutes=_gpu_numpy())
        if gpu
        else numba.njit(function, fastmath={"contract"}, forceinline=True)
        for function in (vector_math.sin, vector_math.cos)
    )
    return {math: _module("vector_math_compiled", sin=sin, cos=cos, exp=math.exp, sqrt=math.sqrt)}


@cache
def _gpu_numpy() -> dict[ModuleType, ModuleType]:
    """Return what code compiled for a GPU finds under the name ``np``: numba has no such functions of numpy there."""
    from numba import cuda

    @numba.njit(forceinline=True)
    def maximum(a: float, b: float) -> float:
        # NaN stays NaN, as with numpy.
        if b > a:
            return b
        return a

    floor, rint = cuda.libdevice.floor, cuda.libdevice.rint
    return {np: _module("gpu_numpy", floor=floor, rint=rint, maximum=maximum, pi=np.pi)}


def _module(name: str, **attributes: Any) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(attributes)
    return module
