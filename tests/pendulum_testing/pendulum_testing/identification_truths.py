"""Recordings of known pendulums as they come: noise with a memory, unrecorded torques, offsets, other friction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from pendulum_bags.identification.model import from_plant
from pendulum_bags.identification.result import IdentificationResult
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

__all__ = ["OUTSIDE", "PLANT", "TRUTHS", "Truth", "covered", "outside"]

Array = NDArray[np.float64]

PLANT = pendulum_plant(
    inertia=0.05, damping=0.03, gravity=1.5, coulomb_friction=0.05, angle_offset=0.01, transport_delay=0.006
)

NAMES = (
    "inertia",
    "damping",
    "gravity",
    "coulomb_friction",
    "angle_offset",
    "torque_offset",
    "transport_delay",
    *JOINT_TORQUES,
)


@dataclass(frozen=True)
class Truth:
    """A kind of recording whose truth is one of the candidates.

    Args:
        plant: The truth.
        amplitude: Peak of the multisine [N m].
        noise: White noise of the angle [rad].
        coloured: Standard deviation of noise with a memory of about 0.15 s [rad].
        torque: Standard deviation of a torque that is not in the recording, with a memory of 0.05 s [N m].
        resolution: Of the encoder [rad]; 0 for none.
    """

    plant: PlantParameters = PLANT
    amplitude: float = 1.2
    noise: float = 1e-3
    coloured: float = 0.0
    torque: float = 0.0
    resolution: float = 0.0

    def recording(self, seed: int, *, seconds: float = 6.0, period: float = 0.005) -> Recording:
        """Return one recording of it."""
        rng = np.random.default_rng(seed)
        time = period * np.arange(round(seconds / period), dtype=np.float64)
        effort = multisine(time, self.amplitude, rng)
        hidden = _memory(rng, time.size, self.torque, 0.05 / period)
        found = synthetic_recording(
            self.plant, effort + hidden, period, rng, noise=self.noise, resolution=self.resolution
        )
        position = found.position + _memory(rng, time.size, self.coloured, 0.15 / period)
        return replace(found, position=position, input=effort)


def _memory(rng: np.random.Generator, size: int, deviation: float, samples: float) -> Array:
    """Return noise of first order whose correlation falls by e within some samples, shape (size,)."""
    pole = float(np.exp(-1.0 / samples))
    white = deviation * np.sqrt(1.0 - pole**2) * rng.standard_normal(size + 10 * round(samples))
    return np.asarray(lfilter([1.0], [1.0, -pole], white)[-size:])


TRUTHS: Mapping[str, Truth] = {
    "white noise": Truth(),
    "coarse encoder": Truth(noise=0.0, resolution=2.0 * np.pi / 8192),
    "coloured noise": Truth(noise=1e-4, coloured=2e-3),
    "torque noise": Truth(noise=5e-4, torque=0.03),
    "both offsets": Truth(PLANT.with_values(torque_offset=0.03)),
    "both offsets near one angle": Truth(
        PLANT.with_values(torque_offset=-0.03, angle_offset=0.03, coulomb_friction=0.01), amplitude=0.3
    ),
    "Stribeck friction": Truth(PLANT.with_values(static_friction=0.09, stribeck_velocity=0.3)),
    "friction by load": Truth(PLANT.with_values(load_friction=0.04)),
    "quadratic drag": Truth(PLANT.with_values(quadratic_drag=0.02)),
    "twice the angle": Truth(PLANT.with_values(torque_cos_2=0.05, torque_sin_2=-0.2)),
    "three times the angle": Truth(PLANT.with_values(torque_cos_3=0.1, torque_sin_3=0.1)),
}
"""By name; the truth of each is among the candidates of `identify`."""

OUTSIDE: Mapping[str, Callable[[float, float, float], float]] = {
    "a gain that falls with the angle": lambda u, theta, _omega: -0.3 * u * float(np.sin(theta)) ** 2,
    "a friction that differs by direction": lambda _u, _theta, omega: -0.03 * abs(omega),
}
"""Torques [N m] of input [N m], angle [rad] and velocity [rad/s] that no candidate has."""


def outside(name: str, seed: int, *, seconds: float = 6.0, period: float = 0.005) -> Recording:
    """Return a recording of the plant with one of the torques of ``OUTSIDE``, which no candidate has."""
    rng = np.random.default_rng(seed)
    time = period * np.arange(round(seconds / period), dtype=np.float64)
    effort = multisine(time, 1.2, rng)
    extra = OUTSIDE[name]
    theta, omega, angles = 0.0, 0.0, []
    steps = 20
    for u in effort:
        angles.append(theta)
        for _ in range(steps):
            torque = u + extra(u, theta, omega) - PLANT.damping * omega - PLANT.gravity * float(np.sin(theta))
            omega += period / steps * torque / PLANT.inertia
            theta += period / steps * omega
    position = np.array(angles) + 1e-3 * rng.standard_normal(time.size)
    return Recording(time, position, None, effort, hold="zero", meta={"source": name})


def covered(result: IdentificationResult, plant: PlantParameters) -> dict[str, bool]:
    """Return by parameter whether its interval holds the truth; those without an interval are left out."""
    truth = from_plant(plant)
    values = {name: truth[name] for name in NAMES} | {"natural_frequency": truth.natural_frequency}
    found = result.uncertainty.intervals
    return {n: found[n].low <= value <= found[n].high for n, value in values.items() if n in found}
