"""What the motor really did, on its own clock, against what had rightfully been asked for.

Behind the bridge the emulator, a process of its own, writes each millisecond what its motor does: neither bridge nor
probe has a say in it. The simulator is the motor itself; what it says it applied is what acted.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.truth_log import COLUMNS
from pendulum_msgs_py.contract.values import NANOSECONDS
from tests.tools.faults.bag_property import early_time

__all__ = ["ROUNDING", "Asked", "Drive", "ModuleTruth", "Witness", "beyond_asked", "driving_torque"]

ROUNDING = 0.2
"""Difference of torques that is none: rounding of the duty, noise of sensors [N m]."""
NO_TORQUE = 1e-3
"""Torque below which a motor is not driven, whatever its duty [N m]."""
_REMEMBERED_NS = 130_000_000
"""Time for which a torque may act after the state that its command answers: 50 ms that a command counts, a cycle, and
what a busy machine may add before the module's command lifetime ends it [ns]."""
_LIFE_NS = 50_000_000
"""Time that a command counts [ns]."""
_GONE_NS = 500_000_000
"""Silence after which somebody has ended [ns]."""
_AHEAD_NS = 2_000_000
"""A simulator's torque acts from its state's stamp on, before the command that answers this state is there [ns]."""


class Drive(NamedTuple):
    """Torque with which a motor drove from an instant on [ns, N m]."""

    time_ns: int
    torque: float


class Asked(NamedTuple):
    """A torque that somebody asked for in answer to the state with a stamp [ns, N m]."""

    stamp_ns: int
    effort: float


class Witness:
    """Takes note of what the rightful ask for on a topic, and of how much they asked for before they were heard.

    A plant may meet a new node before a witness does, where many start at once by two seconds. What was said meanwhile
    is counted: a publisher numbers its messages from 1 on. Each may have asked for anything, at any time in as many
    lives of a command.

    Args:
        limit: Largest torque that a plant lets through [N m].

    Attributes:
        asked: What was asked for; what was not heard as both of the largest torques.
    """

    def __init__(self, limit: float) -> None:
        self.asked: list[Asked] = []
        self._limit = limit
        self._last: dict[int, int] = {}

    def hear(self, asked: Asked, sequence: int) -> None:
        """Take note of a message, by its number at its publisher."""
        # Who has been silent for long is gone, and not continued by somebody new whose numbers are near.
        self._last = {last: when for last, when in self._last.items() if asked.stamp_ns - when < _GONE_NS}
        before = max((last for last in self._last if last < sequence), default=0)
        unheard = sequence - before - 1
        unheard_ns = min(unheard * _LIFE_NS, round(early_time(unheard) * NANOSECONDS))
        begin_ns = max(asked.stamp_ns - unheard_ns, self._last.pop(before, 0))
        self._last[sequence] = asked.stamp_ns
        for stamp_ns in range(begin_ns, asked.stamp_ns, _LIFE_NS) if unheard_ns else ():
            self.asked += [Asked(stamp_ns, -self._limit), Asked(stamp_ns, self._limit)]
        self.asked.append(asked)


def driving_torque(duty: float, torque: float, per_duty: float) -> float:
    """Return the torque with which a motor drives at its speed and at standstill alike [N m].

    A motor that is turned brakes, whatever its duty: that torque is the turner's.
    """
    return math.copysign(min(abs(duty) * per_duty, abs(torque)), duty) if duty * torque > 0.0 else 0.0


class ModuleTruth:
    """Reads what an emulator writes with ``--truth``, as far as it has got.

    Args:
        path: Its file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._rest = ""
        drive = load_emulator("thesis").drivetrain
        self._per_duty = drive.supply_voltage * drive.gear_ratio * drive.torque_constant / drive.winding_resistance
        self._duty, self._torque = COLUMNS.index("pwm"), COLUMNS.index("motor_torque")

    def read(self) -> list[Drive]:
        """Return what is new."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._rest = (self._rest + data.decode("ascii")).split("\n")
        rows = [line.split(",") for line in lines if not line.startswith(COLUMNS[0])]
        return [
            Drive(int(row[0]), driving_torque(float(row[self._duty]), float(row[self._torque]), self._per_duty))
            for row in rows
        ]


def beyond_asked(
    drives: Iterable[Drive], commands: Sequence[Asked], disturbances: Sequence[Asked], limit: float
) -> Drive:
    """Return where a motor drove furthest beyond what was rightfully asked for lately, and by how much [ns, N m].

    Zero is always right. What was asked for counts as far as the limit allows it.

    Args:
        drives: What the motor did.
        commands: What the controller asked for, by stamp.
        disturbances: The same of the disturbance.
        limit: Largest torque [N m].
    """
    stamps = [[asked.stamp_ns for asked in each] for each in (commands, disturbances)]
    worst = Drive(0, 0.0)
    for time_ns, torque in drives:
        low = high = 0.0
        for index, each in enumerate((commands, disturbances)):
            first = bisect_left(stamps[index], time_ns - _REMEMBERED_NS)
            recent = [asked.effort for asked in each[first : bisect_right(stamps[index], time_ns + _AHEAD_NS)]]
            if not recent and index == 0:
                break  # a disturbance alone moves nothing
            low += min([0.0, *recent])
            high += max([0.0, *recent])
        low, high = max(-limit, low), min(limit, high)
        excess = max(torque - high, low - torque) - ROUNDING
        if excess > worst.torque:
            worst = Drive(time_ns, excess)
    return worst
