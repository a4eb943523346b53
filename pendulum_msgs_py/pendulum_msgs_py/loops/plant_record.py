"""The record of a plant's compiled periods: clock, rules, inputs, outputs, and last the plant itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_msgs_py.contract.ordinary import ORDINARY
from pendulum_msgs_py.loops.records import INPUT, OUTPUT, TIME

__all__ = [
    "DISTURBANCE",
    "EFFORT",
    "ENDED",
    "INPUTS",
    "MESSAGE_WAITS",
    "MOST_PERIODS",
    "OWN_STAMPS",
    "UNUSUAL",
    "plant_record",
]  # fmt: skip

MOST_PERIODS = 256
"""Most periods in one slice in real time; their figures are stored."""
OWN_STAMPS = 128
"""Own stamps among which a command's stamp is searched."""
EFFORT, DISTURBANCE, PUSH = range(3)
INPUTS = 3
ENDED, UNUSUAL, MESSAGE_WAITS = range(3)
"""Why a slice ended: its time is over, the next period is not nominal, or (plus the input) a message is Python's."""


def plant_record(plant: np.dtype[Any]) -> np.dtype[Any]:
    """Return the layout of a loop's record, given the plant's own part."""
    return np.dtype(
        [
            ("time", TIME),
            # Address of the count of threads waiting for the supervisor, which end the loop.
            ("waiting_at", "u8"),
            ("waiting", "i8", (1,)),
            ("counter", "i4"),
            ("calls", "i4", (2,)),
            ("lockstep", "i8"),
            ("expected", "i8"),
            ("answered", "i8"),
            ("period_ns", "i8"),
            ("now_ns", "i8"),
            ("last_ns", "i8"),
            ("wall_ahead_ns", "i8"),
            ("end_ns", "i8"),
            ("periods", "i8"),
            ("late_ns", "i8", (MOST_PERIODS,)),
            ("latencies", "i8"),
            ("latency_ns", "i8", (MOST_PERIODS,)),
            ("own_stamp_ns", "i8", (OWN_STAMPS,)),
            ("own_newest", "i8"),
            ("published_ns", "i8"),
            ("sample_ns", "i8"),
            ("position", "f8"),
            ("velocity", "f8"),
            ("effort", "f8"),
            ("rules", ORDINARY),
            ("inputs", INPUT, (INPUTS,)),
            ("states", OUTPUT),
            ("applied", OUTPUT),
            ("clock", OUTPUT),
            ("has_clock", "i8"),
            ("plant", plant),
        ],
        align=True,
    )
