"""The controllers of plants of several joints on the graph, and the table from which a name chooses one.

A controller is a class in a file of its own under ``controllers/`` plus one line in ``JOINT_CONTROLLERS``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, cast

from pendulum_lqr.controller_interface.interface import JointController
from pendulum_lqr.controller_interface.sampling import ASSUMED_PERIOD
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = [
    "JOINT_CONTROLLERS",
    "JOINT_CONTROLLER_NAMES",
    "joint_controller_class",
    "make_joint_controller",
]

JOINT_CONTROLLERS: dict[str, str] = {
    "lqr": "pendulum_lqr.controllers.joint_lqr:JointLqr",
    "discrete_lqr": "pendulum_lqr.controllers.joint_discrete_lqr:JointDiscreteLqr",
    "lqi": "pendulum_lqr.controllers.joint_lqi:JointLqi",
    "lqg": "pendulum_lqr.controllers.joint_lqg:JointLqg",
    "energy_swing_up": "pendulum_lqr.controllers.joint_energy_swing_up:JointEnergySwingUp",
    "tvlqr": "pendulum_lqr.controllers.joint_swing_up:JointSwingUp",
    "ilqr": "pendulum_lqr.controllers.joint_ilqr:JointIlqr",
    "mpc": "pendulum_lqr.controllers.joint_mpc:JointMpc",
    "nmpc": "pendulum_lqr.controllers.joint_nmpc:JointNmpc",
    "policy": "pendulum_lqr.controllers.joint_policy:JointPolicy",
}
"""Name -> ``module:class``; modules are imported on demand."""
JOINT_CONTROLLER_NAMES = f"{', '.join(list(JOINT_CONTROLLERS)[:-1])} or {list(JOINT_CONTROLLERS)[-1]}"
"""For sentences."""


def joint_controller_class(name: str, plant: MechanismParameters) -> type[JointController]:
    """Return the class of a controller.

    Args:
        name: One of ``JOINT_CONTROLLERS``.
        plant: The plant that it is wanted for.

    Raises:
        ParameterError: No controller for several joints has this name.
    """
    if name not in JOINT_CONTROLLERS:
        raise ParameterError(
            f"{name} is for plants of one joint, and plant {plant.name!r} has {', '.join(plant.coordinates.names)}; "
            f"expected {JOINT_CONTROLLER_NAMES}"
        )
    module, _, class_name = JOINT_CONTROLLERS[name].partition(":")
    return cast(type[JointController], getattr(importlib.import_module(module), class_name))


def make_joint_controller(
    name: str, plant: MechanismParameters, values: Mapping[str, Any], period: float | None = None
) -> JointController:
    """Design a controller for a plant of several joints.

    Args:
        name: One of ``JOINT_CONTROLLERS``.
        plant: The plant.
        values: Parameters of its ``parameters`` by name; others at their default.
        period: Period of states [s]; None while it is unknown.

    Raises:
        ParameterError: No such controller for several joints, a value out of domain, a design that does not exist, or
            a loop that is unstable on the linear model at this period, delay included.
    """
    chosen = joint_controller_class(name, plant)
    own = validate(chosen.parameters(plant), values)
    controller = chosen.design(plant, own, ASSUMED_PERIOD if period is None else period)
    if period is not None:
        controller.check(period)
    return controller
