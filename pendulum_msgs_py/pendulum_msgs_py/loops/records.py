"""Records that a compiled loop reads and writes: numbers, and messages as bytes.

Their numpy layouts give Python and compiled code the same memory. Messages match a template except in stamp and numbers
(:func:`pendulum_msgs_py.contract.cdr.template_of`).
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.cdr import MessageTemplate

__all__ = [
    "HAND_OVER_NS",
    "INPUT",
    "MESSAGE",
    "MOST_BYTES",
    "MOST_VALUES",
    "OUTPUT",
    "TIME",
    "expect_template",
    "set_template",
    "structure_of",
]

MOST_BYTES = 512
"""Longest message of a loop [bytes]; Python handles longer ones."""
MOST_VALUES = 3
"""Position, velocity and effort of one joint."""
HAND_OVER_NS = 250_000
"""Time for the receiver of the newest message before Python runs [ns].

Linux wakes a receiver on the sender's core without preempting the sender: Python's work between two slices, done at
once, delayed the reply by 0.5 ms.
"""

TIME = np.dtype([("now", "i8", (2,)), ("until", "i8", (2,)), ("poll", "i4", (6,))], align=True)
"""``timespec`` now and until, and three ``struct pollfd``."""

MESSAGE = np.dtype([("buffer", "u8"), ("length", "u8"), ("capacity", "u8"), ("allocator", "u8", (5,))], align=True)
"""``rcutils_uint8_array_t``: a serialised message."""

INPUT = np.dtype(
    [
        ("subscription", "u8"),
        ("message", "u8", (MESSAGE.itemsize // 8,)),
        # rmw_message_info_t: times of sending and arrival [ns], and unused fields.
        ("info", "i8", (16,)),
        ("size", "i8"),
        ("template", "u1", (MOST_BYTES,)),
        ("mask", "u1", (MOST_BYTES,)),
        ("data", "u1", (MOST_BYTES,)),
        ("value_at", "i8", (MOST_VALUES,)),
        ("value", "f8", (MOST_VALUES,)),
        ("stamp", "u4", (2,)),
        ("stamp_ns", "i8"),
        ("most", "i8"),
    ],
    align=True,
)
"""A subscription, its expected message, and the newest content.

``size`` 0 leaves every message to Python; ``most`` bounds the messages of one poll.
"""

OUTPUT = np.dtype(
    [
        ("publisher", "u8"),
        ("message", "u8", (MESSAGE.itemsize // 8,)),
        ("size", "i8"),
        ("data", "u1", (MOST_BYTES,)),
        ("value_at", "i8", (MOST_VALUES,)),
        ("value", "f8", (MOST_VALUES,)),
        ("values", "i8"),
        ("stamp", "u4", (2,)),
        ("matched", "u8", (1,)),
    ],
    align=True,
)
"""A publisher and its message."""


_NUMBERS = {
    "i8": ctypes.c_int64,
    "u8": ctypes.c_uint64,
    "f8": ctypes.c_double,
    "i4": ctypes.c_int32,
    "u4": ctypes.c_uint32,
    "u1": ctypes.c_uint8,
}


@cache
def structure_of(layout: np.dtype[Any]) -> type[ctypes.Structure]:
    """Return a layout as a ctypes structure, whose fields Python accesses in a third of numpy's time."""

    def kind_of(field: np.dtype[Any]) -> Any:
        base, shape = field.base, field.shape
        kind: Any = structure_of(base) if base.names else _NUMBERS[base.str[1:]]
        for length in reversed(shape):
            kind = kind * length
        return kind

    assert layout.fields is not None
    assert layout.names is not None
    fields = [(name, kind_of(layout.fields[name][0])) for name in layout.names]
    structure = type("Record", (ctypes.Structure,), {"_fields_": fields})
    if ctypes.sizeof(structure) != layout.itemsize:
        raise TypeError(
            f"structure has {ctypes.sizeof(structure)} bytes; expected {layout.itemsize}, as its layout has"
        )
    return structure


def expect_template(source: NDArray[Any], template: MessageTemplate | None) -> None:
    """Set the expected message of an :data:`INPUT`; None leaves every message to Python."""
    source["size"] = 0
    # Missing values read as zero, not as those of an earlier message.
    source["value_at"], source["value"] = 0, 0.0
    if template is None or len(template.data) > MOST_BYTES or len(template.value_at) > MOST_VALUES:
        return
    size = len(template.data)
    source["template"][:size] = np.frombuffer(template.data, dtype=np.uint8)
    source["mask"][:size] = np.frombuffer(template.mask, dtype=np.uint8)
    source["value_at"][: len(template.value_at)] = template.value_at
    source["size"] = size


def set_template(output: NDArray[Any], template: MessageTemplate) -> None:
    """Set the message of an :data:`OUTPUT`, which points at its own bytes."""
    size = len(template.data)
    output["data"][:size] = np.frombuffer(template.data, dtype=np.uint8)
    output["value_at"][: len(template.value_at)] = template.value_at
    output["values"] = len(template.value_at)
    output["size"] = size
    data_at = output["data"].ctypes.data
    output["message"][:3] = (data_at, size, MOST_BYTES)
