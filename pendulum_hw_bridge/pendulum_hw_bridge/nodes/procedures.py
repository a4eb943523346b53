"""The thesis's experiments on the actuator: a hand that turns the link, and the gravity staircase.

Experiment 1 (inertia, damping): the pendulum lies flat, PWM is 0, a hand moves it from 0 to pi and back, in both
directions, six trials. Experiment 2 (gravity): the pendulum hangs; steps of 10 degrees to 90 and back, then to -90 and
back, each a ramp and a hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pendulum_msgs_py.contract.trajectory import Trajectory, thesis_ramp
from pendulum_msgs_py.errors import ParameterError

__all__ = ["HAND_TRIALS", "HandMotion", "Phase", "hand_trials", "staircase", "staircase_angles"]

HAND_TRIALS = 6
"""Trials of experiment 1."""

_HAND_FEEL = 11.8
"""Feed-forward torque of the hand per velocity [N m s/rad]."""
_HAND_STIFFNESS = 15.0
_HAND_DAMPING = 0.2
_TREMOR_TONES = 6
_TREMOR_HERTZ = (0.3, 1.5)
_TREMOR_RADIANS = 0.05
_FASTEST = 1.05
"""Largest speed of the hand [rad/s]: at b = 11.77 N m s/rad it takes 12.4 N m; the actuator withstands 13 N m."""


@dataclass(frozen=True)
class HandMotion:
    """One trial of experiment 1: a hand turns the link from 0 to pi (or -pi), rests, and comes back.

    The hand follows a minimum-jerk path with a tremor of a few slow tones, by feed-forward and a soft correction: a
    stiff hand at 100 Hz would excite the spring.

    Attributes:
        direction: 1 for counter-clockwise first, -1 for clockwise.
        start: Angle at which the trial starts [rad].
        rest: Time at rest before, between and after the two strokes [s].
        strokes: Duration of each stroke [s].
        tremor: Amplitude [rad], frequency [Hz] and phase [rad] of each tone.
    """

    direction: int
    start: float
    rest: float
    strokes: tuple[float, float]
    tremor: tuple[tuple[float, float, float], ...]

    @property
    def duration(self) -> float:
        """Time of the whole trial [s]."""
        return 3.0 * self.rest + sum(self.strokes)

    def reference(self, time: float) -> tuple[float, float]:
        """Return the hand's reference angle [rad] and velocity [rad/s] at a time since the start [s]."""
        out, back = self.strokes
        since_out = time - self.rest
        since_back = since_out - out - self.rest
        distance = self.direction * math.pi
        if since_back > 0.0:
            share, rate = _minimum_jerk(since_back, back)
            share, rate = 1.0 - share, -rate
            envelope, slope = _envelope(since_back, back)
        else:
            share, rate = _minimum_jerk(since_out, out)
            envelope, slope = _envelope(since_out, out)
        tremor = sum(a * math.sin(math.tau * f * time + p) for a, f, p in self.tremor)
        tremor_rate = sum(a * math.tau * f * math.cos(math.tau * f * time + p) for a, f, p in self.tremor)
        return (
            self.start + distance * share + envelope * tremor,
            distance * rate + envelope * tremor_rate + slope * tremor,
        )

    def torque(self, time: float, position: float, velocity: float) -> float:
        """Return the hand's torque on the link [N m], by time since the start [s] and link state [rad, rad/s]."""
        wanted, wanted_rate = self.reference(time)
        correction = _HAND_STIFFNESS * (wanted - position) + _HAND_DAMPING * (wanted_rate - velocity)
        return _HAND_FEEL * wanted_rate + correction


@dataclass(frozen=True)
class Phase:
    """One phase of an experiment, as in the events of a bag.

    Attributes:
        name: ``dynamic`` for a ramp, ``static`` for a hold.
        trial: Number of the trial, from 1.
        angle: Angle reached or held [rad].
        upwards: Whether the step leads away from hanging down.
        trajectory: Ramp; for a hold a trajectory of one point.
        hold: Time to hold after the trajectory [s].
    """

    name: str
    trial: int
    angle: float
    upwards: bool
    trajectory: Trajectory
    hold: float


