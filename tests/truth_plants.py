"""Pendulums under a controller and noise, by numpy and scipy alone: the estimators and their judge share no code."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numba
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
        jitter: Each run has a delay of its own beside ``late``, uniform and less than this: the phase of two loops [s].
        slips: Probability with which a state has no reply in time, and the command before it goes on.
    """

    inertia: float = 0.055
    damping: float = 11.77
    gravity: float = 1.678
    gain: float = 1.0
    late: float = 0.0
    dry: float = 0.0
    rate: float = 100.0
    noise: float = 0.0
    jitter: float = 0.0
    slips: float = 0.0

    def run(
        self,
        noise: NDArray[Any],
        count: int,
        seed: int = 0,
        *,
        errors: NDArray[Any] | None = None,
        steps: int | None = None,
        dense: bool = False,
    ) -> NDArray[Any]:
        """Return angle from upright, velocity and torque of the controller at each state, shape (trials, n, 3).

        Args:
            noise: Torque of each hold, shape (trials, holds) [N m].
            count: States.
            seed: Of the measurement noise, the phases and the slips.
            errors: Of the measured velocity instead, shape (trials, count) [rad/s].
            steps: Delay by the phase of every run instead, in steps of the integration.
            dense: Return all steps of the integration, not only the states.
        """
        trials, every = len(noise), round(1.0 / self.rate / STEP)
        rng = np.random.default_rng([3, seed])
        if errors is None:
            errors = self.noise * rng.standard_normal((trials, count)) if self.noise else np.zeros((trials, count))
        phases = rng.integers(max(1, round(self.jitter / STEP)), size=trials)
        late = round(self.late / STEP) + (phases if steps is None else np.full(trials, steps))
        slips = rng.random((trials, count)) < self.slips if self.slips else np.zeros((trials, count), dtype=bool)
        block = np.zeros((3, 3))
        block[:2, :2] = [[0.0, 1.0], [self.gravity / self.inertia, -self.damping / self.inertia]]
        block[1, 2] = 1.0 / self.inertia
        exact = scipy.linalg.expm(block * STEP)
        out = np.empty((trials, count * every if dense else count, 3))
        values = self.gravity, self.gain, self.dry
        _integrate(noise, errors, slips, late, exact, values, GAIN, (every, round(HOLD / STEP), dense), out)
        return out


