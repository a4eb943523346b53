"""Pendulums under a controller and noise, by numpy and scipy alone: the estimators and their judge share no code."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

GAIN = (33.345265, 0.158993)
"""Gain of the thesis's design [N m/rad, N m s/rad]."""
HOLD = 0.01
"""Time for which a noise sample is held [s]."""
AMPLITUDE = 2.5
"""Largest noise torque [N m]."""
BAND = 20.0
"""Band of the comparison [Hz]."""
STEP = 0.0005
"""Step of the integration [s]."""
_PULSE = 8.0
"""Time after which the response to one noise sample has died out [s]."""


@dataclass(frozen=True)
class Plant:
    """A pendulum held upright, linear but for its friction.

    Args:
        inertia: [kg m^2].
        damping: [N m s/rad].
        gravity: [N m].
        gain: Torque that acts per torque that is commanded.
        late: Delay of the torque [s].
        dry: Dry friction [N m].
        rate: Of the states and of the loop [Hz].
        noise: Standard deviation of the measured velocity's noise [rad/s].
    """

    inertia: float = 0.055
    damping: float = 11.77
    gravity: float = 1.678
    gain: float = 1.0
    late: float = 0.0
    dry: float = 0.0
    rate: float = 100.0
    noise: float = 0.0

    def run(
        self, noise: NDArray[Any], count: int, seed: int = 0, *, errors: NDArray[Any] | None = None
    ) -> NDArray[Any]:
        """Return angle from upright, velocity and torque of the controller at each state, shape (trials, n, 3).

        Args:
            noise: Torque of each hold, shape (trials, holds) [N m].
            count: States.
            seed: Of the measurement noise.
            errors: Of the measured velocity instead, shape (trials, count) [rad/s].
        """
        trials, every, held = len(noise), round(1.0 / self.rate / STEP), round(HOLD / STEP)
        if errors is None:
            errors = self.noise * np.random.default_rng([3, seed]).standard_normal((trials, count))
        motion = np.array([[0.0, 1.0], [self.gravity / self.inertia, -self.damping / self.inertia]])
        block = np.zeros((3, 3))
        block[:2, :2], block[1, 2] = motion, 1.0 / self.inertia
        exact = scipy.linalg.expm(block * STEP)
        forward, push = exact[:2, :2].T, exact[:2, 2]
        state, command = np.zeros((trials, 2)), np.zeros(trials)
        waiting = [np.zeros(trials)] * round(self.late / STEP)
        out = np.empty((trials, count, 3))
        for i in range(count * every):
            if i % every == 0:
                k = i // every
                velocity = state[:, 1] + errors[:, k]
                command = -GAIN[0] * state[:, 0] - GAIN[1] * velocity
                out[:, k] = np.stack((state[:, 0], velocity, command), axis=1)
            torque = self.gain * (command + noise[:, i // held])
            if waiting:
                waiting.append(torque)
                torque = waiting.pop(0)
            state = self._rubbed(state, torque, forward, push) if self.dry else state @ forward + np.outer(torque, push)
        return out

    def _rubbed(
        self, state: NDArray[Any], torque: NDArray[Any], forward: NDArray[Any], push: NDArray[Any]
    ) -> NDArray[Any]:
        """Return the next state under Coulomb friction, which sticks where it can hold."""
        velocity = state[:, 1]
        free = self.gravity * state[:, 0] + torque
        stuck = (velocity == 0.0) & (np.abs(free) <= self.dry)
        friction = -self.dry * np.sign(np.where(velocity == 0.0, free, velocity))
        after = state @ forward + np.outer(torque + friction, push)
        after[(velocity != 0.0) & (after[:, 1] * velocity < 0.0), 1] = 0.0
        after[stuck] = state[stuck]
        return after


@dataclass(frozen=True)
class PlantPair:
    """A simulation and a machine, and what their comparison would find in a run without end."""

    simulation: Plant
    hardware: Plant
    amplitude: float = AMPLITUDE

    def noise(self, seed: int, duration: float) -> NDArray[Any]:
        """Return one value for each hold [N m]."""
        size = round(duration / HOLD) + 1
        return np.random.default_rng([7, seed]).uniform(-self.amplitude, self.amplitude, size)

    def runs(self, seeds: range, duration: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return both motions of each trial, shape (trials, n, 3), each at its own rate."""
        noise = np.stack([self.noise(seed, duration) for seed in seeds])
        first, second = (
            plant.run(noise, round(duration * plant.rate), seed)
            for plant, seed in ((self.simulation, 2 * seeds[0]), (self.hardware, 2 * seeds[0] + 1))
        )
        return first, second

    def truth(self) -> dict[str, float]:
        """Return the ratios of spreads and the distances [% of the hardware's spread], by name.

        Of linear plants exactly, from the energy of the responses to one sample of each noise; with dry friction from
        runs of 4000 s in all.
        """
        slow = min(self.simulation.rate, self.hardware.rate)
        skips = [round(plant.rate / slow) for plant in (self.simulation, self.hardware)]
        if self.hardware.dry or self.simulation.dry:
            a, b = (
                _limited(one[:, ::skip], slow)[:, round(2.0 * slow) :]
                for one, skip in zip(self.runs(range(10**6, 10**6 + 40), 102.0), skips, strict=True)
            )
            return _figures(*((x**2).mean(axis=(0, 1)) for x in (a, b, b - a)))
        plants = self.simulation, self.hardware
        holds = round(2.0 * _PULSE / HOLD)
        pulse = np.zeros((1, holds + 1))
        pulse[0, holds // 4] = 1.0
        driven = [
            _limited(replace(plant, noise=0.0).run(pulse, round(2.0 * _PULSE * plant.rate))[:, ::skip], slow)[0]
            for plant, skip in zip(plants, skips, strict=True)
        ]
        per_sample = self.amplitude**2 / 3.0 / (slow * HOLD)
        parts = [per_sample * (one**2).sum(axis=0) for one in (*driven, driven[1] - driven[0])]
        for side, (plant, skip) in enumerate(zip(plants, skips, strict=True)):
            own = np.zeros(3)
            # An error at any phase of the slower clock adds its share.
            for phase in range(skip if plant.noise else 0):
                errors = np.zeros((1, round(2.0 * _PULSE * plant.rate)))
                errors[0, errors.shape[1] // 4 // skip * skip + phase] = 1.0
                found = _limited(plant.run(np.zeros_like(pulse), errors.shape[1], errors=errors)[:, ::skip], slow)[0]
                own += plant.noise**2 * (found**2).sum(axis=0)
            parts[side] = parts[side] + own
            parts[2] = parts[2] + own
        return _figures(*parts)


def _limited(motion: NDArray[Any], rate: float) -> NDArray[Any]:
    sections = scipy.signal.butter(4, BAND, fs=rate, output="sos")
    return np.asarray(scipy.signal.sosfiltfilt(sections, motion, axis=1, padlen=round(3.0 * rate / BAND)))


def _figures(simulation: NDArray[Any], hardware: NDArray[Any], apart: NDArray[Any]) -> dict[str, float]:
    names = ("angle", "velocity", "torque")
    ratios = {f"spread of {name} (ratio)": float(np.sqrt(hardware[i] / simulation[i])) for i, name in enumerate(names)}
    distances = {
        f"distance of {name}": float(100.0 * np.sqrt(apart[i] / hardware[i]))
        for i, name in enumerate(("angles", "velocities"))
    }
    return {**ratios, **distances, "mean angle difference": 0.0}


_NOISE = 0.004
"""Of an X5-9's velocity [rad/s]."""
PAIRS = {
    "gravity 10 for 1.678 N m": PlantPair(Plant(rate=500.0), Plant(gravity=10.0, noise=_NOISE)),
    "damping 15 % more": PlantPair(Plant(rate=500.0), Plant(damping=13.5, noise=_NOISE)),
    "gain 15 % more": PlantPair(Plant(rate=500.0), Plant(gain=1.15, noise=_NOISE)),
    "dry friction 0.1 N m": PlantPair(Plant(rate=500.0), Plant(dry=0.1, noise=_NOISE)),
    "one plant at two rates": PlantPair(Plant(rate=500.0), Plant(noise=_NOISE)),
    "a loop that oscillates": PlantPair(Plant(rate=500.0, damping=0.6), Plant(damping=0.75, noise=_NOISE)),
}
