"""``check``: what a lab runs before arming."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any

import typer

from pendulum_hw_bridge.bridge_parameters import (
    BRIDGE_SPECS,
    bridge_settings,
    make_port,
    plant_of,
    safety_limits,
    trajectory_gains,
)
from pendulum_hw_bridge.checklist import CheckItem, run_checklist
from pendulum_hw_bridge.clocks import WallClock
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["main"]

EXIT_NOT_READY = 1
"""Exit code where an item of the checklist is not as it should be."""

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def check(
    backend: Annotated[str, typer.Option(help="hebi, emulator, emulator_process or replay.")] = "hebi",
    family: Annotated[
        str, typer.Option(help="HEBI family; empty for any, if there is only one module.")
    ] = "",
    name: Annotated[str, typer.Option(help="HEBI name; empty for any, if there is only one module.")] = "",
    interface: Annotated[str, typer.Option(help="Network address to look on; empty for all.")] = "",
    plant: Annotated[str, typer.Option(help="thesis, x5_9, or a plant file with a drivetrain.")] = "thesis",
    feedback_rate: Annotated[float, typer.Option(help="Feedback records per second [Hz].")] = 100.0,
    gains_file: Annotated[str, typer.Option(help="HEBI gains file; empty for the defaults.")] = "",
    emulator_address: Annotated[
        str, typer.Option(help="HOST:PORT of an emulator process.")
    ] = "127.0.0.1:17590",
    joint_offset: Annotated[
        float, typer.Option(help="Joint angle at which the actuator reads zero [rad].")
    ] = 0.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> int:
    """Go through the checklist before arming; the motor gets no torque.

    Example: python -m pendulum_hw_bridge check --backend hebi --family Lab --name Pendulum
    """
    values: dict[str, Any] = validate(
        BRIDGE_SPECS,
        {
            "backend": backend,
            "family": family,
            "name": name,
            "interface": interface,
            "plant": plant,
            "feedback_rate": feedback_rate,
            "gains_file": gains_file,
            "emulator_address": emulator_address,
            "joint_offset": joint_offset,
        },
    )
    effort = plant_of(values).effort_limit
    settings = bridge_settings(values, effort=effort, velocity=1.5, gains=trajectory_gains(values))
    console = make_console(stderr=True)
    items = run_checklist(
        make_port(values, WallClock()),
        settings,
        safety_limits(values),
        window=(-4.0, 4.0),
        progress=(lambda text: None) if as_json else lambda text: console.print(f"{text} ...", style="dim"),
    )
    ready = all(item.passed for item in items)
    if as_json:
        print(json.dumps({"ready": ready, "items": [asdict(item) for item in items]}, indent=2))
    else:
        _print(items, ready)
    return 0 if ready else EXIT_NOT_READY


def _print(items: list[CheckItem], ready: bool) -> None:
    table = WholeTable("", "check", "seen", "expected", title="Before arming")
    for item in items:
        mark = "[green]ok[/green]" if item.passed else "[bold red]NO[/bold red]"
        table.add_row(mark, item.name, item.seen, item.expected)
    console = make_console()
    console.print(table)
    if ready:
        console.print(
            "Ready. Keep a hand on the motion stop, and nobody in the pendulum's plane.", style="green"
        )
    else:
        console.print("Not ready: do not arm before every line is ok.", style="bold red")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the checklist."""
    return cli_main(app, argv, name="python -m pendulum_hw_bridge check")
