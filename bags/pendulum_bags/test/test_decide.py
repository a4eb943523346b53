"""An experiment goes on until it is decided, and stops when its budget is spent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.commands.whole_run import _summary
from pendulum_bags.comparison import Margins, Outcome, compare_folders, read_run
from pendulum_bags.experiments.deadline import BudgetSpentError, Deadline
from pendulum_bags.experiments.decide import decide
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.repeats import (
    record_simulation,
    repeat_folder,
    repeat_settings,
)
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings
from pendulum_bags.runs.run_folder import read_looks
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.verdict.same_run import same_run_layer
from pendulum_bags.whole.carry_out import Findings, Simulated
from pendulum_testing.synthetic_runs import regulate, run_metadata, write_bag

NOISE = NoiseSettings(duration=2.0)
SETTINGS = RegulationSettings(noise=NOISE)


def write_pair(folder: Path, seed: int, duration: float, keep: slice = slice(None), **changes: float) -> None:
    metadata = run_metadata(seed)
    for side, rate in (("sim", 500.0), ("hw", 100.0)):
        columns = regulate(rate=rate, seed=seed, duration=duration, hardware=side == "hw", changes=changes)
        if side == "sim":
            columns = {name: values[keep] for name, values in columns.items()}
        metadata["pendulum.run"]["plant"] = "emulator" if side == "hw" else "thesis"
        write_bag(folder / side, columns, f"/{side}", metadata=metadata, ramps=False)


class Recorder:
    """Stands in for the nodes alone: it simulates both plants, and takes a made-up time for it."""

    def __init__(self, cost: float, **changes: float) -> None:
        self.cost = cost
        self.changes = changes
        self.now = 0.0
        self.recorded: list[int] = []

    def __call__(self, folder: Path, settings: Any, number: int, *_: Any) -> None:
        noise = repeat_settings(settings, number).noise
        write_pair(repeat_folder(folder, number), noise.seed, 4.0 * number, **self.changes)
        self.recorded.append(number)
        self.now += self.cost

    def clock(self) -> float:
        return self.now


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_pair(tmp_path / "run", 1, 5.0)
    return tmp_path / "run"


def test_a_run_that_decides_is_not_repeated(folder: Path) -> None:
    recorder = Recorder(1.0)
    (found,) = decide(folder, SETTINGS, Margins.parse(), Deadline(60.0, clock=recorder.clock), record=recorder).values()
    assert found.verdict.outcome is Outcome.EQUIVALENT
    assert recorder.recorded == []
    assert read_looks(folder) == 1
    assert found.verdict.tests[0].interval.level == pytest.approx(0.95)


def near(folder: Path, share: float = 0.55) -> Margins:
    """Return margins that the first run cannot decide, but more can: a share of its interval beyond its estimate."""
    test = compare_folders([folder]).verdict.tests[1]
    away = abs(test.interval.estimate - 1.0) + share * (test.interval.high - test.interval.low)
    return Margins.parse({"spread_angle": 100.0 * away})


def test_an_undecided_run_is_repeated_with_new_noise_until_it_is_decided_and_read_back_so(
    folder: Path,
) -> None:
    recorder = Recorder(1.0)
    margins = near(folder)
    (found,) = decide(folder, SETTINGS, margins, Deadline(1000.0, clock=recorder.clock), record=recorder).values()
    assert found.verdict.outcome is not Outcome.UNDECIDED
    assert recorder.recorded == list(range(1, len(found.pairs)))
    assert len(recorder.recorded) >= 1
    assert read_looks(folder) == len(recorder.recorded) + 1
    again = compare_folders([folder], margin=margins)
    assert again.to_json()["verdict"] == found.to_json()["verdict"]
    assert again.looks == found.looks


def test_a_spent_budget_leaves_it_undecided_and_says_what_it_would_take(folder: Path) -> None:
    recorder = Recorder(40.0)
    (found,) = decide(
        folder, SETTINGS, near(folder, 0.05), Deadline(30.0, clock=recorder.clock), record=recorder
    ).values()
    assert recorder.recorded == [1]
    assert found.verdict.outcome is Outcome.UNDECIDED
    (step,) = same_run_layer(found, more="make experiment").next_steps
    assert step.startswith("Record about ")
    assert "more run" in step
    # One recording serves all joints; what takes hours is no step to take.
    for runs, begins in ((30, "Record about 30 more runs"), (3000, "About 3000 more runs"), (None, "More runs would")):
        needs = {
            joint: replace(found, verdict=replace(found.verdict, more_runs=more))
            for joint, more in (("cart", 2), ("pole", runs))
        }
        (step,) = answer_of(needs, more="make experiment").layers[0].next_steps
        assert step.startswith(begins)


def test_a_repeat_that_does_not_end_in_time_is_left_out(folder: Path) -> None:
    recorder = Recorder(1.0)

    def late(folder: Path, settings: Any, number: int, deadline: Deadline) -> None:
        recorder.now += 100.0
        deadline.require()

    (found,) = decide(folder, SETTINGS, near(folder, 0.05), Deadline(60.0, clock=recorder.clock), record=late).values()
    assert len(found.pairs) == read_looks(folder) == 1
    with pytest.raises(BudgetSpentError, match="is spent"):
        Deadline(60.0, 100.0).share(1.0).require(40.0)


def test_no_budget_and_a_real_actuator_mean_one_look(folder: Path) -> None:
    recorder = Recorder(1.0)
    margins = near(folder)
    assert len(decide(folder, SETTINGS, margins, None, record=recorder)[""].pairs) == 1
    hebi = RegulationSettings(noise=NOISE)
    # Behind its check of the lab file, which is not the matter here.
    object.__setattr__(hebi, "hardware", "hebi")
    assert len(decide(folder, hebi, margins, Deadline(60.0, clock=recorder.clock), record=recorder)[""].pairs) == 1
    assert recorder.recorded == []


def test_a_run_that_a_busy_machine_disturbed_is_measured_again_and_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    # The simulator lost every state of a quarter of the run.
    lost = np.r_[0:500, 750:1000]
    write_pair(folder, 1, 2.0, keep=lost)
    recorder = Recorder(1.0)
    recorder(folder, SETTINGS, 1)
    (found,) = decide(
        folder, SETTINGS, Margins.parse(), Deadline(60.0, clock=recorder.clock), record=lambda *_: None
    ).values()
    assert [pair.hardware.source for pair in found.pairs] == [str(repeat_folder(folder, 1) / "hw")]
    assert "because states are missing (simulation missed 250 states)" in found.left_out[0]
    # The seed that was asked for makes the run again, not that of the repeat.
    answer = answer_of(found)
    told = _summary(
        "thesis", Findings(Simulated("thesis", SETTINGS, folder, comparisons={"": found})), answer, [answer]
    )
    assert found.to_json()["seed"] != SETTINGS.noise.seed
    assert told["seed"] == SETTINGS.noise.seed
    assert found.verdict.outcome is Outcome.EQUIVALENT


def test_repeats_have_noise_of_their_own_and_twice_as_much_each_time() -> None:
    chosen = [repeat_settings(SETTINGS, number).noise for number in (1, 2, 3)]
    assert len({noise.seed for noise in chosen} | {1, 2, 3}) == 6
    assert [noise.duration for noise in chosen] == [20.0, 40.0, 60.0]


def test_a_simulation_in_this_process_is_kept_as_its_recorder_would_keep_it(tmp_path: Path) -> None:
    spec = SETTINGS.run("sim")
    arrays = simulate(spec)
    run = read_run(record_simulation(tmp_path / "sim", spec))
    np.testing.assert_array_equal(run.window.position, arrays.position[:-1])
    np.testing.assert_array_equal(run.window.effort, arrays.command[:-1])
    assert run.disturbance is not None
    np.testing.assert_array_equal(run.disturbance.value, arrays.disturbance[:-1])
    assert run.metadata["pendulum.run"]["engine"] == "in_process"
    assert run.missed_deadlines == 0
