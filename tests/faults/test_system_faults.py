"""Faults of time, memory and folders, in short; ``make faults`` has the long forms."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.tools.faults.clocks import simulate_hours
from tests.tools.faults.outcome import Trial
from tests.tools.faults.resources import RESOURCE_TRIALS

_SHORT = [trial for trial in RESOURCE_TRIALS if trial.name.startswith("recorder:")]


@pytest.mark.parametrize("trial", _SHORT, ids=lambda trial: trial.name)
def test_a_recorder_that_fails_says_so_and_keeps_what_was_sealed(trial: Trial, tmp_path: Path) -> None:
    if reason := trial.why_not():
        pytest.skip(reason)
    outcome = trial.act(tmp_path, random.Random(trial.name))
    assert outcome.survived, outcome.detail


def test_the_clock_of_a_lockstep_run_is_exact_after_many_steps(domain_id: int) -> None:
    outcome = simulate_hours(0.02)
    assert outcome.survived, outcome.detail
