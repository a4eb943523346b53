"""Proofs that the motor's torque ends with the command lifetime, and with the motion stop. Both turn the motor gently.

For the motion stop, commands continue with a lifetime of 250 ms until the torque has ended: expiry of the usual 50 ms
would end the duty within the allowed 60 ms, and a button that only sets its flag would pass. Each proof counts from the
last record (or command) that certainly had the duty. Pure: port and dialogue are arguments, time is the port's clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.lab.guided import Dialogue, expect_numbers
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorPort,
    Command,
    Feedback,
    MStopAction,
    Strategy,
    afterwards,
    no_torque,
)
from pendulum_hw_bridge.port.settings import BridgeSettings, write_limits
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["PROOF_DUTY", "prove_lifetime", "prove_m_stop"]

PROOF_DUTY = 0.01
"""Duty of proofs: about 0.4 N m at 36 V, which lifts the thesis's pendulum by less than 15 degrees [-]."""
_PROOF_SECONDS = 0.3
_PRESS_SECONDS = 20.0
_LARGEST_TRAVEL = 1.0
"""Largest rotation under that duty [rad]: twice the overshoot of the thesis's pendulum."""
_ENDS_WITHIN = 0.06
"""Time within which the M-stop must end the duty [s]."""
_LEAST_RATE = 50.0
"""Least feedback rate that resolves this time, with a record to spare [Hz]."""
_NO_DUTY = 1e-9
_SILENT_PERIODS = 10
"""Feedback periods without feedback after which a proof is aborted [-]."""
_MARGIN_PERIODS = 2
"""Feedback periods by which the end of the duty may show late [-]."""
_LEAST_MARGIN = 0.02
"""Smallest such margin, for computer and network at any rate [s]."""
_LIFETIME_MEANWHILE = 0.25
"""Command lifetime during the proof of the motion stop [s]: lost commands must not end the duty."""


def prove_lifetime(
    port: ActuatorPort,
    settings: BridgeSettings,
    dialogue: Dialogue,
    checks: SafetyLimits | None = None,
    drivetrain: SeriesElasticParameters | None = None,
) -> float:
    """Drive gently, stop sending, and return for how long the duty lasted [s].

    ``settings`` has the command lifetime and limits that the bridge will set; ``drivetrain`` maps the duty to torque.

    Raises:
        ActuatorError: No duty, a limit was exceeded, the duty did not end in time, or feedback did not show when.
    """
    dialogue.go_on(
        f"Proof of the command lifetime. THE MOTOR WILL TURN GENTLY: duty {PROOF_DUTY:g} (about 0.4 N m) for "
        f"{_PROOF_SECONDS:g} s. Then this program falls silent, as if it were killed, and the motor must lose its "
        f"torque within {1e3 * settings.command_lifetime:g} ms. A hand on the motion stop, nobody in the pendulum's "
        "plane."
    )
    margin = max(_MARGIN_PERIODS / settings.feedback_rate, _LEAST_MARGIN)
    limit = settings.command_lifetime + margin
    with afterwards(port.stop):
        drive = _GentleDrive(port, settings, checks, drivetrain)
        record = drive.read()
        while record.stamp_ns - drive.begin_ns < _PROOF_SECONDS * NANOSECONDS:
            drive.command(record)
            record = drive.read()
        if not _has_duty(record):
            raise ActuatorError(
                "command_not_in_force", f"motor did not have the duty {PROOF_DUTY:g} when it was to end"
            )
        drive.expects_nothing()
        ended = _end_of_duty(iter(drive.read, None), drive.sent_ns, limit)
        if ended > limit:
            raise ActuatorError(
                "exception",
                f"motor kept its duty for {1e3 * ended:.0f} ms after the last command; expected at most "
                f"{1e3 * limit:.0f} ms. Do not arm this machine",
            )
    dialogue.say(
        f"Proved: the torque ended {1e3 * ended:.0f} ms after the last command (at most {1e3 * limit:.0f} ms: "
        f"the lifetime, and {1e3 * margin:.0f} ms until it shows)."
    )
    return ended


