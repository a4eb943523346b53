"""Backends of the actuator port: one module and one entry in :data:`BACKENDS` each."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from pendulum_msgs_py.parameters import ParameterSpec

if TYPE_CHECKING:
    from pendulum_hw_bridge.port.actuator import ActuatorPort
    from pendulum_hw_bridge.port.clocks import Clock

__all__ = ["BACKENDS", "Backend"]


class Backend(NamedTuple):
    """One backend.

    Attributes:
        target: ``module:class``, imported when chosen; its ``from_parameters(values, clock, lockstep=...)`` makes a
            port.
        parameters: Bridge parameters that only this backend reads.
        is_machine: Whether a real machine moves: the bridge's own limits are then the strict ones.
        in_process: Whether it runs in this process: then parameters describe it and it supports simulated time.
    """

    target: str
    parameters: tuple[ParameterSpec, ...] = ()
    is_machine: bool = True
    in_process: bool = False

    def make(self, values: Mapping[str, Any], clock: Clock, *, lockstep: bool = False) -> ActuatorPort:
        """Return the port that the parameters describe, not connected yet.

        In ``lockstep``, time is simulated: feedback comes without jitter, just before each state.

        Raises:
            ParameterError: A parameter of the backend is refused.
        """
        module, name = self.target.split(":")
        port: ActuatorPort = getattr(importlib.import_module(module), name).from_parameters(
            values, clock, lockstep=lockstep
        )
        return port


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
)
"""Parameters of several modules; for a single module the same names in the singular."""

BACKENDS: dict[str, Backend] = {
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
