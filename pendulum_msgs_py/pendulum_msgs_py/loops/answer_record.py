"""The record of a loop that replies to each message of an input by one of an output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pendulum_msgs_py.loops.records import INPUT, OUTPUT, TIME

__all__ = ["ENDED", "FAILED", "LEFT", "MOST_ANSWERS", "Answerer", "LoopKind", "answer_record"]

MOST_ANSWERS = 1024
"""Largest number of replies in one slice; each of their times is stored."""
ENDED, LEFT, FAILED = range(3)
"""Why a slice ended: its time is over or a call is pending, a message is left to Python, or rcl failed to take one."""


@dataclass(frozen=True)
class LoopKind:
    """The loop that replies.

    Attributes:
        own: Layout of what its replies depend on and change.
        builder: Builds it, ``module:function``.
        choice: Which variant of it.
    """

    own: np.dtype[Any]
    builder: str
    choice: tuple[str, ...]


class Answerer(Protocol):
    """A node's logic that replies, and lends a loop the numbers for it.

    Attributes:
        kind: The loop; None where there is none.
        refusal: Why it cannot reply at present; empty where it can.
    """

    kind: LoopKind | None
    refusal: str

    def lend(self, own: Any) -> bool:
        """Write what replies depend on into a record; return False where Python has to handle the next message."""

    def take_back(self, record: Any) -> None:
        """Take over the changes by one or more replies; the record is the loop's whole one."""


def answer_record(own: np.dtype[Any]) -> np.dtype[Any]:
    """Return the layout of a loop that replies.

    Args:
        own: Layout of what its replies depend on and change.
    """
    return np.dtype(
        [
            ("time", TIME),
            ("counter", "i4"),
            # Event counters of what ends a slice, -1 for none.
            ("calls", "i4", (2,)),
            ("wall_ahead_ns", "i8"),
            ("end_ns", "i8"),
            ("state", INPUT),
            ("answer", OUTPUT),
            ("answers", "i8"),
            ("stamp_ns", "i8", (MOST_ANSWERS,)),
            ("age_ns", "i8", (MOST_ANSWERS,)),
            ("compute_ns", "i8", (MOST_ANSWERS,)),
            ("own", own),
        ],
        align=True,
    )