def prove_m_stop(
    port: ActuatorPort,
    settings: BridgeSettings,
    dialogue: Dialogue,
    checks: SafetyLimits | None = None,
    drivetrain: SeriesElasticParameters | None = None,
) -> float:
    """Drive gently until the motion stop is pressed, and return for how long the duty lasted [s].

    The duty is still commanded afterwards, with a longer lifetime, so that only the motion stop can end it. Arguments
    as for :func:`prove_lifetime`.

    Raises:
        ActuatorError: Not pressed in time, a limit was exceeded, no end of the duty in time, or feedback did not show
            when.
    """
    if settings.limits.m_stop is not MStopAction.MOTOR_OFF:
        raise ActuatorError(
            "settings",
            f"motion stop action is {settings.limits.m_stop.value}; expected {MStopAction.MOTOR_OFF.value}, which "
            "alone ends the torque",
        )
    if settings.feedback_rate < _LEAST_RATE:
        raise ActuatorError(
            "settings",
            f"feedback rate is {settings.feedback_rate:g} Hz; expected at least {_LEAST_RATE:g} Hz, to see "
            f"the duty end within {1e3 * _ENDS_WITHIN:.0f} ms",
        )
    dialogue.go_on(
        f"Proof of the motion stop. THE MOTOR WILL TURN GENTLY: duty {PROOF_DUTY:g} (about 0.4 N m) for at most "
        f"{_PRESS_SECONDS:g} s, until you press the motion stop; keep it pressed then. Nobody in the pendulum's plane."
    )
    settings = replace(settings, command_lifetime=max(settings.command_lifetime, _LIFETIME_MEANWHILE))
    with afterwards(port.stop):
        dialogue.say("Press the motion stop NOW.")
        drive = _GentleDrive(port, settings, checks, drivetrain)
        driven_ns, heard_ns = None, drive.begin_ns
        record = drive.read(may_be_pressed=True)
        while not record.m_stop:
            heard_ns = record.stamp_ns
            if heard_ns - drive.begin_ns >= _PRESS_SECONDS * NANOSECONDS:
                raise ActuatorError("m_stop", f"motion stop was not pressed within {_PRESS_SECONDS:g} s")
            driven_ns = heard_ns if _has_duty(record) else driven_ns
            drive.command(record)
            record = drive.read(may_be_pressed=True)
        since_ns = _expect_driven_until(record.stamp_ns, driven_ns, heard_ns)
        ended = _end_of_duty(_while_pressed(drive, record, settings), since_ns, _ENDS_WITHIN)
        if ended > _ENDS_WITHIN:
            raise ActuatorError(
                "m_stop",
                f"motor kept its duty for {1e3 * ended:.0f} ms after the motion stop; expected at most "
                f"{1e3 * _ENDS_WITHIN:.0f} ms. Do not arm this machine",
            )
    dialogue.say(f"Proved: the torque ended within {1e3 * ended:.0f} ms. Release the motion stop.")
    return ended


class _GentleDrive:
    """Duty of proofs; each record is checked before the next command. Stamps in [ns]."""

    def __init__(
        self,
        port: ActuatorPort,
        settings: BridgeSettings,
        checks: SafetyLimits | None,
        drivetrain: SeriesElasticParameters | None,
    ) -> None:
        write_limits(port, settings)
        self._port, self._settings = port, settings
        self._mapping = EffortMapping(EffortStrategy.DIRECT_PWM, drivetrain or load_emulator("thesis").drivetrain)
        reads = port.set_strategy(Strategy.DIRECT_PWM, no_torque(Strategy.DIRECT_PWM))
        if reads is not Strategy.DIRECT_PWM:
            raise ActuatorError("strategy", f"strategy reads back as {reads.name}; expected DIRECT_PWM")
        self._monitor = SafetyMonitor(checks or SafetyLimits(), 1.0 / settings.feedback_rate)
        self._begin_position: float | None = None
        self.begin_ns = self.sent_ns = self._newest_ns = port.now_ns()

    def read(self, *, may_be_pressed: bool = False) -> Feedback:
        """Return the next record within all limits; a pressed motion stop is a fault unless permitted."""
        period = 1.0 / self._settings.feedback_rate
        for _ in range(_SILENT_PERIODS + 1):
            record = self._port.read(period)
            # Older or repeated records do not show the present state.
            if record is not None and record.stamp_ns >= self._newest_ns and self._monitor.is_new(record):
                self._newest_ns = record.stamp_ns
                if may_be_pressed and record.m_stop:
                    self.expects_nothing()
                self._judge(record._replace(m_stop=False) if may_be_pressed else record)
                return record
        raise ActuatorError(
            "feedback_lost",
            f"no feedback for {1e3 * _SILENT_PERIODS * period:.0f} ms; expected it every {1e3 * period:.0f} ms",
        )

    def _judge(self, record: Feedback) -> None:
        expect_numbers(record)
        if not math.isfinite(record.pwm_command):
            raise ActuatorError("feedback_not_finite", f"duty is {record.pwm_command}; expected a finite number")
        if self._begin_position is None:
            self._begin_position = record.position
        _expect_inside(record, self._settings, self._begin_position)
        fault = self._monitor.check(record)
        if fault is not None:
            raise ActuatorError(fault.name, fault.message)

    def command(self, record: Feedback) -> None:
        """Command the duty, if permitted at the newest record's voltage."""
        effort = self._mapping.motor_effort(PROOF_DUTY, 0.0, record.voltage)
        _expect_allowed(effort, record.voltage, self._settings)
        command = Command(pwm=PROOF_DUTY)
        sent_ns = self._port.write(command).sent_ns
        pause, self.sent_ns = (sent_ns - self.sent_ns) / NANOSECONDS, sent_ns
        self._monitor.note_sent(command, Strategy.DIRECT_PWM, sent_ns)
        if pause >= self._settings.command_lifetime:
            raise ActuatorError(
                "host_stalled",
                f"{1e3 * pause:.0f} ms passed between two commands; expected less than the command lifetime, "
                f"{1e3 * self._settings.command_lifetime:.0f} ms. Nothing is proved. Try again while this computer has "
                "nothing else to do",
            )

    def expects_nothing(self) -> None:
        """Expect the end of the duty."""
        self._monitor.stopped()


