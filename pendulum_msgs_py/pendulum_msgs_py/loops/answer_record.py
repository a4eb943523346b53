"""The record of a loop that replies to each message of an input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pendulum_msgs_py.loops.records import INPUT, OUTPUT, TIME

__all__ = ["ENDED", "FAILED", "LEFT", "MOST_ANSWERS", "Answerer", "LoopKind", "answer_record"]

MOST_ANSWERS = 1024
"""Most replies in one slice; their times are stored."""
ENDED, LEFT, FAILED = range(3)
"""Why a slice ended: its time is over or a call is pending, a message is left to Python, or rcl failed."""


@dataclass(frozen=True)
class LoopKind:
    """A replying loop.

    Attributes:
        own: Layout of its own state.
        builder: Its builder, ``module:function``.
        choice: Arguments of the builder.
    """

    own: np.dtype[Any]
    builder: str
    choice: tuple[str, ...]


class Answerer(Protocol):
    """Logic of a node that lends its state to a replying loop.

    Attributes:
        kind: The loop, or None.
        refusal: Why it cannot run at present, or empty.
    """

    kind: LoopKind | None
    refusal: str

    def lend(self, own: Any) -> bool:
        """Write the state into a record; return False if Python has to handle the next message."""

    def take_back(self, record: Any) -> None:
        """Read the state back from the loop's whole record after one or more replies."""


def answer_record(own: np.dtype[Any]) -> np.dtype[Any]:
    """Return the layout of a replying loop, with the node's own state."""
    return np.dtype(
        [
            ("time", TIME),
            ("counter", "i4"),
            # Event counters that end a slice, -1 for none.
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
