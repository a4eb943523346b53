"""The scalar equations in another arithmetic.

With ``cmath`` in place of ``math`` they give exact derivatives (complex step), with ``numpy`` they take arrays, with
``casadi`` they become expressions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from types import FunctionType, ModuleType
from typing import Any

__all__ = ["complex_step", "in_arithmetic"]

_EQUATIONS = ("pendulum_msgs_py.dynamics", "pendulum_msgs_py.mechanisms", "pendulum_msgs_py.plants.friction_terms")
_STEP = 2.0**-64
"""Imaginary step: its square vanishes in any sum, and a power of two scales without rounding."""


@lru_cache(maxsize=64)
def in_arithmetic(function: Callable[..., Any], arithmetic: ModuleType) -> Callable[..., Any]:
    """Return a function of ``dynamics`` or ``mechanisms``, and all that it calls, with another module for ``math``."""
    assert isinstance(function, FunctionType)
    scope = dict(function.__globals__)
    for name in function.__code__.co_names:
        value = scope.get(name)
        if value is math:
            scope[name] = arithmetic
        elif isinstance(value, FunctionType) and value.__module__.startswith(_EQUATIONS):
            scope[name] = in_arithmetic(value, arithmetic)
    return FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)


def complex_step(function: Callable[..., Any], at: tuple[float, ...]) -> list[list[float]]:
    """Return the Jacobian of a function of n numbers at a point, exact to rounding: row i, column j is d f_i / d x_j.

    Source:
        Squire and Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40(1), 1998.
    """
    columns = []
    for j in range(len(at)):
        point = [complex(value, _STEP if i == j else 0.0) for i, value in enumerate(at)]
        columns.append([complex(value).imag / _STEP for value in function(*point)])
    return [list(row) for row in zip(*columns, strict=True)]
