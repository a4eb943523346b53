"""A disturbance in compiled code: its state is lent to a loop, and taken back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.disturbances.disturbance import UniformNoise
from pendulum_lqr.disturbances.disturbing import INTERVALS, DisturbanceLoop
from pendulum_msgs_py.contract.noise import stream_key
from pendulum_msgs_py.loops.answer_record import LoopKind

__all__ = ["DISTURBING", "CompiledDisturbance"]

DISTURBING = np.dtype(
    [
        ("newest_ns", "i8"),
        ("start_ns", "i8"),
        ("duration_ns", "i8"),
        ("acts", "i8"),
        ("key", "u8"),
        ("amplitude", "f8"),
        ("hold_ns", "i8"),
        ("torque", "f8"),
        ("count", "i8"),
        ("interval_ns", "i8", (INTERVALS,)),
        ("ordered_ns", "i8", (INTERVALS,)),
    ],
    align=True,
)
"""``count`` intervals are known; the newest follows them in a ring. ``duration_ns`` is 0 for no end."""


class CompiledDisturbance:
    """Publishes uniform noise or zero for one joint, :class:`pendulum_msgs_py.loops.answer_record.Answerer`.

    ``ready`` returns whether the next torque needs no other work; ``refusal`` says why no loop is used.
    """

    def __init__(self, loops: Sequence[DisturbanceLoop], ready: Callable[[], bool], refusal: str = "") -> None:
        self._loop = loops[0]
        self._ready = ready
        self.refusal = refusal or ("" if len(loops) == 1 else "several joints")
        self.kind: LoopKind | None = None
        if not self.refusal:
            self.kind = LoopKind(DISTURBING, "pendulum_lqr.disturbances.disturbance_kernel:uniform_loop", ())

    def lend(self, own: Any) -> bool:
        """Write the state of the torques into a record; return whether the next state may be a nominal one."""
        loop, signal = self._loop, self._loop.signal
        if not isinstance(signal, UniformNoise):
            self.refusal = "only uniform noise is compiled"
            return False
        self.refusal = ""
        if not loop.goes_on or not self._ready():
            return False
        own["newest_ns"], own["duration_ns"] = loop.newest_stamp_ns, loop.duration_ns
        own["acts"], own["start_ns"] = loop.start_ns is not None, loop.start_ns or 0
        own["key"], own["amplitude"], own["hold_ns"] = stream_key(signal.seed), signal.amplitude, signal.hold_ns
        intervals = loop.intervals_ns
        own["count"] = len(intervals)
        own["interval_ns"][: len(intervals)] = intervals
        return True

    def take_back(self, record: Any) -> None:
        """Take over the changes by one or more torques."""
        count = int(record["answers"])
        self._loop.count(record["stamp_ns"][:count].tolist(), float(record["own"]["torque"]))
