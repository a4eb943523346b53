"""Assembly of a plant on drives with a current loop: Dynamixel and others, one for each joint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.backends.torque_drive import TORQUE_LOOP, TorqueDrive
from pendulum_hw_bridge.bridge import bridge_parameters
from pendulum_hw_bridge.bridge.group_assembly import refuse_slides, values_of_joint
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.current_drive import CurrentCheck, CurrentMapping
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyMonitor
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import MStopAction
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DriveAssembly"]

_MEASURED_SHARE = 1.3
"""Limit of the measured effort, as a multiple of the effort limit [-]."""
_DISAGREEMENT = 0.05
"""Largest disagreement of position and velocity within 0.2 s: drives filter their velocity [rad]."""
_LATE = 0.01
"""Time for which an older setpoint may still show: bus, current loop and filter of the current [s]."""
_STIFFNESS = 20.0
"""Natural frequency of position control, which the bridge computes: a tenth of the slowest usual rate [rad/s]."""
_DAMPING = 0.7
"""Its damping ratio [-]."""


class DriveAssembly:
    """Modules of a plant's joints; ParameterError if a parameter does not fit the joints or the drives."""

    def __init__(self, values: Mapping[str, Any], plant: PlantParameters, limits: PlantLimits) -> None:
        refuse_slides(plant.coordinates, values["backend"])
        coordinates = plant.coordinates
        if len(coordinates.driven) != len(coordinates.joints):
            free = [name for index, name in enumerate(coordinates.names) if index not in coordinates.driven]
            raise ParameterError(
                f"plant {plant.name!r} has no motor at {', '.join(free)}; expected one at each joint with backend "
                f"{values['backend']!r}"
            )
        self._values, self._plant, self._limits = values, plant, limits
        # A single joint has its own parameters; the lists are those of several.
        several = len(coordinates.joints) > 1
        self._joints = [
            values_of_joint(values, coordinates, index) if several else dict(values)
            for index in range(len(coordinates.joints))
        ]
        self.mappings = [self._mapping(index) for index in range(len(self._joints))]

    def modules(self, clock: Clock) -> list[Module]:
        """Return the modules on a host clock, not connected yet."""
        made: list[Module] = []
        first: TorqueDrive | None = None
        for index, own in enumerate(self._joints):
            if first is None:
                port = bridge_parameters.make_port(own, clock)
                assert isinstance(port, TorqueDrive)
                first = port
            else:
                port = first.on_this_bus(own)
            made.append(self.module(port, index))
        return made

    def module(self, port: TorqueDrive, index: int) -> DrivenModule:
        """Return the module of a joint on its port."""
        own, limits, mapping = self._joints[index], self._limits, self.mappings[index]
        settings = bridge_parameters.bridge_settings(
            own,
            effort=mapping.effort_limit,
            velocity=limits.velocity,
            gains=mapping.gains,
            window=(limits.position_min[index], limits.position_max[index]),
        )
        # These drives have no input for a motion stop: the switch of the supply is it.
        settings = replace(settings, limits=replace(settings.limits, m_stop=MStopAction.DISABLED, joint=mapping.joint))
        safety = bridge_parameters.safety_limits(own, mapping.effort_limit)
        safety = replace(
            safety,
            measured_effort=own["measured_effort_limit"] or _MEASURED_SHARE * mapping.effort_limit,
            position_disagreement=_DISAGREEMENT,
            winding_current=0.0,
            command_tolerance=0.02 * mapping.effort_limit,
        )
        period = round(NANOSECONDS / own["feedback_rate"]) / NANOSECONDS
        name = mapping.joint.name if len(self._joints) > 1 else ""
        monitor = SafetyMonitor(safety, period, mapping.drivetrain, mapping.joint)
        return DrivenModule(port, mapping, monitor, settings, joint=name, check=CurrentCheck)

    def _mapping(self, index: int) -> CurrentMapping:
        values, plant, limit = self._values, self._plant, self._limits.effort[index]
        joint = plant.coordinates.joints[index]
        drive = BACKENDS[values["backend"]].drive_of(values["drive_model"])
        hardware = QuasiDirectDrive(
            gear_ratio=drive.gear_ratio,
            peak_current=limit / drive.torque_per_ampere,
            supply_voltage=max(values["voltage_window"]),
        )
        alone = len(self._joints) == 1
        stiffness, inertia = 0.0, plant.inertia if alone else 0.0
        if alone:
            stiffness = plant.gravity + inertia * _STIFFNESS**2
        return CurrentMapping(
            EffortStrategy.EFFORT_LOOP,
            hardware.constants(joint, limit),
            gains=DEFAULT_GAINS[TORQUE_LOOP],
            effort_limit=limit,
            joint=joint,
            late=math.ceil(_LATE * values["feedback_rate"]),
            stiffness=stiffness,
            viscosity=2.0 * _DAMPING * math.sqrt(stiffness * inertia),
        )
