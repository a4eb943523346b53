"""The setpoints of no torque: one definition, under every strategy of the firmware."""

import math

import numpy as np
import pytest

from pendulum_hw_bridge.emulation.firmware import control_pwm, gain_rows, new_loop_memory
from pendulum_hw_bridge.port.actuator import Command, Strategy, no_torque
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS

LOOPS = [Strategy.TORQUE_CASCADE, Strategy.PARALLEL_PWM, Strategy.MIXED]


def is_empty(command: Command) -> bool:
    return all(map(math.isnan, (command.position, command.velocity, command.effort, command.pwm)))


def test_no_torque_is_a_duty_of_zero_under_direct_pwm_and_no_setpoint_under_any_other_strategy() -> None:
    direct = no_torque(Strategy.DIRECT_PWM)
    assert direct.pwm == 0.0
    assert is_empty(Command(pwm=math.nan, position=direct.position, velocity=direct.velocity, effort=direct.effort))
    for strategy in (Strategy.OFF, *LOOPS):
        assert is_empty(no_torque(strategy))


def test_where_the_strategy_is_uncertain_no_torque_is_no_setpoint() -> None:
    for strategy in (Strategy.OFF, *LOOPS):
        assert is_empty(no_torque(Strategy.DIRECT_PWM, strategy))
    assert is_empty(no_torque())
    assert no_torque(Strategy.DIRECT_PWM, Strategy.DIRECT_PWM).pwm == 0.0


def duty(strategy: Strategy, command: Command, *, running: bool) -> float:
    """Return the duty that the firmware makes of setpoints at 0.9 rad, 0.2 rad/s and 1.3 N m."""
    rows, memory = gain_rows(DEFAULT_GAINS[int(strategy)]), new_loop_memory()
    pwm = 0.0
    for setpoints in ([(1.0, 0.3, 1.3)] if running else []) + [
        (command.position, command.velocity, command.effort_field)
    ]:
        pwm = control_pwm(int(strategy), rows, memory, np.array(setpoints), 0.9, 0.2, 1.3, 0.025, 0.33, 1e-3)
    return pwm


@pytest.mark.parametrize("running", [True, False])
@pytest.mark.parametrize("strategy", [Strategy.DIRECT_PWM, *LOOPS])
def test_the_firmware_makes_no_duty_of_no_torque_while_an_effort_of_zero_drives(
    strategy: Strategy, running: bool
) -> None:
    assert duty(strategy, no_torque(strategy), running=running) == 0.0
    assert duty(strategy, no_torque(strategy, Strategy.DIRECT_PWM), running=running) == 0.0
    if strategy is not Strategy.DIRECT_PWM:
        assert abs(duty(strategy, Command(effort=0.0), running=running)) > 0.1


def test_the_effort_field_carries_the_duty_or_the_effort() -> None:
    assert Command(pwm=0.25).effort_field == 0.25
    assert Command(effort=2.0).effort_field == 2.0
    assert math.isnan(Command(position=1.0).effort_field)
