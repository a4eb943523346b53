"""Recordings that determine a pendulum and such that do not, at random: the motions come from SciPy alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pendulum_bags.runs.datasets import Recording
from pendulum_testing.scipy_pendulum import sampled_pendulum, tones

__all__ = ["BAD", "GOOD", "Trial", "Truth", "make"]


@dataclass(frozen=True)
class Truth:
    """A pendulum: inertia [kg m^2], gravity [N m], damping [N m s/rad], Coulomb friction [N m]."""

    inertia: float
    gravity: float
    damping: float
    coulomb: float

    @property
    def frequency(self) -> float:
        """Natural frequency [rad/s]."""
        return float(np.sqrt(self.gravity / self.inertia))


@dataclass(frozen=True)
class Trial:
    """A recording, its truth, and how it is identified."""

    recording: Recording
    truth: Truth


def _truth(rng: np.random.Generator) -> Truth:
    inertia = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
    frequency = rng.uniform(3.0, 8.0)
    gravity = inertia * frequency**2
    ratio = np.exp(rng.uniform(np.log(0.005), np.log(0.1)))
    return Truth(inertia, gravity, 2.0 * ratio * inertia * frequency, rng.uniform(0.0, 0.04) * gravity)


def _record(
    rng: np.random.Generator,
    truth: Truth,
    command: Callable[[float, float, float], float],
    *,
    start: tuple[float, float] = (0.0, 0.0),
    seconds: float = 8.0,
    push: Callable[[float], float] | None = None,
) -> Recording:
    period, noise = float(rng.choice([0.005, 0.01])), float(np.exp(rng.uniform(np.log(2e-4), np.log(1.5e-3))))
    time = period * np.arange(round(seconds / period), dtype=np.float64)
    angle, torque = sampled_pendulum(
        command,
        time,
        rng.normal(0.0, noise, time.size),
        inertia=truth.inertia,
        damping=truth.damping,
        gravity=truth.gravity,
        coulomb=truth.coulomb,
        start=start,
        push=push,
    )
    return Recording(time, angle, None, torque, hold="zero")


def _pd(truth: Truth, goal: Callable[[float], float], stiffness: float, feedforward: bool) -> Callable:
    gain, rate = stiffness * truth.gravity, 0.7 * 2.0 * np.sqrt(stiffness * truth.gravity * truth.inertia)

    def command(t: float, angle: float, speed: float) -> float:
        ahead = truth.gravity * np.sin(goal(t)) if feedforward else 0.0
        return float(gain * (goal(t) - angle) - rate * speed + ahead)

    return command


def _nudge(rng: np.random.Generator, size: float, seconds: float) -> Callable[[float], float]:
    """Return an unrecorded push: a few gentle bumps."""
    at, wide = rng.uniform(0.4, 0.9, 3) * seconds, rng.uniform(0.15, 0.4, 3)
    high = rng.uniform(-1.0, 1.0, 3) * size
    return lambda t: float(np.sum(high * np.exp(-(((t - at) / wide) ** 2))))


# --- what determines ---------------------------------------------------------------------------------------------


def free_swing(rng: np.random.Generator) -> Trial:
    """A release from a large angle, without torque."""
    truth = _truth(rng)
    start = (rng.uniform(0.8, 2.5), 0.0)
    return Trial(_record(rng, truth, lambda t, q, v: 0.0, start=start, seconds=10.0), truth)


def multisine(rng: np.random.Generator) -> Trial:
    """A sum of sines of torque, open loop."""
    truth = _truth(rng)
    own = truth.frequency / (2.0 * np.pi)
    drive = tones(rng, rng.uniform(0.7, 1.2) * truth.gravity, lowest=0.2 * own, highest=2.0 * own)
    return Trial(_record(rng, truth, lambda t, q, v: float(drive(t))), truth)


def closed_loop(rng: np.random.Generator) -> Trial:
    """A PD that holds the pendulum, with noise torque added and recorded."""
    truth = _truth(rng)
    goal, bits = rng.uniform(-0.8, 0.8), rng.uniform(-1.0, 1.0, 200)
    hold = _pd(truth, lambda t: goal, rng.uniform(0.5, 2.0), True)
    size = rng.uniform(0.6, 1.0) * truth.gravity
    return Trial(_record(rng, truth, lambda t, q, v: hold(t, q, v) + size * bits[int(t / 0.08)]), truth)


def tracking(rng: np.random.Generator) -> Trial:
    """A PD that follows a large sum of sines."""
    truth = _truth(rng)
    own = truth.frequency / (2.0 * np.pi)
    path = tones(rng, rng.uniform(0.9, 1.4), lowest=0.2 * own, highest=1.2 * own)
    return Trial(_record(rng, truth, _pd(truth, lambda t: float(path(t)), rng.uniform(1.0, 4.0), False)), truth)


def staircase(rng: np.random.Generator) -> Trial:
    """The thesis's staircase: position held at angles through more than half a turn, quick moves between."""
    truth = _truth(rng)
    angles = np.linspace(-rng.uniform(1.2, 1.6), rng.uniform(1.2, 1.6), 6)

    def goal(t: float) -> float:
        index = min(int(t / 2.0), len(angles) - 1)
        before = angles[max(index - 1, 0)] if index else 0.0
        share = min((t - 2.0 * index) / 0.5, 1.0)
        return float(before + (angles[index] - before) * (3.0 * share**2 - 2.0 * share**3))

    return Trial(_record(rng, truth, _pd(truth, goal, 3.0, True), seconds=12.0), truth)


