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
from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_rosbag.reader import Bag, read_bag

__all__ = ["COMMAND_LIFE", "POSITION_MARK", "TorqueRecord", "check_bag", "early_time"]

COMMAND_LIFE = 0.060
"""Time from the last valid command to zero torque [s]."""
_EARLY_TIME = (0.5, 3.0)
"""Time by which a plant usually meets a controller before somebody else does at most, and as far as the numbers of the
controller's messages prove it [s]: of five nodes that start at once beside three busy loops the last was met after
2.1 s."""
POSITION_MARK = "pendulum.position_control"
"""Metadata of a bag that has no word of the plant's mode: by plant, pairs of log times [ns] between which it made its
own torque."""
_TOLD_EVERY = 1.5
"""Longest time before a first diagnostics for which it tells the mode too: its period and a half [s]."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class TorqueRecord:
    """What the torque of one plant did in a bag.

    Attributes:
        plant: Namespace of the plant.
        samples: Recorded torques.
        judged: Those not under position control, to which the rule of the last command applies.
        largest: Largest absolute torque [N m].
        longest: Longest time from a command, or from the first record where none came before, to a torque that was not
            zero yet [s].
        missing: Commands that the recorder says it lost: each may stand behind the torque of one command's life,
            wherever that was, and behind no more.
        violations: One sentence for each broken rule.
    """

    plant: str
    samples: int
    judged: int
    largest: float
    longest: float
    missing: int
    violations: tuple[str, ...]


def early_time(messages: int) -> float:
    """Return the longest time before the first command that was heard for which earlier ones explain torque [s].

    A plant may believe each of them for a command's life. How many states they answered tells nothing: who starts on a
    busy machine answers few of them, and a plant that is late publishes few.

    Args:
        messages: How many there were, by their numbers.
    """
    usual, longest = _EARLY_TIME
    return max(usual, min(messages * COMMAND_LIFE, longest))


def check_bag(path: Path, *, limit: float, allowance: float = 0.0, witnessed: Sequence[int] = ()) -> list[TorqueRecord]:
    """Check the torque of every plant in a bag.

    Under position control the plant makes its own torque: there only the limit is checked. That it was under position
    control is for the plant to say, in its events and diagnostics, or, where a bag has neither, for ``POSITION_MARK``:
    a trajectory on its topic may have been refused. Else, from the first record on, a torque is excused by a command
    that a plant may believe and by nothing else: of the plant's own controller (or, where there is none of that name,
    of who commanded first), for this joint, finite, not from the future and not too old when it came. It must be recent
    in log times, which are of one clock, or in stamps, which are of the plant's: a message that had to be sent again
    comes late in the one, and a bag of two machines has two clocks. A disturbance or a push alone excuses nothing; a
    command from before the recording may stand behind the torque of its first life.

    Args:
        path: The bag.
        limit: Largest torque allowed [N m].
        allowance: Time that the recorder may have been kept waiting [s].
        witnessed: Stamps of commands of the plant's controller that somebody else heard in time [ns]: of one that came
            and went within half a second a recorder may never have known.

    Raises:
        BagError: The bag cannot be read.
        DataError: It has no applied torque.
    """
    with read_bag(path) as bag:
        ending = f"/{names.APPLIED_EFFORT}"
        plants = [topic[: -len(ending)] for topic in bag.topics if topic.endswith(ending)]
        if not plants:
            raise DataError(f"{path} has no topic {names.APPLIED_EFFORT}; expected one for each plant")
        return [_check_plant(bag, plant, limit, allowance, witnessed) for plant in plants]


def _check_plant(bag: Bag, plant: str, limit: float, allowance: float, witnessed: Sequence[int]) -> TorqueRecord:
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
    stamps = applied["stamp_ns"]
    logged, answers = _commands(bag, plant)
    # What the plant's clock said when the command came.
    then = np.maximum(_last_before(logged, times, stamps), stamps[0])
    tolerance = round((COMMAND_LIFE + period + allowance) * NANOSECONDS)
    believed = answers - then <= tolerance
    command = _last_before(times, logged[believed & (then - answers <= tolerance)])
    answered = _last_before(stamps, np.sort(np.concatenate((answers[believed], np.array(witnessed, np.int64)))))
    judged = ~_under_position_control(bag, plant, times, tolerance)
    # From the state with this stamp on, a torque acts for a period.
    age = np.minimum(
        (times - np.maximum(command, times[0])) * 1e-9, (stamps - np.maximum(answered, stamps[0])) * 1e-9 + period
    )
    driven = judged & (efforts != 0.0)
    longest = float(np.max(age[driven], initial=0.0))
    allowed = COMMAND_LIFE + period + allowance
    counts = bag.metadata.get("pendulum.recorder.counts", {})

    def counted(kind: str) -> int:
        return int(counts.get(f"{plant}/{names.EFFORT_COMMAND}", {}).get(kind, 0))

    missing = counted("lost")
    unexplained = times[driven & (age > allowed)]
    unexplained = _without_early(unexplained, logged, counted("early") + counted("before"), tolerance)
    if _lives_needed(unexplained, tolerance) > missing:
        late = f"torque {longest * 1e3:.0f} ms after the last command"
        violations.append(f"{late}; expected at most {allowed * 1e3:.0f} ms")
    return TorqueRecord(plant, len(times), int(judged.sum()), largest, longest, missing, tuple(violations))


def _without_early(times: np.ndarray, commands: np.ndarray, early: int, life_ns: int) -> np.ndarray:
    """Leave out the torques that commands explain of which the recorder heard too late.

    Such a command comes shortly before one that was recorded. It may stand behind several torques: a simulator that
    catches up applies one for each period that passed.
    """
    if len(commands) == 0:
        return times
    waiting = commands[np.minimum(np.searchsorted(commands, times), len(commands) - 1)] - times
    span_ns = early_time(early) * NANOSECONDS
    soon = (waiting >= 0) & (waiting <= span_ns)
    # As many lives as there were such commands, and no longer in all than the time for which there may be any.
    most = min(early, math.ceil(span_ns / life_ns))
    return times[~soon] if _lives_needed(times[soon], life_ns) <= most else times


def _lives_needed(times: np.ndarray, life_ns: int) -> int:
    """Return how many commands, each of this life, there must have been at least for torque at these times."""
    needed = 0
    while len(times):
        needed += 1
        times = times[times > times[0] + life_ns]
    return needed


def _under_position_control(bag: Bag, plant: str, times: np.ndarray, margin_ns: int) -> np.ndarray:
    """Tell for each time whether the plant said that it held or followed a position, give or take a margin."""
    told_every = round(_TOLD_EVERY * NANOSECONDS)
    # When, what, and for how long before, if it is the first word.
    told = [
        (event["log_time_ns"], str(event.get("mode")), 0)
        for event in bag.events()
        if event["topic"] == f"{plant}/{names.EVENTS}" and event["name"] == names.Event.PLANT_MODE
    ]
    for stored in bag.messages(names.DIAGNOSTICS) if names.DIAGNOSTICS in bag else ():
        for status in stored.message.status:
            if status.name.startswith(f"{plant}/") and status.name.endswith(": plant"):
                told += [(stored.log_time_ns, pair.value, told_every) for pair in status.values if pair.key == "mode"]
    told.sort(key=lambda each: each[0])
    spans = [] if told else bag.metadata.get(POSITION_MARK, {}).get(plant, [])
    for index, (since, mode, before) in enumerate(told):
        if mode == Mode.POSITION.value:
            until = told[index + 1][0] if index + 1 < len(told) else int(times[-1])
            spans.append((since - (0 if index else before), until))
    inside = np.zeros(len(times), np.bool_)
    for since, until in spans:
        inside |= (times >= since - margin_ns) & (times <= until + margin_ns)
    return inside


def _commands(bag: Bag, plant: str) -> tuple[np.ndarray, np.ndarray]:
    """Return log times and stamps of the commands of the one who may command [ns]."""
    name = f"{plant}/{names.EFFORT_COMMAND}"
    found: dict[str, list[tuple[int, int]]] = {}
    # One by one: among the commands there may be the strange messages of a fault, which no plant acts on.
    for log_ns, data in bag.raw(name) if name in bag else ():
        fields = decode_joint_state(data)
        if fields is None or fields.joints not in {("",), (names.JOINT,)}:
            continue
        if fields.effort and math.isfinite(fields.effort[0]):
            found.setdefault(fields.frame_id, []).append((log_ns, fields.stamp_ns))
    own = f"{plant}/controller"
    commander = own if own in found else next(iter(found), own)
    rows = np.array(found.get(commander, []), np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _last_before(times: np.ndarray, events: np.ndarray, values: np.ndarray | None = None) -> np.ndarray:
    """Return for each time the last event at or before it, or its value [ns]; 0 where there is none."""
    if len(events) == 0:
        return np.zeros(len(times), np.int64)
    place = np.searchsorted(events, times, side="right")
    return np.where(place > 0, (events if values is None else values)[np.maximum(place - 1, 0)], 0)


@app.command(epilog="Example: python -m tests.tools.faults.bag_property --limit 13 bags/examples/regulation_sim")
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
    return cli_main(app, argv, name="python -m tests.tools.faults.bag_property")


if __name__ == "__main__":
    raise SystemExit(main())
