"""Times of states and commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pendulum_msgs_py.contract import names
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.statistics import bag_statistics

__all__ = ["answer"]


def answer(path: Path, plant: str) -> dict[str, Any]:
    """Return rate, jitter, gaps and latency of a plant in a bag, by name."""
    with read_bag(path) as bag:
        found = bag_statistics(bag)
    states = found.topics[f"{plant}/{names.JOINT_STATES}"]
    row: dict[str, Any] = {f"states_{name}": getattr(states, name) for name in ("count", "rate", "jitter", "longest")}
    row |= {f"states_{name}": getattr(states, name) for name in ("gaps", "missing", "clock_jumps")}
    answered = f"{plant}/{names.EFFORT_COMMAND}"
    for latency in found.latencies:
        if latency.answer == answered and latency.source == f"{plant}/{names.JOINT_STATES}":
            row |= {"answer_median": latency.median, "answer_p99": latency.p99}
    return row
