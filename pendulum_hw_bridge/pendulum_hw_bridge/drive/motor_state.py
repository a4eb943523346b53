"""Conservative estimates of supply voltage and motor speed, which decide the torque of a duty.

Single records can be wrong, and too low a voltage or too high a speed would increase the duty. So the voltage is the
maximum over some records, and the change of the motor's angle bounds the speed.
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
"""Speed at which the firmware reduces the duty, before the gears [rad/s]. Source: HEBI, X-series, 25 000 rpm."""
_VOLTAGE_RECORDS = 5
_SPAN_NS = 10_000_000
"""Shortest time over which the motor's angle is differentiated [ns]."""
_LONGEST_SPAN_NS = 10 * _SPAN_NS
_ANGLE_STEP = math.pi / 3.0
"""Resolution of the motor's angle, before the gears [rad]: six commutations per turn."""
_SLACK = 0.25
"""Allowed change of motor speed within the span, at the output, in addition to the angle's resolution [rad/s]."""


class MotorState(NamedTuple):
    """Supply voltage and motor speed at the output.

    Attributes:
        voltage: Supply voltage, upper estimate [V].
        velocity: Motor speed [rad/s].
        lowest: Lowest speed of any sensor, at most 0 [rad/s].
        highest: Highest speed that all sensors confirm, at least 0 [rad/s].
    """

    voltage: float
    velocity: float = 0.0
    lowest: float = 0.0
    highest: float = 0.0


class MotorWatch:
    """Estimates voltage and speed from consecutive records; voltages [V] outside the window are clipped to it."""

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
