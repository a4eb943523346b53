"""The controllers of plants of several joints, by name: each written once for any mechanism."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path

from pendulum_lqr.controllers.joint_policy import JointPolicy
from pendulum_lqr.interface import JointController
from pendulum_lqr.mechanism_catch import MechanismCatch, make_mechanism_catch
from pendulum_lqr.mechanism_controller import MechanismController
from pendulum_lqr.mechanism_mpc import MechanismMpc
from pendulum_lqr.mechanism_planned import PlannedSwingUp
from pendulum_lqr.mechanism_trajectory import MechanismTrajectory, load_trajectory
from pendulum_lqr.mechanism_tvlqr import MechanismTvlqr
from pendulum_lqr.policy import require_plant
from pendulum_lqr.policy_answers import check_policy_period, states_to_hold
from pendulum_lqr.policy_file import POLICY_SUFFIX, load_policy
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = [
    "DifferencedVelocity",
    "default_catch",
    "make_mechanism_controller",
    "mechanism_controller_names",
    "refuse_passive_friction",
    "stored_trajectory",
    "tracked_swing_up",
]

_CALM = ((1.0, 1.0, 1.0, 1.0), 10.0)
"""Weights of catch and tracking behind a swing-up, for two joints: of gains as low as still catch from far."""
_TUBE = 10.0
"""Width of the tube about a swing-up: beyond it, planning anew is better than tracking."""
_CATCH_SUFFIX = "+lqr"
"""What the name of a policy file ends with where an LQR takes over near upright."""


class DifferencedVelocity:
    """Gives a controller velocities from the last two positions in the place of the measured ones.

    The slope between two positions is the velocity in their middle; half a period of the model's acceleration brings
    it to the end. That is exact to the period's square, and as good as the positions are: an encoder's steps over the
    period come through as noise.
    """

    def __init__(self, plant: MechanismParameters, controller: MechanismController) -> None:
        self.plant, self.controller = plant, controller
        self.reset()

    def reset(self) -> None:
        """Forget the last position; the first velocity is the measured one."""
        self.controller.reset()
        self._last: tuple[float, Vector] | None = None
        self._effort = (0.0,) * len(self.plant.effort_limits)

    def command(self, t: float, x: Vector) -> Vector:
        """Return the controller's efforts [N m or N]."""
        n = len(self.plant.joints)
        q, v = x[:n], x[n:]
        if self._last is not None and t > self._last[0]:
            before, old = self._last
            h = t - before
            slope = tuple((new - was) / h for new, was in zip(q, old, strict=True))
            a = self.plant.acceleration(q, slope, self.plant.coordinates.spread(self._effort))
            v = tuple(middle + 0.5 * h * each for middle, each in zip(slope, a, strict=True))
        self._last = (t, q)
        self._effort = self.controller.command(t, (*q, *v))
        return self._effort


class _WholeStates:
    """A controller of the graph as one that is asked for whole states."""

    def __init__(self, inner: JointController, joints: int) -> None:
        self._inner, self._joints = inner, joints

    def reset(self) -> None:
        """Forget the past."""
        self._inner.reset()

    def command(self, t: float, x: Vector) -> Vector:
        """Return m efforts [N m or N]."""
        return self._inner.command(t, x[: self._joints], x[self._joints :])


def stored_trajectory(plant: MechanismParameters) -> MechanismTrajectory:
    """Return the swing-up that comes with the project for a preset.

    Raises:
        ParameterError: There is none for this plant.
    """
    folder = Path(str(resources.files("pendulum_lqr"))) / "trajectories"
    path = folder / f"{plant.name}.json"
    if not path.is_file():
        names = ", ".join(sorted(each.stem for each in folder.glob("*.json")))
        raise ParameterError(f"no swing-up is stored for plant {plant.name!r}; expected one of {names}")
    return load_trajectory(path)


def default_catch(plant: MechanismParameters) -> MechanismCatch:
    """Return the LQR that catches, with its sampled region."""
    return make_mechanism_catch(plant, *plant.mechanism.weights)


def refuse_passive_friction(controller: str, plant: MechanismParameters) -> None:
    """Refuse a plant for a controller that plans without dry friction, if no effort can make up for it where it is.

    Raises:
        ParameterError: A passive joint has some.
    """
    coordinates = plant.coordinates
    for index, (name, joint) in enumerate(zip(coordinates.names, plant.joints, strict=True)):
        if index not in coordinates.driven and joint.breakaway > 0.0:
            raise ParameterError(
                f"{controller} plans without dry friction, and {name} of plant {plant.name!r} is passive with "
                f"{joint.breakaway:g} {coordinates.joints[index].effort_unit}; "
                "expected 0, as of a preset's frictionless twin"
            )


def _followed(plant: MechanismParameters, period: float, *, recovers: bool) -> MechanismTvlqr:
    # Without a swing-up no region need be sampled, which takes a second.
    swing_up = stored_trajectory(plant)
    q, r = _CALM
    catch = make_mechanism_catch(plant, q, r)
    recover = MechanismMpc(period, catch) if recovers else None
    return MechanismTvlqr(period, swing_up, catch, q=q, r=r, recover=recover, tube=_TUBE)


def tracked_swing_up(plant: MechanismParameters, period: float) -> MechanismTvlqr:
    """Return the controller that follows the stored swing-up of a plant by time-varying LQR.

    Raises:
        ParameterError: There is none for this plant.
    """
    return _followed(plant, period, recovers=False)


def _tvlqr_mpc(plant: MechanismParameters, period: float) -> MechanismController:
    return DifferencedVelocity(plant, _followed(plant, period, recovers=True))


_CONTROLLERS: dict[str, Callable[[MechanismParameters, float], MechanismController]] = {
    "tvlqr": tracked_swing_up,
    "ilqr": lambda plant, period: PlannedSwingUp(period, default_catch(plant)),
    "mpc": lambda plant, period: DifferencedVelocity(plant, MechanismMpc(period, default_catch(plant))),
    "tvlqr_mpc": _tvlqr_mpc,
}


def mechanism_controller_names() -> tuple[str, ...]:
    """Return the names of all controllers of plants of several joints."""
    return tuple(_CONTROLLERS)


def make_mechanism_controller(name: str, plant: MechanismParameters, period: float) -> MechanismController:
    """Design a controller; ilqr and mpc compile for some ten seconds the first time.

    Args:
        name: Of :func:`mechanism_controller_names`, or the path of a policy file, ``FILE.npz``; of ``FILE.npz+lqr``
            an LQR takes over near upright.
        plant: The plant that it believes in.
        period: Sampling period [s].

    Raises:
        ParameterError: No controller has this name, or it does not go with this plant.
        DataError: A policy file is refused.
    """
    file = name.removesuffix(_CATCH_SUFFIX)
    if file.endswith(POLICY_SUFFIX):
        policy = load_policy(file)
        require_plant(policy, plant)
        check_policy_period(policy, period)
        catch = make_mechanism_catch(plant, *_CALM) if file != name else None
        hold = states_to_hold(policy, period)
        # It has all of its effort from the start.
        inner = JointPolicy(policy, hold, plant.effort_limits, start_time=0.0, catch=catch)
        return _WholeStates(inner, len(plant.joints))
    if name not in _CONTROLLERS:
        raise ParameterError(
            f"controller {name!r} is unknown; expected one of {', '.join(_CONTROLLERS)}, or a policy file (.npz)"
        )
    return _CONTROLLERS[name](plant, period)
