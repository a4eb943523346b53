"""Faults of the emulated actuator, as on real drives, cables and networks."""

from __future__ import annotations

import math
from enum import Enum
from typing import Any

from pendulum_hw_bridge.port.actuator import Feedback, LimitState, TemperatureState

__all__ = ["ActuatorFault", "distort"]


class ActuatorFault(str, Enum):
    """A fault of actuator, sensor or connection, described by ``meaning``."""

    meaning: str

    def __new__(cls, value: str, meaning: str = "") -> ActuatorFault:
        """Use the name as value."""
        fault = str.__new__(cls, value)
        fault._value_ = value
        fault.meaning = meaning
        return fault

    FEEDBACK_LOST = "feedback_lost", "the network cable is pulled on the way back"
    FEEDBACK_FROZEN = "feedback_frozen", "the module repeats its last record"
    FEEDBACK_SLOW = "feedback_slow", "every tenth record arrives"
    FEEDBACK_LATE = "feedback_late", "a queue holds each record back by 80 ms"
    POSITION_NAN = "position_nan", "the position reads NaN"
    VELOCITY_NAN = "velocity_nan", "the velocity reads NaN"
    EFFORT_NAN = "effort_nan", "the effort reads NaN"
    POSITION_FROZEN = "position_frozen", "the output encoder is stuck while the motor turns"
    POSITION_JUMP = "position_jump", "the output encoder slips by 0.5 rad"
    VELOCITY_SPIKE = "velocity_spike", "the velocity reads 5 rad/s"
    EFFORT_OFFSET = "effort_offset", "the spring encoder slips: the effort reads 15 N m too much"
    PWM_STUCK = "pwm_stuck", "the duty stays where it is, whatever the setpoint, until the strategy goes off"
    PWM_RUNAWAY = "pwm_runaway", "the duty goes to its end, until the strategy goes off"
    WINDING_OPEN = "winding_open", "a motor phase breaks: PWM, but no current"
    COMMANDS_LOST = "commands_lost", "the network cable is pulled on the way there"
    LOCKED_BY_OTHER = "locked_by_other", "another sender, such as Scope, holds the module"
    STRATEGY_CHANGED = "strategy_changed", "the module runs another strategy than confirmed"
    GAINS_LOST = "gains_lost", "the module forgets its gains, and its loops output nothing"
    MODULE_REBOOT = "module_reboot", "the module restarts: strategy off, clock from zero"
    M_STOP = "m_stop", "the motion-stop button is pressed"
    OVER_TEMPERATURE_MOTOR = "over_temperature_motor", "the firmware says that the motor is too hot"
    OVER_TEMPERATURE_BOARD = "over_temperature_board", "the firmware says that the board is too hot"
    TEMPERATURE_CRITICAL = "temperature_critical", "the firmware says that a temperature is critical"
    WINDING_HOT = "winding_hot", "the winding estimate reads 150 degC"
    VOLTAGE_LOW = "voltage_low", "the supply sags to 18 V"
    VOLTAGE_HIGH = "voltage_high", "the supply rises to 52 V"
    POSITION_LIMIT = "position_limit", "the firmware's own position limit acts"
    VELOCITY_LIMIT = "velocity_limit", "the firmware's own velocity limit acts"
    EFFORT_LIMIT = "effort_limit", "the firmware's own effort limit acts"
    OVERSPEED = "overspeed", "the link is turned faster than the bridge allows"
    OUTSIDE_WINDOW = "outside_window", "the position reads outside the window"
    SEND_FAILED = "send_failed", "the network interface refuses to send"


def distort(feedback: Feedback, faults: set[ActuatorFault], frozen: Feedback | None) -> Feedback:
    """Return a record as faulty sensors would give it; ``frozen`` is the record at the start of a freeze."""
    changes: dict[str, Any] = {}
    fault = ActuatorFault
    if fault.POSITION_NAN in faults:
        changes["position"] = math.nan
    if fault.VELOCITY_NAN in faults:
        changes["velocity"] = math.nan
    if fault.EFFORT_NAN in faults:
        changes["effort"] = math.nan
    if fault.POSITION_FROZEN in faults and frozen is not None:
        changes["position"] = frozen.position
    if fault.POSITION_JUMP in faults:
        changes["position"] = feedback.position + 0.5
    if fault.OUTSIDE_WINDOW in faults:
        changes["position"] = feedback.position + 20.0
    if fault.VELOCITY_SPIKE in faults:
        changes["velocity"] = 5.0
    if fault.OVERSPEED in faults:
        changes["velocity"] = 1.55
        changes["velocity_limit"] = LimitState.INSIDE
    if fault.EFFORT_OFFSET in faults:
        changes["effort"] = feedback.effort + 15.0
    if fault.WINDING_HOT in faults:
        changes["winding_temperature"] = 150.0
    if fault.TEMPERATURE_CRITICAL in faults:
        changes["temperature_state"] = TemperatureState.CRITICAL
    if fault.OVER_TEMPERATURE_MOTOR in faults:
        changes["temperature_state"] = TemperatureState.EXCEED_MAX_MOTOR
    if fault.OVER_TEMPERATURE_BOARD in faults:
        changes["temperature_state"] = TemperatureState.EXCEED_MAX_BOARD
    if fault.POSITION_LIMIT in faults:
        changes["position_limit"] = LimitState.ABOVE
    if fault.VELOCITY_LIMIT in faults:
        changes["velocity_limit"] = LimitState.ABOVE
    if fault.EFFORT_LIMIT in faults:
        changes["effort_limit"] = LimitState.ABOVE
    return feedback._replace(**changes) if changes else feedback
