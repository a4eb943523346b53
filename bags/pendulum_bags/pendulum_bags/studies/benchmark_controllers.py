"""The benchmark's contenders: controllers that get whole states, with velocities of their own where it gives none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pendulum_lqr.controller_interface.interface import Controller, unwrapped
from pendulum_lqr.controller_interface.policy_runner import check_policy_period, states_to_hold
from pendulum_lqr.controllers.linear_feedback import require_catching
from pendulum_lqr.controllers.policy import LearnedPolicy
from pendulum_lqr.policies.policy import require_plant
from pendulum_lqr.policies.policy_file import POLICY_SUFFIX, load_policy
from pendulum_lqr.swing_up.catch import make_mechanism_catch
from pendulum_lqr.swing_up.mpc import MechanismMpc
from pendulum_lqr.swing_up.planned import PlannedSwingUp
from pendulum_lqr.swing_up.stored_swing_up import CALM_WEIGHTS, default_catch, tracked_swing_up
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DifferencedVelocity", "contender_names", "make_contender"]

_OLD_NAMES = {"mpc": "nmpc", "tvlqr_mpc": "tvlqr_nmpc"}
"""Accepted until the next release."""
_CATCH_SUFFIX = "+lqr"
"""Suffix of a policy file's name for an LQR that takes over near upright."""


class DifferencedVelocity(Controller):
    """Gives a controller velocities from the last two positions in place of the measured ones.

    The slope between two positions is the velocity in their middle; half a period of the model's acceleration
    extrapolates it to the end. That is exact to the square of the period; encoder steps over the period appear as
    noise.
    """

    def __init__(self, plant: PlantParameters, inner: Controller) -> None:
        super().__init__(plant.effort_limits)
        self.plant = plant
        self.inner: Controller = inner
        self.reset()

    def reset(self) -> None:
        """Forget the last position; the first velocity is the measured one."""
        self.inner.reset()
        self._last: tuple[float, Vector] | None = None
        self._effort = (0.0,) * len(self.plant.effort_limits)

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the controller's efforts [N m or N]."""
        q, v = position, velocity
        if self._last is not None and t > self._last[0]:
            before, old = self._last
            h = t - before
            slope = tuple((new - was) / h for new, was in zip(q, old, strict=True))
            a = self.plant.acceleration(q, slope, self.plant.coordinates.spread(self._effort))
            v = tuple(middle + 0.5 * h * each for middle, each in zip(slope, a, strict=True))
        self._last = (t, q)
        self._effort = self.inner.efforts(t, q, v)
        return self._effort


def _tvlqr_nmpc(plant: PlantParameters, period: float) -> Controller:
    return DifferencedVelocity(plant, tracked_swing_up(plant, period, recovers=True))


_CONTROLLERS: dict[str, Callable[[PlantParameters, float], Controller]] = {
    "tvlqr": tracked_swing_up,
    "ilqr": lambda plant, period: PlannedSwingUp(period, default_catch(plant)),
    "nmpc": lambda plant, period: DifferencedVelocity(plant, MechanismMpc(period, default_catch(plant))),
    "tvlqr_nmpc": _tvlqr_nmpc,
}


def contender_names() -> tuple[str, ...]:
    """Return the names of all contenders."""
    return tuple(_CONTROLLERS)


def make_contender(name: str, plant: PlantParameters, period: float) -> Controller:
    """Design a controller; ilqr and nmpc compile for some ten seconds the first time.

    Args:
        name: Of :func:`contender_names`, or the path of a policy file, ``FILE.npz``; with ``FILE.npz+lqr``
            an LQR takes over near upright.
        plant: Plant of its model.
        period: Sampling period [s].

    Raises:
        ParameterError: Unknown name, it does not fit this plant, or the LQR that catches does not settle at this
            period.
        DataError: A policy file is refused.
    """
    file = name.removesuffix(_CATCH_SUFFIX)
    if file.endswith(POLICY_SUFFIX):
        policy = load_policy(file)
        require_plant(policy, plant)
        check_policy_period(policy, period)
        catch = make_mechanism_catch(plant, *CALM_WEIGHTS) if file != name else None
        hold = states_to_hold(policy, period)
        # Full effort from the start.
        inner = LearnedPolicy(policy, hold, plant.effort_limits, start_time=0.0, catch=catch)
        inner.check(period)
        return inner
    name = _OLD_NAMES.get(name, name)
    if name not in _CONTROLLERS:
        raise ParameterError(
            f"controller {name!r} is unknown; expected one of {', '.join(_CONTROLLERS)}, or a policy file (.npz)"
        )
    controller = _CONTROLLERS[name](plant, period)
    caught: Any = unwrapped(controller)
    require_catching(name, caught.catch, period)
    return controller
