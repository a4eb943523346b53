"""Disturbance torques as pure functions of (parameters, seed, time since the start).

Time is in integer nanoseconds and random signals are functions of (seed, sample index), so simulator, hardware and
replay get the same torque at the same time, at any loop rate. A random signal changes every ``hold_time``, which
affects the response more than the plant does, so it is always explicit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.disturbances.multisine import multisine_wave
from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, validate

__all__ = [
    "DISTURBANCES",
    "DISTURBANCE_SPECS",
    "Disturbance",
    "DisturbanceKind",
    "UniformNoise",
    "from_bag",
    "make_disturbance",
    "torques",
]

_MOST_BANDWIDTH = 0.25
"""Largest bandwidth of coloured noise per sample rate, up to which its -3 dB point is accurate [-]."""

# Taps (1-based) of maximum-length shift registers; P. Alfke, Xilinx XAPP 052, 1996, table 3.
_TAPS: dict[int, tuple[int, ...]] = {
    2: (2, 1), 3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4), 9: (9, 5), 10: (10, 7),
    11: (11, 9), 12: (12, 6, 4, 1), 13: (13, 4, 3, 1), 14: (14, 5, 3, 1), 15: (15, 14), 16: (16, 15, 13, 4),
}  # fmt: skip


Disturbance = Callable[[int], float]
"""From the time since the start [ns] to the torque [N m]; 0 before the start."""


def make_disturbance(values: Mapping[str, object], recorded: Disturbance | None = None) -> Disturbance:
    """Return the disturbance that parameters of ``DISTURBANCE_SPECS`` describe; others have defaults.

    Args:
        values: Parameters.
        recorded: Signal of kind ``from_bag``, made by :func:`from_bag`.

    Raises:
        ParameterError: A value is refused, or ``from_bag`` lacks its recording.
    """
    parameters = validate(DISTURBANCE_SPECS, values)
    if parameters["kind"] == "from_bag":
        if recorded is None:
            raise ParameterError("kind is 'from_bag' without a recording; expected a recorded disturbance")
        return recorded
    kind = DISTURBANCES[parameters["kind"]]
    if kind.random and not parameters["hold_time"] > 0.0:
        raise ParameterError(f"hold_time is 0 s; expected > 0 for the random kind {parameters['kind']}")
    hold_ns = round(parameters["hold_time"] * NANOSECONDS)
    if parameters["hold_time"] > 0.0 and hold_ns < 1:
        raise ParameterError(f"hold_time is {parameters['hold_time']} s; expected 0 or at least 1e-9 s")
    return kind.make(parameters, hold_ns)


def torques(disturbance: Disturbance, elapsed_ns: ArrayLike) -> NDArray[np.float64]:
    """Return the torques at many times since the start [ns], shape as given [N m]."""
    times = np.asarray(elapsed_ns, dtype=np.int64)
    flat = [disturbance(int(time)) for time in times.ravel()]
    return np.array(flat, dtype=np.float64).reshape(times.shape)


def from_bag(elapsed_ns: ArrayLike, values: ArrayLike) -> Disturbance:
    """Return the replay of a recorded torque: each value until the next; 0 before and after.

    The last value lasts as long as the one before.

    Args:
        elapsed_ns: Times since the start of the disturbance, increasing integers, shape (n,) [ns].
        values: Torques, shape (n,) [N m].

    Raises:
        DataError: Shapes differ, a value is not finite, or times do not increase.
    """
    times = np.asarray(elapsed_ns, dtype=np.int64)
    recorded = np.asarray(values, dtype=np.float64)
    if times.ndim != 1 or times.shape != recorded.shape or times.size == 0:
        raise DataError(
            f"recorded disturbance has times {times.shape} and torques {recorded.shape}; expected equal (n,)"
        )
    if not np.all(np.isfinite(recorded)):
        raise DataError("recorded disturbance holds a torque that is not finite")
    if np.any(np.diff(times) <= 0):
        index = int(np.argmax(np.diff(times) <= 0))
        raise DataError(
            f"recorded disturbance: time {times[index + 1]} ns follows {times[index]} ns; expected increasing"
        )
    end = int(times[-1] + (times[-1] - times[-2] if times.size > 1 else NANOSECONDS // 100))
    first = int(times[0])

    def torque(time_ns: int) -> float:
        if time_ns < first or time_ns >= end:
            return 0.0
        return float(recorded[int(np.searchsorted(times, time_ns, side="right")) - 1])

    return torque


@dataclass(frozen=True)
class UniformNoise:
    """Independent samples, uniform in [-amplitude, amplitude] [N m], each held for ``hold_ns`` [ns]."""

    seed: int
    amplitude: float
    hold_ns: int

    def __call__(self, time_ns: int) -> float:
        """Return the torque at a time since the start [N m]."""
        return 0.0 if time_ns < 0 else float(noise.uniform(self.seed, time_ns // self.hold_ns, self.amplitude))


def _uniform(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    return UniformNoise(p["seed"], p["amplitude"], hold_ns)


def _gaussian(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """White normal samples through a finite Gaussian window, so that sample i needs no history.

    The window exp(-t^2 / 2 sigma^2) has its -3 dB point at f = sqrt(ln 2) / (2 pi sigma); weights have unit energy.
    """
    amplitude, seed, bandwidth = p["amplitude"], p["seed"], p["bandwidth"]
    weights = [1.0]
    if bandwidth * hold_ns > _MOST_BANDWIDTH * NANOSECONDS:
        raise ParameterError(
            f"bandwidth is {bandwidth:g} Hz with hold_time {hold_ns / NANOSECONDS:g} s, whose samples would be white; "
            f"expected at most {_MOST_BANDWIDTH}/hold_time = {_MOST_BANDWIDTH * NANOSECONDS / hold_ns:g} Hz, or 0 for "
            "white noise"
        )
    if bandwidth > 0.0:
        sigma = math.sqrt(math.log(2.0)) / (2.0 * math.pi * bandwidth) * NANOSECONDS / hold_ns
        reach = math.ceil(4.0 * sigma)
        if reach > 5000:
            raise ParameterError(
                f"bandwidth is {bandwidth} Hz with hold_time {hold_ns / NANOSECONDS} s; expected a longer hold_time, "
                "of at least 1/20000 of the correlation time"
            )
        shape = [math.exp(-0.5 * (k / sigma) ** 2) if sigma > 0.0 else float(k == 0) for k in range(-reach, reach + 1)]
        energy = math.sqrt(sum(value * value for value in shape))
        weights = [value / energy for value in shape]

    def torque(time_ns: int) -> float:
        if time_ns < 0:
            return 0.0
        index = time_ns // hold_ns
        return amplitude * sum(weight * _normal(seed, index + offset) for offset, weight in enumerate(weights))

    return torque


def _normal(seed: int, index: int) -> float:
    """Return a standard normal number, a pure function of (seed, index), by Box and Muller from two uniform ones."""
    first = 0.5 * (1.0 + float(noise.uniform(seed, 2 * index, 1.0)))
    second = float(noise.uniform(seed, 2 * index + 1, math.pi))
    return math.sqrt(-2.0 * math.log(max(first, 1e-300))) * math.cos(second)


def _prbs(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Maximum-length binary sequence of a shift register."""
    amplitude, order = p["amplitude"], p["order"]
    length = 2**order - 1
    state = length
    bits = []
    for _ in range(length):
        bits.append(amplitude if state & 1 else -amplitude)
        feedback = 0
        for tap in _TAPS[order]:
            feedback ^= state >> (order - tap)
        state = (state >> 1) | ((feedback & 1) << (order - 1))
    shift = p["seed"] % length

    def torque(time_ns: int) -> float:
        return 0.0 if time_ns < 0 else bits[(time_ns // hold_ns + shift) % length]

    return torque


def _require_sampled(name: str, frequency: float, hold_ns: int) -> None:
    """Refuse a frequency that the held samples would alias (Shannon's limit)."""
    if 2.0 * frequency * hold_ns >= NANOSECONDS:
        raise ParameterError(
            f"{name} is {frequency:g} Hz with hold_time {hold_ns / NANOSECONDS:g} s, whose samples would show another "
            f"frequency; expected less than 0.5/hold_time = {0.5 * NANOSECONDS / hold_ns:g} Hz, or hold_time 0"
        )


def _held(signal: Callable[[float], float], hold_ns: int) -> Disturbance:
    def torque(time_ns: int) -> float:
        if time_ns < 0:
            return 0.0
        return signal((time_ns - time_ns % hold_ns if hold_ns else time_ns) / NANOSECONDS)

    return torque


def _sine(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Sine that starts at zero."""
    amplitude, omega = p["amplitude"], 2.0 * math.pi * p["frequency"]
    _require_sampled("frequency", p["frequency"], hold_ns)
    return _held(lambda t: amplitude * math.sin(omega * t), hold_ns)


def _multisine(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Periodic sum of cosines with random phases, whose largest torque is the amplitude."""
    omega, phases, scale = multisine_wave(p)
    _require_sampled("highest line", float(np.max(omega)) / (2.0 * math.pi), hold_ns)
    return _held(lambda t: scale * float(np.cos(omega * t + phases).sum()), hold_ns)


def _chirp(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Exponential sweep: equal time in every octave; Farina, AES 108th Convention, 2000, eq. 4."""
    amplitude, low, high, length = p["amplitude"], p["frequency"], p["frequency_end"], p["sweep_time"]
    _require_sampled("frequency", low, hold_ns)
    _require_sampled("frequency_end", high, hold_ns)
    rate = math.log(high / low) / length
    scale = 2.0 * math.pi * low

    def signal(t: float) -> float:
        t = t % length
        phase = scale * t if rate == 0.0 else scale * math.expm1(rate * t) / rate
        return float(amplitude * math.sin(phase))

    return _held(signal, hold_ns)


def _step(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Constant torque from start_time on."""
    amplitude, start = p["amplitude"], p["start_time"]
    return _held(lambda t: amplitude if t >= start else 0.0, hold_ns)


def _pulse_train(p: Mapping[str, Any], hold_ns: int) -> Disturbance:
    """Pulses of pulse_width, once per 1/frequency, alternating in sign."""
    amplitude, start, width, period = p["amplitude"], p["start_time"], p["pulse_width"], 1.0 / p["frequency"]
    if width > period:
        raise ParameterError(f"pulse_width is {width} s; expected at most 1/frequency = {period:g} s")

    if width * NANOSECONDS < hold_ns:
        raise ParameterError(
            f"pulse_width is {width:g} s with hold_time {hold_ns / NANOSECONDS:g} s, between whose samples a pulse may "
            "fall; expected at least hold_time, or hold_time 0"
        )

    def signal(t: float) -> float:
        if t < start:
            return 0.0
        # Rounding must not put a whole number of periods into the pulse before.
        count = math.floor((t - start) / period + 1e-9)
        if t - start - count * period >= width - 1e-12:
            return 0.0
        return float(amplitude if count % 2 == 0 else -amplitude)

    return _held(signal, hold_ns)


class DisturbanceKind(NamedTuple):
    """A kind of disturbance.

    Attributes:
        make: From the checked parameters and the hold time [ns] to the torque.
        random: Whether it is a sequence of samples, and so needs a hold time.
        parameters: Parameters of this kind alone.
    """

    make: Callable[[Mapping[str, Any], int], Disturbance]
    random: bool = False
    parameters: tuple[ParameterSpec, ...] = ()


DISTURBANCES: dict[str, DisturbanceKind] = {
    "uniform": DisturbanceKind(_uniform, random=True),
    "gaussian": DisturbanceKind(_gaussian, random=True),
    "sine": DisturbanceKind(_sine),
    "multisine": DisturbanceKind(_multisine),
    "chirp": DisturbanceKind(_chirp),
    "prbs": DisturbanceKind(_prbs, random=True),
    "step": DisturbanceKind(_step),
    "pulse_train": DisturbanceKind(_pulse_train),
}
"""Kinds that follow from parameters alone; ``from_bag`` is made by :func:`from_bag`."""

DISTURBANCE_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("kind", "uniform", "", "Shape of the torque.", choices=(*DISTURBANCES, "from_bag")),
    ParameterSpec("amplitude", 2.5, "N m", "Largest torque; the standard deviation for gaussian."),
    ParameterSpec("hold_time", 0.01, "s",
        "How long one sample is held; 0 for a sine, multisine, chirp, step or pulse train means a smooth signal.",
        minimum=0.0, maximum=3600.0),
    ParameterSpec("seed", 1, "-", "Seed of the random kinds and phases; shifts the sequence of prbs.", minimum=0,
        maximum=2**63 - 1),
    ParameterSpec("bandwidth", 10.0, "Hz", "Cut-off (-3 dB) of gaussian; 0 for white from sample to sample.",
        minimum=0.0),
    ParameterSpec("frequency", 1.0, "Hz",
        "Frequency of sine, start of chirp, lowest line of multisine, repetition of pulse_train.", minimum=0.0,
        exclusive_minimum=True),
    ParameterSpec("frequency_end", 10.0, "Hz", "Frequency at the end of a chirp, highest line of multisine.",
        minimum=0.0, exclusive_minimum=True),
    ParameterSpec("sweep_time", 10.0, "s", "Length of one chirp; it then starts again.", minimum=0.0,
        exclusive_minimum=True),
    ParameterSpec("order", 9, "-", "Length of prbs: repeats after 2^order - 1 samples.", minimum=2, maximum=16),
    ParameterSpec("signal_period", 4.0, "s",
        "Length of one period of multisine; its lines are odd multiples of 1/signal_period.", minimum=0.0,
        exclusive_minimum=True),
    ParameterSpec("lines", 40, "-", "Number of lines of multisine, at most.", minimum=1, maximum=10_000),
    ParameterSpec("start_time", 0.0, "s", "Time at which step and pulse_train begin.", minimum=0.0),
    ParameterSpec("pulse_width", 0.1, "s", "Length of each pulse of pulse_train.", minimum=0.0, exclusive_minimum=True),
    *(spec for kind in DISTURBANCES.values() for spec in kind.parameters),
)  # fmt: skip
"""Parameters of all kinds."""
