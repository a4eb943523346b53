"""The trials of the thesis's two identification experiments, as a report reads them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from pendulum_bags.identification.thesis import (
    fit_gravity,
    fit_inertia_damping,
    static_holds,
    trial_part,
)
from pendulum_bags.identification.thesis_figures import TrialSet
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import DataError

__all__ = ["read_trials"]


def read_trials(folder: str | os.PathLike[str]) -> TrialSet:
    """Read the bags ``trial_1``, ``trial_2``, ... of a folder and regress them as the thesis does.

    Staircases are told from motions by hand by their holds.

    Raises:
        BagError: A bag cannot be read.
        DataError: There is no trial, or one lacks what the regression needs.
    """
    bags = sorted(Path(folder).glob("trial_*"), key=lambda bag: (len(bag.name), bag.name))
    if not bags:
        raise DataError(f"{folder} has no bags trial_1, trial_2, ...; expected the trials of one experiment")
    recordings = [_cut(read_recording(bag, effort="measured")) for bag in bags]
    staircase = all(len(static_holds(recording)) >= 4 for recording in recordings)
    result = (fit_gravity if staircase else fit_inertia_damping)(recordings)
    return TrialSet(result, recordings)


def _cut(recording: Recording) -> Recording:
    """Return the trial alone, with the measured effort at the stamps of the states, where it was measured."""
    part = trial_part(recording)
    return replace(part, input=np.interp(part.time, part.input_stamps, part.input), input_time=None)