# --- what does not -----------------------------------------------------------------------------------------------


def held(rng: np.random.Generator) -> Trial:
    """A PD holds one set point; a hand nudges it, which no column records."""
    truth = _truth(rng)
    goal, size = rng.uniform(-0.6, 0.6), rng.uniform(0.02, 0.15) * truth.gravity
    hold = _pd(truth, lambda t: goal, rng.uniform(0.5, 3.0), bool(rng.integers(2)))
    start = (goal + rng.uniform(-0.1, 0.1), 0.0)
    return Trial(_record(rng, truth, hold, start=start, push=_nudge(rng, size, 8.0)), truth)


def small_staircase(rng: np.random.Generator) -> Trial:
    """A staircase whose steps are as small as what friction holds."""
    truth = _truth(rng)
    truth = Truth(truth.inertia, truth.gravity, truth.damping, 0.05 * truth.gravity)
    step, middle = rng.uniform(0.01, 0.03), rng.uniform(-0.3, 0.3)
    hold = _pd(truth, lambda t: middle + step * int(t / 1.5), 2.0, False)
    return Trial(_record(rng, truth, hold, start=(middle, 0.0), push=_nudge(rng, 0.03 * truth.gravity, 8.0)), truth)


def constant_torque(rng: np.random.Generator) -> Trial:
    """A torque that rises to a value and stays there, as at a limit; a hand nudges."""
    truth = _truth(rng)
    level, rise = rng.uniform(0.1, 0.4) * truth.gravity, rng.uniform(0.2, 1.0)
    push = _nudge(rng, rng.uniform(0.05, 0.2) * truth.gravity, 8.0)
    heavy = Truth(truth.inertia, truth.gravity, 3.0 * truth.damping, truth.coulomb)
    return Trial(_record(rng, heavy, lambda t, q, v: level * min(t / rise, 1.0), push=push), heavy)


def constant_throughout(rng: np.random.Generator) -> Trial:
    """A swing under one torque that never changes: as good as an offset."""
    truth = _truth(rng)
    level = rng.uniform(-0.4, 0.4) * truth.gravity
    return Trial(_record(rng, truth, lambda t, q, v: level, start=(rng.uniform(0.8, 1.8), 0.0)), truth)


def collinear(rng: np.random.Generator) -> Trial:
    """A torque proportional to a small angle: a spring, which no fit tells from gravity."""
    truth = _truth(rng)
    gain = rng.uniform(-0.5, 0.8) * truth.gravity
    start = (rng.uniform(0.1, 0.25), 0.0)
    return Trial(_record(rng, truth, lambda t, q, v: -gain * q, start=start), truth)


def dead_column(rng: np.random.Generator) -> Trial:
    """A driven motion whose column of torque is a constant (0 or a tare)."""
    made = multisine(rng)
    level = float(rng.choice([0.0, 0.03])) * made.truth.gravity
    r = made.recording
    return Trial(Recording(r.time, r.position, None, np.full(r.time.size, level), hold="zero"), made.truth)


def short_swing(rng: np.random.Generator) -> Trial:
    """A part of one small swing."""
    truth = _truth(rng)
    seconds = rng.uniform(0.15, 0.3) * 2.0 * np.pi / truth.frequency
    start = (rng.uniform(0.05, 0.3), 0.0)
    level = rng.uniform(0.0, 0.1) * truth.gravity
    return Trial(_record(rng, truth, lambda t, q, v: level, start=start, seconds=seconds), truth)


def one_step(rng: np.random.Generator) -> Trial:
    """One torque step within a slow creep: strong damping hides inertia and gravity."""
    truth = _truth(rng)
    heavy = Truth(truth.inertia, truth.gravity, 20.0 * truth.inertia * truth.frequency, truth.coulomb)
    level = rng.uniform(0.2, 0.5) * truth.gravity
    return Trial(_record(rng, heavy, lambda t, q, v: level if t > 0.2 else 0.0, seconds=1.5), heavy)


GOOD = (free_swing, multisine, closed_loop, tracking, staircase)
BAD = (
    held,
    small_staircase,
    constant_torque,
    constant_throughout,
    collinear,
    dead_column,
    short_swing,
    one_step,
)


def make(kind: Callable[[np.random.Generator], Trial], seed: int) -> Trial:
    """Return the recording of a kind with a number of its own."""
    return kind(np.random.default_rng([seed, *kind.__name__.encode()]))
