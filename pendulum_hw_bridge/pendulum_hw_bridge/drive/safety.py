"""Checks of each feedback record that only an actuator needs, each with a named fault.

The supervisor has the rules common to all plants (position window, velocity, age of the measurement, commands).
"""

from __future__ import annotations

import math
from collections import deque

from pendulum_hw_bridge.drive.fault_table import FAULTS, Fault
from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.drive.safety_limits import SafetyLimits
from pendulum_hw_bridge.port.actuator import (
    Command,
    CommandLock,
    Feedback,
    LimitState,
    Strategy,
    TemperatureState,
    state_name,
)
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.dynamics.series_elastic import winding_current, winding_resistance_at
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["FAULTS", "Fault", "SafetyLimits", "SafetyMonitor"]

_COUNT = 3
_MOTION_TIME = 0.2
"""Time over which position and velocity are compared: even a slow ramp exceeds the tolerance in it [s]."""
_GAP = 1.6
"""Longest interval, in periods, without a missing record: each may be 0.3 periods early or late [-]."""
_CURRENT_TIME = 0.5
"""Time within which wrong winding currents are counted together [s]."""
_WAY = 1e-3
"""Longest usual transport time of a command [s]."""
_CURRENT_SHARE = 0.2
"""Tolerance of the winding current in addition to the absolute one, as a share of the expected one [-]."""
_WRONG_COMMANDS = 2
"""Records with a wrong setpoint that make a fault: on a cable, single packets get lost, two in a row do not [-]."""
_WRONG_COMMAND_TIME = 0.008
"""Time for which a wrong setpoint must be in force to be a fault [s]."""
_ROUNDING = 1e-5
"""Difference between a setpoint and its single-precision copy in a record [rad, rad/s, N m]."""
_CLAMPED_SHARE = 0.9
"""Share of the largest speed above which the firmware may reduce the duty [-]."""
_SENSED = ("position", "velocity", "effort", "motor_position", "motor_velocity", "deflection", "winding_current")
"""Quantities of which noise changes at least one from record to record."""
_VOLTAGE_CHANGE = 0.15
"""Allowed relative deviation of the supply voltage from its moving average [-]."""
_VOLTAGE_WEIGHT = 0.02
"""Weight of a record in that average [-]: half a second at 100 Hz."""


