"""``record``: write topics to a bag that stays readable if the recorder is killed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.errors import BagError
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option
from pendulum_rosbag.recorder.options import RecorderOptions, read_metadata

__all__ = ["main"]


def record(
    context: typer.Context,
    output: Annotated[Path, out_option("Folder of the bag; it must not exist.")],
    topics: Annotated[list[str] | None, typer.Argument(help="Topics by their full names; by default all.")] = None,
    regex: Annotated[str, typer.Option(help="Record topics that match this pattern, too.")] = "",
    exclude: Annotated[str, typer.Option(help="Leave out topics that match this pattern.")] = "",
    storage: Annotated[str, typer.Option(help="mcap or sqlite3.")] = "mcap",
    compression: Annotated[str, typer.Option(help="zstd, or none.")] = "none",
    max_size: Annotated[
        float, typer.Option(help="Begin a new file before this one is larger [MB]; 0 for never.")
    ] = 0.0,
    max_duration: Annotated[
        float, typer.Option(help="Begin a new file before this one is longer [s]; 0 for never.")
    ] = 0.0,
    duration: Annotated[float, typer.Option(help="Stop after this time [s]; 0 for never.")] = 0.0,
    metadata: Annotated[Path | None, typer.Option(help="JSON object to store with the bag.")] = None,
    log_time: Annotated[
        str, typer.Option(help="receive (time of arrival) or header (stamp of the message).")
    ] = "receive",
    wait: Annotated[bool, typer.Option("--wait", help="Begin when the service ~/start is called.")] = False,
    black_box: Annotated[
        float,
        typer.Option(help="Keep so much in memory [s], and write a bag of it at each fault and e-stop; 0 records all."),
    ] = 0.0,
) -> int:
    """Record topics to a rosbag2 folder that is complete and readable at every instant.

    Example: python -m pendulum_rosbag record -o runs/today --regex '^/(sim|hw)/' --compression zstd. ROS arguments
    follow --ros-args.
    """
    options = RecorderOptions(
        output,
        tuple(topics or ()),
        regex,
        exclude,
        storage,
        None if compression in ("", "none") else compression,
        round(max_size * 1e6),
        max_duration,
        duration,
        read_metadata(metadata),
        log_time,
        wait,
        black_box,
    )
    if output.exists():
        raise BagError(f"bag {output} exists already; expected a new folder (bags are never overwritten)")

    from pendulum_msgs_py.ros.runner import run_node
    from pendulum_rosbag.recorder.recorder_node import SPECS, Recorder

    return run_node(
        lambda stop: Recorder(options, stop),
        list(context.obj),
        program="pendulum_rosbag record",
        description="Record topics to a bag.",
        specs=SPECS,
    )


main = command_line(record, "python -m pendulum_rosbag record", takes_ros_arguments=True)
