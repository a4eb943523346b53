"""Times of states and commands."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.run_data import missed_periods
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.statistics import bag_statistics

__all__ = ["answer"]


def answer(path: Reading, plant: str) -> dict[str, Any]:
    """Return rate, jitter, gaps and latency of a plant in a recording, by name; of a file what its stamps show."""
    if not path.has_states:
        steps = np.diff(path.motion.time)
        missing = missed_periods(np.round(path.motion.time * NANOSECONDS).astype(np.int64))
        figures = {"count": steps.size + 1, "rate": 1.0 / steps.mean(), "jitter": steps.std(), "longest": steps.max()}
        return {f"states_{name}": value for name, value in figures.items()} | {"states_missing": missing}
    with read_bag(path) as bag:
        found = bag_statistics(bag)
    states = found.topics[f"{plant}/{names.JOINT_STATES}"]
    row: dict[str, Any] = {f"states_{name}": getattr(states, name) for name in ("count", "rate", "jitter", "longest")}
    row |= {f"states_{name}": getattr(states, name) for name in ("gaps", "missing", "clock_jumps")}
    answered = f"{plant}/{names.drive_topics(found.topics, plant).command}"
    for latency in found.latencies:
        if latency.answer == answered and latency.source == f"{plant}/{names.JOINT_STATES}":
            row |= {"answer_median": latency.median, "answer_p99": latency.p99}
    return row
