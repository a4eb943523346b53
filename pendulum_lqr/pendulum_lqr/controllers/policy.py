"""A learned policy from a file, for any number of joints, with a fallback outside its training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.loop_check import require_stable
from pendulum_lqr.controller_interface.policy_runner import (
    START_TIME,
    ZERO,
    PolicyRunner,
    check_policy_period,
    policy_specs,
    states_to_hold,
)
from pendulum_lqr.controllers.linear_feedback import JOINT_LIMIT, joint_limits, require_catching
from pendulum_lqr.policies.policy import Policy, require_plant
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of, make_mechanism_catch
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["START_TIME", "LearnedPolicy"]

_LQR = (ZERO, "lqr")


class LearnedPolicy(Controller):
    """Runs the network of a policy file, at the policy's own period.

    Each command holds for a whole number of states if they come faster than in training. Outside the trained box of
    states, or if the network's output is not finite, it gives up: the fallback commands until the next start. Its own
    and the fallback's efforts are limited by a ramp over ``start_time``: a swing-up from hanging needs much effort at
    once, which a plant refuses at the start (``start_effort_limit``, arming, position control).

    Args:
        policy: Policy.
        hold: States per command.
        effort_limits: Largest effort of each driven joint [N m or N].
        fallback: Controller after it gave up; None for no effort.
        start_time: Time from the first state to full effort [s].
        catch: LQR that takes over near upright, for several joints, or None.
        plant: Plant with which the fallback is checked; None for that of the policy.
    """

    STARTS_SOFTLY = True  # it observes its own last effort, so it applies the limit itself
    FEEDBACK = False  # the linear model does not apply: it is checked by what it visited in training
    SUMMARY = "learned policy from a file, with a fallback outside of what it was trained for"

    def __init__(
        self,
        policy: Policy,
        hold: int,
        effort_limits: Vector,
        fallback: Controller | None = None,
        *,
        start_time: float = START_TIME,
        catch: MechanismCatch | None = None,
        plant: PlantParameters | None = None,
    ) -> None:
        self._runner = PolicyRunner(policy, hold, effort_limits, start_time)
        super().__init__(self._runner.limits)
        self.policy, self.fallback, self.catch = policy, fallback, catch
        self.plant = plant or policy.plant
        self._deviation = policy.coordinates.deviation

    @classmethod
    def parameters(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return the file and the fallback; of several joints also the catching controller, and the limit."""
        if plant is None or plant.is_pendulum:
            return policy_specs((*_LQR, "pd_gravity", "energy_swing_up"))
        meaning = "Who takes over near upright, in the region from which it catches: zero for nobody, or lqr."
        return (*policy_specs(_LQR), ParameterSpec("catch", ZERO, "", meaning, choices=_LQR), JOINT_LIMIT)

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> LearnedPolicy:
        """Return the controller of the parameter ``policy``.

        Raises:
            ParameterError: There is no file, or the policy is for another plant or period.
            DataError: The file is refused.
        """
        if not p["policy"]:
            raise ParameterError("policy is empty; expected the path of a policy file (.npz)")
        if p.get("set_point", 0.0) != 0.0:
            raise ParameterError(f"set_point is {p['set_point']:g} rad; a policy holds upright alone, expected 0 rad")
        policy = load_policy(p["policy"])
        if plant.is_pendulum and len(policy.joints) != 1:
            raise ParameterError(f"policy {policy.name!r} is for joints {', '.join(policy.joints)}; expected one joint")
        require_plant(policy, plant)
        fallback = None
        if p["fallback"] != ZERO:
            values = {"effort_limit": p["effort_limit"]}
            fallback = make_controller(p["fallback"], plant, period, values, checked=False)
        own = joint_limits(plant, p["effort_limit"])
        limits = tuple(min(both) for both in zip(own, policy.effort_limit, strict=True))
        catch = None
        if not plant.is_pendulum and p["catch"] != ZERO:
            catch = make_mechanism_catch(plant, *plant.weights, limits)
        hold = states_to_hold(policy, period)
        return cls(policy, hold, limits, fallback, start_time=p["start_time"], catch=catch, plant=plant)

    @property
    def notice(self) -> str:
        """Why it gave up, or empty."""
        return self._runner.notice

    @notice.setter
    def notice(self, text: str) -> None:
        self._runner.notice = text

    def check(self, period: float) -> None:
        """Refuse a period that is no whole fraction of the policy's, or at which catch or fallback are unstable [s]."""
        check_policy_period(self.policy, period)
        if self.catch is not None:
            require_catching("policy", self.catch, period)
        if self.fallback is not None:
            self.fallback.check(period)
            if self.plant.is_pendulum:
                require_stable("the fallback", self.fallback, self.plant, period)

    def reset(self) -> None:
        """Forget the past, including having given up."""
        self._runner.reset()
        if self.catch is not None:
            self.catch.active = False
        if self.fallback is not None:
            self.fallback.reset()

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the policy's efforts, the catch's near upright, or the fallback's after it gave up [N m or N]."""
        efforts = self._runner.efforts(t, self._deviation(position), velocity)
        if efforts is None:
            fallback = self.fallback
            ask = None if fallback is None else lambda: fallback.efforts(t, position, velocity)
            efforts = self._runner.fall_back(t, position + velocity, ask)
        elif self.catch is not None:
            x = deviation_of(self.policy.coordinates, position + velocity)
            if self.catch.holds(x):
                # The network's samples contain the applied efforts: it may have to continue from here.
                efforts = self._runner.begun(t, self.catch.command(x))
                self._runner.follow(efforts)
        return efforts

    def describe(self) -> str:
        """Return policy, catch, and whether it gave up."""
        nothing = "zero torque" if self.plant.is_pendulum else "no effort"
        text = self._runner.describe(nothing if self.fallback is None else self.fallback.describe())
        return text if self.catch is None else f"{text}; LQR within {self.catch.region.describe()}"

    def take_over(self, previous: Controller) -> None:
        """Take over samples, efforts and notice from the same kind of policy."""
        if not isinstance(previous, LearnedPolicy):
            return
        self._runner.take_over(previous._runner)
        if self.catch is not None and previous.catch is not None:
            self.catch.active = previous.catch.active
        if self.fallback is not None and previous.fallback is not None:
            self.fallback.carry_over(previous.fallback)
