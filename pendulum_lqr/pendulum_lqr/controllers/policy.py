"""A learned policy from a file, with a fallback where it was never trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller_interface.controller import BaseController, make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.loop_check import require_stable
from pendulum_lqr.controller_interface.policy_answers import (
    START_TIME,
    ZERO,
    PolicyAnswers,
    check_policy_period,
    policy_specs,
    states_to_hold,
)
from pendulum_lqr.policies.policy import Policy, require_plant
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["START_TIME", "LearnedPolicy"]


class LearnedPolicy(BaseController):
    """Runs the network of a policy file, at the policy's own period.

    Where states come a whole number of times as often as the policy was trained for, each of its commands holds for as
    many states. Outside of the box of states that training visited, or where the network's output is not finite, it
    gives up: the fallback commands from then on, until the next start.

    Its torque, and its fallback's, begins at zero and may reach the limit after ``start_time``: a swing-up from hanging
    needs much at once, which a plant refuses at the start (``start_effort_limit``, arming, position control).

    Args:
        policy: The policy, of one joint.
        hold: States for which a command holds.
        effort_limit: Largest torque [N m].
        fallback: Controller that takes over after it gave up; None for zero torque.
        start_time: Time from the first state until it has all of its torque [s].
    """

    STARTS_SOFTLY = True  # it observes its own last torque, so it applies the limit itself
    FEEDBACK = False  # the linear model does not apply: it is checked by what it visited in training
    SUMMARY = "learned policy from a file, with a fallback outside of what it was trained for"
    PARAMETERS = policy_specs((ZERO, "lqr", "pd_gravity", "energy_swing_up"))

    def __init__(
        self,
        policy: Policy,
        hold: int,
        effort_limit: float,
        fallback: Controller | None = None,
        *,
        start_time: float = START_TIME,
        plant: PlantParameters | None = None,
    ) -> None:
        self._answers = PolicyAnswers(policy, hold, (effort_limit,), start_time)
        super().__init__(self._answers.limits[0])
        self.policy = policy
        self.fallback = fallback
        self.plant: Any = plant or policy.plant

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
        if p["fallback"] != ZERO:
            values = {"effort_limit": p["effort_limit"]}
            fallback = make_controller(p["fallback"], plant, period, values, checked=False)
        return cls(
            policy, states_to_hold(policy, period), p["effort_limit"], fallback, start_time=p["start_time"], plant=plant
        )

    def check(self, period: float) -> None:
        """Refuse a period that the policy's is no whole multiple of, and a fallback that is unstable at it."""
        check_policy_period(self.policy, period)
        if self.fallback is not None:
            require_stable("the fallback", self.fallback, self.plant, period)

    @property
    def notice(self) -> str:
        """Why it gave up; empty as long as it did not."""
        return self._answers.notice

    @notice.setter
    def notice(self, text: str) -> None:
        self._answers.notice = text

    def reset(self) -> None:
        """Forget the past, and that it gave up."""
        self._answers.reset()
        if self.fallback is not None:
            self.fallback.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the policy's torque, or the fallback's after it gave up [N m]."""
        efforts = self._answers.answer(t, (x[0],), (x[1],))
        if efforts is None:
            fallback = self.fallback
            efforts = self._answers.fall_back(t, x, None if fallback is None else lambda: (fallback.command(t, x),))
        return efforts[0]

    def describe(self) -> str:
        """Return which policy it is, and whether it gave up."""
        return self._answers.describe("zero torque" if self.fallback is None else self.fallback.describe())

    def take_over(self, previous: Controller) -> None:
        """Take over samples and torque from the same kind of policy, and that it gave up."""
        if not isinstance(previous, LearnedPolicy):
            return
        self._answers.take_over(previous._answers)
        if self.fallback is not None and previous.fallback is not None:
            self.fallback.carry_over(previous.fallback)
