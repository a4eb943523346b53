"""``scan``: list the actuators that answer, and which of them the bridge would drive."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_hw_bridge.backends import BACKENDS, hebi
from pendulum_hw_bridge.backends.hebi_discovery import LOOK_TIME, ModuleRecord, ModuleSelection, discover, select_module
from pendulum_hw_bridge.bridge.assembly import for_plant
from pendulum_hw_bridge.bridge.bridge_parameters import BRIDGE_SPECS
from pendulum_hw_bridge.port.actuator import ActuatorError
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.lab_file import load_lab
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["main"]

EXIT_NONE_CHOSEN = 1
"""Exit code if not exactly one module matches."""


def scan(
    lab: Annotated[Path | None, typer.Option(help="Lab file that says which module is meant.")] = None,
    backend: Annotated[str | None, typer.Option(help="hebi, dynamixel, or emulator_process.")] = None,
    interface: Annotated[
        str | None, typer.Option(help="Network address to search; default all; emulator:HOST:PORT in a rehearsal.")
    ] = None,
    family: Annotated[str | None, typer.Option(help="HEBI family that is meant.")] = None,
    name: Annotated[str | None, typer.Option(help="HEBI name that is meant.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial number that is meant.")] = None,
    mac_address: Annotated[str | None, typer.Option(help="MAC address that is meant.")] = None,
    module_type: Annotated[str | None, typer.Option(help="Type that it must be of; default X5-9.")] = None,
    emulator_address: Annotated[str | None, typer.Option(help="HOST:PORT of an emulator process.")] = None,
    look_time: Annotated[float, typer.Option(help="Time to look for [s].", min=0.25, max=60.0)] = LOOK_TIME,
    as_json: Json = False,
) -> int:
    """List the actuators that answer; nothing is set and nothing moves.

    Example: python -m pendulum_hw_bridge scan --interface 192.168.1.10
    """
    given = {
        "backend": backend,
        "interface": interface,
        "family": family,
        "name": name,
        "serial": serial,
        "mac_address": mac_address,
        "module_type": module_type,
        "emulator_address": emulator_address,
    }
    known = {spec.name for spec in BRIDGE_SPECS}
    of_file = {k: v for k, v in load_lab(lab).values.items() if k in known} if lab is not None else {"backend": "hebi"}
    chosen_values = {**of_file, **{k: v for k, v in given.items() if v is not None}}
    specs = for_plant(BRIDGE_SPECS, "thesis", str(chosen_values.get("backend")))
    values = validate(specs, chosen_values)
    console = make_console(stderr=True)
    if not as_json:
        console.print(f"looking for {values['backend']} actuators for {look_time:g} s ...", style="dim")
    modules = _modules(values, look_time)
    chosen, reason = None, ""
    try:
        chosen = _choose(modules, values, look_time)
    except ActuatorError as error:
        reason = str(error)
    if as_json:
        found = {
            "modules": [asdict(module) for module in modules],
            "chosen": chosen and asdict(chosen),
            "reason": reason,
        }
        print(json_text(found))
    else:
        _print(modules, chosen, reason)
    return 0 if chosen is not None else EXIT_NONE_CHOSEN


def _choose(modules: list[ModuleRecord], values: dict[str, Any], look_time: float) -> ModuleRecord:
    """Return the module that is meant; ActuatorError if there is none."""
    if not BACKENDS[values["backend"]].torque_drive:
        return select_module(modules, ModuleSelection.of(values), seconds=look_time)
    number, model = str(int(values["drive_id"])), values["drive_model"]
    for module in modules:
        if (module.serial, module.type) == (number, model):
            return module
    seen = ", ".join(f"{module.serial} ({module.type})" for module in modules) or "none"
    raise ActuatorError("module_lost", f"drives on {values['interface']}: {seen}; expected number {number} ({model})")


def _modules(values: dict[str, Any], look_time: float) -> list[ModuleRecord]:
    if values["backend"] == "hebi":
        return discover(hebi.open_lookup(values["interface"]), look_time=look_time, patience=look_time)
    if BACKENDS[values["backend"]].torque_drive:
        return [
            ModuleRecord(drive.family, "", "", drive.serial, drive.model.name, drive.firmware, values["interface"])
            for drive in BACKENDS[values["backend"]].scan(values)
        ]
    if values["backend"] != "emulator_process":
        raise ParameterError(f"backend is {values['backend']!r}; expected hebi, dynamixel or emulator_process")
    from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend

    port = EmulatorProcessBackend(values["emulator_address"], attempts=max(1, round(4 * look_time)))
    try:
        port.connect()
        tells = port.status()
    except ActuatorError:
        return []
    finally:
        port.release()
    # An emulator has no network card; its address identifies it.
    return [
        ModuleRecord(
            tells["family"],
            tells["name"],
            "",
            tells["serial"],
            tells["type"],
            tells["firmware"],
            values["emulator_address"],
        )
    ]


def _print(modules: list[ModuleRecord], chosen: ModuleRecord | None, reason: str) -> None:
    console = make_console()
    if modules:
        table = WholeTable(
            "",
            "family",
            "name",
            "serial",
            "type",
            "firmware",
            "MAC address",
            "IP address",
            "state",
            title="Actuators that answer",
        )
        for module in modules:
            state = "stale" if module.stale else "answers" if module.serial else "seen, does not answer"
            table.add_row(
                "[green]->[/green]" if module == chosen else "",
                module.family,
                module.name,
                *(
                    text or "–"
                    for text in (module.serial, module.type, module.firmware, module.mac_address, module.address)
                ),
                state,
            )
        console.print(table)
    if chosen is not None:
        console.print(f"The bridge would drive {chosen}.", style="green", highlight=False)
    else:
        console.print(reason, style="bold red", highlight=False)


main = command_line(scan, "python -m pendulum_hw_bridge scan")
