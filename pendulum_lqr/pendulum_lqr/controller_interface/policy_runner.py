"""Commands of a learned policy, for any number of joints: samples, network, rate limit, soft start, deactivation."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import soft_start
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.policies.policy import Policy
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["START_TIME", "ZERO", "PolicyRunner", "check_policy_period", "policy_specs", "states_to_hold"]

START_TIME = 0.2
"""Default time from the first state to a policy's full effort [s]."""
ZERO = "zero"
_SAME_PERIOD = 0.05
"""Relative tolerance of a period that must be a whole fraction of the policy's."""
_LATE = 0.2
_INTERVALS = 15
"""Number of intervals between states whose median may be off by ``_LATE`` at run time."""


def policy_specs(fallbacks: Sequence[str]) -> tuple[ParameterSpec, ...]:
    """Return the parameters of a controller that runs a policy file; ``fallbacks`` starts with ``ZERO``."""
    return (
        ParameterSpec("policy", "", "", "Policy file (.npz)."),
        ParameterSpec("fallback", ZERO, "", "Command after the policy gives up: zero torque, or a controller's at its "
                      "defaults.", choices=tuple(fallbacks)),
        ParameterSpec("start_time", START_TIME, "s", "Time in which the torque that it may ask for rises from zero to "
                      "its limit, after the first state; 0 for at once.", minimum=0.0, maximum=5.0),
    )  # fmt: skip


def states_to_hold(policy: Policy, period: float) -> int:
    """Return the number of states per command of a policy, at their period [s]."""
    return max(1, round(policy.period / period))


def check_policy_period(policy: Policy, period: float) -> None:
    """Refuse a period of the states [s] that is no whole fraction of the policy's."""
    parts = policy.period / period
    if abs(parts / max(1, round(parts)) - 1.0) > _SAME_PERIOD:
        raise DesignError(
            f"policy {policy.name!r} was trained for a period of {policy.period:g} s and states come every "
            f"{period:g} s; expected {policy.period:g} s or a whole part of it"
        )


