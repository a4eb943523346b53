"""Checks of the mounting of a pendulum at rest: zero, load and sign."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pendulum_hw_bridge.checks.check_item import CheckItem
from pendulum_hw_bridge.checks.nudge import NUDGE_ANGLE, Hand, watch_nudge
from pendulum_hw_bridge.port.actuator import ActuatorPort, Feedback
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["rest_items", "sign_item"]

_LEAST_ZERO_TOLERANCE = 0.15
_TORQUE_TOLERANCE = 0.3


def rest_items(
    records: Sequence[Feedback],
    settings: BridgeSettings,
    plant: PlantParameters,
    window: tuple[float, float],
    hangs: bool,
) -> list[CheckItem]:
    """Check angle and torque of a pendulum at rest: hanging is zero, and the torque is that of its weight."""
    sign = settings.joint_sign
    angle = sign * float(np.mean([record.position for record in records])) + settings.joint_offset
    torque = sign * float(np.mean([record.effort for record in records])) - settings.effort_tare
    items = [
        CheckItem(
            "angle is inside its window",
            window[0] <= angle <= window[1],
            f"{angle:.3f} rad",
            f"{window[0]:g} to {window[1]:g} rad",
        )
    ]
    weight = plant.gravity * math.sin(angle) if hangs and math.isfinite(angle) else 0.0
    if hangs:
        tolerance = max(_LEAST_ZERO_TOLERANCE, _friction_angle(plant))
        turns = round(angle / math.tau) if math.isfinite(angle) else 0
        note = f", {turns} turn{'s' * (abs(turns) != 1)} off" if turns else ""
        items.append(
            CheckItem(
                "hanging is zero",
                abs(angle) <= tolerance,
                f"{angle:.3f} rad{note}",
                f"0 within {tolerance:.2f} rad",
                "either it does not hang, or joint_offset (lab file: joint.zero) is wrong: "
                "python -m pendulum_hw_bridge lab zero FILE",
            )
        )
    items.append(
        CheckItem(
            "torque at rest is what hangs there",
            abs(torque - weight) <= _TORQUE_TOLERANCE,
            f"{torque:.2f} N m",
            f"{weight:.2f} within {_TORQUE_TOLERANCE:g} N m",
            "something pulls at the link, the plant file is another pendulum's, or the sensor needs a tare: "
            "python -m pendulum_hw_bridge lab tare FILE",
        )
    )
    return items


def _friction_angle(plant: PlantParameters) -> float:
    """Return how far from hanging friction can hold the link at rest [rad]."""
    friction = plant.static_friction or plant.coulomb_friction
    if plant.drivetrain is not None:
        friction += plant.drivetrain.motor_static_friction
    return math.asin(min(1.0, friction / plant.gravity)) if plant.gravity > 0.0 else 0.0


def sign_item(
    port: ActuatorPort, settings: BridgeSettings, hand: Hand | None, progress: Callable[[str], None]
) -> CheckItem:
    """Check by a nudge whether counter-clockwise is positive; untried without a hand."""
    name, expected = "counter-clockwise is positive", "the angle grows"
    if hand is None:
        return CheckItem(name, None, "not tried", expected, "try it without --no-nudge")
    progress("waiting for a nudge counter-clockwise")
    turned = settings.joint_sign * watch_nudge(port, hand)
    if turned == 0.0:
        seen = f"nothing turned by {NUDGE_ANGLE:g} rad"
        return CheckItem(name, False, seen, expected, "turn the link by hand, counter-clockwise, when asked")
    hint = "joint_sign (lab file: joint.sign) is wrong: python -m pendulum_hw_bridge lab zero FILE"
    return CheckItem(name, turned > 0.0, f"{turned:+.2f} rad", expected, hint)
