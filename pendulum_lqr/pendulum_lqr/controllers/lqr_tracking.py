"""LQR that follows a moving reference: feedforward of the plant's torque, gains scheduled over the angle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.specs import Q, R
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.reference import SHAPES, Motion, Reference, Way
from pendulum_lqr.linear.scheduling import Schedule, ScheduledMargins, scheduled_margins
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["LqrTracking"]

_GAP = 0.1
"""Time without a state after which the reference is rejoined [s]: twice a plant's timeout."""
_LONGER = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Factors on the transition time that are tried if the torque does not suffice."""
_POINTS = 40
_AGAIN = 0.1
"""Interval of searches for a transition onto the reference [s]."""


class LqrTracking(BaseController):
    """u = u_r(t) - K(theta_r) (x - x_r(t)), where u_r moves the plant along the reference without feedback.

    Transitions join the reference from the present state at the start, after a gap and after an error beyond
    ``max_error``; a change of parameters continues from the previous reference. Its time is that of the states' stamps.

    Attributes:
        margins: Stability; None before it was checked.
        needed: Largest torque of the reference [N m].

    Source:
        Rugh, Shamma, Automatica 36(10), 2000 (gain scheduling, frozen parameters); Spong, Hutchinson, Vidyasagar,
        Robot Modeling and Control, 2006, section 6.4 (feedforward of the computed torque).
    """

    SUMMARY = (
        "follows a moving reference: torque of the plant's equation fed forward, LQR gain scheduled over the angle"
    )
    TIME_INVARIANT = False
    PARAMETERS = (
        ParameterSpec("reference", "sine", "", "sine, or steps to and fro, each a motion of least jerk, with a rest "
                      "behind it; both about the set-point.", choices=SHAPES),
        ParameterSpec("amplitude", 0.3, "rad", "How far the reference goes to either side.", minimum=0.0,
                      maximum=math.pi),
        ParameterSpec("frequency", 0.2, "Hz", "How often it repeats itself.", minimum=0.01, maximum=20.0),
        ParameterSpec("move_time", 1.5, "s", "Of steps: duration of each, at most half a period.", minimum=0.01),
        ParameterSpec("approach_time", 1.0, "s", "Time in which the reference is joined from where the pendulum is; up "
                      "to 16 times as long where the torque does not suffice, 0 for at once.", minimum=0.0,
                      maximum=60.0),
        ParameterSpec("max_error", 0.3, "rad", "Error beyond which the reference is joined anew.", minimum=0.0,
                      exclusive_minimum=True),
        ParameterSpec("reserve", 0.1, "-", "Share of the torque limit that is left to the feedback.", minimum=0.0,
                      maximum=0.9),
        ParameterSpec("share", 0.8, "-", "Share of the plant's Coulomb friction that is fed forward, by the sign of "
                      "the reference's velocity.", minimum=0.0, maximum=1.0),
        Q,
        R,
    )  # fmt: skip

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(p["effort_limit"], p["set_point"])
        self._plant = plant
        self.reference = Reference(p["reference"], p["set_point"], p["amplitude"], p["frequency"], p["move_time"])
        if self.reference.shape == "steps" and self.reference.move_time > 0.5 * self.reference.period:
            raise ParameterError(
                f"move_time is {self.reference.move_time:g} s; expected at most half a period of the reference, "
                f"{0.5 * self.reference.period:g} s"
            )
        self.schedule = Schedule(plant, p["q"], p["r"], p["share"], self.reference.fastest)
        self.margins: ScheduledMargins | None = None
        self._approach_time = p["approach_time"]
        self._max_error = p["max_error"]
        self._within = (1.0 - p["reserve"]) * self.effort_limit
        # A torque acts after the delay and is held for a period: use that of the middle of its interval.
        self._lead = plant.transport_delay + 0.5 * period
        self.needed, at = self._most_torque()
        if self.needed > self._within:
            raise DesignError(
                f"following the reference takes up to {self.needed:.4g} N m (at {at:.3g} rad from upright), and "
                f"effort_limit {self.effort_limit:g} N m less a reserve of {100.0 * p['reserve']:g} % leaves "
                f"{self._within:.4g} N m; expected a smaller amplitude or frequency, a longer move_time, a set_point "
                "that takes less, or a smaller reserve"
            )
        self.reset()

    @classmethod
    def judged_at(cls, p: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
        """Return the ends and the middle of the reference, each as a constant one."""
        ends = {wrap(p["set_point"] + side * p["amplitude"]) for side in (-1.0, 0.0, 1.0)}
        return [{"set_point": end, "amplitude": 0.0, "approach_time": 0.0} for end in sorted(ends)]

    def check(self, period: float) -> None:
        """Refuse a period at which a frozen loop, or the loop along the reference, is unstable."""
        self.margins = scheduled_margins(self._plant, period, self.reference, self.schedule)

    def reset(self) -> None:
        """Forget the transition."""
        self._way: Way | None = None
        self._joined = False
        self._newest: float | None = None
        self._next_try = -math.inf
        self._lost = 0
        self.notice = ""

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]; 0 if it does not suffice to join the reference."""
        angle, velocity = x[0], x[1]
        if self._newest is not None and t - self._newest > _GAP:
            self._joined, self._next_try = False, t
        self._newest = t
        if self._joined:
            now = self.motion(t)
            error = wrap(angle - now.angle)
            if abs(error) <= self._max_error:
                return self._torque(t, now, error, velocity)
            self._lost += 1
            self.notice = (
                f"lost the reference {self._lost} times, the last time by more than max_error, {self._max_error:g} "
                "rad, and joined it anew"
            )
            self._joined, self._next_try = False, t
        if t >= self._next_try:
            self._join(t, angle, velocity)
        if not self._joined:
            return 0.0
        now = self.motion(t)
        return self._torque(t, now, wrap(angle - now.angle), velocity)

    def motion(self, t: float) -> Motion:
        """Return the reference at a time since the first state [s], including the transition."""
        return self._motion_by(self._way, t)

    def take_over(self, previous: Controller) -> None:
        """Continue from the previous reference, so that neither it nor the torque jumps."""
        if not isinstance(previous, LqrTracking) or previous._newest is None:
            return
        self._newest, self._lost, self.notice = previous._newest, previous._lost, previous.notice
        if not previous._joined:
            return
        t, before = previous._newest, previous.motion(previous._newest)
        self._way = self._find_way(t, [before]) or self._way_from(t, before, _LONGER[-1])
        self._joined = True

    def describe(self) -> str:
        """Return reference, gains at its ends, torque and stability."""
        reference = self.reference
        low, high = reference.centre - reference.amplitude, reference.centre + reference.amplitude
        gains = ", ".join(f"[{k0:.6f}, {k1:.6f}]" for k0, k1 in map(self.schedule.gain, (low, reference.centre, high)))
        text = (
            f"{reference.shape} of {reference.amplitude:g} rad about {reference.centre:g} rad at "
            f"{reference.frequency:g} Hz, K = {gains} at {low:.3g}, {reference.centre:.3g}, {high:.3g} rad, takes "
            f"up to {self.needed:.4g} N m"
        )
        return text if self.margins is None else f"{text}, {self.margins.describe()}"

    def _torque(self, t: float, now: Motion, error: float, velocity: float) -> float:
        k0, k1 = self.schedule.gain(now.angle)
        fed = self.schedule.feedforward(self.motion(t + self._lead))
        return self.clamp(fed - k0 * error - k1 * (velocity - now.velocity))

    def _join(self, t: float, angle: float, velocity: float) -> None:
        """Find a transition onto the reference from the present state, with as little torque as possible."""
        # At its own velocity, or at rest: sustaining a speed that damping stops within milliseconds would take torque.
        starts = [Motion(angle, velocity, 0.0), Motion(angle, 0.0, 0.0)]
        starts.sort(key=lambda start: abs(self.schedule.feedforward(start)))
        if self._approach_time == 0.0:
            self._way, self._joined = None, True
            return
        way = self._find_way(t, starts)
        if way is not None:
            self._way, self._joined = way, True
            if self._lost == 0:
                self.notice = ""
            return
        self._next_try = t + _AGAIN
        self.notice = (
            f"gives no torque: from {angle:.3g} rad, {velocity:.3g} rad/s no way onto the reference takes less than "
            f"{self._within:.4g} N m; expected a start nearer to it"
        )

    def _find_way(self, t: float, starts: Sequence[Motion]) -> Way | None:
        """Return the first transition for which the torque suffices, or None."""
        for start in starts:
            for longer in _LONGER:
                way = self._way_from(t, start, longer)
                if way is None or self._suffices(way):
                    return way
        return None

    def _motion_by(self, way: Way | None, t: float) -> Motion:
        motion = self.reference.at(t)
        return motion if way is None else Motion(*(a + b for a, b in zip(motion, way.at(t), strict=True)))

    def _way_from(self, t: float, start: Motion, longer: float) -> Way | None:
        there = self.reference.at(t)
        duration = longer * self._approach_time
        if duration == 0.0:
            return None
        return Way(
            t,
            duration,
            wrap(start.angle - there.angle),
            start.velocity - there.velocity,
            start.acceleration - there.acceleration,
        )

    def _suffices(self, way: Way) -> bool:
        for k in range(_POINTS + 1):
            t = way.start + way.duration * k / _POINTS
            if abs(self.schedule.feedforward(self._motion_by(way, t))) > self._within:
                return False
        return True

    def _most_torque(self) -> tuple[float, float]:
        """Return the largest torque of the reference itself [N m], and its angle [rad]."""
        points = 200
        motions = [self.reference.at(self.reference.period * k / points) for k in range(points)]
        worst = max(motions, key=lambda motion: abs(self.schedule.feedforward(motion)))
        return abs(self.schedule.feedforward(worst)), wrap(worst.angle)