class PolicyRunner:
    """Commands of a policy for states of n joints, m efforts each, until it gives up.

    Args:
        policy: Policy.
        hold: States per command.
        limits: Largest effort of each driven joint [N m or N].
        start_time: Time from the first state to full effort [s].

    Attributes:
        notice: Why it gave up, or empty.
    """

    def __init__(self, policy: Policy, hold: int, limits: Vector, start_time: float) -> None:
        self.policy = policy
        self.hold = hold
        self.start_time = start_time
        self.limits = tuple(min(limit, own) for limit, own in zip(limits, policy.effort_limit, strict=True))
        self._layers = tuple(zip(policy.network.weights, policy.network.biases, strict=True))
        self._relu, self._squash = policy.network.activation == "relu", policy.network.output == "tanh"
        self._steps = tuple(rate * policy.period for rate in policy.effort_rate)
        driven = {joint: k for k, joint in enumerate(policy.coordinates.driven)}
        self._layout = tuple(
            (signal, driven[joint] if signal == "effort" else joint) for signal, joint in policy.layout
        )
        self._units = tuple((joint.unit, joint.velocity_unit) for joint in policy.coordinates.joints)
        self._still = (0.0,) * len(policy.effort_limit)
        self.reset()

    def reset(self) -> None:
        """Forget the past, including having given up."""
        self.notice = ""
        self._observation: Any = None
        self._effort: Vector = self._still
        self._wait = 0
        self._times: list[float] = []

    def efforts(self, t: float, x: Vector, v: Vector) -> Vector | None:
        """Return the efforts of the driven joints, or None once it has given up [N m or N].

        Args:
            t: Time since the start [s].
            x: Deviation of each joint from upright, wrapped where it turns [rad or m].
            v: Velocities [rad/s or m/s].
        """
        if not self.notice:
            self._watch_period(t)
        if not self.notice:
            self._watch_box(t, x, v)
        if self.notice:
            return None
        if self._wait > 0:
            self._wait -= 1
            return self._effort
        self._wait = self.hold - 1
        outputs = self._network(x, v)
        for each in outputs:
            if not math.isfinite(each):
                self._give_up(t, f"its network returned {each}")
                return None
        wanted = []
        for output, scale, before, step in zip(
            outputs, self.policy.effort_limit, self._effort, self._steps, strict=True
        ):
            wanted.append(before + min(step, max(-step, scale * output - before)))
        self._effort = self.begun(t, wanted)
        return self._effort

    def follow(self, efforts: Vector) -> None:
        """Record efforts that another controller applied in place of the last command [N m or N]."""
        self._effort = efforts

    def fall_back(self, t: float, state: Sequence[float], fallback: Callable[[], Sequence[float]] | None) -> Vector:
        """Return the efforts of a fallback, with soft start; zero without one, or if state or efforts are not finite.

        Args:
            t: Time since the start [s].
            state: Input of the fallback; checked, since limits would turn NaN into a full effort.
            fallback: Calls the fallback controller.
        """
        if fallback is None or not all(map(math.isfinite, state)):
            return self._still
        efforts = fallback()
        return self.begun(t, efforts) if all(map(math.isfinite, efforts)) else self._still

    def begun(self, t: float, efforts: Sequence[float]) -> Vector:
        """Return efforts within the limits at this time since the start [N m or N]."""
        return tuple(
            soft_start(effort, limit, t, self.start_time) for effort, limit in zip(efforts, self.limits, strict=True)
        )

    def describe(self, after: str) -> str:
        """Return a description of the policy, and whether it gave up; ``after`` names what commands then."""
        policy = self.policy
        sizes = "-".join(str(size) for size in policy.network.sizes)
        text = f"{policy.name} ({policy.task}, {sizes}) every {policy.period:g} s, fallback {after}"
        return f"{text}; {self.notice}" if self.notice else text

    def take_over(self, previous: PolicyRunner) -> None:
        """Take over samples, efforts and notice from another run of the same kind of policy."""
        self.notice = previous.notice
        own, other = self.policy, previous.policy
        if (own.layout, own.history, own.velocity_scale, own.effort_limit) == (
            other.layout,
            other.history,
            other.velocity_scale,
            other.effort_limit,
        ):
            self._observation = None if previous._observation is None else previous._observation.copy()
            self._effort = tuple(
                min(limit, max(-limit, effort)) for effort, limit in zip(previous._effort, self.limits, strict=True)
            )
            self._wait = min(previous._wait, self.hold - 1)

    def _network(self, x: Vector, v: Vector) -> list[float]:
        """Return the network's outputs for the samples up to this one, within [-1, 1]."""
        policy = self.policy
        sample = []
        for signal, k in self._layout:
            if signal == "cos":
                sample.append(math.cos(x[k]))
            elif signal == "sin":
                sample.append(math.sin(x[k]))
            elif signal == "velocity":
                sample.append(v[k] / policy.velocity_scale[k])
            elif signal == "effort":
                sample.append(self._effort[k] / policy.effort_limit[k])
            elif signal == "position":
                sample.append(x[k] / policy.angle_box[k])
            else:
                sample.append(x[k])
        size = len(sample)
        if self._observation is None:
            self._observation = np.array(sample * policy.history, dtype=np.float32)
        else:
            self._observation[:-size] = self._observation[size:]
            self._observation[-size:] = sample
        y = self._observation
        last = len(self._layers) - 1
        for number, (weight, bias) in enumerate(self._layers):
            y = weight.dot(y) + bias
            if number < last:
                y = np.maximum(y, 0.0) if self._relu else np.tanh(y)
        return [self._bounded(each) for each in y.tolist()]

    def _bounded(self, output: float) -> float:
        if not math.isfinite(output):
            return output
        return math.tanh(output) if self._squash else min(1.0, max(-1.0, output))

    def _watch_box(self, t: float, x: Vector, v: Vector) -> None:
        boxes = zip(x, v, self.policy.angle_box, self.policy.velocity_box, strict=True)
        for k, (position, velocity, reach, fastest) in enumerate(boxes):
            if not (abs(velocity) <= fastest and abs(position) <= reach):
                unit, speed = self._units[k]
                what = "angle" if unit == "rad" else "position"
                which = "" if len(x) == 1 else f" of {self.policy.joints[k]}"
                seen = f"{what}{which} {position:.3g} {unit}, velocity {velocity:.3g} {speed}"
                box = f"(+-{reach:.3g} {unit}, +-{fastest:.3g} {speed})"
                self._give_up(t, f"{seen} is outside of what it was trained for {box}")
                return

    def _watch_period(self, t: float) -> None:
        """Give up if states come at another rate than in training."""
        self._times.append(t)
        if len(self._times) <= _INTERVALS:
            return
        median = statistics.median(later - earlier for earlier, later in pairwise(self._times))
        self._times = [t]
        if not abs(median * self.hold / self.policy.period - 1.0) <= _LATE:
            own = self.policy.period / self.hold
            self._give_up(t, f"states come every {median:.3g} s; the policy expects {own:.3g} s")

    def _give_up(self, t: float, reason: str) -> None:
        self.notice = f"gave up after {t:.3f} s: {reason}"
