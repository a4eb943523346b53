"""What a report is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pendulum_bags.comparison import Comparison
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.identification.thesis_figures import TrialSet
from pendulum_bags.replay.result import InputReplay
from pendulum_bags.runs.run_data import OpenBag
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import Answer
from pendulum_bags.verdict.answer import answer_of
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_rosbag.reader import read_bag

__all__ = ["ReportData"]


@dataclass(frozen=True)
class ReportData:
    """Everything that figures and tables draw on.

    Args:
        comparison: The comparison.
        summary: Content of ``summary.json``.
        replays: Real recordings driven through our plant.
        names: Names of the run folders.
        trials: The thesis's identification experiments, where they were recorded.
        answer: The sum of all layers that were measured; by default of the comparison alone.
        certified: Which designs carry over to the hardware, where its frequency response was measured.
        open_bag: How a bag is opened that tells more than the comparison.
    """

    comparison: Comparison
    summary: Mapping[str, Any]
    replays: Sequence[InputReplay] = ()
    names: Sequence[str] = ()
    trials: Sequence[TrialSet] = ()
    answer: Answer = None  # type: ignore[assignment]  # filled in below
    certified: Analysis | None = None
    open_bag: OpenBag = read_bag

    def __post_init__(self) -> None:
        """Find the answer."""
        if self.answer is None:
            object.__setattr__(self, "answer", answer_of(self.comparison))  # type: ignore[unreachable]

    @property
    def run(self) -> Mapping[str, Any]:
        """Return what the simulation's bag says about its run."""
        return run_record(self.comparison.pairs[0].simulation.metadata)

    @cached_property
    def plant(self) -> PlantParameters | None:
        """Return the plant that the run was designed on."""
        try:
            return load_plant(str(self.run.get("plant", "thesis")))
        except ParameterError:
            # The file that the run was made with is gone: figures of the model are left out, and say so.
            return None