@numba.njit(cache=True)
def _integrate(noise, errors, slips, late, exact, values, gains, counts, out) -> None:
    """Fill in the motions; Coulomb friction sticks where it can hold."""
    gravity, gain, dry = values
    every, held, dense = counts
    for k in range(len(noise)):
        angle = velocity = command = 0.0
        waiting = np.zeros(late[k] + 1)
        for i in range(errors.shape[1] * every):
            measured = velocity + errors[k, i // every]
            if i % every == 0 and not slips[k, i // every]:
                command = -gains[0] * angle - gains[1] * measured
            if dense or i % every == 0:
                row = i if dense else i // every
                out[k, row, 0], out[k, row, 1], out[k, row, 2] = angle, measured, command
            waiting[i % len(waiting)] = gain * (command + noise[k, i // held])
            torque = waiting[(i + 1) % len(waiting)]
            free = gravity * angle + torque
            if dry > 0.0:
                if velocity == 0.0 and abs(free) <= dry:
                    continue
                torque -= dry * np.sign(velocity if velocity != 0.0 else free)
            next_angle = exact[0, 0] * angle + exact[0, 1] * velocity + exact[0, 2] * torque
            after = exact[1, 0] * angle + exact[1, 1] * velocity + exact[1, 2] * torque
            angle = next_angle
            velocity = 0.0 if dry > 0.0 and velocity != 0.0 and after * velocity < 0.0 else after


@dataclass(frozen=True)
class PlantPair:
    """A simulation and a machine, which is sampled as seldom or more so, under noise that each sample inherits from.

    Args:
        simulation: Without measurement noise.
        hardware: The machine.
        amplitude: Largest innovation of the noise [N m].
        colour: Share of a noise sample that the next one inherits; 0 for white noise.
    """

    simulation: Plant
    hardware: Plant
    amplitude: float = AMPLITUDE
    colour: float = 0.0

    @property
    def is_random(self) -> bool:
        """Whether runs of the machine differ by more than their noise."""
        return self.hardware.jitter > 0.0 or self.hardware.slips > 0.0

    def noise(self, seed: int, duration: float) -> NDArray[Any]:
        """Return one value for each hold [N m]."""
        size = round(duration / HOLD) + 1
        innovations = np.random.default_rng([7, seed]).uniform(-self.amplitude, self.amplitude, size)
        return self._coloured(innovations)

    def _coloured(self, innovations: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(scipy.signal.lfilter([1.0], [1.0, -self.colour], innovations))

    def runs(self, seeds: range, duration: float, *, apart: bool = False) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return both motions of each trial, shape (trials, n, 3), each at its own rate.

        Args:
            seeds: One for each trial.
            duration: [s].
            apart: The machine has noise of its own.
        """
        noise = np.stack([self.noise(seed, duration) for seed in seeds])
        other = np.stack([self.noise(OTHER + seed, duration) for seed in seeds]) if apart else noise
        first, second = (
            plant.run(values, round(duration * plant.rate), seed)
            for plant, values, seed in (
                (self.simulation, noise, 2 * seeds[0]),
                (self.hardware, other, 2 * seeds[0] + 1),
            )
        )
        return first, second

    def truth(self, *, apart: bool = False) -> dict[str, float]:
        """Return what a run without end would have, by the names of the tests; of runs that differ, the mean over runs.

        Of linear plants exactly, from the energy of the responses to one sample of each noise, and with what slips add
        under 100 s of one noise with and without them at each phase; of others from 20 000 s.

        Args:
            apart: Of runs that share no noise, with no delay to take out.
        """
        hardware = self.hardware
        even = replace(self, hardware=replace(hardware, slips=0.0))
        own = np.zeros(3)
        pulse = np.zeros(round(2.0 * _PULSE / HOLD) + 1)
        if hardware.noise and not hardware.dry:
            errors = np.zeros((1, round(2.0 * _PULSE * hardware.rate)))
            errors[0, errors.size // 4] = hardware.noise
            own = (_limited(even.hardware.run(0.0 * pulse[None], errors.size, errors=errors)[0]) ** 2).sum(axis=0)
        found = []
        phases = round(hardware.jitter / STEP)
        for steps in range(max(1, phases)):
            if hardware.dry:
                moments = np.mean([self._long(seed, steps) for seed in range(10**6, 10**6 + 200)], axis=0)
            else:
                pulse[pulse.size // 4] = self.amplitude / np.sqrt(3.0 * hardware.rate * HOLD)
                moments = even._moments(self._coloured(pulse), 0, steps, 0)
                moments[2] += own
            figures = _figures(moments, apart)
            if hardware.slips:
                slips, none = (_figures(pair._long(10**6 + steps, steps), apart) for pair in (self, even))
                figures = {name: value + slips[name] - none[name] for name, value in figures.items()}
            found.append(figures)
        # With the delay left in, the intervals of a machine whose runs differ are of these runs.
        names = [name for name in found[0] if phases == 0 or "distance" not in name or "less" in name]
        mean = {name: float(np.mean([one[name] for one in found])) for name in names}
        return {name: float(np.exp(value)) if "ratio" in name else value for name, value in mean.items()}

    def _long(self, seed: int, steps: int) -> NDArray[Any]:
        return self._moments(self.noise(seed, 104.0), seed, steps, round(2.0 * self.hardware.rate))

    def _moments(self, noise: NDArray[Any], seed: int, steps: int, pause: int) -> NDArray[Any]:
        """Return squares of the simulation, products and squares of the machine, shape (3, lags, 3).

        Args:
            noise: Torque of each hold [N m].
            seed: Of the measurement noise.
            steps: Delay by the phase, in steps of the integration.
            pause: States at begin and end that do not count; 0 for the response to a pulse, of which the sum is taken.
        """
        plants, rate = (self.simulation, self.hardware), self.hardware.rate
        count, phases = len(noise) - 1, round(1.0 / rate / STEP)
        if not pause:
            plants = self.simulation, replace(self.hardware, noise=0.0)
        dense = plants[0].run(noise[None], round(count * HOLD * plants[0].rate), dense=True)[0]
        machine = _limited(plants[1].run(noise[None], round(count * HOLD * rate), seed, steps=steps)[0])
        seen = _limited(dense.reshape(len(machine), phases, 3).swapaxes(0, 1))
        edge = max(pause, 10)
        b = machine[edge:-edge]
        found = np.empty((3, _LAGS.size, 3))
        for i, lag in enumerate(_LAGS):
            late = -(lag // -phases)
            a = seen[-lag % phases, edge - late : len(machine) - edge - late]
            found[:, i] = (a**2).sum(axis=0), (a * b).sum(axis=0), (b**2).sum(axis=0)
        return found / (len(b) if pause else 1.0)


_LAGS = np.arange(-40, 81)
"""Lags of the truth in steps of the integration: multiples of a step."""


def _limited(motion: NDArray[Any], rate: float = 100.0) -> NDArray[Any]:
    sections = scipy.signal.butter(4, BAND, fs=rate, output="sos")
    return np.asarray(scipy.signal.sosfiltfilt(sections, motion, axis=-2, padlen=round(3.0 * rate / BAND)))


def _parabola(share: float) -> NDArray[Any]:
    """Return the weights of three values in a row at a share of a step from the middle one."""
    return np.array([0.5 * share * (share - 1.0), 1.0 - share**2, 0.5 * share * (share + 1.0)])


def _top(values: NDArray[Any], middle: int) -> tuple[int, float, float]:
    """Return the middle, the share of a step from there and the value of the top of the parabola about it."""
    three = values[middle - 1 : middle + 2]
    left, centre, right = three
    bend = left - 2.0 * centre + right
    share = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend < 0.0 else float(np.sign(right - left))
    return middle, share, float(_parabola(share) @ three)


def _figures(moments: NDArray[Any], apart: bool) -> dict[str, float]:
    """Return the logarithms of the ratios of spreads, the distances [% of the hardware's spread] and the delay [ms]."""
    zero = int(np.flatnonzero(_LAGS == 0)[0])
    likeness = moments[1, :, 1] / np.sqrt(moments[0, :, 1])
    best = int(np.argmax(likeness))
    # Parabolas through three lags; none across the kink where a sample of the simulation meets a change of the noise.
    middles = [best] if _LAGS[best] % round(HOLD / STEP) else [best - 1, best + 1]
    tops = [_top(likeness, middle) for middle in middles]
    middle, share, _ = (zero, 0.0, 0.0) if apart else max(tops, key=lambda top: top[2])
    weights = _parabola(share)
    late = np.einsum("l,kli->ki", weights, moments[:, middle - 1 : middle + 2])
    found = {
        f"spread of {name} (ratio)": float(0.5 * np.log(late[2, i] / late[0, i]))
        for i, name in enumerate(("angle", "velocity", "torque"))
    }
    found["mean angle difference"] = 0.0
    if not apart:
        found["delay"] = float(1e3 * STEP * (_LAGS[middle] + share))
        for note, (one, both, other) in (("", moments[:, zero]), (" less the delay", late)):
            for i, name in enumerate(("angles", "velocities")):
                apart_by = max(one[i] + other[i] - 2.0 * both[i], 0.0)
                found[f"distance of {name}{note}"] = float(100.0 * np.sqrt(apart_by / other[i]))
    return found


_NOISE = 0.004
"""Of an X5-9's velocity [rad/s]."""
OTHER = 10**8
"""Added to the seeds of noise that the other side does not share."""
_MACHINE, _SIMULATED = Plant(noise=_NOISE), Plant(rate=500.0)
PAIRS = {
    "gravity 10 for 1.678 N m": PlantPair(_SIMULATED, replace(_MACHINE, gravity=10.0)),
    "damping 15 % more": PlantPair(_SIMULATED, replace(_MACHINE, damping=13.5)),
    "gain 15 % more": PlantPair(_SIMULATED, replace(_MACHINE, gain=1.15)),
    "dry friction 0.1 N m": PlantPair(_SIMULATED, replace(_MACHINE, dry=0.1)),
    "one plant at two rates": PlantPair(_SIMULATED, _MACHINE),
    "4 ms of delay": PlantPair(_SIMULATED, replace(_MACHINE, late=0.004)),
    "a loop that oscillates": PlantPair(replace(_SIMULATED, damping=0.6), replace(_MACHINE, damping=0.75)),
}
COLOURED = {f"{name}, coloured noise": replace(PAIRS[name], colour=0.8) for name in list(PAIRS)[::2]}
"""The same where the noise is not white."""
REAL_TIME = {
    f"{name}, in real time": replace(PAIRS[name], hardware=replace(PAIRS[name].hardware, jitter=HOLD, slips=0.01))
    for name in list(PAIRS)[::2]
}
"""The same where each run has a phase of its own, and the machine misses states."""
POWER = {
    "one plant at two rates": PAIRS["one plant at two rates"],
    "10 ms of delay": PlantPair(_SIMULATED, replace(_MACHINE, late=0.010)),
    "gain 20 % more": PlantPair(_SIMULATED, replace(_MACHINE, gain=1.2)),
    "gain 20 % less": PlantPair(_SIMULATED, replace(_MACHINE, gain=0.8)),
    "twice the friction": PlantPair(_SIMULATED, replace(_MACHINE, damping=23.54)),
}
"""What a default run must call by its name."""
