"""Simulator and bridge at one rate, each with its controller and under noise, as what looks at them is measured."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.session import ANSWER_PRIORITY, PLANT_PRIORITY, in_real_time
from pendulum_msgs_py.programs import graph
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.benchmarks.plant_listener import PlantListener, domain_environment

__all__ = ["PLANTS", "RATE", "TwoPlants", "patient_watchdog", "two_plants"]

RATE = 500.0
"""States per second of each plant [Hz]."""
_LONGEST_SLEEP = 0.025
"""What a desktop's scheduler may keep a program from running [s]: many cycles at a high rate."""
PLANTS = ("/sim/simulator", "/hw/bridge")


@dataclass(frozen=True)
class TwoPlants:
    """The running plants.

    Attributes:
        folder: For whatever is written meanwhile.
        group: Starts more programs, and ends them with the plants.
        environment: For these programs.
        loops: Hears the plants' diagnostics.
        programs: Plants, controllers and disturbances.
    """

    folder: Path
    group: ProcessGroup
    environment: dict[str, str]
    loops: PlantListener
    programs: list[RunningProgram]


def patient_watchdog(rate: float) -> int:
    """Return the cycles without feedback after which a bridge on an emulator should fault on a busy machine [-].

    Args:
        rate: Feedback records per second [Hz].
    """
    return max(3, math.ceil(_LONGEST_SLEEP * rate))


@contextmanager
def two_plants(*, real_time: bool = False) -> Iterator[TwoPlants]:
    """Start them, the bridge armed, and end them with all that their group started.

    Args:
        real_time: Plants, and who answers them, go before all else on the machine as in an experiment, where we may.
    """
    with tempfile.TemporaryDirectory() as scratch, reserve_domain(None) as domain:
        group, loops = ProcessGroup(Path(scratch), PROJECT), PlantListener(domain, *PLANTS)
        environment = domain_environment(domain)
        try:
            plants = (
                graph.simulator("/sim", rate_hz=RATE, start="top"),
                graph.bridge(
                    "/hw",
                    backend="emulator",
                    feedback_rate=RATE,
                    initial_position=math.pi,
                    feedback_watchdog=patient_watchdog(RATE),
                ),
            )
            answering = (
                *(graph.controller(space, period=1.0 / RATE) for space in ("/sim", "/hw")),
                *(graph.disturbance(space, autostart=True) for space in ("/sim", "/hw")),
            )
            nodes = (*plants, *answering)
            if real_time:
                nodes = (
                    *(in_real_time(plant, PLANT_PRIORITY) for plant in plants),
                    *(in_real_time(program, ANSWER_PRIORITY) for program in answering),
                )
            programs = [group.start(it.package, it.executable, *it.ros_arguments(), env=environment) for it in nodes]
            loops.wait_for_loops()
            loops.arm("/hw/bridge")
            yield TwoPlants(Path(scratch), group, environment, loops, programs)
        finally:
            loops.close()
            group.close()
