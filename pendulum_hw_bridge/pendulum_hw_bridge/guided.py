"""Guided procedures of a lab: each says what it will do before it does it, and measures what the lab file then holds.

Pure: the actuator is a port, the person a dialogue, time the port's clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pendulum_hw_bridge.actuator import ActuatorError, ActuatorPort, Command, Feedback, Strategy
from pendulum_hw_bridge.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.feedback_stream import feedback_for
from pendulum_hw_bridge.nudge import Hand, watch_nudge
from pendulum_hw_bridge.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.settings import BridgeSettings, write_limits
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, SeriesElasticParameters

__all__ = [
    "PROOF_DUTY",
    "Dialogue",
    "MountedZero",
    "find_zero_and_sign",
    "measure_tare",
    "prove_lifetime",
    "prove_m_stop",
]

PROOF_DUTY = 0.01
"""Duty for proofs: about 0.4 N m at 36 V, which lifts the thesis's pendulum by less than 15 degrees [-]."""
_REST_WINDOW = 2.0
_REST_TRAVEL = 5e-4
"""Largest drift within the window that is rest [rad]; noise of the encoder is averaged out."""
_REST_PATIENCE = 120.0
_LARGEST_TARE = 1.0
_PROOF_SECONDS = 0.3
_PRESS_SECONDS = 20.0
_LARGEST_TRAVEL = 1.0
"""Largest turn of the link under the duty for proofs [rad]: twice what a swing of the thesis's pendulum overshoots."""
_ENDS_WITHIN = 0.06
"""Time within which the M-stop must end the duty [s]."""
_NO_DUTY = 1e-9
_SILENT_PERIODS = 10
"""Feedback periods without feedback after which a proof is broken off [-]."""
_MARGIN_PERIODS = 2
"""Feedback periods by which the end of the duty may be seen late [-]."""


class Dialogue(Protocol):
    """The person at the machine."""

    def say(self, text: str) -> None:
        """Show a sentence."""

    def go_on(self, text: str) -> None:
        """Show a sentence and wait until the person agrees; raises where they do not."""


@dataclass(frozen=True)
class MountedZero:
    """How an actuator is mounted.

    Attributes:
        sign: 1 where it counts counter-clockwise.
        offset: Joint angle where the actuator reads zero [rad].
        play: Distance between the two places at which friction lets it rest [rad].
    """

    sign: int
    offset: float
    play: float


def find_zero_and_sign(port: ActuatorPort, dialogue: Dialogue, hand: Hand, other_hand: Hand) -> MountedZero:
    """Find where the pendulum hangs and which way the actuator counts; the motor gets no torque.

    Friction lets a pendulum rest a little off its lowest point, on the side it came from: zero is the middle between
    the rests after a turn to either side.

    Args:
        port: Connected, strategy off.
        dialogue: The person.
        hand: Turns counter-clockwise.
        other_hand: Turns clockwise.

    Raises:
        ActuatorError: Nothing turns, nothing comes to rest, or both turns go one way.
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
    """Return what the torque sensor shows beyond what hangs there, in joint coordinates [N m].

    Args:
        port: Connected, strategy off.
        settings: Zero and sign of the joint.
        plant: How much torque hangs at which angle.
        dialogue: The person.

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


def prove_lifetime(
    port: ActuatorPort,
    settings: BridgeSettings,
    dialogue: Dialogue,
    checks: SafetyLimits | None = None,
    drivetrain: SeriesElasticParameters | None = None,
) -> float:
    """Drive gently, fall silent, and return for how long the motor kept its duty [s].

    Args:
        port: Connected, strategy off.
        settings: The command lifetime and the limits that the bridge will set.
        dialogue: The person.
        checks: Limits of the checks of feedback; None for the usual ones.
        drivetrain: Which torque the duty makes; None for that of an X5-9.

    Raises:
        ActuatorError: The duty never came, a limit was left, or it did not end by itself in time.
    """
    dialogue.go_on(
        f"Proof of the command lifetime. THE MOTOR WILL TURN GENTLY: duty {PROOF_DUTY:g} (about 0.4 N m) for "
        f"{_PROOF_SECONDS:g} s. Then this program falls silent, as if it were killed, and the motor must lose its "
        f"torque within {1e3 * settings.command_lifetime:g} ms. A hand on the motion stop, nobody in the pendulum's "
        "plane."
    )
    try:
        last_ns = _drive(port, settings, checks, lambda record, now: now < _PROOF_SECONDS, drivetrain)
        limit = settings.command_lifetime + _MARGIN_PERIODS / settings.feedback_rate
        ended = _duty_ends(port, last_ns, limit)
    finally:
        port.stop()
    if ended > limit:
        raise ActuatorError(
            "exception",
            f"motor kept its duty for {1e3 * ended:.0f} ms after the last command; expected at most "
            f"{1e3 * limit:.0f} ms. Do not arm this machine",
        )
    dialogue.say(
        f"Proved: the torque ended {1e3 * ended:.0f} ms after the last command (at most {1e3 * limit:.0f} ms: "
        f"the lifetime, and {_MARGIN_PERIODS:g} records until it shows)."
    )
    return ended