def _while_pressed(drive: _GentleDrive, record: Feedback, settings: BridgeSettings) -> Iterator[Feedback]:
    """Yield records while the motion stop is pressed; the duty is still commanded."""
    while True:
        if not record.m_stop:
            raise ActuatorError("m_stop", "motion stop was released during its proof; expected it to be held pressed")
        silence = (record.stamp_ns - drive.sent_ns) / NANOSECONDS
        if silence >= settings.command_lifetime:
            raise ActuatorError(
                "feedback_lost",
                f"no feedback for {1e3 * silence:.0f} ms while the motion stop was pressed; expected less than the "
                f"command lifetime, {1e3 * settings.command_lifetime:.0f} ms, which would have ended the duty too",
            )
        yield record
        drive.command(record)
        record = drive.read(may_be_pressed=True)


def _has_duty(record: Feedback) -> bool:
    return abs(record.pwm_command) > 0.5 * PROOF_DUTY


def _expect_driven_until(pressed_ns: int, driven_ns: int | None, heard_ns: int) -> int:
    """Return when the motor last had its duty [ns]; refuse a press without duty or without feedback."""
    silence = (pressed_ns - heard_ns) / NANOSECONDS
    if driven_ns is not None and silence > _ENDS_WITHIN:
        raise ActuatorError(
            "feedback_lost",
            f"no feedback for {1e3 * silence:.0f} ms while the motion stop was pressed; expected at most "
            f"{1e3 * _ENDS_WITHIN:.0f} ms",
        )
    if driven_ns is None or (pressed_ns - driven_ns) / NANOSECONDS > _ENDS_WITHIN:
        raise ActuatorError(
            "command_not_in_force",
            f"motor did not have the duty {PROOF_DUTY:g} when the motion stop was pressed; is the motion stop pressed "
            "already?",
        )
    return driven_ns


def _end_of_duty(records: Iterator[Feedback], since_ns: int, limit: float) -> float:
    """Return when the duty has ended for good [s]; more than the limit if late.

    Args:
        records: Feedback, read until beyond the limit because a duty may return.
        since_ns: Time at which the motor certainly had its duty, and should start to lose it [ns].
        limit: Longest permitted time [s].

    Raises:
        ActuatorError: Feedback paused when it ended, so that the time is unknown.
    """
    limit_ns = round(limit * NANOSECONDS)
    shown, ended = 0, None
    for record in records:
        age = record.stamp_ns - since_ns
        if age < 0:
            continue
        if abs(record.pwm_command) >= _NO_DUTY:
            shown, ended = age, None
        elif ended is None:
            ended = age
        if age > limit_ns:
            break
    if ended is None:
        return shown / NANOSECONDS
    # A busy computer must not condemn a machine whose torque ended in time.
    if ended > limit_ns and 2 * (ended - shown) > limit_ns:
        raise ActuatorError(
            "feedback_lost",
            f"no feedback for {1e3 * (ended - shown) / NANOSECONDS:.0f} ms while the duty ended; expected records that "
            f"tell whether it ended within {1e3 * limit:.0f} ms. Nothing is proved. Try again while this computer and "
            "its network have nothing else to do",
        )
    return ended / NANOSECONDS


def _expect_allowed(effort: float, voltage: float, settings: BridgeSettings) -> None:
    """Refuse a torque beyond the effort limit: the firmware's limit does not apply to a duty."""
    if not effort <= settings.limits.effort:
        raise ActuatorError(
            "settings",
            f"duty for proofs makes {effort:.2f} N m at {voltage:.0f} V; expected at most the effort limit, "
            f"{settings.limits.effort:g} N m: this machine cannot be proved under that limit",
        )


def _expect_inside(record: Feedback, settings: BridgeSettings, begin: float) -> None:
    """Refuse to continue outside the bridge's limits, or after too large a rotation."""
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
