"""Analyse the recordings, and record more, until they decide or no time is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pendulum_bags.comparison import Comparison, Looks, Margins, Outcome, compare_joints
from pendulum_bags.experiments.deadline import NEVER, BudgetSpentError, Deadline
from pendulum_bags.experiments.joint_run import JointSettings
from pendulum_bags.experiments.repeats import record_repeat, repeat_folder, repeat_settings
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.runs.run_folder import write_looks

__all__ = ["decide"]

_COMPARING = 1.0
"""Processor time to compare the recordings of one joint [s]."""


def decide(
    folder: Path,
    settings: RegulationSettings | JointSettings,
    margins: Margins,
    deadline: Deadline | None,
    *,
    joints: Sequence[str] = ("",),
    on_repeat: Callable[[int, float], None] = lambda number, duration: None,
    on_comparison: Callable[[Mapping[str, Comparison]], None] = lambda found: None,
    record: Callable[[Path, RegulationSettings | JointSettings, int, Deadline], None] = record_repeat,
) -> Mapping[str, Comparison]:
    """Compare a run folder, and record repeats into it until the comparison is decided.

    Only an emulator or a simulation is repeated: a real machine moves only on its operator's command. Each interim
    analysis spends a share of the total error.

    Args:
        folder: Folder of the run; a repeat whose hardware recording exists already is used at once.
        deadline: Of the repeats; None for one analysis of the existing recordings.
        on_repeat: Called with the number of a repeat and its duration of noise [s] before it is recorded.
    """
    if not settings.can_repeat or deadline is None:
        compared = compare_joints([folder], joints, margin=margins)
        on_comparison(compared)
        return compared
    number = 0
    while repeat_folder(folder, number + 1).is_dir():
        number += 1
        record(folder, settings, number, NEVER)
    look = 1
    slowest = 0.0
    while True:
        write_looks(folder, look)
        compared = compare_joints([folder], joints, margin=margins, looks=Looks(look))
        on_comparison(compared)
        left = deadline.left
        # A repeat has at most twice the noise of the one before.
        if _is_decided(compared) or 1.5 * slowest > left:
            return compared
        number += 1
        on_repeat(number, repeat_settings(settings, number).noise.duration)
        try:
            record(folder, settings, number, deadline)
            deadline.require(_COMPARING * len(joints))
        except BudgetSpentError:
            return compared
        look += 1
        slowest = left - deadline.left


def _is_decided(compared: Mapping[str, Comparison]) -> bool:
    """Return whether more repeats are needless: one joint decides a no, all of them a yes."""
    outcomes = [one.verdict.outcome for one in compared.values()]
    decided = Outcome.DIFFERENT in outcomes or Outcome.UNDECIDED not in outcomes
    return decided or any(one.unlike_references for one in compared.values())
