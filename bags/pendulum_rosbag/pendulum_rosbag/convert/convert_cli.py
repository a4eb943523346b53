"""``convert``: rewrite one bag; ``merge``: join many bags; ``cut``: cut out a span; ``filter``: keep some topics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import TimeRemainingColumn

from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counting_bar
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_rosbag.convert.rewrite import Choice
    from pendulum_rosbag.reader import Bag

__all__ = ["convert_main", "cut_main", "filter_main", "merge_main"]

_STEPS = 1000

Source = Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap or .db3 file.")]
AnySource = Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap, .db3 or ROS 1 .bag file.")]
Output = Annotated[Path, out_option("Folder of the new bag; it must not exist.")]
Storage = Annotated[str, typer.Option(help="mcap or sqlite3; by default that of the bag.")]
Compression = Annotated[str, typer.Option(help="zstd or none; by default what the bag has.")]
Topics = Annotated[list[str] | None, typer.Option("--topic", "-t", help="Topic to keep; several times if wanted.")]
Regex = Annotated[str, typer.Option(help="Keep topics that match this pattern, too.")]
Exclude = Annotated[str, typer.Option(help="Leave out topics that match this pattern.")]
MaxSize = Annotated[float, typer.Option(help="Begin a new file before this one is larger [MB]; 0 for never.")]
MaxDuration = Annotated[float, typer.Option(help="Begin a new file before this one is longer [s]; 0 for never.")]


def convert(
    bag: AnySource,
    output: Output,
    storage: Storage = "",
    compression: Compression = "",
    max_size: MaxSize = 0.0,
    max_duration: MaxDuration = 0.0,
    as_json: Json = False,
) -> None:
    """Write a bag anew: other storage or compression, split or in one file, ordered by log time; ROS 1 bags too.

    Example: python -m pendulum_rosbag convert runs/today/sim -o /tmp/sim --storage sqlite3
    """
    _run([bag], output, None, storage, compression, as_json, max_size, max_duration)


def merge(
    bags: Annotated[list[Path], typer.Argument(help="Bags, as for convert.")],
    output: Output,
    storage: Storage = "",
    compression: Compression = "",
    max_size: MaxSize = 0.0,
    max_duration: MaxDuration = 0.0,
    as_json: Json = False,
) -> None:
    """Write several bags to one, ordered by log time; the run metadata of each is kept under its name.

    Example: python -m pendulum_rosbag merge runs/today/sim runs/today/hw -o /tmp/both
    """
    if len(bags) < 2:
        raise ParameterError("1 bag was named; expected at least 2 to merge")
    _run(bags, output, None, storage, compression, as_json, max_size, max_duration)


def cut(
    bag: Source,
    output: Output,
    start: Annotated[float | None, typer.Option(help="Begin so long after the first message [s].")] = None,
    stop: Annotated[float | None, typer.Option(help="End so long after the first message [s].")] = None,
    from_event: Annotated[str, typer.Option(help="Begin with the first event of this name.")] = "",
    to_event: Annotated[str, typer.Option(help="End with the last event of this name.")] = "",
    storage: Storage = "",
    compression: Compression = "",
    as_json: Json = False,
) -> None:
    """Write the messages of a time span, by log time.

    Example: python -m pendulum_rosbag cut runs/today/sim -o /tmp/noise --from-event noise_start --to-event noise_end
    """
    from pendulum_rosbag.convert.rewrite import Choice
    from pendulum_rosbag.reader import read_bag

    if start is None and stop is None and not from_event and not to_event:
        raise ParameterError("no span was given; expected --start, --stop, --from-event or --to-event")
    if (start is not None and from_event) or (stop is not None and to_event):
        raise ParameterError("a time and an event were given for one end of the span; expected one of them")
    for name, value in (("start", start), ("stop", stop)):
        if value is not None and not (math.isfinite(value) and value >= 0.0):
            raise ParameterError(f"{name} is {value} s; expected >= 0 s after the first message")
    with read_bag(bag) as opened:
        begin = opened.start_ns
        start_ns = None if start is None else begin + round(start * 1e9)
        stop_ns = None if stop is None else begin + round(stop * 1e9)
        if from_event:
            start_ns = _event_times(opened, from_event)[0]
        if to_event:
            stop_ns = _event_times(opened, to_event)[-1] + 1
    _run([bag], output, Choice(start_ns=start_ns, stop_ns=stop_ns), storage, compression, as_json)


def filter_topics(
    bag: Source,
    output: Output,
    topics: Topics = None,
    regex: Regex = "",
    exclude: Exclude = "",
    storage: Storage = "",
    compression: Compression = "",
    as_json: Json = False,
) -> None:
    """Write the messages of some topics.

    Example: python -m pendulum_rosbag filter runs/today/sim -o /tmp/states -t /sim/joint_states --regex '/events$'
    """
    from pendulum_rosbag.convert.rewrite import Choice

    if not (topics or regex or exclude):
        raise ParameterError("no topic was chosen; expected --topic, --regex or --exclude")
    _run([bag], output, Choice(tuple(topics or ()), regex, exclude), storage, compression, as_json)


def _event_times(bag: Bag, name: str) -> list[int]:
    events = bag.events()
    times = sorted(int(event["log_time_ns"]) for event in events if event["name"] == name)
    if not times:
        known = ", ".join(sorted({str(event["name"]) for event in events})) or "none"
        raise DataError(f"bag {bag.path} has no event {name!r}; it has {known}")
    return times


def _run(
    bags: Sequence[Path],
    output: Path,
    choice: Choice | None,
    storage: str,
    compression: str,
    as_json: bool,
    max_size: float = 0.0,
    max_duration: float = 0.0,
) -> None:
    from pendulum_rosbag.convert.rewrite import rewrite

    for name, value in (("max-size", max_size), ("max-duration", max_duration)):
        if not (math.isfinite(value) and value >= 0.0):
            raise ParameterError(f"{name} is {value}; expected >= 0")

    console = make_console(stderr=True, highlight=False)
    with counting_bar(console, TimeRemainingColumn()) as bar:
        task = bar.add_task(output.name, total=_STEPS)
        report = rewrite(
            bags,
            output,
            choice,
            storage=storage,
            compression=None if compression == "none" else compression,
            max_size=math.ceil(max_size * 1e6),
            max_duration=max_duration,
            on_progress=lambda share: bar.update(task, completed=round(share * _STEPS)),
        )
    if as_json:
        print(json_text(dataclasses.asdict(report)))
        return
    for sentence in report.damage:
        print(f"found: {sentence}")
    for topic, count in sorted(report.messages.items()):
        print(f"{count:10d}  {topic}")
    print(report.sentence())


convert_main = command_line(convert, "python -m pendulum_rosbag convert")
merge_main = command_line(merge, "python -m pendulum_rosbag merge")
cut_main = command_line(cut, "python -m pendulum_rosbag cut")
filter_main = command_line(filter_topics, "python -m pendulum_rosbag filter")
