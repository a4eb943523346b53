"""``info``: show what is in a bag, and how good its timing is."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.statistics import BagStatistics, bag_statistics

__all__ = ["main"]


def info(
    bag: Annotated[Path, typer.Argument(help="Folder of the bag, or one .mcap or .db3 file.")], as_json: Json = False
) -> int:
    """Print whether a bag is good: rates, gaps, jitter, latencies between topics, duplicates and clock jumps.

    Example: python -m pendulum_rosbag info runs/today/sim --json
    """
    opened = read_bag(bag, verify=True)
    statistics = bag_statistics(opened)
    if as_json:
        document = dataclasses.asdict(statistics) | {"metadata": opened.metadata, "notes": opened.notes}
        print(json_text(document))
        return 0
    _print(statistics, opened.metadata, opened.notes)
    return 0


def _print(statistics: BagStatistics, metadata: dict[str, Any], notes: list[str]) -> None:
    console = make_console()
    console.print(
        f"{statistics.path} ({statistics.storage}): {statistics.count} messages in {statistics.duration:.3f} s",
        highlight=False,
        soft_wrap=True,
    )
    verdict = f"NOT GOOD: {'; '.join(statistics.problems)}" if statistics.problems else "good"
    style = "bold red" if statistics.problems else "bold green"
    console.print(f"recording: {verdict}", style=style, highlight=False, soft_wrap=True, markup=False)
    for sentence in statistics.damage:
        console.print(f"damaged: {sentence}", style="bold red", highlight=False, soft_wrap=True)
    for sentence in notes:
        console.print(f"note: {sentence}", highlight=False, soft_wrap=True, markup=False)
    # Two tables: one line per topic for the rate, one for faults.
    title = "topics (intervals between stamps, or log times, in ms)"
    table = WholeTable("topic", "type", "by", title=title, title_justify="left")
    for heading in ("count", "rate [Hz]", "median", "jitter", "p99", "longest", "gaps", "missing"):
        table.add_column(heading, justify="right")
    for name, topic in statistics.topics.items():
        table.add_row(
            name,
            topic.type.rsplit("/", 1)[-1],
            "stamp" if topic.stamped else "log",
            str(topic.count),
            *(_number(v) for v in (topic.rate, topic.period, topic.jitter, topic.period_p99, topic.longest)),
            _alarm(topic.gaps),
            _alarm(topic.missing),
        )
    console.print(table)
    stamped = {name: topic for name, topic in statistics.topics.items() if not math.isnan(topic.age)}
    if stamped:
        table = WholeTable("topic", title="stamps (age = log time - stamp, in ms)", title_justify="left")
        for heading in ("age", "age p99", "duplicates", "backward", "clock jumps"):
            table.add_column(heading, justify="right")
        for name, topic in stamped.items():
            counts = (topic.duplicates, topic.backward, topic.clock_jumps)
            table.add_row(name, _number(topic.age), _number(topic.age_p99), *(_alarm(count) for count in counts))
        console.print(table)
    if statistics.latencies:
        table = WholeTable("from", "to the answer on", title="latencies (by equal stamps, in ms)", title_justify="left")
        for heading in ("matched", "median", "p99", "longest"):
            table.add_column(heading, justify="right")
        for latency in statistics.latencies:
            values = (latency.median, latency.p99, latency.longest)
            table.add_row(latency.source, latency.answer, str(latency.matched), *(_number(v) for v in values))
        console.print(table)
    for event in statistics.events:
        offset = (event["log_time_ns"] - statistics.events[0]["log_time_ns"]) * 1e-9
        parts = [str(event[key]) for key in ("mode", "reason", "trial") if event.get(key) not in (None, "")]
        text = f"event {offset:+9.3f} s  {' '.join([str(event['name']), ': '.join(parts)]).rstrip()}"
        console.print(text, highlight=False, soft_wrap=True, markup=False)
    for key, value in metadata.items():
        text = value if isinstance(value, str) else json.dumps(value)
        console.print(
            f"{key}: {text if len(text) < 400 else text[:400] + ' ...'}", highlight=False, soft_wrap=True, markup=False
        )


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"


def _alarm(count: int) -> str:
    return f"[bold red]{count}[/]" if count else "0"


main = command_line(info, "python -m pendulum_rosbag info")
