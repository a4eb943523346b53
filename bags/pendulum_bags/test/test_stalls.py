"""A run that a stalled machine broke off is measured again, a bounded number of times, and never on a real machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pendulum_bags.commands.whole_run import _print_summary, _summary
from pendulum_bags.comparison import compare_folders
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.experiments.stalls import ATTEMPTS, is_stall, run_undisturbed
from pendulum_bags.report import write_report
from pendulum_bags.runs.run_folder import create_run_folder, discard_if_empty, read_stalls
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.whole.carry_out import Findings, Simulated
from pendulum_msgs_py.errors import FaultError, PlantStoppedError
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_testing.synthetic_runs import write_run_folder

STALL = PlantStoppedError("/hw", "fault", "host_stalled: bridge did not run for 610 ms; expected at most 500 ms")


def failing(folder: Path, errors: list[FaultError | None]) -> Callable[[], None]:
    """Return a run that leaves bags and logs, and fails with each of these errors in turn."""

    def run() -> None:
        for place in ("sim", "hw", "sim_500hz", "logs", "repeats/1/hw"):
            # Each is made anew: what a run that broke off has left would be in the way.
            (folder / place).mkdir(parents=True)
        (folder / "logs" / "hw_bridge.log").write_text("host_stalled", encoding="utf-8")
        error = errors.pop(0)
        if error is not None:
            raise error

    return run


def test_a_stalled_run_is_reported_and_carried_out_again_in_a_clean_folder(tmp_path: Path) -> None:
    said: list[str] = []
    run_undisturbed(failing(tmp_path, [STALL, None]), tmp_path, emulated=True, report=said.append)
    assert said == [f"This machine stood still ({STALL}); measuring again, run 2 of at most 3."]
    left = ["hw", "logs", "logs_stalled_1", "repeats", "sim", "sim_500hz", "stalls.json"]
    assert sorted(place.name for place in tmp_path.iterdir()) == left
    assert read_stalls(tmp_path) == [{"reason": str(STALL), "logs": "logs_stalled_1"}]


def test_a_machine_that_stalls_each_time_is_an_error_after_three_runs(tmp_path: Path) -> None:
    errors: list[FaultError | None] = [STALL] * (ATTEMPTS + 1)
    with pytest.raises(
        FaultError, match=r"stood still in each of 3 runs, .*host_stalled.*; close what else runs on it"
    ):
        run_undisturbed(failing(tmp_path, errors), tmp_path, emulated=True, report=lambda _: None)
    assert len(errors) == 1
    assert [stall["logs"] for stall in read_stalls(tmp_path)] == ["logs_stalled_1", "logs_stalled_2", "logs"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), FaultError("hw_bridge ended with code 2")])
def test_what_a_stalled_run_left_outlives_an_end_of_the_next_one_that_records_nothing(
    tmp_path: Path, error: BaseException
) -> None:
    folder = create_run_folder(tmp_path / "run", "thesis")
    first = failing(folder, [STALL])

    def run() -> None:
        if read_stalls(folder):
            raise error
        first()

    with pytest.raises(type(error)):
        run_undisturbed(run, folder, emulated=True, report=lambda _: None)
    assert not discard_if_empty(folder)
    assert (folder / "logs_stalled_1" / "hw_bridge.log").read_text(encoding="utf-8") == "host_stalled"
    assert discard_if_empty(create_run_folder(tmp_path / "other", "thesis"))


def test_runs_that_broke_off_are_reported_by_the_comparison_the_terminal_and_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    reason = "motion_disagreement: velocity says 0.0199 rad, position 0.0093 rad in 0.2 s [rad]"
    errors = [PlantStoppedError("/hw", "fault", reason), None]

    def run() -> None:
        error = errors.pop(0)
        if error is not None:
            raise error
        write_run_folder(folder, ramps=False)

    folder.mkdir()
    run_undisturbed(run, folder, emulated=True, report=lambda _: None)
    comparison = compare_folders([folder])
    settings, answer = RegulationSettings(), answer_of(comparison)
    found = Findings(Simulated("thesis", settings, folder, comparisons={"": comparison}))
    summary = _summary("thesis", found, answer, [answer])
    assert summary["stalls"] == [{"run": "run", "reason": f"/hw went to fault: {reason}", "logs": ""}]
    _print_summary(make_console(highlight=False), comparison, "emulator")
    page = write_report(folder, summary, comparison=comparison, recordings=[], formats=[]).read_text(encoding="utf-8")
    for told in (capsys.readouterr().out, page):
        words = " ".join(told.split())
        assert "1 run aborted before this one and does not count" in words
        assert reason in words


@pytest.mark.parametrize(
    ("error", "emulated"),
    [
        (STALL, False),
        (PlantStoppedError("/hw", "e_stop", "e-stop pressed"), True),
        (PlantStoppedError("/hw", "fault", "winding_current: 3 A do not fit a duty of 0"), True),
        (FaultError("hw_bridge ended with code 2"), True),
    ],
    ids=["real machine", "e-stop", "another fault", "dead program"],
)
def test_what_is_no_stall_of_an_emulator_ends_the_experiment_at_once(
    tmp_path: Path, error: FaultError, emulated: bool
) -> None:
    with pytest.raises(FaultError) as raised:
        run_undisturbed(failing(tmp_path, [error, None]), tmp_path, emulated=emulated, report=pytest.fail)
    assert raised.value is error


@pytest.mark.parametrize(
    "reason",
    [
        "measurement is 944 ms old; expected at most 510 ms: is the machine too busy, or the link lost?",
        "feedback_lost: no feedback for 520 ms",
        "feedback_late: record is 600 ms old",
        "motion_disagreement: velocity says 0.0199 rad, position 0.0093 rad in 0.2 s; expected them within 0.01 rad",
        "disarmed: no command for 30.0 s (no fresh command: zero torque)",
    ],
)
def test_late_states_and_commands_are_stalls(reason: str) -> None:
    assert is_stall(PlantStoppedError("/hw", "fault", reason))
