"""Angles of the pendulum: theta = 0 hangs down, theta = pi is upright, counter-clockwise is positive."""

from __future__ import annotations

import math
from typing import overload

import numpy as np
from numpy.typing import NDArray

__all__ = ["UPRIGHT", "deviation_from_upright", "from_upright", "wrap", "wrap_angle"]

UPRIGHT = math.pi
"""Angle of the inverted pendulum [rad]."""

_TWO_PI = 2.0 * math.pi


@overload
def wrap(angle: float) -> float: ...
@overload
def wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]: ...
def wrap(angle: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Return the equivalent angle in [-pi, pi) [rad], NaN if not finite; angles in range stay the same bit for bit."""
    if isinstance(angle, np.ndarray):
        with np.errstate(invalid="ignore"):
            turned = (angle + math.pi) % _TWO_PI - math.pi
        # The modulo of a tiny negative number rounds up to the modulus itself.
        turned = np.where(turned >= math.pi, -math.pi, turned)
        return np.where((angle >= -math.pi) & (angle < math.pi), angle, turned)
    return wrap_angle(angle)


def wrap_angle(angle: float) -> float:
    """Return :func:`wrap` of one angle [rad], also in compiled loops."""
    if -math.pi <= angle < math.pi:
        return angle
    if math.isinf(angle):
        return math.nan
    wrapped = (angle + math.pi) % _TWO_PI - math.pi
    return -math.pi if wrapped >= math.pi else wrapped


def deviation_from_upright(theta: float) -> float:
    """Return :func:`from_upright` of one angle [rad], also in compiled loops."""
    return wrap_angle(theta - UPRIGHT)


@overload
def from_upright(theta: float) -> float: ...
@overload
def from_upright(theta: NDArray[np.float64]) -> NDArray[np.float64]: ...
def from_upright(theta: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Return the deviation from upright that controllers use, wrap(theta - pi) [rad]."""
    return wrap(theta - UPRIGHT)
