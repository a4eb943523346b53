"""Check that the motor's duty follows from setpoints and gains, and respects the torque limit.

Every record contains the duty. Under strategy 3 it follows from setpoints, gains and measured position and velocity.
The torque loop's derivative acts between records, so only its range and whether it moves can be checked.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping
from pendulum_hw_bridge.drive.fault_table import Fault
from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.port.actuator import Command, Feedback, Strategy
from pendulum_hw_bridge.port.gains import GainSet, PidGains
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["OutputCheck"]

_RECORDS = 4
"""Records of one decision: three wrong ones are a fault, or four with the same duty."""
_WRONG = 3
_TOLERANCE = 0.015
"""Tolerated disagreement of the duty [-]: 0.6 N m of an X5-9 at 36 V."""
_FORWARD_TOLERANCE = 0.15
"""Additional share of the velocity feed-forward: the firmware normalises with a voltage of its own [-]."""
_STILL = 5e-4
"""Change of the expected duty at which a constant duty is stuck; firmware steps are 2.4e-4 [-]."""
_STILL_EFFORT = 0.02
"""The same under the torque loop, where noise of the measured torque moves the expected duty [-]."""
_CYCLES = 4
"""Firmware cycles after which the output low-pass has settled from a clamp [-]."""
_OPPOSED_TIME = 0.008
"""Time for which a constant duty may oppose the expected one [s]."""
_EFFORT_MARGIN = (1.1, 0.5)
"""Motor torque is a fault above this multiple of the limit plus this margin [-, N m]."""
_NEAR_SPEED_LIMIT = 0.9
"""Share of the largest speed above which the firmware may reduce the duty [-]."""


class OutputCheck:
    """Checks the duty of consecutive feedback records; ``pwm_limit`` is the largest duty that is sent [-]."""

    def __init__(self, mapping: EffortMapping, pwm_limit: float = 1.0) -> None:
        self.mapping = mapping
        self.gains: GainSet = mapping.gains
        self._pwm_limit = pwm_limit
        self._wrong: deque[bool] = deque(maxlen=_RECORDS)
        self._duties: deque[tuple[float, list[float]]] = deque(maxlen=_RECORDS)
        self._too_much = 0
        self._opposed_since_ns: int | None = None

    def reset(self) -> None:
        """Forget earlier records after a change of strategy."""
        self._wrong.clear()
        self._duties.clear()
        self._too_much = 0
        self._opposed_since_ns = None

    def check(self, feedback: Feedback, strategy: Strategy, candidates: Sequence[Command]) -> Fault | None:
        """Return the fault that the duty of a record shows, or None; ``candidates`` are ordered by likelihood."""
        return self._check_effort(feedback) or (
            self._check_loops(feedback, candidates) if strategy is Strategy.PARALLEL_PWM else None
        )

    def _check_effort(self, feedback: Feedback) -> Fault | None:
        mapping, pwm, voltage = self.mapping, feedback.pwm_command, feedback.voltage
        velocity = feedback.motor_velocity / mapping.drivetrain.gear_ratio
        if not (math.isfinite(pwm) and voltage > 0.0 and math.isfinite(velocity)):
            self._too_much += 1
            return self._effort_fault("not known") if self._too_much >= _WRONG else None
        still, moving = mapping.motor_effort(pwm, 0.0, voltage), mapping.motor_effort(pwm, velocity, voltage)
        # A back-driven motor brakes whatever the duty: that torque is not the drive's.
        effort = max(min(still, moving), -max(still, moving))
        factor, margin = _EFFORT_MARGIN
        self._too_much = self._too_much + 1 if effort > factor * mapping.effort_limit + margin else 0
        return self._effort_fault(f"{effort:.1f} N m") if self._too_much >= 2 else None

    def _effort_fault(self, seen: str) -> Fault:
        return Fault(
            "motor_effort", f"torque of the motor is {seen}; expected at most {self.mapping.effort_limit:g} N m"
        )

    def _check_loops(self, feedback: Feedback, candidates: Sequence[Command]) -> Fault | None:
        pwm = feedback.pwm_command
        # The firmware may normalise its velocity feed-forward with nominal or present voltage.
        voltages = (self.mapping.drivetrain.supply_voltage, feedback.voltage)
        wanted = [(c, self._expected(c, feedback, voltage)) for c in candidates for voltage in voltages]
        self._wrong.append(not any(self._agrees(feedback, command, duty) for command, duty in wanted))
        _, likeliest = wanted[0]
        self._duties.append((pwm, [duty for _, duty in wanted[:: len(voltages)]]))
        text = f"duty is {pwm:.4f}; setpoints and gains ask for {likeliest:.4f}"
        if sum(self._wrong) >= _WRONG:
            return Fault("output_disagreement", f"{text}: stuck, runaway, other gains or another strategy?")
        duties, asked = [duty for duty, _ in self._duties], [duty for _, duty in self._duties]
        still = len(duties) == _RECORDS and min(duties) == max(duties)
        threshold = _STILL
        # Any candidate: a record may still show the torque loop that the newest setpoints switched off.
        if any(math.isfinite(candidate.effort) for candidate in candidates):
            loop = self.gains.effort
            threshold = math.inf if _clamped(loop, pwm) else _STILL_EFFORT
        if self._opposes(feedback, likeliest, still):
            return Fault("output_disagreement", f"{text}, the other way, and has not moved: is it stuck?")
        if still and _memoryless(self.gains) and _moves(asked, threshold):
            return Fault("output_disagreement", f"{text}, but it has not moved for {_RECORDS} records: is it stuck?")
        return None

    def _opposes(self, feedback: Feedback, wanted: float, still: bool) -> bool:
        """Return whether a constant duty has opposed the expected one for too long."""
        opposed = (
            still and feedback.pwm_command * wanted < 0.0 and min(abs(feedback.pwm_command), abs(wanted)) > _TOLERANCE
        )
        if not opposed:
            self._opposed_since_ns = None
        elif self._opposed_since_ns is None:
            self._opposed_since_ns = feedback.stamp_ns
        since = self._opposed_since_ns
        return since is not None and feedback.stamp_ns - since >= _OPPOSED_TIME * NANOSECONDS

    def _agrees(self, feedback: Feedback, command: Command, wanted: float) -> bool:
        gains, pwm = self.gains, feedback.pwm_command
        if math.isfinite(command.effort):
            loop = gains.effort
            return loop.min_output - _TOLERANCE <= pwm <= loop.max_output + _TOLERANCE
        forward = 0.0 if math.isnan(command.velocity) else gains.velocity.feed_forward * command.velocity
        nominal = self.mapping.drivetrain.supply_voltage
        tolerance = _TOLERANCE + _FORWARD_TOLERANCE * abs(self.mapping.back_emf_pwm(forward, nominal))
        if abs(pwm - wanted) <= tolerance:
            return True
        if abs(feedback.velocity) > _NEAR_SPEED_LIMIT * MOTOR_SPEED_LIMIT / self.mapping.drivetrain.gear_ratio:
            return min(0.0, wanted) - tolerance <= pwm <= max(0.0, wanted) + tolerance
        # The effect of an integral, a derivative or a dead zone between two records is unknown.
        largest = gains.position.max_output + gains.velocity.max_output + tolerance
        return not _memoryless(gains) and abs(pwm) <= largest

    def _expected(self, command: Command, feedback: Feedback, voltage: float) -> float:
        gains, mapping = self.gains, self.mapping
        # The firmware's torque normalisation assumes an unknown efficiency; the clamp is what counts here.
        torque_forward, speed_forward = mapping.pwm_per_torque(), mapping.back_emf_pwm(1.0, voltage)
        duty = _output(gains.position, command.position, feedback.position, 0.0)
        duty += _output(gains.velocity, command.velocity, feedback.velocity, speed_forward)
        duty += _output(gains.effort, command.effort, feedback.effort, torque_forward)
        return min(self._pwm_limit, max(-self._pwm_limit, duty))


def _output(gains: PidGains, target: float, measured: float, normaliser: float) -> float:
    if math.isnan(target):
        return 0.0
    target = min(gains.max_target, max(gains.min_target, target))
    output = gains.kp * (target - measured) + gains.feed_forward * target * normaliser
    return min(gains.max_output, max(gains.min_output, output))


def _clamped(gains: PidGains, duty: float) -> bool:
    """Return whether a duty is at a clamp, or a value that the low-pass leaves between two clamps.

    A setpoint step throws the derivative to the other clamp for a cycle and back. Records at one phase of that repeat
    one duty, for single steps and for steps every few cycles. Any other constant duty between the clamps is stuck.
    """
    new, old = gains.output_lowpass, 1.0 - gains.output_lowpass
    shares = [new * old**cycle for cycle in range(_CYCLES)]
    # With steps every few cycles, the remainders of earlier ones add up.
    shares += [new * old**cycle / (1.0 - old**every) for every in range(2, _CYCLES + 1) for cycle in range(every)]
    low, high = gains.min_output, gains.max_output
    left = [each for share in shares for each in (high - share * (high - low), low + share * (high - low))]
    return not low + _STILL < duty < high - _STILL or any(abs(duty - each) <= _STILL for each in left)


def _moves(asked: Sequence[Sequence[float]], threshold: float) -> bool:
    """Return whether the expected duty moved by more than a threshold, whichever candidate each record shows.

    On a busy machine a setpoint may be in force a record earlier or later than likely.
    """
    lowest = (low for record in asked for low in record)
    return not any(all(any(low <= duty <= low + threshold for duty in record) for record in asked) for low in lowest)


def _memoryless(gains: GainSet) -> bool:
    return all(loop.ki == loop.kd == loop.dead_zone == loop.punch == 0.0 for loop in (gains.position, gains.velocity))
