"""Analyse the recordings, and record more, until they decide or the budget is spent."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.comparison import Comparison, Looks, Margins, Outcome, compare_folders
from pendulum_bags.experiments.repeats import record_repeat, repeat_folder, repeat_settings
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.runs.run_folder import write_looks

__all__ = ["Budget", "decide"]


@dataclass(frozen=True)
class Budget:
    """How long an experiment may last.

    Args:
        seconds: Wall time for repeats beyond the first analysis; 0 for one analysis of one run [s].
        clock: Monotonic clock [s].
    """

    seconds: float = 60.0
    clock: Callable[[], float] = time.monotonic


def decide(
    folder: Path,
    settings: RegulationSettings,
    margins: Margins,
    budget: Budget,
    *,
    on_look: Callable[[int, float], None] = lambda number, duration: None,
    on_comparison: Callable[[Comparison], None] = lambda found: None,
    record: Callable[[Path, RegulationSettings, int], None] = record_repeat,
) -> Comparison:
    """Compare a run folder, and record repeats into it until the comparison is decided.

    Only an emulator or a simulation is repeated: a machine moves when its operator wants it to. Each interim analysis
    costs a share of the error of all, so that stopping as soon as it is decided errs no more often than one analysis.

    Args:
        folder: Folder of the run, recorded; a repeat whose hardware recording exists already is used at once.
        settings: Settings of the run.
        margins: What difference does not matter.
        budget: Limit of the repeats.
        on_look: Called with the number of a repeat and its duration of noise [s] before it is recorded.
        on_comparison: Called with the comparison after each analysis.
        record: Records what a repeat lacks.
    """
    if not settings.can_repeat or budget.seconds <= 0.0:
        comparison = compare_folders([folder], margin=margins)
        on_comparison(comparison)
        return comparison
    started = budget.clock()
    number = 0
    while repeat_folder(folder, number + 1).is_dir():
        number += 1
        record(folder, settings, number)
    look = 1
    slowest = 0.0
    while True:
        write_looks(folder, look)
        comparison = compare_folders([folder], margin=margins, looks=Looks(look))
        on_comparison(comparison)
        spent = budget.clock() - started
        # The next repeat has at most twice the noise of the last one.
        decided = comparison.verdict.outcome is not Outcome.UNDECIDED or comparison.unlike_references
        if decided or spent + 1.5 * slowest > budget.seconds:
            return comparison
        number += 1
        look += 1
        before = budget.clock()
        on_look(number, repeat_settings(settings, number).noise.duration)
        record(folder, settings, number)
        slowest = budget.clock() - before
