"""What must hold in every bag, whatever happened while it was recorded: bounded torque, and none without a command.

The same property that hypothesis checks on the rules of a plant, checked on what the running system did::

    |applied effort| <= limit, and zero from 60 ms (and one period) after the last command
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_rosbag.reader import Bag, read_bag

__all__ = ["COMMAND_LIFE", "TorqueRecord", "check_bag"]

COMMAND_LIFE = 0.060
"""Time from the last valid command to zero torque [s]."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class TorqueRecord:
    """What the torque of one plant did in a bag.

    Attributes:
        plant: Namespace of the plant.
        samples: Recorded torques.
        judged: Those under torque control, to which the rule of the last command applies.
        largest: Largest absolute torque [N m].
        longest: Longest time from a command to a torque that was not zero yet [s].
        missing: Commands that the recorder says it lost: an unrecorded one may stand behind any torque, so with some
            missing the rule of the last command cannot be judged, and only the limit is.
        violations: One sentence for each broken rule.
    """

    plant: str
    samples: int
    judged: int
    largest: float
    longest: float
    missing: int
    violations: tuple[str, ...]


def check_bag(path: Path, *, limit: float, allowance: float = 0.0) -> list[TorqueRecord]:
    """Check the torque of every plant in a bag.

    Under position control (from a trajectory to the next torque command) the plant makes its own torque: there only
    the limit is checked. A torque is excused by a command that is recent in log times, which are of one clock, or in
    stamps, which are of the plant's: a message that had to be sent again comes late in the one, a stranger's clock
    shows in the other.

    Args:
        path: The bag.
        limit: Largest torque allowed [N m].
        allowance: Time that the recorder may have been kept waiting [s].

    Raises:
        BagError: The bag cannot be read.
        DataError: It has no applied torque.
    """
    with read_bag(path) as bag:
        ending = f"/{names.APPLIED_EFFORT}"
        plants = [topic[: -len(ending)] for topic in bag.topics if topic.endswith(ending)]
        if not plants:
            raise DataError(f"{path} has no topic {names.APPLIED_EFFORT}; expected one for each plant")
        return [_check_plant(bag, plant, limit, allowance) for plant in plants]


def _check_plant(bag: Bag, plant: str, limit: float, allowance: float) -> TorqueRecord:
    applied = bag.array(f"{plant}/{names.APPLIED_EFFORT}")
    times, efforts = applied["log_time_ns"], applied["effort"]
    violations = []
    if len(times) == 0:
        return TorqueRecord(plant, 0, 0, 0.0, 0.0, 0, ("no torque was recorded",))
    finite = np.isfinite(efforts)
    largest = float(np.max(np.abs(efforts[finite]), initial=0.0))
    if not finite.all():
        violations.append(f"{int((~finite).sum())} torques are not finite")
    if largest > limit:
        violations.append(f"torque reached {largest:.4g} N m; expected at most {limit:g} N m")
    period = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else 0.0
    command = _last_before(times, _log_times(bag, plant, names.EFFORT_COMMAND))
    # A disturbance or a push is a command, too: each ends by itself after its life.
    others = (names.DISTURBANCE, names.PUSH)
    latest = np.maximum.reduce([command, *(_last_before(times, _log_times(bag, plant, name)) for name in others)])
    stamps = applied["stamp_ns"]
    answered = np.maximum.reduce(
        [_last_before(stamps, _stamps(bag, plant, name)) for name in (names.EFFORT_COMMAND, *others)]
    )
    trajectory = _last_before(times, _log_times(bag, plant, names.JOINT_TRAJECTORY))
    judged = (command > trajectory) & (command > 0)
    # From the state with this stamp on, a torque acts for a period.
    age = np.minimum((times - latest) * 1e-9, (stamps - answered) * 1e-9 + period)
    driven = judged & (efforts != 0.0)
    longest = float(np.max(age[driven], initial=0.0))
    allowed = COMMAND_LIFE + period + allowance
    counts = bag.metadata.get("pendulum.recorder.counts", {})

    def counted(kind: str) -> int:
        return sum(counts.get(f"{plant}/{name}", {}).get(kind, 0) for name in (names.EFFORT_COMMAND, *others))

    missing = counted("lost")
    # A command that the recorder heard of too late explains the torque after one state.
    unexplained = int(np.count_nonzero(driven & (age > allowed))) - counted("early")
    if unexplained > 0 and not missing:
        late = f"torque {longest * 1e3:.0f} ms after the last command"
        violations.append(f"{late}; expected at most {allowed * 1e3:.0f} ms")
    return TorqueRecord(plant, len(times), int(judged.sum()), largest, longest, missing, tuple(violations))


def _log_times(bag: Bag, plant: str, topic: str) -> np.ndarray:
    name = f"{plant}/{topic}"
    return bag.log_times(name) if name in bag else np.empty(0, np.int64)


def _stamps(bag: Bag, plant: str, topic: str) -> np.ndarray:
    name = f"{plant}/{topic}"
    if name not in bag:
        return np.empty(0, np.int64)
    # One by one: among the commands there may be the strange messages of a fault, which no plant acts on.
    commands = [decode_joint_state(data) for _, data in bag.raw(name)]
    return np.sort(np.array([fields.stamp_ns for fields in commands if fields is not None], np.int64))


def _last_before(times: np.ndarray, events: np.ndarray) -> np.ndarray:
    """Return for each time the last event at or before it [ns], 0 where there is none."""
    if len(events) == 0:
        return np.zeros(len(times), np.int64)
    place = np.searchsorted(events, times, side="right")
    return np.where(place > 0, events[np.maximum(place - 1, 0)], 0)


@app.command(epilog="Example: python -m tests.faults.bag_property --limit 13 bags/examples/regulation_sim")
def check(
    bags: Annotated[list[Path], typer.Argument(help="Bags to check.")],
    limit: Annotated[float, typer.Option(help="Largest torque allowed [N m].")] = math.inf,
) -> int:
    """Check that torque was bounded, and that there was none without a command."""
    broken = 0
    for bag in bags:
        for record in check_bag(bag, limit=limit):
            broken += len(record.violations)
            sys.stdout.write(json.dumps({"bag": str(bag), **vars_of(record)}) + "\n")
    return 1 if broken else 0


def vars_of(record: TorqueRecord) -> dict[str, object]:
    """Return the record as a mapping."""
    return {name: getattr(record, name) for name in TorqueRecord.__dataclass_fields__}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.faults.bag_property")


if __name__ == "__main__":
    raise SystemExit(main())
