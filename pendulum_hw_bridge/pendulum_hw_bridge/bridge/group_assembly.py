"""Assembly of a plant of several joints on a group of HEBI modules."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pendulum_hw_bridge.backends.hebi_discovery import ModuleSelection
from pendulum_hw_bridge.backends.hebi_group import GroupDrive, GroupEncoder, HebiGroup
from pendulum_hw_bridge.bridge import bridge_parameters
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping
from pendulum_hw_bridge.drive.safety import SafetyMonitor
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError

__all__ = ["OF_GROUPS", "GroupAssembly", "refuse_slides", "values_of_joint"]

OF_GROUPS = {
    "families": "family",
    "names": "name",
    "serials": "serial",
    "mac_addresses": "mac_address",
    "joint_offsets": "joint_offset",
    "joint_signs": "joint_sign",
    "effort_tares": "effort_tare",
    "drive_ids": "drive_id",
}
"""Parameters of several modules -> those of one."""


def refuse_slides(coordinates: Coordinates, backend: str = "hebi") -> None:
    """Raise ParameterError if a joint slides: modules only turn."""
    for joint in coordinates.joints:
        if joint.unit != "rad":
            raise ParameterError(
                f"joint {joint.name!r} slides, and a module of backend {backend!r} turns; expected a plant whose "
                "joints all turn"
            )


class GroupAssembly:
    """Modules of a plant's joints, in one HEBI group; ParameterError if a parameter does not fit the joints."""

    def __init__(self, values: Mapping[str, Any], coordinates: Coordinates, limits: PlantLimits) -> None:
        self._values = values
        self._coordinates = coordinates
        self._limits = limits
        self._joints = [values_of_joint(values, coordinates, index) for index in range(len(coordinates.joints))]
        self._plant = load_emulator(values["drivetrain"]).plant
        self._gains = bridge_parameters.trajectory_gains(values)
        self.mappings = [self._mapping(driven) for driven in range(len(coordinates.driven))]
        # Made here too, so that a refused parameter ends the process with its message.
        self.modules(None)

    def modules(self, clock: Clock | None) -> list[Module]:
        """Return the modules on a host clock, not connected yet; None for a check of the parameters."""
        values, coordinates = self._values, self._coordinates
        selections = map(ModuleSelection.of, self._joints)
        shared = HebiGroup(
            list(zip(coordinates.names, selections, strict=True)),
            coordinates.driven,
            interface=values["interface"],
            log=Path(values["hebi_log"]) if values["hebi_log"] else None,
        )
        return [self._module(shared, index, clock) for index in range(len(self._joints))]

    def _mapping(self, driven: int) -> EffortMapping:
        return bridge_parameters.effort_mapping(self._values, self._plant, self._gains, self._limits, joint=driven)

    def _module(self, shared: HebiGroup, index: int, clock: Clock | None) -> Module:
        limits, own = self._limits, self._joints[index]
        joint = self._coordinates.joints[index].name
        driven = self._coordinates.driven.index(index) if index in self._coordinates.driven else None
        effort = max(limits.effort) if driven is None else limits.effort[driven]
        settings = bridge_parameters.bridge_settings(
            own,
            effort=effort,
            velocity=self.mappings[driven or 0].velocity_limit,
            gains=self._gains,
            window=(limits.position_min[index], limits.position_max[index]),
        )
        # As for one module, whose rate is rounded to whole nanoseconds.
        period = round(NANOSECONDS / own["feedback_rate"]) / NANOSECONDS
        safety = bridge_parameters.safety_limits(own, effort)
        if driven is None:
            return Module(GroupEncoder(shared, index, clock), SafetyMonitor(safety, period), settings, joint=joint)
        drivetrain = self._plant.drivetrain
        return DrivenModule(
            GroupDrive(shared, index, clock, drivetrain=vars(drivetrain)),
            self.mappings[driven],
            SafetyMonitor(safety, period, drivetrain),
            settings,
            joint=joint,
        )


def values_of_joint(values: Mapping[str, Any], coordinates: Coordinates, index: int) -> dict[str, Any]:
    """Return the bridge's parameters with those of one joint under their names for a single module."""
    own = dict(values)
    for several, one in OF_GROUPS.items():
        given, joints = values[several], coordinates.names
        if len(given) not in {1, len(joints)}:
            raise ParameterError(
                f"{several} has {len(given)} values; expected {len(joints)}, for {', '.join(joints)}, or one for all"
            )
        own[one] = given[index if len(given) > 1 else 0]
    sign = own["joint_sign"]
    if sign not in {1.0, -1.0}:
        raise ParameterError(f"joint_signs has {sign:g} for {coordinates.names[index]}; expected 1 or -1")
    own["joint_sign"] = int(sign)
    return own
