"""Noise as a pure function of (seed, index): sample i needs no earlier sample.

This is the only definition of the random torques, for the disturbance node, the batch engine and replay::

    uniform(seed, index, a) = a (2 U - 1),  U = (scramble(scramble(seed, 1), index) >> 11) / 2^53

The integer functions work modulo 2^64 and give the same bits for Python integers, ``uint64`` arrays and compiled
scalars.

Source: SplitMix64 in counter form: Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014,
with Stafford's variant 13 as finaliser.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.errors import ParameterError

__all__ = ["MAX_SEED", "scramble", "stream_key", "uniform", "uniform_array", "unit_interval"]

MAX_SEED = 2**64 - 1
"""Largest seed and largest index."""

_GAMMA = 0x9E3779B97F4A7C15
_MIX_1 = 0xBF58476D1CE4E5B9
_MIX_2 = 0x94D049BB133111EB
_MASK = 0xFFFFFFFFFFFFFFFF
_TWO_TO_MINUS_52 = 2.0**-52


def scramble(key: int, index: int) -> int:
    """Return 64 pseudorandom bits for a key and an index, both 0 to ``MAX_SEED``."""
    z = (key + index * _GAMMA) & _MASK
    z = ((z ^ (z >> 30)) * _MIX_1) & _MASK
    z = ((z ^ (z >> 27)) * _MIX_2) & _MASK
    return z ^ (z >> 31)


def unit_interval(bits: int) -> float:
    """Return 64 bits as a number in [-1, 1), in steps of 2^-52."""
    return (bits >> 11) * _TWO_TO_MINUS_52 - 1.0


def stream_key(seed: int) -> int:
    """Return the key of a seed's stream; raise a ParameterError for a seed outside 0 to ``MAX_SEED``."""
    if not 0 <= seed <= MAX_SEED:
        raise ParameterError(f"seed is {seed}; expected an integer from 0 to 2^64 - 1")
    return scramble(int(seed), 1)


def uniform(seed: int, index: int, amplitude: float) -> float:
    """Return sample ``index`` of a seed's uniform noise, in [-amplitude, amplitude), in the unit of the amplitude.

    Raises:
        ParameterError: Seed or index is outside 0 to ``MAX_SEED``.
    """
    if not 0 <= index <= MAX_SEED:
        raise ParameterError(f"noise index is {index}; expected an integer from 0 to 2^64 - 1")
    return amplitude * unit_interval(scramble(stream_key(seed), int(index)))


def uniform_array(seed: int, start: int, count: int, amplitude: float) -> NDArray[np.float64]:
    """Return samples ``start`` to ``start + count - 1``, shape (count,), equal to :func:`uniform` bit for bit.

    Raises:
        ParameterError: Seed or indices are outside 0 to ``MAX_SEED``, or the amplitude is not finite.
    """
    if start < 0 or count < 0 or start + count > MAX_SEED:
        raise ParameterError(f"noise samples {start} to {start + count}; expected 0 to 2^64 - 1")
    if not math.isfinite(amplitude):
        raise ParameterError(f"noise amplitude is {amplitude}; expected a finite number")
    indices = np.arange(count, dtype=np.uint64) + np.uint64(start)
    key = np.full(1, stream_key(seed), dtype=np.uint64)
    bits = scramble(key, indices)  # type: ignore[arg-type]  # arrays of uint64 wrap as the mask does
    return amplitude * unit_interval(bits)  # type: ignore[return-value]
