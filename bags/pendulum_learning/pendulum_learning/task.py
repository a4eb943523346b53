"""The task and the variations of plant, delay, noise and kicks that make a policy transfer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["VARIED", "SwingUpTask", "ranges_of"]

VARIED = ("inertia", "damping", "gravity", "coulomb_friction")
"""Parameters that vary between episodes; static friction has a fixed ratio to Coulomb friction."""
_OF_JOINTS = ("damping", "coulomb_friction")
_FIXED = ("gravity", "pole_length", "gear_ratio")
"""Parameters that are known exactly, or have no effect."""
_POSITIVE = ("period", "rate_time", "episode", "travel")


@dataclass(frozen=True)
class SwingUpTask:
    """Swing up from anywhere and hold upright.

    Attributes:
        period: Time between two commands [s].
        share: Half width of each parameter's range, as a share of its value, unless the plant file's is wider [-].
        delay: Longest mean delay from state to torque, drawn from 0 up to this in each episode [s].
        jitter: Standard deviation of the delay from command to command [s].
        angle_noise: Standard deviation of measured angles [rad].
        velocity_noise: Standard deviation of measured velocities [rad/s].
        offset: Largest error of the zero angle [rad], and of the torque as a share of the limit [-].
        kick: Largest torque on the link, as a share of the torque limit; a kick lasts 50 ms [-].
        rate_time: Least time for the torque to go from one limit to the other [s].
        travel: Largest deviation of a joint that slides [m].
        episode: Length of an episode [s].
    """

    period: float = 0.01
    share: float = 0.25
    delay: float = 0.008
    jitter: float = 0.001
    angle_noise: float = 1e-3
    velocity_noise: float = 0.03
    offset: float = 0.01
    kick: float = 0.7
    kick_rate: float = 0.5
    rate_time: float = 0.05
    history: int = 3
    travel: float = 0.4
    episode: float = 6.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name in _POSITIVE):
                raise ParameterError(f"{name} is {value}; expected a finite number >= 0 (> 0 for times and travel)")
        if not 1 <= self.history <= 50:
            raise ParameterError(f"history is {self.history}; expected 1 to 50 samples")
        if self.share >= 1.0:
            raise ParameterError(f"share is {self.share}; expected less than 1")
        if self.delay + 4.0 * self.jitter > 2.0 * self.period:
            raise ParameterError(
                f"delay is {self.delay} s with a jitter of {self.jitter} s; expected two periods, "
                f"{2.0 * self.period:g} s, at most"
            )


def ranges_of(
    plant: PlantParameters, share: float, intervals: Mapping[str, Sequence[float]]
) -> dict[str, tuple[float, float]]:
    """Return the range of each parameter that varies in training, by name; gravity does not.

    ``share`` is the half width as a share of the value [-], ``intervals`` are those of the plant file.
    """
    if not plant.is_pendulum:
        numbers = plant.numbers
        varied = [name for name in numbers if name not in _FIXED and _varies(name)]
    else:
        numbers = {name: plant.value(name) for name in (*VARIED, "static_friction")}
        varied = list(VARIED)
    found = {}
    for name in varied:
        value = numbers[name]
        low, high = intervals.get(name, (value, value))
        found[name] = (max(0.0, min(low, (1.0 - share) * value)), max(high, (1.0 + share) * value))
    for coulomb in [name for name in varied if name.endswith("coulomb_friction")]:
        static = f"{coulomb.removesuffix('coulomb_friction')}static_friction"
        ratio = numbers[static] / numbers[coulomb] if static in numbers and numbers[coulomb] else 0.0
        if ratio:
            low, high = found[coulomb]
            found[static] = (ratio * low, ratio * high)
    return {name: pair for name, pair in found.items() if pair[0] < pair[1]}


def _varies(name: str) -> bool:
    joint, _, key = name.rpartition(".")
    return not joint or key in _OF_JOINTS
