"""Guided procedures of a lab: each announces its action, then measures values for the lab file.

Pure: the actuator is a port, the person a dialogue, time the port's clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pendulum_hw_bridge.checks.nudge import Hand, watch_nudge
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, Feedback
from pendulum_hw_bridge.port.feedback_stream import feedback_for
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Dialogue", "MountedZero", "expect_numbers", "find_zero_and_sign", "measure_tare"]

_REST_WINDOW = 2.0
_REST_TRAVEL = 5e-4
"""Largest drift within the window that counts as rest [rad]; encoder noise is averaged out."""
_REST_PATIENCE = 120.0
_LARGEST_TARE = 1.0


class Dialogue(Protocol):
    """The person at the machine."""

    def say(self, text: str) -> None:
        """Show a sentence."""

    def go_on(self, text: str) -> None:
        """Show a sentence and wait for consent; raises without it."""


@dataclass(frozen=True)
class MountedZero:
    """Mounting of an actuator.

    Attributes:
        sign: 1 if it counts counter-clockwise, else -1.
        offset: Joint angle where the actuator reads zero [rad].
        play: Distance between the two rest positions due to friction [rad].
    """

    sign: int
    offset: float
    play: float


def find_zero_and_sign(port: ActuatorPort, dialogue: Dialogue, hand: Hand, other_hand: Hand) -> MountedZero:
    """Find the zero and sign of a connected actuator; the motor gets no torque.

    Friction stops a pendulum slightly off its lowest point, on the side it came from: zero is the middle between the
    rest positions after a turn to either side.

    Raises:
        ActuatorError: The link does not turn, does not come to rest, or both turns have one direction.
    """
    dialogue.go_on(
        "Zero and sign. The motor gets no torque. You will turn the link a little counter-clockwise, let it come to "
        "rest, then clockwise, and let it come to rest again. Let it hang still now."
    )
    port.stop()
    _rest(port, dialogue)
    first = _turned(port, hand)
    above = _rest(port, dialogue)
    dialogue.say("Now the same CLOCKWISE.")
    second = _turned(port, other_hand)
    below = _rest(port, dialogue)
    if first * second > 0.0:
        raise ActuatorError(
            "exception", "both turns went the same way; expected one counter-clockwise and then one clockwise"
        )
    sign = 1 if first > 0.0 else -1
    middle = 0.5 * (above + below)
    found = MountedZero(sign, -sign * middle, abs(above - below))
    dialogue.say(
        f"Zero: the joint angle is {found.offset:+.4f} rad where the actuator reads zero, sign {sign:+d}; "
        f"friction leaves {math.degrees(found.play):.1f} degrees of play."
    )
    return found


def measure_tare(port: ActuatorPort, settings: BridgeSettings, plant: PlantParameters, dialogue: Dialogue) -> float:
    """Return the torque sensor's reading beyond the link's weight, in joint coordinates [N m], without torque.

    Raises:
        ActuatorError: The pendulum does not rest, or the tare is so large that something pulls.
    """
    dialogue.go_on("Effort tare. The motor gets no torque. Let the pendulum hang still, and do not touch it.")
    port.stop()
    _rest(port, dialogue)
    records = _listen(port, _REST_WINDOW)
    sign = settings.joint_sign
    angle = sign * float(np.mean([record.position for record in records])) + settings.joint_offset
    torque = sign * float(np.mean([record.effort for record in records]))
    tare = torque - plant.gravity * math.sin(angle)
    if abs(tare) > _LARGEST_TARE:
        raise ActuatorError(
            "effort_measured",
            f"torque at rest is {torque:.2f} N m at {angle:.2f} rad; expected within {_LARGEST_TARE:g} N m of what "
            "hangs there: something pulls, or zero is wrong",
        )
    spread = float(np.std([record.effort for record in records]))
    dialogue.say(f"Tare: {tare:+.3f} N m (noise {spread:.3f} N m).")
    return tare


def _turned(port: ActuatorPort, hand: Hand) -> float:
    turned = watch_nudge(port, hand)
    if turned == 0.0:
        raise ActuatorError("exception", "nothing turned; expected the link to be turned by about 10 degrees")
    return turned


def _rest(port: ActuatorPort, dialogue: Dialogue) -> float:
    """Wait for rest; return the actuator's angle [rad]."""
    deadline = port.now_ns() + round(_REST_PATIENCE * NANOSECONDS)
    dialogue.say("Waiting for it to come to rest ...")
    while port.now_ns() < deadline:
        angles = [record.position for record in _listen(port, _REST_WINDOW)]
        quarter = max(1, len(angles) // 4)
        if abs(float(np.mean(angles[:quarter])) - float(np.mean(angles[-quarter:]))) < _REST_TRAVEL:
            return float(np.mean(angles))
    raise ActuatorError(
        "exception", f"pendulum did not come to rest within {_REST_PATIENCE:g} s; expected it to hang still"
    )


def _listen(port: ActuatorPort, seconds: float) -> list[Feedback]:
    records = []
    for record in feedback_for(port, seconds):
        expect_numbers(record)
        records.append(record)
    if len(records) < 2:
        raise ActuatorError("feedback_lost", f"{len(records)} records in {seconds:g} s; expected feedback to flow")
    return records


def expect_numbers(record: Feedback) -> None:
    """Refuse NaN or infinite feedback, which must not reach the lab file."""
    for what, value, unit in (
        ("position", record.position, "rad"),
        ("velocity", record.velocity, "rad/s"),
        ("effort", record.effort, "N m"),
    ):
        if not math.isfinite(value):
            raise ActuatorError("feedback_not_finite", f"{what} is {value} {unit}; expected a finite number")
