"""Recordings of a known pendulum, to test identification and excitation against the truth.

The integrator is not that of the fit: RK4 with small steps on the shared equations of motion, dry friction
smoothed over 1e-4 rad/s, so that a fault of the fit's kernel cannot cancel in the test.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.dynamics import friction_magnitude, rigid_acceleration
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["multisine", "synthetic_recording"]

Array = NDArray[np.float64]

_acceleration = njit(cache=True)(rigid_acceleration)
_friction = njit(cache=True)(friction_magnitude)


@njit(cache=True)
def _integrate(effort: Array, period: float, substeps: int, delay: float, state: Array, plant: Array) -> Array:
    inertia, damping, gravity, coulomb, static, stribeck, load, offset, angle, drag, a_2, b_2, a_3, b_3 = plant
    h = period / substeps
    theta, omega = state[0], state[1]
    out = np.zeros((effort.size, 2))
    for i in range(effort.size):
        out[i, 0], out[i, 1] = theta, omega
        for sub in range(substeps):
            at = math.floor((i + (sub + 0.5) / substeps) - delay / period + 1e-9)
            u = effort[max(at, 0)]
            k_theta, k_omega = 0.0, 0.0
            a, b, last_t, last_w = theta, omega, 0.0, 0.0
            for stage in range(4):
                if stage > 0:
                    step = h if stage == 3 else 0.5 * h
                    a, b = theta + step * last_t, omega + step * last_w
                dry = _friction(b, coulomb, static, stribeck) + load * abs(gravity * math.sin(a - angle))
                net = u + offset - dry * math.tanh(b / 1e-4) - drag * b * abs(b)
                x = a - angle
                net += a_2 * math.cos(2 * x) + b_2 * math.sin(2 * x) + a_3 * math.cos(3 * x) + b_3 * math.sin(3 * x)
                last_t, last_w = b, _acceleration(a - angle, b, net, inertia, damping, gravity)
                weight = 1.0 / 3.0 if stage in (1, 2) else 1.0 / 6.0
                k_theta += weight * last_t
                k_omega += weight * last_w
            theta += h * k_theta
            omega += h * k_omega
    return out


def multisine(time: Array, amplitude: float, rng: np.random.Generator, *, tones: int = 8, top: float = 3.0) -> Array:
    """Return a sum of sines of random phase between 0.2 Hz and ``top`` [Hz], peak ``amplitude``; shape of ``time``."""
    frequency = np.geomspace(0.2, top, tones)
    phase = rng.uniform(0.0, 2.0 * np.pi, tones)
    signal = np.sin(2.0 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)
    return np.asarray(amplitude * signal / np.max(np.abs(signal)))


def synthetic_recording(
    plant: PlantParameters,
    effort: Array,
    period: float,
    rng: np.random.Generator,
    *,
    noise: float = 1e-3,
    resolution: float = 0.0,
    start: tuple[float, float] = (0.0, 0.0),
) -> Recording:
    """Return what a sensor would record of a plant under a held effort.

    Args:
        plant: The truth, rigid.
        effort: Held from sample to sample, shape (n,) [N m].
        period: Sampling period [s].
        rng: For the noise.
        noise: Standard deviation of the angle [rad].
        resolution: Step of the encoder [rad]; 0 for none.
        start: Angle [rad] and velocity [rad/s] at the first sample.
    """
    values = np.array(
        [
            plant.inertia,
            plant.damping,
            plant.gravity,
            plant.coulomb_friction,
            plant.static_friction,
            plant.stribeck_velocity,
            plant.load_friction,
            plant.torque_offset,
            plant.angle_offset,
            plant.quadratic_drag,
            plant.torque_cos_2,
            plant.torque_sin_2,
            plant.torque_cos_3,
            plant.torque_sin_3,
        ]
    )
    # The smoothed friction is stiff: its rate is torque over (inertia times 1e-4 rad/s).
    dry = plant.static_friction + plant.load_friction * plant.gravity
    rate = max(dry / plant.inertia / 1e-4, plant.damping / plant.inertia, 1.0)
    substeps = max(10, math.ceil(period * rate / 2.0))
    clean = _integrate(
        np.asarray(effort, dtype=float), period, substeps, plant.transport_delay, np.array(start), values
    )
    position = clean[:, 0] + noise * rng.standard_normal(len(clean))
    if resolution > 0.0:
        position = resolution * np.round(position / resolution)
    return Recording(
        period * np.arange(len(clean), dtype=np.float64),
        position,
        None,
        effort,
        hold="zero",
        meta={"source": "synthetic", "plant": plant.name},
    )
