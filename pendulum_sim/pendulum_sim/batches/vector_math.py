"""The few functions of ``math`` that the equations use, without branches, so that compiled loops become vector code.

The sine is its Taylor polynomial of degree 19 after reduction to [-pi/2, pi/2]. There the series alternates with
falling terms, so the truncation error is below the first term left out, (pi/2)^21 / 21! = 2.6e-16: less than rounding.
"""

from __future__ import annotations

import numpy as np

__all__ = ["cos", "sin", "wrap"]

_INVERSE_PI = 1.0 / np.pi
# pi in two parts: the first has 33 significant bits, so that its products with whole numbers up to 2^20 are exact.
_PI_HIGH = 3.1415926534682512
_PI_LOW = float(np.longdouble("3.14159265358979323846264338327950288") - np.longdouble(_PI_HIGH))
_TWO_PI = 2.0 * np.pi
_C3 = -1.0 / 6.0
_C5 = 1.0 / 120.0
_C7 = -1.0 / 5040.0
_C9 = 1.0 / 362880.0
_C11 = -1.0 / 39916800.0
_C13 = 1.0 / 6227020800.0
_C15 = -1.0 / 1307674368000.0
_C17 = 1.0 / 355687428096000.0
_C19 = -1.0 / 121645100408832000.0


def sin(x: float) -> float:
    """Return the sine, within 4e-16 for angles up to 1e4 rad.

    Args:
        x: Angle, scalar or array [rad].
    """
    turns = np.rint(x * _INVERSE_PI)
    r = (x - turns * _PI_HIGH) - turns * _PI_LOW
    # Every half turn changes the sign.
    r *= 1.0 - 2.0 * (turns - 2.0 * np.floor(0.5 * turns))
    s = r * r
    series = _C11 + s * (_C13 + s * (_C15 + s * (_C17 + s * _C19)))
    series = _C3 + s * (_C5 + s * (_C7 + s * (_C9 + s * series)))
    return r + r * s * series


def cos(x: float) -> float:
    """Return the cosine, within 4e-16 for angles up to 1e4 rad: the sine of the distance from its nearest zero.

    Args:
        x: Angle, scalar or array [rad].
    """
    turns = np.rint(x * _INVERSE_PI - 0.5)
    zero = turns + 0.5
    r = (x - zero * _PI_HIGH) - zero * _PI_LOW
    # Falling through the zeros of even number, rising through the odd ones.
    r *= 2.0 * (turns - 2.0 * np.floor(0.5 * turns)) - 1.0
    s = r * r
    series = _C11 + s * (_C13 + s * (_C15 + s * (_C17 + s * _C19)))
    series = _C3 + s * (_C5 + s * (_C7 + s * (_C9 + s * series)))
    return r + r * s * series


def wrap(angle: float) -> float:
    """Return the equivalent angle in [-pi, pi), bit for bit what lies there already, but for the last ulp before pi.

    Args:
        angle: Scalar or array [rad].
    """
    turned = angle - _TWO_PI * np.floor((angle + np.pi) / _TWO_PI)
    # The sum is rounded: just below an odd multiple of pi it may count as the turn above.
    return np.maximum(turned, -np.pi)