def hand_trials(seed: int, *, trials: int = HAND_TRIALS, start: float = 0.0) -> tuple[HandMotion, ...]:
    """Return the trials of experiment 1, alternating in direction, from an angle [rad].

    A trial depends on the seed alone, not on the number of trials.

    Source:
        Thesis, section "Determination of moment of inertia and damping": six trials, both directions.
    """
    if trials < 1:
        raise ParameterError(f"number of trials is {trials}; expected >= 1")
    return tuple(_hand_trial(seed, index, start) for index in range(trials))


def staircase_angles(step: float = 10.0, top: float = 90.0) -> tuple[float, ...]:
    """Return the angles of the staircase [rad]: 0 to ``top`` [deg] by ``step`` [deg], back, and the same to -top."""
    count = round(top / step) if step > 0.0 else 0
    if count < 1 or abs(count * step - top) > 1e-9 * top:
        raise ParameterError(f"staircase step is {step} deg and top {top} deg; expected top a multiple of step > 0")
    half = [*range(1, count + 1), *range(count - 1, -1, -1)]
    return tuple(math.radians(sign * step * index) for sign in (1.0, -1.0) for index in half)


def staircase(trial: int, *, step: float = 10.0, top: float = 90.0, hold: float = 2.0) -> Iterator[Phase]:
    """Yield the phases of a trial of experiment 2: a ramp to each angle [deg], then a hold [s].

    Source:
        Thesis, section "Determination of Gravitational force coefficient of the system".
    """
    before = 0.0
    for angle in staircase_angles(step, top):
        upwards = abs(angle) > abs(before)
        ramp = thesis_ramp(before, angle)
        yield Phase("dynamic", trial, angle, upwards, ramp, 0.0)
        yield Phase("static", trial, angle, upwards, thesis_ramp(angle, angle), hold)
        before = angle


def _hand_trial(seed: int, index: int, start: float) -> HandMotion:
    random = np.random.Generator(np.random.Philox(key=[seed, index]))
    strokes = random.uniform(7.0, 10.0, 2)
    amplitudes = _TREMOR_RADIANS * random.uniform(0.5, 1.0, _TREMOR_TONES) / math.sqrt(_TREMOR_TONES)
    frequencies = random.uniform(*_TREMOR_HERTZ, _TREMOR_TONES)
    phases = random.uniform(0.0, math.tau, _TREMOR_TONES)
    motion = HandMotion(
        direction=1 if index % 2 == 0 else -1,
        start=start,
        rest=0.5,
        strokes=(float(strokes[0]), float(strokes[1])),
        tremor=tuple(zip(amplitudes.tolist(), frequencies.tolist(), phases.tolist(), strict=True)),
    )
    return _slowed(motion)


def _slowed(motion: HandMotion) -> HandMotion:
    """Return the motion with its tremor scaled down to the largest speed."""
    stroke = replace(motion, tremor=())
    share = 1.0
    for time in np.arange(0.0, motion.duration, 0.02):
        smooth = stroke.reference(time)[1]
        shaking = motion.reference(time)[1] - smooth
        if shaking != 0.0:
            share = min(share, (_FASTEST - math.copysign(smooth, smooth * shaking)) / abs(shaking))
    return replace(motion, tremor=tuple((share * a, f, p) for a, f, p in motion.tremor))


def _minimum_jerk(time: float, duration: float) -> tuple[float, float]:
    """Return the share of a minimum-jerk stroke, 0 to 1, and its rate [1/s] (Flash and Hogan, 1985)."""
    x = min(1.0, max(0.0, time / duration))
    return x * x * x * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x * x * (1.0 - x) * (1.0 - x) / duration


def _envelope(time: float, duration: float) -> tuple[float, float]:
    """Return the tremor's amplitude factor within a stroke, 0 to 1 to 0, and its rate [1/s]."""
    x = min(1.0, max(0.0, time / duration))
    return math.sin(math.pi * x) ** 2, math.pi / duration * math.sin(2.0 * math.pi * x)