def prove_m_stop(
    port: ActuatorPort,
    settings: BridgeSettings,
    dialogue: Dialogue,
    checks: SafetyLimits | None = None,
    drivetrain: SeriesElasticParameters | None = None,
) -> float:
    """Drive gently until somebody presses the motion stop, and return for how long the motor kept its duty [s].

    Args:
        port: Connected, strategy off.
        settings: The command lifetime and the limits that the bridge will set.
        dialogue: The person.
        checks: Limits of the checks of feedback; None for the usual ones.
        drivetrain: Which torque the duty makes; None for that of an X5-9.

    Raises:
        ActuatorError: Nobody pressed it in time, a limit was left, or it did not end the duty.
    """
    dialogue.go_on(
        f"Proof of the motion stop. THE MOTOR WILL TURN GENTLY: duty {PROOF_DUTY:g} (about 0.4 N m) for at most "
        f"{_PRESS_SECONDS:g} s, until you press the motion stop. Nobody in the pendulum's plane."
    )
    pressed_ns = 0

    def unpressed(record: Feedback, now: float) -> bool:
        nonlocal pressed_ns
        pressed_ns = record.stamp_ns if record.m_stop else 0
        return not record.m_stop and now < _PRESS_SECONDS

    try:
        dialogue.say("Press the motion stop NOW.")
        _drive(port, settings, checks, unpressed, drivetrain)
        if not pressed_ns:
            raise ActuatorError("m_stop", f"motion stop was not pressed within {_PRESS_SECONDS:g} s")
        ended = _duty_ends(port, pressed_ns, _ENDS_WITHIN)
    finally:
        port.stop()
    if ended > _ENDS_WITHIN:
        raise ActuatorError(
            "m_stop",
            f"motor kept its duty for {1e3 * ended:.0f} ms after the motion stop; expected at most "
            f"{1e3 * _ENDS_WITHIN:.0f} ms. Do not arm this machine",
        )
    dialogue.say(f"Proved: the torque ended within {1e3 * ended:.0f} ms. Release the motion stop.")
    return ended


def _drive(
    port: ActuatorPort,
    settings: BridgeSettings,
    checks: SafetyLimits | None,
    goes_on: Callable[[Feedback, float], bool],
    drivetrain: SeriesElasticParameters | None = None,
) -> int:
    """Keep the duty for proofs while told to; return when the last command was sent [ns]."""
    write_limits(port, settings)
    mapping = EffortMapping(EffortStrategy.DIRECT_PWM, drivetrain or load_emulator("thesis").drivetrain)
    reads = port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.0))
    if reads is not Strategy.DIRECT_PWM:
        raise ActuatorError("strategy", f"strategy reads back as {reads.name}; expected DIRECT_PWM")
    monitor = SafetyMonitor(checks or SafetyLimits(), 1.0 / settings.feedback_rate)
    start_ns, begin = port.now_ns(), math.nan
    last_ns, silent, driven = start_ns, 0, False
    while True:
        record = port.read(1.0 / settings.feedback_rate)
        if record is None:
            silent += 1
            if silent > _SILENT_PERIODS:
                raise ActuatorError(
                    "feedback_lost",
                    f"no feedback for {_SILENT_PERIODS * 1e3 / settings.feedback_rate:.0f} ms; expected it every "
                    f"{1e3 / settings.feedback_rate:.0f} ms",
                )
            continue
        silent = 0
        _expect_numbers(record)
        driven = driven or abs(record.pwm_command) > 0.5 * PROOF_DUTY
        if not goes_on(record, (record.stamp_ns - start_ns) / NANOSECONDS):
            break
        begin = record.position if math.isnan(begin) else begin
        _expect_inside(record, settings, begin)
        fault = monitor.check(record)
        if fault is not None:
            raise ActuatorError(fault.name, fault.message)
        _expect_allowed(mapping.motor_effort(PROOF_DUTY, 0.0, record.voltage), record.voltage, settings)
        last_ns = port.write(Command(pwm=PROOF_DUTY)).sent_ns
    if not driven:
        raise ActuatorError(
            "command_not_in_force", f"motor never had the duty {PROOF_DUTY:g}; is the motion stop pressed already?"
        )
    return last_ns


