"""``check``: run the checklist before arming; it sends no torque."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.bridge.bridge_parameters import plant_of
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.checks.check_item import Checklist
from pendulum_hw_bridge.checks.checklist import run_checklist
from pendulum_hw_bridge.checks.machine_checklist import run_machine_checklist
from pendulum_hw_bridge.checks.nudge import hand_of
from pendulum_hw_bridge.emulation import EMULATOR_PRESET_NAMES
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_hw_bridge.port.clocks import WallClock
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.plant_parameters import is_mechanism, load_mechanism
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.graph import ParameterArgument
from pendulum_msgs_py.programs.options import Json
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["main"]

EXIT_NOT_READY = 1
"""Exit code if an item of the checklist fails."""
EXIT_BUSY = 3
"""Exit code if this computer was too busy to judge the actuator, and nothing else failed."""


def check(
    context: typer.Context,
    lab: Annotated[Path | None, typer.Option(help="Lab file; explicit options take precedence.")] = None,
    backend: Annotated[str | None, typer.Option(help=f"One of {', '.join(BACKENDS)}.")] = None,
    family: Annotated[str | None, typer.Option(help="HEBI family; default any, if only one answers.")] = None,
    name: Annotated[str | None, typer.Option(help="HEBI name; default any, if only one answers.")] = None,
    serial: Annotated[str | None, typer.Option(help="Serial number of the HEBI module.")] = None,
    interface: Annotated[str | None, typer.Option(help="Network address to search; default all.")] = None,
    plant: Annotated[
        str | None, typer.Option(help=f"{EMULATOR_PRESET_NAMES}, a plant file with a drivetrain, or of several joints.")
    ] = None,
    feedback_rate: Annotated[float | None, typer.Option(help="Feedback records per second [Hz].")] = None,
    gains_file: Annotated[str | None, typer.Option(help="HEBI gains file; default those of the X5-9.")] = None,
    emulator_address: Annotated[str | None, typer.Option(help="HOST:PORT of an emulator process.")] = None,
    joint_offset: Annotated[
        float | None, typer.Option(help="Joint angle at which the actuator reads zero [rad].")
    ] = None,
    joint_sign: Annotated[int | None, typer.Option(help="1, or -1 where the actuator turns the other way.")] = None,
    nudge: Annotated[
        bool, typer.Option(help="Wait for a hand to turn the link counter-clockwise, to test the sign.")
    ] = True,
    as_json: Json = False,
) -> int:
    """Go through the checklist before arming; the motor gets no torque.

    It is judged by the options that the bridge will use: give it the bridge's own, after --ros-args, or the lab file.
    The pendulum must hang at rest. A plant of several joints has lines for each. Exit code 0 if ready, 1 if not, 3 if
    this computer was too busy to tell.

    Example: python -m pendulum_hw_bridge check --lab lab.yaml
    """
    from pendulum_hw_bridge.checks.check_node import bridge_values

    options: dict[str, ParameterArgument | None] = {
        "lab_file": None if lab is None else str(lab),
        "backend": backend,
        "family": family,
        "name": name,
        "serial": serial,
        "interface": interface,
        "plant": plant,
        "feedback_rate": feedback_rate,
        "gains_file": gains_file,
        "emulator_address": emulator_address,
        "joint_offset": joint_offset,
        "joint_sign": joint_sign,
    }
    given = {key: value for key, value in options.items() if value is not None}
    ros_arguments: list[str] = context.obj or []
    if not ros_arguments and lab is None:
        given.setdefault("backend", "hebi")
    values = bridge_values(ros_arguments, given)
    ask = make_console(stderr=True).print

    def progress(text: str) -> None:
        if not as_json:
            ask(f"{text} ...", style="dim")

    found = _go_through(values, progress, (lambda text: ask(text, style="bold")) if nudge else None)
    if as_json:
        items = [asdict(item) for item in found.items]
        document = {"ready": found.ready, "host_busy": found.host_busy, "items": items, "figures": found.figures}
        print(json_text(document))
    else:
        _print(found, "motion stop" if BACKENDS[values["backend"]].bounds.m_stop else "switch of its supply")
    if found.ready:
        return 0
    return EXIT_NOT_READY if found.refused else EXIT_BUSY


def _go_through(
    values: Mapping[str, Any], progress: Callable[[str], None], ask: Callable[[str], None] | None
) -> Checklist:
    from pendulum_hw_bridge.checks.check_node import machine_of

    machine = machine_of(values)
    modules = machine.modules(WallClock())
    windows = list(zip(machine.limits.position_min, machine.limits.position_max, strict=True))
    backend = BACKENDS[values["backend"]]
    if is_mechanism(values["plant"]):
        return run_machine_checklist(modules, load_mechanism(values["plant"]), windows, progress=progress)
    (module,) = modules
    assert isinstance(module, DrivenModule)
    return run_checklist(
        module.port,
        module.settings,
        module.monitor.limits,
        plant_of(values),
        window=windows[0],
        hand=None if ask is None else hand_of(module.port, ask),
        hangs=not values["flat"],
        strategy=module.mapping.strategy if backend.torque_drive else Strategy.DIRECT_PWM,
        m_stop=backend.bounds.m_stop,
        progress=progress,
    )


def _print(found: Checklist, stop: str) -> None:
    table = WholeTable("", "check", "seen", "expected", title="Before arming")
    marks = {True: "[green]ok[/green]", False: "[bold red]NO[/bold red]", None: "[yellow]?[/yellow]"}
    for item in found.items:
        table.add_row(marks[item.passed], item.name, item.seen, item.expected)
    console = make_console()
    console.print(table)
    for item in found.items:
        if item.passed is False and item.hint:
            console.print(f"{item.name}: {item.hint}", style="red", highlight=False, markup=False)
    if found.ready:
        console.print(f"Ready. Keep a hand on the {stop}, and nobody in the pendulum's plane.", style="green")
        if found.untried:
            console.print(f"Not tried: {', '.join(found.untried)}.", style="yellow")
    elif found.refused:
        console.print("Not ready: do not arm before every line is ok.", style="bold red")
    else:
        console.print(
            "This computer is too busy to tell: close other programs and check again. Nothing was found against the "
            "actuator.",
            style="bold yellow",
        )


main = command_line(check, "python -m pendulum_hw_bridge check", takes_ros_arguments=True)
