"""``repair``: repair bags that a recorder left broken."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_rosbag.repair.repair import repair_bag

__all__ = ["main"]


def repair(
    bag: Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap or .db3 file.")],
    output: Annotated[
        Path | None, out_option("Folder for the sound bag; by default it takes the place of BAG.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Rewrite a sound bag, too.")] = False,
    as_json: Json = False,
) -> int:
    """Save all whole messages of a broken bag to a sound one; the broken one is kept as BAG.broken.

    Example: python -m pendulum_rosbag repair runs/today/sim
    """
    report = repair_bag(bag, output, force=force)
    if as_json:
        print(json_text(dataclasses.asdict(report)))
        return 0
    for sentence in report.damage:
        print(f"found: {sentence}")
    for topic, count in sorted(report.messages.items()):
        print(f"{count:10d}  {topic}")
    for name in report.kept:
        print(f"      kept  {name}")
    print(report.sentence())
    return 0


main = command_line(repair, "python -m pendulum_rosbag repair")
