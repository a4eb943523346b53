"""A run that a stalled computer aborted is no result: it is reported, recorded, and repeated a few times.

A real machine is never restarted automatically.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from pendulum_bags.runs.run_folder import REPEATS, write_stall
from pendulum_msgs_py.errors import FaultError, PlantStoppedError

__all__ = ["ATTEMPTS", "is_stall", "run_undisturbed"]

ATTEMPTS = 3
"""Most attempts of a run."""
STALLS = ("host_stalled", "feedback_lost", "feedback_late", "motion_disagreement")
"""Faults of the bridge caused by the machine's stall of an emulator's feedback: position and velocity of distant
records disagree."""
SAID = ("is the machine too busy", "no command for", "no fresh command")
"""Reasons of a plant with old states, and of one whose controller stalled."""
_LOGS = "logs"


def is_stall(error: FaultError) -> bool:
    """Return whether a plant that is no real machine stopped because this machine stalled."""
    if not isinstance(error, PlantStoppedError):
        return False
    name = error.reason.split(":", maxsplit=1)[0]
    return name in STALLS or any(part in error.reason for part in SAID)


def run_undisturbed(run: Callable[[], None], folder: Path, *, emulated: bool, report: Callable[[str], None]) -> None:
    """Carry out a run, and repeat it if the computer stalled.

    Args:
        folder: The run's folder; logs and reason of a stalled run remain.
        emulated: Whether the hardware is emulated; a real machine moves only on its operator's command.

    Raises:
        FaultError: It failed for another reason, or the computer stalled each time.
    """
    for attempt in range(1, ATTEMPTS + 1):
        try:
            run()
        except FaultError as error:
            if not emulated or not is_stall(error):
                raise
            last = attempt == ATTEMPTS
            # Recorded before anything is removed: a fault may resemble a stall.
            write_stall(
                folder, str(error), "" if not (folder / _LOGS).is_dir() else _LOGS if last else _logs_of(attempt)
            )
            if last:
                raise FaultError(
                    f"this machine stood still in each of {ATTEMPTS} runs, the last time so that {error}; close what "
                    "else runs on it, and measure again"
                ) from error
            report(f"This machine stood still ({error}); measuring again, run {attempt + 1} of at most {ATTEMPTS}.")
            _clear(folder, attempt)
        else:
            return


def _clear(folder: Path, attempt: int) -> None:
    for bag in ("sim", "hw", "sim_500hz", REPEATS):
        shutil.rmtree(folder / bag, ignore_errors=True)
    logs = folder / _LOGS
    if logs.is_dir():
        logs.rename(folder / _logs_of(attempt))


def _logs_of(attempt: int) -> str:
    return f"{_LOGS}_stalled_{attempt}"
