"""The rigid plant in the record of a compiled loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_msgs_py.loops.machine_code import NoMachineCodeError
from pendulum_sim.stepping.dry_friction import PACKED
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_sim.stepping.plants import JointPlant, OneJoint

__all__ = ["BUILDER", "LAYOUT", "MOST_COEFFICIENTS", "LoopPlant", "loop_plant"]

BUILDER = "pendulum_sim.simulator.loop_kernel:rigid_loop"
_MOST_SEGMENTS = 16
_MOST_WHOLE = 62
"""Most whole periods of a transport delay."""
MOST_COEFFICIENTS = 16
_INTERPRETED = frozenset({"adaptive"})
"""Methods that call a Python library."""

LAYOUT = np.dtype(
    [
        ("theta", "f8"),
        ("theta_dot", "f8"),
        ("torque", "f8"),
        ("steps", "i8"),
        ("limit", "f8"),
        ("dry", "i8"),
        ("line", "f8", (_MOST_WHOLE + 2,)),
        ("waits", "i8"),
        ("segments", "i8"),
        ("newer", "i8", (_MOST_SEGMENTS,)),
        ("length", "f8", (_MOST_SEGMENTS,)),
        ("coefficients", "f8", (_MOST_SEGMENTS * MOST_COEFFICIENTS,)),
        ("packed", "f8", (len(PACKED),)),
    ],
    align=True,
)
"""State, delayed commands, sub-steps of a period with their coefficients, and parameters."""


class LoopPlant:
    """A rigid plant for a compiled loop."""

    def __init__(self, plant: RigidPlant) -> None:
        self.plant = plant
        self.builder = BUILDER
        self.choice: tuple[str, ...] = (plant.method, "torques") if plant.parameters.has_torques else (plant.method,)
        self.layout = LAYOUT

    def describe(self, record: Any) -> None:
        """Write parameters and sub-steps into a record of :data:`LAYOUT`."""
        plant = self.plant
        record.limit, record.dry = plant.parameters.effort_limit, plant.dry
        record.waits = len(plant.delay.line)
        record.segments = len(plant.segments)
        for index, (is_newer, length, coefficients) in enumerate(plant.segments):
            record.newer[index], record.length[index] = is_newer, length
            first = index * MOST_COEFFICIENTS
            record.coefficients[first : first + len(coefficients)] = coefficients
        record.packed[:] = plant.packed

    def lend(self, record: Any) -> None:
        """Write the state."""
        plant = self.plant
        record.theta, record.theta_dot, record.torque = plant.theta, plant.theta_dot, plant.effort
        record.steps = plant.steps
        record.line[: len(plant.delay.line)] = tuple(plant.delay.line)

    def take_back(self, record: Any) -> None:
        """Read the state back."""
        plant = self.plant
        plant.theta, plant.theta_dot, plant.effort = record.theta, record.theta_dot, record.torque
        plant.steps = record.steps
        plant.delay.line.extend(record.line[: len(plant.delay.line)])


def loop_plant(joint_plant: JointPlant) -> LoopPlant:
    """Return a plant for a compiled loop; a NoMachineCodeError if it is stepped by Python."""
    plant = joint_plant.plant if isinstance(joint_plant, OneJoint) else None
    if not isinstance(plant, RigidPlant):
        raise NoMachineCodeError("the plant is not a rigid pendulum of ours")
    if plant.method in _INTERPRETED:
        raise NoMachineCodeError(f"method {plant.method} is not compiled")
    if len(plant.segments) > _MOST_SEGMENTS or plant.delay.whole > _MOST_WHOLE:
        raise NoMachineCodeError(f"more than {_MOST_SEGMENTS} substeps, or a delay of more than {_MOST_WHOLE} periods")
    return LoopPlant(plant)
