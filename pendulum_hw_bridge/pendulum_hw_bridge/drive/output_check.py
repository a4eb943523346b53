"""Whether the duty on the motor is the one that setpoints and gains ask for, and no more than the limit allows.

The firmware reports its duty with every record. Under direct PWM it is what was sent. Under strategy 3 it follows from
setpoints, gains and the same record's position and velocity; of the torque loop, whose derivative acts between two
records, only the largest output and whether it moves at all can be told.
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
"""Records that are looked at together; a fault shows in three of them, or in all four stands still."""
_WRONG = 3
_TOLERANCE = 0.015
"""Disagreement of a duty that is none [-]: 0.6 N m of an X5-9 at 36 V."""
_FORWARD_TOLERANCE = 0.15
"""The same as a share of the velocity's feed-forward, which the firmware normalises with a voltage of its own [-]."""
_STILL = 5e-4
"""Change of what is asked for at which a duty that does not change at all is stuck; its steps are 2.4e-4 [-]."""
_STILL_EFFORT = 0.02
"""The same under the torque loop: noise of the measured torque moves what is asked for [-]."""
_CYCLES = 4
"""Cycles of the firmware after which a low-pass has forgotten that the output was thrown against a clamp [-]."""
_OPPOSED_TIME = 0.008
"""Time for which a duty that stands still may be the opposite of what is asked for [s]."""
_EFFORT_MARGIN = (1.1, 0.5)
"""A motor's torque is too much above this multiple of the limit and so much more [-, N m]."""
_NEAR_SPEED_LIMIT = 0.9
"""Share of the largest speed above which the firmware may take the duty back [-]."""


class OutputCheck:
    """Checks the duty of feedback records in their order.

    Args:
        mapping: Torque to duty, with the effort limit and the nominal voltage.
        pwm_limit: Largest duty that is sent [-].
    """

    def __init__(self, mapping: EffortMapping, pwm_limit: float = 1.0) -> None:
        self.mapping = mapping
        self.gains: GainSet = mapping.gains
        self._pwm_limit = pwm_limit
        self._wrong: deque[bool] = deque(maxlen=_RECORDS)
        self._duties: deque[tuple[float, float]] = deque(maxlen=_RECORDS)
        self._too_much = 0
        self._opposed_since_ns: int | None = None

    def reset(self) -> None:
        """Forget earlier records: another strategy begins, or none."""
        self._wrong.clear()
        self._duties.clear()
        self._too_much = 0
        self._opposed_since_ns = None

    def check(self, feedback: Feedback, strategy: Strategy, candidates: Sequence[Command]) -> Fault | None:
        """Return the fault that the duty of a record shows, or None.

        Args:
            feedback: The record.
            strategy: Strategy that was set, not off.
            candidates: Setpoints that may be in force, the likeliest first.
        """
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
        # A motor that is turned against its will brakes, whatever the duty: that torque is the turner's.
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
        # The firmware may normalise its feed-forward of velocity with the nominal voltage or with the present one.
        voltages = (self.mapping.drivetrain.supply_voltage, feedback.voltage)
        wanted = [(c, self._expected(c, feedback, voltage)) for c in candidates for voltage in voltages]
        self._wrong.append(not any(self._agrees(feedback, command, duty) for command, duty in wanted))
        _, likeliest = wanted[0]
        self._duties.append((pwm, likeliest))
        text = f"duty is {pwm:.4f}; setpoints and gains ask for {likeliest:.4f}"
        if sum(self._wrong) >= _WRONG:
            return Fault("output_disagreement", f"{text}: stuck, runaway, other gains or another strategy?")
        duties, asked = [duty for duty, _ in self._duties], [duty for _, duty in self._duties]
        still = len(duties) == _RECORDS and min(duties) == max(duties)
        threshold = _STILL
        # Of any: a record may still show the torque loop that the newest setpoints switched off.
        if any(math.isfinite(candidate.effort) for candidate in candidates):
            loop = self.gains.effort
            threshold = math.inf if _clamped(loop, pwm) else _STILL_EFFORT
        if self._opposes(feedback, likeliest, still):
            return Fault("output_disagreement", f"{text}, the other way, and has not moved: is it stuck?")
        if still and _memoryless(self.gains) and max(asked) - min(asked) > threshold:
            return Fault("output_disagreement", f"{text}, but it has not moved for {_RECORDS} records: is it stuck?")
        return None

    def _opposes(self, feedback: Feedback, wanted: float, still: bool) -> bool:
        """Whether a duty that stands still has been the opposite of what is asked for, for too long."""
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
        # What an integral, a derivative or a dead zone does between two records cannot be told from one of them.
        largest = gains.position.max_output + gains.velocity.max_output + tolerance
        return not _memoryless(gains) and abs(pwm) <= largest

    def _expected(self, command: Command, feedback: Feedback, voltage: float) -> float:
        gains, mapping = self.gains, self.mapping
        # The firmware's normalisation of a torque assumes an efficiency of its own; the clamp is what counts here.
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
    """Whether a duty stands at a clamp, or is what the low-pass leaves where the output goes from clamp to clamp.

    A setpoint that steps throws the derivative against the other clamp for a cycle, and back: records of one phase of
    that read one duty each time, whether it happens once in long or every few cycles. Any other duty between the
    clamps has no reason to stand still.
    """
    new, old = gains.output_lowpass, 1.0 - gains.output_lowpass
    shares = [new * old**cycle for cycle in range(_CYCLES)]
    # Every few cycles: what is left of the throw before adds up.
    shares += [new * old**cycle / (1.0 - old**every) for every in range(2, _CYCLES + 1) for cycle in range(every)]
    low, high = gains.min_output, gains.max_output
    left = [each for share in shares for each in (high - share * (high - low), low + share * (high - low))]
    return not low + _STILL < duty < high - _STILL or any(abs(duty - each) <= _STILL for each in left)


def _memoryless(gains: GainSet) -> bool:
    return all(loop.ki == loop.kd == loop.dead_zone == loop.punch == 0.0 for loop in (gains.position, gains.velocity))
