"""A policy file among the controllers of plants of several joints, with an LQR near upright or without."""

from __future__ import annotations

from pendulum_lqr.controllers.joint_policy import JointPolicy
from pendulum_lqr.mechanism_catch import MechanismCatch
from pendulum_lqr.policy import require_plant
from pendulum_lqr.policy_answers import check_policy_period, states_to_hold
from pendulum_lqr.policy_file import POLICY_SUFFIX, load_policy
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["CATCH_SUFFIX", "MechanismPolicy", "is_policy_name"]

CATCH_SUFFIX = "+lqr"
"""What the name of a policy file ends with where an LQR takes over near upright."""


def is_policy_name(name: str) -> bool:
    """Return whether a controller's name is that of a policy file, with ``CATCH_SUFFIX`` or without."""
    return name.removesuffix(CATCH_SUFFIX).endswith(POLICY_SUFFIX)


class MechanismPolicy:
    """What a policy file answers; it has all of its effort from the start.

    Args:
        plant: The plant.
        period: Sampling period [s].
        path: The file.
        catch: LQR that takes over near upright; None for none.

    Raises:
        ParameterError: The policy is for another plant.
        DesignError: The period is no whole part of the policy's.
        DataError: The file is refused.
    """

    def __init__(self, plant: MechanismParameters, period: float, path: str, catch: MechanismCatch | None) -> None:
        policy = load_policy(path)
        require_plant(policy, plant)
        check_policy_period(policy, period)
        self._joints = len(plant.joints)
        self.inner = JointPolicy(
            policy, states_to_hold(policy, period), plant.effort_limits, start_time=0.0, catch=catch
        )

    def reset(self) -> None:
        """Forget the past, and that it gave up."""
        self.inner.reset()

    def command(self, t: float, x: Vector) -> Vector:
        """Return m efforts [N m or N]."""
        return self.inner.command(t, x[: self._joints], x[self._joints :])
