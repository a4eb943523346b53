"""A safety monitor and the feedback records that it is shown, for the tests of its checks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pendulum_hw_bridge.drive.fault_table import FAULTS
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.port.actuator import Command, Strategy
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_testing.feedback_records import feedback_record

__all__ = ["DRIVETRAIN", "LIMITS", "MILLISECOND", "PERIOD", "STEP", "TIMEOUT", "Watched"]

PERIOD = 2.0**-6
"""Feedback period of which every multiple is exact, in seconds as in nanoseconds [s]."""
STEP = 15_625_000
TIMEOUT = 3 * STEP
MILLISECOND = 1_000_000
LIMITS = SafetyLimits(
    winding_current=0.0, position_disagreement=10.0, pwm_tolerance=2.0**-10, command_tolerance=2.0**-9
)
DRIVETRAIN = SeriesElasticParameters(
    gear_ratio=2.0,
    torque_constant=1.0,
    back_emf_constant=0.5,
    winding_resistance=4.0,
    resistance_temperature_coefficient=0.0,
)


class Watched:
    """A monitor and the records that it is shown, each a period after the one before and a little different."""

    def __init__(self, drivetrain: SeriesElasticParameters | None = None, **limits: Any) -> None:
        self.monitor = SafetyMonitor(replace(LIMITS, **limits), PERIOD, drivetrain)
        self.now_ns = 1_000_000_000
        self.count = 0

    def see(self, after_ns: int = STEP, **given: Any) -> str:
        """Show one more record; return the name of its fault, or an empty string."""
        self.now_ns += after_ns
        self.count += 1
        fault = self.monitor.check(feedback_record(self.now_ns, self.count, **{"effort": 1e-9 * self.count, **given}))
        assert self.monitor.present is fault
        assert fault is None or fault.name in FAULTS
        return "" if fault is None else fault.name

    def tell(self, strategy: Strategy = Strategy.DIRECT_PWM, **setpoints: float) -> None:
        """Tell what is sent at the time of the newest record."""
        self.monitor.note_sent(Command(**setpoints), strategy, self.now_ns)
