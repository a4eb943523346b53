"""Compiles the plant's scalar functions with numba, on request for many plants at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba

from pendulum_msgs_py.loops.trees import WITHIN, compile_to_tell, tuple_loader
from pendulum_msgs_py.loops.trees import compile_tree as _compile_tree
from pendulum_sim.batches import vector_math

__all__ = ["WITHIN", "compile_to_tell", "compile_tree", "tuple_loader"]

# What compiled code finds under the name ``math``; its attributes must be compiled themselves.
_vector_module = ModuleType("vector_math_compiled")
_vector_module.sin = numba.njit(vector_math.sin, fastmath={"contract"}, forceinline=True)  # type: ignore[attr-defined]
_vector_module.cos = numba.njit(vector_math.cos, fastmath={"contract"}, forceinline=True)  # type: ignore[attr-defined]
_vector_module.exp = math.exp  # type: ignore[attr-defined]


def compile_tree(function: Callable[..., Any], *, vector: bool = False, inline: bool = False) -> Any:
    """Return a function, and those it calls, compiled.

    Args:
        function: A plain function of this project that uses scalars, tuples and ``math``.
        vector: Take ``pendulum_sim.batches.vector_math`` in place of ``math``, and inline each function.
        inline: Inline each function, a compiled one: machine code without function arguments can be cached on disk.
    """
    substitutes = {math: _vector_module} if vector else {}
    return _compile_tree(function, inline=inline or vector, substitutes=substitutes, within=inline)