def _expect_allowed(effort: float, voltage: float, settings: BridgeSettings) -> None:
    """Refuse a torque beyond the effort limit: the firmware's own limit does not bind a duty."""
    if not effort <= settings.limits.effort:
        raise ActuatorError(
            "settings",
            f"duty for proofs makes {effort:.2f} N m at {voltage:.0f} V; expected at most the effort limit, "
            f"{settings.limits.effort:g} N m: this machine cannot be proved under that limit",
        )


def _expect_inside(record: Feedback, settings: BridgeSettings, begin: float) -> None:
    """Refuse to drive on outside the limits that the bridge keeps, or where the link turns on and on."""
    limits, turned = settings.limits, abs(record.position - begin)
    if not limits.position_min <= record.position <= limits.position_max:
        raise ActuatorError(
            "supervisor",
            f"actuator's position is {record.position:.2f} rad; expected {limits.position_min:g} to "
            f"{limits.position_max:g} rad",
        )
    if abs(record.velocity) > limits.velocity:
        raise ActuatorError(
            "supervisor", f"velocity is {record.velocity:.2f} rad/s; expected at most {limits.velocity:g} rad/s"
        )
    if turned > _LARGEST_TRAVEL:
        raise ActuatorError(
            "supervisor",
            f"link turned by {turned:.2f} rad under the duty {PROOF_DUTY:g}; expected at most {_LARGEST_TRAVEL:g} rad: "
            "is the pendulum mounted?",
        )


def _duty_ends(port: ActuatorPort, since_ns: int, limit: float) -> float:
    """Return when the duty had ended, after a time [s]; ten times the limit and more where it did not."""
    limit_ns = round(limit * NANOSECONDS)
    heard_ns = shown_ns = since_ns
    while port.now_ns() - since_ns < 10 * limit_ns:
        record = port.read(0.01)
        if record is None:
            continue
        heard_ns = record.stamp_ns
        if heard_ns < since_ns:
            continue
        if abs(record.pwm_command) < _NO_DUTY:
            gap_ns = heard_ns - shown_ns
            # A busy computer must not condemn a machine that has lost its torque in time.
            if shown_ns - since_ns <= limit_ns < heard_ns - since_ns and 2 * gap_ns > limit_ns:
                raise ActuatorError(
                    "feedback_lost",
                    f"no feedback for {1e3 * gap_ns / NANOSECONDS:.0f} ms while the duty ended; expected records that "
                    f"tell whether it ended within {1e3 * limit:.0f} ms. Try again while this computer has nothing "
                    "else to do",
                )
            return (heard_ns - since_ns) / NANOSECONDS
        shown_ns = heard_ns
    silence_ns = port.now_ns() - heard_ns
    if silence_ns > 5 * limit_ns:
        raise ActuatorError(
            "feedback_lost", f"no feedback for {silence_ns / NANOSECONDS:.1f} s; expected to see the duty end"
        )
    return (port.now_ns() - since_ns) / NANOSECONDS


def _turned(port: ActuatorPort, hand: Hand) -> float:
    turned = watch_nudge(port, hand)
    if turned == 0.0:
        raise ActuatorError("exception", "nothing turned; expected the link to be turned by about 10 degrees")
    return turned


def _rest(port: ActuatorPort, dialogue: Dialogue) -> float:
    """Wait until it rests; return where, in the actuator's own angle [rad]."""
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
        _expect_numbers(record)
        records.append(record)
    if len(records) < 2:
        raise ActuatorError("feedback_lost", f"{len(records)} records in {seconds:g} s; expected feedback to flow")
    return records


def _expect_numbers(record: Feedback) -> None:
    """Refuse feedback that is no number: no angle can be judged by it, and none may reach the lab file."""
    for what, value, unit in (
        ("position", record.position, "rad"),
        ("velocity", record.velocity, "rad/s"),
        ("effort", record.effort, "N m"),
    ):
        if not math.isfinite(value):
            raise ActuatorError("feedback_not_finite", f"{what} is {value} {unit}; expected a finite number")
