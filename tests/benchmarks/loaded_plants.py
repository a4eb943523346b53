"""Measures what both plants miss where a machine of two cores has all to do: recorder, console, and two busy loops."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from pendulum_bags.experiments.session import RECORDER_PRIORITY, permitted
from pendulum_rosbag.reader import read_bag
from tests.benchmarks.console_cost import start_console
from tests.benchmarks.plant_listener import missed_share
from tests.benchmarks.two_plants import PLANTS, RATE, two_plants

__all__ = ["LoadedPlants", "loaded_plants"]

_BUSY_LOOPS = 2
_WARM_UP = 5.0
_START = 60.0
_BUSY = [sys.executable, "-c", "while True: pass"]


@dataclass(frozen=True)
class LoadedPlants:
    """What a run showed.

    Attributes:
        missed: Of each plant, by the name of its node: share of its deadlines missed by a period or more [%].
        faults: Reasons of the plants that are in a fault at the end.
        recorded: Messages in the bag.
        lost: Messages that the recorder knows of and the bag has not.
        real_time: Whether plants, who answers them and the recorder had real-time priority.
    """

    missed: dict[str, float]
    faults: list[str]
    recorded: int
    lost: int
    real_time: bool


def loaded_plants(duration: float, *, real_time: bool = True) -> LoadedPlants:
    """Run both plants at 500 Hz, controlled and under noise, recorded and shown on a page, beside two busy loops.

    Args:
        duration: Length of the measurement [s].
        real_time: As an experiment runs them: before all else, where this user may have that. Else as ordinary ones.
    """
    with two_plants(real_time=real_time) as running:
        group, loops = running.group, running.loops
        bag = running.folder / "bag"
        start_console(group, running.environment, running.folder / "runs")
        priority = permitted(RECORDER_PRIORITY) if real_time else 0
        in_time = ("--ros-args", "-p", f"realtime_priority:={priority}")
        recording = ("record", "-o", bag, "--regex", "^/(sim|hw)/", *in_time)
        recorder = group.start("pendulum_rosbag", *recording, env=running.environment)
        recorder.wait_for_output("ready", _START)
        for index in range(_BUSY_LOOPS):
            group.start_command(_BUSY, name=f"busy {index}")
        loops.spin(_WARM_UP)
        loops.clear()
        loops.let_run(duration)
        rows = {plant: loops.rows[plant] for plant in PLANTS}
        missed = {plant: missed_share(found[0], found[-1], RATE) for plant, found in rows.items()}
        faults = [found[-1]["reason"] for found in rows.values() if found[-1]["mode"] == "fault"]
        recorder.interrupt()
        recorder.wait(_START)
        with read_bag(bag) as opened:
            counts = opened.metadata["pendulum.recorder.counts"].values()
        return LoadedPlants(
            missed,
            faults,
            recorded=sum(count["written"] for count in counts),
            lost=sum(count["lost"] for count in counts),
            real_time=priority > 0,
        )
