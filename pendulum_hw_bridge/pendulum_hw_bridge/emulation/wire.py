"""Packets between an emulated actuator process and its clients, over UDP as with a real module.

Connectionless on purpose: the actuator is not informed when the bridge dies. Setpoints and feedback are fixed structs;
settings are JSON requests with replies.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

from pendulum_hw_bridge.port.actuator import Command, Feedback, HardwareLimits, MStopAction
from pendulum_hw_bridge.port.gains import GAIN_FIELDS, LOOPS, GainSet, PidGains
from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "COMMAND",
    "FEEDBACK",
    "MAX_PACKET",
    "REPLY",
    "REQUEST",
    "decode_command",
    "decode_feedback",
    "decode_json",
    "encode_command",
    "encode_feedback",
    "encode_json",
    "gains_from_json",
    "gains_to_json",
    "kind_of",
    "limits_from_json",
    "limits_to_json",
    "parse_address",
]

MAX_PACKET = 8192
"""Largest packet [bytes]."""

_MAGIC = b"X59/1"
COMMAND, FEEDBACK, REQUEST, REPLY = (_MAGIC + bytes([kind]) for kind in range(1, 5))

_COMMAND = struct.Struct("<4d")
_INTEGERS = 3
_FLAGS = 6
_FEEDBACK = struct.Struct(f"<{_INTEGERS}q{len(Feedback._fields) - _INTEGERS - _FLAGS}d{_FLAGS}b")


def kind_of(packet: bytes) -> bytes:
    """Return the kind of a packet, empty if unknown."""
    kind = packet[: len(COMMAND)]
    return kind if kind in {COMMAND, FEEDBACK, REQUEST, REPLY} else b""


def encode_command(command: Command) -> bytes:
    """Return the packet of setpoints."""
    return COMMAND + _COMMAND.pack(command.position, command.velocity, command.effort, command.pwm)


def decode_command(packet: bytes) -> Command | None:
    """Return the setpoints of a packet, or None for a wrong length or an infinite value."""
    if len(packet) != len(COMMAND) + _COMMAND.size:
        return None
    values = _COMMAND.unpack_from(packet, len(COMMAND))
    return None if any(math.isinf(value) for value in values) else Command(*values)


def encode_feedback(feedback: Feedback) -> bytes:
    """Return the packet of a feedback record."""
    return FEEDBACK + _FEEDBACK.pack(*feedback)


def decode_feedback(packet: bytes) -> Feedback | None:
    """Return the record of a packet, or None for a wrong length."""
    if len(packet) != len(FEEDBACK) + _FEEDBACK.size:
        return None
    values = list(_FEEDBACK.unpack_from(packet, len(FEEDBACK)))
    values[-_FLAGS] = bool(values[-_FLAGS])
    return Feedback(*values)


def encode_json(kind: bytes, value: dict[str, Any]) -> bytes:
    """Return the packet of a request or a reply."""
    return kind + json.dumps(value, allow_nan=False).encode()


def decode_json(packet: bytes) -> dict[str, Any]:
    """Return the object in a request or reply, or an empty one."""
    try:
        value = json.loads(packet[len(REQUEST) :])
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def gains_to_json(gains: GainSet) -> dict[str, Any]:
    """Return gains as JSON, without infinite clamps."""
    loops = {
        loop: {name: value for name in GAIN_FIELDS if math.isfinite(value := float(getattr(gains.loop(loop), name)))}
        for loop in LOOPS
    }
    return {"strategy": gains.strategy, **loops}


def gains_from_json(value: dict[str, Any]) -> GainSet:
    """Return the gains in a JSON object; ParameterError if it lacks a loop or a gain is refused."""
    try:
        return GainSet(int(value["strategy"]), *(PidGains(**value[loop]) for loop in LOOPS))
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(f"gains are not understood: {error}") from error


def limits_to_json(limits: HardwareLimits) -> dict[str, Any]:
    """Return limits as JSON, without infinite ends of the window."""
    value: dict[str, Any] = {
        "effort": limits.effort,
        "velocity": limits.velocity,
        "pwm": limits.pwm,
        "m_stop": limits.m_stop.value,
    }
    for name in ("position_min", "position_max"):
        if math.isfinite(getattr(limits, name)):
            value[name] = getattr(limits, name)
    return value


def limits_from_json(value: dict[str, Any]) -> HardwareLimits:
    """Return the limits in a JSON object; ParameterError if it is not understood or a limit is refused."""
    try:
        return HardwareLimits(**{**value, "m_stop": MStopAction(value["m_stop"])})
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(f"limits are not understood: {error}") from error


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; ParameterError for anything else."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ParameterError(f"emulator address is {text!r}; expected HOST:PORT, such as 127.0.0.1:17590")
    return host, int(port)
