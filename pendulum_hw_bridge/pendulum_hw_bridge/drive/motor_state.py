"""What may be believed of supply voltage and motor speed, which decide the torque that a duty makes.

A record can be wrong for once. A voltage that reads too low would ask for too much duty, a speed that reads too high
for too much compensation; so the voltage is the highest of some records, and the speed is bounded by what the motor's
angle says.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from pendulum_hw_bridge.port.actuator import Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["MOTOR_SPEED_LIMIT", "MotorState", "MotorWatch"]

MOTOR_SPEED_LIMIT = 25_000.0 * 2.0 * math.pi / 60.0
"""Speed at which the firmware takes the drive back, before the gears [rad/s]. Source: HEBI, X-series, 25 000 rpm."""
_VOLTAGE_RECORDS = 5
_SPAN_NS = 10_000_000
"""Time over which the motor's angle tells a speed, at least [ns]."""
_LONGEST_SPAN_NS = 10 * _SPAN_NS
_ANGLE_STEP = math.pi / 3.0
"""Step of the motor's angle, before the gears [rad]: six commutations a turn."""
_SLACK = 0.25
"""Change of the motor's speed, at the output, within the span, beside the step of the angle [rad/s]."""


class MotorState(NamedTuple):
    """Supply and motor speed, as far as they may be believed.

    Attributes:
        voltage: Supply voltage, rather too high than too low [V].
        velocity: Motor speed at the output side of the gears [rad/s].
        lowest: The lowest speed that any of the sensors tells, at most 0 [rad/s].
        highest: The highest speed that all of them bear out, at least 0 [rad/s].
    """

    voltage: float
    velocity: float = 0.0
    lowest: float = 0.0
    highest: float = 0.0


class MotorWatch:
    """Judges voltage and speed of feedback records in their order.

    Args:
        drivetrain: Constants of motor and gears.
        voltage_min: Lowest supply voltage that is believed [V].
        voltage_max: Highest; also what is assumed before the first record [V].
    """

    def __init__(self, drivetrain: SeriesElasticParameters, voltage_min: float, voltage_max: float) -> None:
        self._gear_ratio = drivetrain.gear_ratio
        self._window = (voltage_min, voltage_max)
        self._fastest = MOTOR_SPEED_LIMIT / drivetrain.gear_ratio
        self._voltages: deque[float] = deque(maxlen=_VOLTAGE_RECORDS)
        self._angles: deque[tuple[int, float, float]] = deque()
        self.state = MotorState(voltage_max)

    def update(self, feedback: Feedback) -> MotorState:
        """Return the state after one more record."""
        low, high = self._window
        if math.isfinite(feedback.voltage):
            self._voltages.append(min(high, max(low, feedback.voltage)))
        self.state = MotorState(max(self._voltages, default=high), *self._speeds(feedback))
        return self.state

    def _speeds(self, feedback: Feedback) -> tuple[float, float, float]:
        """Return the speed to compensate, and the range that no sensor contradicts."""
        now, motor, link = feedback.hardware_ns, feedback.motor_position / self._gear_ratio, feedback.position
        if self._angles and now < self._angles[-1][0]:
            self._angles.clear()
        while len(self._angles) > 1 and self._angles[1][0] <= now - _SPAN_NS:
            self._angles.popleft()
        before = self._angles[0] if self._angles else None
        if math.isfinite(motor) and math.isfinite(link):
            self._angles.append((now, motor, link))
        if before is None or not 0 < now - before[0] <= _LONGEST_SPAN_NS:
            return 0.0, 0.0, 0.0
        elapsed = (now - before[0]) / NANOSECONDS
        reported = feedback.motor_velocity / self._gear_ratio
        turned = (motor - before[1]) / elapsed
        speeds = [reported, turned, feedback.velocity, (link - before[2]) / elapsed]
        if not all(map(math.isfinite, speeds)):
            return 0.0, 0.0, 0.0
        slack = _ANGLE_STEP / self._gear_ratio / elapsed + _SLACK
        believed = min(turned + slack, max(turned - slack, reported))
        believed = min(self._fastest, max(-self._fastest, believed))
        return believed, max(min(0.0, max(speeds)), -self._fastest), min(max(0.0, min(speeds)), self._fastest)