class SafetyMonitor:
    """Checks consecutive records of nominal ``period`` [s]; without ``drivetrain`` the winding current is unchecked."""

    def __init__(
        self,
        limits: SafetyLimits,
        period: float,
        drivetrain: SeriesElasticParameters | None = None,
        joint: Joint = ONE_JOINT.joints[0],
    ) -> None:
        self.limits = limits
        self.joint = joint
        self.period = period
        self.drivetrain = drivetrain
        self._last: Feedback | None = None
        self._last_new_ns: int | None = None
        self._motion: deque[tuple[float, float]] = deque(maxlen=round(_MOTION_TIME / period) + 1)
        self._sent: deque[tuple[int, int, Command]] = deque(maxlen=16)
        self._travelled = 0.0
        self._strategy = Strategy.OFF
        self._strategy_since_ns = 0
        self._wrong_commands = 0
        self._wrong_since_ns = 0
        self._wrong_currents = 0
        self._wrong_current_ns = 0
        self._unknown_temperatures = 0
        self._clock_offset_ns: int | None = None
        self._measured_ns = 0
        self._clamped_speed, self._unseen_speed = math.inf, 0.0
        if drivetrain is not None:
            self._unseen_speed = MOTOR_SPEED_LIMIT / drivetrain.gear_ratio
            self._clamped_speed = _CLAMPED_SHARE * self._unseen_speed
        self._repeated = 0
        self._still = 0
        self._voltage: float | None = None
        self._wrong_voltages = 0
        self.output: OutputCheck | None = None
        self.present: Fault | None = None

    @property
    def timeout(self) -> float:
        """Age at which feedback counts as lost [s]."""
        return self.limits.feedback_cycles * self.period

    def note_sent(self, command: Command, strategy: Strategy, sent_ns: int) -> None:
        """Record what was sent, to compare it with the setpoints in force."""
        if strategy is not self._strategy:
            self._sent.clear()
            self._strategy = strategy
            self._strategy_since_ns = sent_ns
            if self.output is not None:
                self.output.reset()
        self._sent.append((sent_ns, sent_ns, command))

    def left(self, left_ns: int) -> None:
        """Record the time at which sending the newest setpoints had finished [ns]."""
        if self._sent:
            sent_ns, _, command = self._sent.pop()
            self._sent.append((sent_ns, left_ns, command))

    def stopped(self) -> None:
        """Record that commanding has ended."""
        self._strategy = Strategy.OFF
        self._wrong_currents = 0

    def is_new(self, feedback: Feedback) -> bool:
        """Return whether a record is new, and record the time of the last new one."""
        last = self._last
        fresh = last is None or (feedback.sequence != last.sequence and feedback.hardware_ns != last.hardware_ns)
        self._repeated = 0 if fresh else self._repeated + 1
        if fresh:
            self._last_new_ns = feedback.stamp_ns
        return fresh

    def age(self, now_ns: int) -> float:
        """Return the age of the newest record, infinite before the first [s]."""
        return math.inf if self._last_new_ns is None else (now_ns - self._last_new_ns) / NANOSECONDS

    def silence(self, now_ns: int) -> Fault | None:
        """Return the fault of missing feedback, or None; ``now_ns`` is host time [ns]."""
        if self._last_new_ns is None:
            return None
        age = self.age(now_ns)
        if age > self.timeout and self._repeated:
            return Fault(
                "feedback_frozen",
                f"the same record has come {self._repeated} times in {age * 1e3:.0f} ms; expected a new one within "
                f"{self.timeout * 1e3:.0f} ms",
            )
        if age > self.timeout:
            return Fault(
                "feedback_lost",
                f"no new feedback for {age * 1e3:.0f} ms; expected one within {self.timeout * 1e3:.0f} ms",
            )
        return None

    def check(self, feedback: Feedback) -> Fault | None:
        """Return the first fault of a new record, or None; also stored in ``present``."""
        fault = (
            self._check_values(feedback)
            or self._check_continuity(feedback)
            or self._check_frozen(feedback)
            or self._check_state(feedback)
            or self._check_voltage(feedback)
            or self._check_motion(feedback)
            or self._check_command(feedback)
            or self._check_output(feedback)
            or self._check_current(feedback)
        )
        self._last = feedback
        self.present = fault
        return fault

    def _check_values(self, feedback: Feedback) -> Fault | None:
        own = self.joint
        for name, unit in (("position", own.unit), ("velocity", own.velocity_unit), ("effort", own.effort_unit)):
            value = getattr(feedback, name)
            if not math.isfinite(value):
                return Fault("feedback_not_finite", f"{name} reads {value} {unit}; expected a finite number")
        return None

    def _check_continuity(self, feedback: Feedback) -> Fault | None:
        last = self._last
        offset = feedback.stamp_ns - feedback.hardware_ns
        self._measured_ns = feedback.stamp_ns
        if last is not None and feedback.hardware_ns < last.hardware_ns:
            self._clock_offset_ns = None
            return Fault(
                "module_restarted",
                f"module's clock went back by {(last.hardware_ns - feedback.hardware_ns) / NANOSECONDS:.3f} s",
            )
        if feedback.hardware_ns > 0:
            # The smallest offset so far is that of the fastest transport; any excess is waiting time.
            if self._clock_offset_ns is None or offset < self._clock_offset_ns:
                self._clock_offset_ns = offset
            late = (offset - self._clock_offset_ns) / NANOSECONDS
            # Compare with the commands that had arrived by then: a busy host reads records late.
            self._measured_ns = feedback.hardware_ns + self._clock_offset_ns
            # Two crystals drift apart by some 50 ppm: let the reference follow slowly.
            self._clock_offset_ns += round(1e-4 * self.period * NANOSECONDS)
            if late > self.timeout:
                return Fault(
                    "feedback_late",
                    f"feedback is {late * 1e3:.0f} ms late; expected at most {self.timeout * 1e3:.0f} ms",
                )
        return None

    def _check_frozen(self, feedback: Feedback) -> Fault | None:
        last = self._last
        same = last is not None and all(getattr(feedback, name) == getattr(last, name) for name in _SENSED)
        self._still = self._still + 1 if same else 0
        if self._still < self.limits.feedback_cycles:
            return None
        return Fault(
            "feedback_frozen",
            f"{self._still + 1} records in a row measure the same to the last digit; expected them to differ, by "
            "noise at least",
        )

    def _check_state(self, feedback: Feedback) -> Fault | None:
        limits = self.limits
        if feedback.m_stop:
            return Fault("m_stop", "motion stop is pressed; release it, then disarm and arm again")
        if feedback.temperature_state != TemperatureState.NORMAL:
            state = state_name(TemperatureState, feedback.temperature_state)
            return Fault("over_temperature", f"firmware reports temperature state {state}; expected NORMAL")
        if feedback.winding_temperature > limits.winding_temperature:
            return Fault(
                "over_temperature",
                f"winding is at {feedback.winding_temperature:.0f} degC; "
                f"expected at most {limits.winding_temperature:.0f} degC",
            )
        # NaN compares false with its limit and causes no derating.
        known = math.isfinite(feedback.winding_temperature)
        self._unknown_temperatures = 0 if known else self._unknown_temperatures + 1
        if self._unknown_temperatures >= _COUNT:
            return Fault(
                "over_temperature",
                f"winding temperature reads {feedback.winding_temperature} degC in {_COUNT} records; expected a number",
            )
        if feedback.lock == CommandLock.LOCKED_BY_OTHER:
            return Fault("locked_by_other", "another sender holds the module; close Scope or other programs")
        if not limits.voltage_min <= feedback.voltage <= limits.voltage_max:
            return Fault(
                "voltage",
                f"supply is {feedback.voltage:.1f} V; expected {limits.voltage_min:g} to {limits.voltage_max:g} V",
            )
        for name in ("position_limit", "velocity_limit", "effort_limit"):
            if getattr(feedback, name) in {LimitState.BELOW, LimitState.ABOVE}:
                state = state_name(LimitState, getattr(feedback, name))
                return Fault("firmware_limit", f"firmware's {name} reads {state}; expected INSIDE")
        if abs(feedback.effort) > limits.measured_effort:
            return Fault(
                "effort_measured",
                f"measured {'torque' if self.joint.unit == 'rad' else 'force'} is {feedback.effort:.2f} "
                f"{self.joint.effort_unit}; expected at most {limits.measured_effort:g} {self.joint.effort_unit}",
            )
        return None

    def _check_voltage(self, feedback: Feedback) -> Fault | None:
        """Compare the supply voltage with its average: the mapping of torque to duty depends on it."""
        usual = feedback.voltage if self._voltage is None else self._voltage
        self._voltage = usual + _VOLTAGE_WEIGHT * (feedback.voltage - usual)
        wrong = abs(feedback.voltage - usual) > _VOLTAGE_CHANGE * usual
        self._wrong_voltages = self._wrong_voltages + 1 if wrong else 0
        if self._wrong_voltages < 2:
            return None
        return Fault(
            "voltage", f"supply is {feedback.voltage:.1f} V, a moment ago it was {usual:.1f} V; is the cable loose?"
        )

    def _check_motion(self, feedback: Feedback) -> Fault | None:
        last = self._last
        elapsed = math.inf if last is None else (feedback.hardware_ns - last.hardware_ns) / NANOSECONDS
        expected = math.nan if last is None else 0.5 * (feedback.velocity + last.velocity) * elapsed
        if last is None or not (elapsed < 2.0 * self.timeout and math.isfinite(expected + last.position)):
            # The motion in between is unknown: restart the comparison.
            self._motion.clear()
            expected = 0.0
        else:
            jump, allowed = feedback.position - last.position - expected, self.limits.position_jump
            if elapsed > _GAP * self.period:
                # Records are missing, so the velocity in between is unknown.
                allowed += self._unseen_speed * (elapsed - self.period)
                expected += jump
            if abs(jump) > allowed:
                return Fault(
                    "position_jump",
                    f"position jumped by {jump:.3f} {self.joint.unit} in {elapsed * 1e3:.0f} ms; "
                    f"expected at most {allowed:.3g} {self.joint.unit} in addition to the velocity",
                )
        self._travelled += expected
        self._motion.append((self._travelled, feedback.position))
        travelled = self._travelled - self._motion[0][0]
        moved = feedback.position - self._motion[0][1]
        if abs(travelled - moved) > self.limits.position_disagreement:
            unit = self.joint.unit
            return Fault(
                "motion_disagreement",
                f"velocity says {travelled:.4f} {unit}, position {moved:.4f} {unit} in {_MOTION_TIME:g} s; "
                f"expected them within {self.limits.position_disagreement:g} {unit}",
            )
        return None

    def _check_command(self, feedback: Feedback) -> Fault | None:
        settled = self._measured_ns - self._strategy_since_ns > self.timeout * NANOSECONDS
        if self._strategy is Strategy.OFF or not settled:
            self._wrong_commands = 0
            return None
        recent = self._in_force(self._measured_ns)
        if self._strategy is Strategy.DIRECT_PWM:
            acts, candidates, name = feedback.pwm_command, [_or_zero(command.pwm) for command in recent], "PWM"
        elif math.isfinite(recent[-1].position):
            acts, candidates, name = feedback.position_command, [c.position for c in recent], "position"
        else:
            acts, candidates, name = feedback.effort_command, [c.effort for c in recent], "effort"
        direct = self._strategy is Strategy.DIRECT_PWM
        tolerance = self.limits.pwm_tolerance if direct else self.limits.command_tolerance
        good = any(_same(acts, candidate, tolerance) for candidate in candidates)
        if not good and direct and abs(feedback.velocity) > self._clamped_speed:
            # Near its speed limit the firmware reduces the duty; it never increases or reverses it.
            good = any(min(0.0, candidate) <= acts <= max(0.0, candidate) for candidate in candidates)
        if good:
            self._wrong_commands = 0
            return None
        if self._wrong_commands == 0:
            self._wrong_since_ns = self._measured_ns
        self._wrong_commands += 1
        lasts = (self._measured_ns - self._wrong_since_ns) / NANOSECONDS
        if self._wrong_commands >= _WRONG_COMMANDS and lasts >= _WRONG_COMMAND_TIME:
            return Fault(
                "command_not_in_force",
                f"module acts on {name} {acts:.4f}, sent was {candidates[-1]:.4f}; "
                "is the strategy another, or does the command not arrive?",
            )
        return None

    def _check_output(self, feedback: Feedback) -> Fault | None:
        if self.output is None or self._strategy is Strategy.OFF:
            return None
        if self._measured_ns - self._strategy_since_ns <= round(self.period * NANOSECONDS):
            return None
        # On a busy machine a setpoint may act later than expected: the record reports which of those sent acts.
        acting = [command for _, _, command in self._sent if _is_reported(command, feedback)]
        return self.output.check(feedback, self._strategy, self._in_force(self._measured_ns) + acting)

    def _in_force(self, measured_ns: int) -> list[Command]:
        """Return the commands that a record may show: the newest that had arrived, and those under way."""
        window = round((1.2 * self.period + _WAY) * NANOSECONDS)
        arrived = [command for _, left, command in self._sent if left <= measured_ns - round(_WAY * NANOSECONDS)]
        recent = [command for sent, left, command in self._sent if sent <= measured_ns <= left + window]
        return (arrived[-1:] + recent) or [self._sent[-1][2]]

    def _check_current(self, feedback: Feedback) -> Fault | None:
        drive, tolerance = self.drivetrain, self.limits.winding_current
        if drive is None or tolerance <= 0.0 or not math.isfinite(feedback.pwm_command):
            return None
        resistance = winding_resistance_at(
            feedback.winding_temperature, drive.winding_resistance, drive.resistance_temperature_coefficient
        )
        expected = winding_current(
            feedback.pwm_command,
            feedback.motor_velocity / drive.gear_ratio,
            feedback.voltage,
            drive.back_emf_constant,
            drive.gear_ratio,
            resistance,
        )
        wrong = not abs(feedback.winding_current - expected) <= tolerance + _CURRENT_SHARE * abs(expected)
        # Too small a current to distinguish from none: the record neither confirms nor clears a fault.
        tells = abs(expected) > tolerance / (1.0 - _CURRENT_SHARE)
        lapsed = feedback.stamp_ns - self._wrong_current_ns > _CURRENT_TIME * NANOSECONDS
        if wrong and (lapsed or not self._wrong_currents):
            self._wrong_currents, self._wrong_current_ns = 0, feedback.stamp_ns
        if wrong or tells:
            self._wrong_currents = self._wrong_currents + 1 if wrong else 0
        if wrong and self._wrong_currents >= _COUNT:
            return Fault(
                "winding_current",
                f"winding current is {feedback.winding_current:.3f} A; PWM {feedback.pwm_command:.3f} and velocity "
                f"ask for {expected:.3f} A",
            )
        return None


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def _is_reported(command: Command, feedback: Feedback) -> bool:
    """Return whether a record reports all three setpoints of a command as those in force."""
    return (
        _same(feedback.position_command, command.position, _ROUNDING)
        and _same(feedback.velocity_command, command.velocity, _ROUNDING)
        and _same(feedback.effort_command, command.effort, _ROUNDING)
    )


def _same(acts: float, sent: float, tolerance: float) -> bool:
    """Return whether a loop acts on the setpoint sent; a loop that is off may report NaN or 0."""
    if math.isnan(sent):
        return math.isnan(acts) or acts == 0.0
    return abs(acts - sent) <= tolerance
