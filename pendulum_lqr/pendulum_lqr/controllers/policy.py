"""A learned policy from a file, with a fallback where it was never trained."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pendulum_lqr.controller import BaseController, make_controller, soft_start
from pendulum_lqr.design import DesignError
from pendulum_lqr.interface import Controller
from pendulum_lqr.policy import SIGNALS, Policy, require_plant
from pendulum_lqr.policy_file import load_policy
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["START_TIME", "LearnedPolicy"]

START_TIME = 0.2
"""Time from the first state until a policy has all of its torque, by default [s]."""
_ZERO = "zero"
_FALLBACKS = (_ZERO, "lqr", "pd_gravity", "energy_swing_up")
_SAME_PERIOD = 0.05
"""Share by which a period may differ from a whole part of the policy's."""
_LATE = 0.2
_INTERVALS = 15
"""Intervals between states whose median may be off by this share at most while it runs."""


class LearnedPolicy(BaseController):
    """Answers with the network of a policy file, at the policy's own period.

    Where states come a whole number of times as often as the policy was trained for, each of its answers holds for as
    many states. Outside of the box of states that training visited, or where the network gives no finite number, it
    gives up: the fallback answers from then on, until the next start.

    Its torque, and its fallback's, begins at zero and may reach the limit after ``start_time``: a hanging pendulum asks
    a swing-up for much at once, and a plant lets nobody begin so (``start_effort_limit``, arming, position control).

    Args:
        policy: The policy, of one joint.
        hold: States for which an answer holds.
        effort_limit: Largest torque [N m].
        fallback: Who answers after it gave up; None for zero torque.
        start_time: Time from the first state until it has all of its torque [s].
    """

    STARTS_SOFTLY = True  # it sees the torque that it asked for, so it has to know
    FEEDBACK = False  # the linear model tells nothing of it: it is judged by what it visited in training
    SUMMARY = "learned policy from a file, with a fallback outside of what it was trained for"
    PARAMETERS = (
        ParameterSpec("policy", "", "", "Policy file (.npz)."),
        ParameterSpec("fallback", _ZERO, "", "Who answers where the policy gives up: zero torque, or a controller at "
                      "its defaults.", choices=_FALLBACKS),
        ParameterSpec("start_time", START_TIME, "s", "Time in which the torque that it may ask for rises from zero to "
                      "its limit, after the first state; 0 for at once.", minimum=0.0, maximum=5.0),
    )  # fmt: skip

    def __init__(
        self,
        policy: Policy,
        hold: int,
        effort_limit: float,
        fallback: Controller | None = None,
        *,
        start_time: float = START_TIME,
    ) -> None:
        super().__init__(min(effort_limit, policy.effort_limit[0]))
        self.policy = policy
        self.hold = hold
        self.fallback = fallback
        self.start_time = start_time
        self._layers = tuple(zip(policy.network.weights, policy.network.biases, strict=True))
        self._relu, self._squash = policy.network.activation == "relu", policy.network.output == "tanh"
        self._scale = policy.effort_limit[0]
        self._step = policy.effort_rate[0] * policy.period
        self._angle_box, self._velocity_box = policy.angle_box[0], policy.velocity_box[0]
        self._signals = tuple(name in policy.signals for name in SIGNALS)
        self.reset()

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> LearnedPolicy:
        """Return the controller of the parameter ``policy``."""
        if not p["policy"]:
            raise ParameterError("policy is empty; expected the path of a policy file (.npz)")
        if p["set_point"] != 0.0:
            raise ParameterError(f"set_point is {p['set_point']:g} rad; a policy holds upright alone, expected 0 rad")
        policy = load_policy(p["policy"])
        if len(policy.joints) != 1:
            raise ParameterError(f"policy {policy.name!r} is for joints {', '.join(policy.joints)}; expected one joint")
        require_plant(policy, plant)
        fallback = None
        if p["fallback"] != _ZERO:
            values = {"effort_limit": p["effort_limit"]}
            fallback = make_controller(p["fallback"], plant, period, values, checked=False)
        return cls(
            policy, max(1, round(policy.period / period)), p["effort_limit"], fallback, start_time=p["start_time"]
        )

    def check(self, plant: PlantParameters, period: float) -> None:
        """Refuse a period that the policy's is no whole multiple of, and a fallback that is unstable at it.

        Raises:
            ParameterError: as said.
        """
        policy = self.policy
        parts = policy.period / period
        if abs(parts / max(1, round(parts)) - 1.0) > _SAME_PERIOD:
            raise DesignError(
                f"policy {policy.name!r} was trained for a period of {policy.period:g} s and states come every "
                f"{period:g} s; expected {policy.period:g} s or a whole part of it"
            )
        if self.fallback is not None:
            from pendulum_lqr.loop_check import require_stable

            require_stable("the fallback", self.fallback, plant, period)

    def reset(self) -> None:
        """Forget the past, and that it gave up."""
        self.notice = ""
        self._observation: Any = None
        self._effort = 0.0
        self._wait = 0
        self._times: list[float] = []
        if self.fallback is not None:
            self.fallback.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the policy's torque, or the fallback's after it gave up [N m]."""
        angle, velocity = x[0], x[1]
        if not self.notice:
            self._watch_period(t)
        if not self.notice and not (abs(velocity) <= self._velocity_box and abs(angle) <= self._angle_box):
            self._give_up(
                t, f"angle {angle:.3g} rad, velocity {velocity:.3g} rad/s is outside of what it was trained for "
                f"(+-{self._angle_box:.3g} rad, +-{self._velocity_box:.3g} rad/s)",
            )  # fmt: skip
        if self.notice:
            return self._fall_back(t, x)
        if self._wait > 0:
            self._wait -= 1
            return self._effort
        self._wait = self.hold - 1
        answer = self._answer(angle, velocity)
        if not math.isfinite(answer):
            self._give_up(t, f"its network answered {answer}")
            return self._fall_back(t, x)
        step = self._scale * answer - self._effort
        self._effort = self._begun(t, self._effort + min(self._step, max(-self._step, step)))
        return self._effort

    def describe(self) -> str:
        """Return which policy it is, and whether it gave up."""
        policy = self.policy
        sizes = "-".join(str(size) for size in policy.network.sizes)
        after = "zero torque" if self.fallback is None else self.fallback.describe()
        told = f"{policy.name} ({policy.task}, {sizes}) every {policy.period:g} s, fallback {after}"
        return f"{told}; {self.notice}" if self.notice else told

    def take_over(self, previous: Controller) -> None:
        """Take over samples and torque from the same kind of policy, and that it gave up."""
        if not isinstance(previous, LearnedPolicy):
            return
        self.notice = previous.notice
        same = (self.policy.signals, self.policy.history, self.policy.velocity_scale, self.policy.effort_limit)
        other = previous.policy
        if same == (other.signals, other.history, other.velocity_scale, other.effort_limit):
            self._observation = None if previous._observation is None else previous._observation.copy()
            self._effort, self._wait = self.clamp(previous._effort), min(previous._wait, self.hold - 1)
        if self.fallback is not None and previous.fallback is not None:
            self.fallback.carry_over(previous.fallback)

    def _answer(self, angle: float, velocity: float) -> float:
        """Return the network's answer to the samples up to this one, within [-1, 1]."""
        values = (
            angle,
            math.cos(angle),
            math.sin(angle),
            velocity / self.policy.velocity_scale[0],
            self._effort / self._scale,
        )
        sample = [value for value, seen in zip(values, self._signals, strict=True) if seen]
        size = len(sample)
        if self._observation is None:
            self._observation = np.array(sample * self.policy.history, dtype=np.float32)
        else:
            self._observation[:-size] = self._observation[size:]
            self._observation[-size:] = sample
        y = self._observation
        last = len(self._layers) - 1
        for number, (weight, bias) in enumerate(self._layers):
            y = weight.dot(y) + bias
            if number < last:
                y = np.maximum(y, 0.0) if self._relu else np.tanh(y)
        answer = float(y[0])
        if not math.isfinite(answer):
            return answer
        return math.tanh(answer) if self._squash else min(1.0, max(-1.0, answer))

    def _watch_period(self, t: float) -> None:
        """Give up where states come at another rate, whatever was said of it: the network knows no other time."""
        self._times.append(t)
        if len(self._times) <= _INTERVALS:
            return
        median = statistics.median(later - earlier for earlier, later in pairwise(self._times))
        self._times = [t]
        if not abs(median * self.hold / self.policy.period - 1.0) <= _LATE:
            own = self.policy.period / self.hold
            self._give_up(t, f"states come every {median:.3g} s; it answers for every {own:.3g} s")

    def _give_up(self, t: float, reason: str) -> None:
        self.notice = f"gave up after {t:.3f} s: {reason}"

    def _fall_back(self, t: float, x: Sequence[float]) -> float:
        if self.fallback is None:
            return 0.0
        effort = self.fallback.command(t, x)
        return self._begun(t, effort) if math.isfinite(effort) else 0.0

    def _begun(self, t: float, effort: float) -> float:
        """Return the torque within what it may have so long after its start [N m]."""
        return soft_start(effort, self.effort_limit, t, self.start_time)
