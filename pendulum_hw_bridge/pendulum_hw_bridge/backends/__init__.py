"""Backends of the actuator port: one module and one entry in :data:`BACKENDS` each."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from pendulum_msgs_py.parameters import ParameterSpec, ParameterValue

if TYPE_CHECKING:
    from pendulum_hw_bridge.backends.torque_drive import DriveModel, Identity
    from pendulum_hw_bridge.port.actuator import ActuatorPort
    from pendulum_hw_bridge.port.clocks import Clock

__all__ = ["BACKENDS", "Backend", "Bounds"]


class Bounds(NamedTuple):
    """Largest limits that protect a machine; ``actuator`` names it in messages.

    Attributes:
        effort: Peak torque [N m].
        velocity: Twice what the motor can do, so that a larger limit limits nothing [rad/s].
        supply: Widest window of the supply [V].
        m_stop: Whether the actuator has an input for a motion stop.
    """

    effort: float = 13.0
    velocity: float = 3.0
    supply: tuple[float, float] = (18.0, 52.0)
    actuator: str = "an X5-9"
    m_stop: bool = True


class Backend(NamedTuple):
    """One backend.

    Attributes:
        target: ``module:class``, imported when chosen; its ``from_parameters(values, clock, lockstep=...)`` makes a
            port.
        parameters: Bridge parameters that only this backend reads.
        is_machine: Whether a real machine moves: the bridge's own limits are then the strict ones.
        in_process: Whether it runs in this process: then parameters describe it and it supports simulated time.
        bounds: Largest limits that the bridge accepts on a machine.
        defaults: Defaults of the bridge's parameters that differ with this backend.
        torque_drive: Whether its drives have a current loop: then the class is a ``TorqueDrive``.
    """

    target: str
    parameters: tuple[ParameterSpec, ...] = ()
    is_machine: bool = True
    in_process: bool = False
    bounds: Bounds = Bounds()
    defaults: Mapping[str, ParameterValue] = {}
    torque_drive: bool = False

    def make(self, values: Mapping[str, Any], clock: Clock, *, lockstep: bool = False) -> ActuatorPort:
        """Return the port that the parameters describe, not connected yet.

        In ``lockstep``, time is simulated: feedback comes without jitter, just before each state.

        Raises:
            ParameterError: A parameter of the backend is refused.
        """
        port: ActuatorPort = self._type().from_parameters(values, clock, lockstep=lockstep)
        return port

    def drive_of(self, model: str) -> DriveModel:
        """Return a model of the backend's drives by its name; ParameterError if it is unknown."""
        drive: DriveModel = self._type().drive_of(model)
        return drive

    def scan(self, values: Mapping[str, Any]) -> list[Identity]:
        """Return the drives that answer on a bus; ActuatorError if it cannot be opened."""
        found: list[Identity] = self._type().scan(values)
        return found

    def _type(self) -> Any:
        module, name = self.target.split(":")
        return getattr(importlib.import_module(module), name)


def _fixed(name: str, default: str, description: str) -> tuple[ParameterSpec, ...]:
    return (ParameterSpec(name, default, "", description, read_only=True),)


def _of_joints(name: str, default: list[str] | list[float], unit: str, what: str) -> ParameterSpec:
    text = f"`hebi` with several joints: {what}, in the order of the joints; one value for all."
    return ParameterSpec(name, default, unit, text, read_only=True)


_OF_GROUPS = (
    ParameterSpec(
        "drivetrain",
        "x5_9",
        "",
        "`hebi` with several joints: preset or plant file whose drivetrain each module has.",
        read_only=True,
    ),
    _of_joints("families", [""], "", "HEBI family of each module"),
    _of_joints("names", [""], "", "HEBI name of each module, never sorted"),
    _of_joints("serials", [""], "", "serial number of each module"),
    _of_joints("mac_addresses", [""], "", "MAC address of each module"),
    _of_joints("joint_offsets", [0.0], "rad", "joint angle at which each module reads zero"),
    _of_joints("joint_signs", [1.0], "-", "1, or -1 where a module turns the other way"),
    _of_joints("effort_tares", [0.0], "N m", "torque that each sensor shows when nothing pulls"),
    ParameterSpec("drive_ids", [1.0], "", "`dynamixel` with several joints: number of each drive.", read_only=True),
)
"""Parameters of several modules; for a single module the same names in the singular."""

BACKENDS: dict[str, Backend] = {
    "dynamixel": Backend(
        "pendulum_hw_bridge.backends.dynamixel:DynamixelBackend",
        bounds=Bounds(4.5, 15.0, (3.5, 16.0), "an XM430-W350", m_stop=False),
        defaults={
            "plant": "xl330",
            "drive_model": "XL330-M288",
            "bus_rate": 1_000_000,
            "command_lifetime": 0.04,
            "velocity_limit": 8.0,
            "start_effort_limit": 0.1,
            "handover_effort_limit": 0.1,
            "voltage_window": [3.8, 6.2],
            "winding_temperature_limit": 70.0,
            "derating_temperature": 60.0,
        },
        torque_drive=True,
    ),
    "emulator": Backend("pendulum_hw_bridge.backends.emulator:EmulatorBackend", is_machine=False, in_process=True),
    "emulator_process": Backend(
        "pendulum_hw_bridge.backends.emulator_process:EmulatorProcessBackend",
        _fixed("emulator_address", "127.0.0.1:17590", "`emulator_process`: address of the emulated actuator."),
        is_machine=False,
    ),
    "hebi": Backend(
        "pendulum_hw_bridge.backends.hebi:HebiBackend",
        (*_fixed("hebi_log", "", "`hebi`: new .hebilog file that hebi-py writes; empty for none."), *_OF_GROUPS),
    ),
    "replay": Backend(
        "pendulum_hw_bridge.backends.replay:ReplayBackend",
        _fixed("replay_file", "", "`replay`: feedback to play: a bag folder, an NPZ or a CSV file."),
        is_machine=False,
    ),
}
"""Backends by name; ``EMULATED_BACKENDS``, which experiments read too, lists those that emulate a pendulum."""
