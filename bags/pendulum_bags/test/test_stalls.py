"""A run that a stalled machine broke off is measured again, a bounded number of times, and never on a real machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pendulum_bags.experiments.conductor_node import PlantStoppedError
from pendulum_bags.experiments.stalls import ATTEMPTS, is_stall, run_undisturbed
from pendulum_msgs_py.errors import FaultError

STALL = PlantStoppedError("/hw", "fault", "host_stalled: bridge did not run for 610 ms; expected at most 500 ms")


def failing(folder: Path, errors: list[FaultError | None]) -> Callable[[], None]:
    """Return a run that leaves bags and logs, and fails with each of these errors in turn."""

    def run() -> None:
        for place in ("sim", "hw", "logs", "repeats/1/hw"):
            (folder / place).mkdir(parents=True)
        (folder / "logs" / "hw_bridge.log").write_text("host_stalled", encoding="utf-8")
        error = errors.pop(0)
        if error is not None:
            raise error

    return run


def test_a_stalled_run_is_told_and_carried_out_again_in_a_clean_folder(tmp_path: Path) -> None:
    said: list[str] = []
    run_undisturbed(failing(tmp_path, [STALL, None]), tmp_path, emulated=True, tell=said.append)
    assert said == [f"This machine stood still ({STALL}); measuring again, run 2 of at most 3."]
    assert sorted(place.name for place in tmp_path.iterdir()) == ["hw", "logs", "logs_stalled_1", "repeats", "sim"]


def test_a_machine_that_stalls_each_time_is_an_error_after_three_runs(tmp_path: Path) -> None:
    errors: list[FaultError | None] = [STALL] * (ATTEMPTS + 1)
    with pytest.raises(
        FaultError, match=r"stood still in each of 3 runs, .*host_stalled.*; close what else runs on it"
    ):
        run_undisturbed(failing(tmp_path, errors), tmp_path, emulated=True, tell=lambda _: None)
    assert len(errors) == 1


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
        run_undisturbed(failing(tmp_path, [error, None]), tmp_path, emulated=emulated, tell=pytest.fail)
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
