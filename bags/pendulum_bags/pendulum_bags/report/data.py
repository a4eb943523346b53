"""What a report is made from."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.comparison import Comparison
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.identification.thesis import fit_gravity, fit_inertia_damping, static_holds, trial_part
from pendulum_bags.identification.thesis_figures import TrialSet
from pendulum_bags.replay.result import InputReplay
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_bags.runs.run_data import OpenBag
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import Answer
from pendulum_bags.verdict.answer import answer_of
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_rosbag.reader import read_bag

__all__ = ["ReportData", "read_trials"]


@dataclass(frozen=True)
class ReportData:
    """The data of all figures and tables.

    Args:
        summary: Content of ``summary.json``.
        trials: The thesis's identification experiments, if recorded.
        answer: The sum of all measured layers; by default of the comparison alone.
        certified: Designs that carry over, if the hardware's frequency response was measured.
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
        """Return the simulation's bag's metadata of its run."""
        return run_record(self.comparison.pairs[0].simulation.metadata)

    @cached_property
    def plant(self) -> PlantParameters | None:
        """Return the plant that the run was designed on; None where that is not known."""
        if self.comparison.of_files and "plant" not in self.run:
            return None
        try:
            return load_plant(str(self.run.get("plant", "thesis")))
        except ParameterError:
            return None


def read_trials(folder: str | os.PathLike[str]) -> TrialSet:
    """Read the bags ``trial_1``, ``trial_2``, ... and regress them as the thesis does, or raise a DataError."""
    bags = sorted(Path(folder).glob("trial_*"), key=lambda bag: (len(bag.name), bag.name))
    if not bags:
        raise DataError(f"{folder} has no bags trial_1, trial_2, ...; expected the trials of one experiment")
    recordings = [_cut(read_recording(bag, effort="measured")) for bag in bags]
    staircase = all(len(static_holds(recording)) >= 4 for recording in recordings)
    result = (fit_gravity if staircase else fit_inertia_damping)(recordings)
    return TrialSet(result, recordings)


def _cut(recording: Recording) -> Recording:
    part = trial_part(recording)
    return replace(part, input=np.interp(part.time, part.input_stamps, part.input), input_time=None)
