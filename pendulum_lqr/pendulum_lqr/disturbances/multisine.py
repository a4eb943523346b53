"""A multisine: a periodic sum of cosines with random phases, for measuring a frequency response.

Its power is on chosen lines, odd multiples of 1/period, so averaging over periods has no leakage, and differences
between periods are noise. Other lines are silent in a linear plant; power there shows nonlinearity, such as friction.
Source: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012, sections 2.7 and 4.3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError

__all__ = ["multisine_harmonics", "multisine_phases", "multisine_wave"]

_CANDIDATES = 32
"""Sets of random phases, of which the one with the smallest peak is used."""


def multisine_harmonics(parameters: Mapping[str, Any]) -> NDArray[np.int64]:
    """Return the excited lines as odd multiples of 1/signal_period, evenly spread over the octaves, shape (n,).

    Coinciding lines are merged. Reads ``signal_period`` [s], ``frequency``, ``frequency_end`` [Hz] and ``lines``.

    Raises:
        ParameterError: No odd multiple lies in the band.
    """
    period, count = float(parameters["signal_period"]), int(parameters["lines"])
    low, high = float(parameters["frequency"]), float(parameters["frequency_end"])
    if high < low:
        raise ParameterError(f"frequency_end is {high:g} Hz; expected >= frequency = {low:g} Hz")
    if high * period > 1e6:
        raise ParameterError(
            f"frequency_end is {high:g} Hz with signal_period {period:g} s; expected at most 10^6 lines up to it"
        )
    first = 2 * math.ceil((low * period * (1.0 - 1e-12) - 1.0) / 2.0) + 1
    last = 2 * math.floor((high * period * (1.0 + 1e-12) - 1.0) / 2.0) + 1
    first = max(first, 1)
    if last < first:
        raise ParameterError(
            f"no odd multiple of 1/signal_period = {1.0 / period:g} Hz lies between {low:g} and {high:g} Hz; "
            "expected a longer signal_period or a wider band"
        )
    wanted = np.geomspace(first, last, count)
    odd = 2 * np.round((wanted - 1.0) / 2.0).astype(np.int64) + 1
    return np.unique(np.clip(odd, first, last))


def multisine_phases(harmonics: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Return the phases of the lines, shape (n,) [rad]: the set with the smallest peak of 32 random ones."""
    n, size = harmonics.size, 1 << max(6, math.ceil(math.log2(8.0 * float(harmonics[-1]))))
    if size > 1 << 18:
        return noise.uniform_array(seed, 0, n, math.pi)
    best, phases = math.inf, np.zeros(n)
    for candidate in range(_CANDIDATES):
        tried = noise.uniform_array(seed, candidate * n, n, math.pi)
        peak = float(np.abs(_wave(harmonics, tried, size)).max())
        if peak < best:
            best, phases = peak, tried
    return phases


def multisine_wave(parameters: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return angular frequencies [rad/s], phases [rad] and the common amplitude a [N m] of the lines.

    ``amplitude`` is the largest torque of d(t) = a sum_k cos(omega_k t + phase_k).
    """
    harmonics = multisine_harmonics(parameters)
    phases = multisine_phases(harmonics, int(parameters["seed"]))
    size = 1 << max(8, min(18, math.ceil(math.log2(16.0 * float(harmonics[-1])))))
    peak = float(np.abs(_wave(harmonics, phases, size)).max())
    # Between raster points a sum of lines can exceed them by 1/cos(pi k/size) at most.
    peak /= math.cos(math.pi * float(harmonics[-1]) / size) if 4 * harmonics[-1] < size else 0.7
    omega = 2.0 * math.pi * harmonics.astype(np.float64) / float(parameters["signal_period"])
    return omega, phases, float(parameters["amplitude"]) / peak


def _wave(harmonics: NDArray[np.int64], phases: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Return one period of the sum of unit cosines on a raster, shape (size,)."""
    bins = np.zeros(size // 2 + 1, dtype=np.complex128)
    inside = harmonics < size // 2
    bins[harmonics[inside]] = 0.5 * size * np.exp(1j * phases[inside])
    return np.fft.irfft(bins, size)
