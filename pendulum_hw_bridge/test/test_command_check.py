"""What goes to an actuator is checked before: nothing infinite, nothing of another strategy, nothing beyond a limit."""

from __future__ import annotations

import math

import pytest

from pendulum_hw_bridge.port.actuator import MAX_COMMAND_LIFETIME, Command, HardwareLimits, Strategy
from pendulum_hw_bridge.port.command_check import check_command, check_lifetime
from pendulum_msgs_py.errors import ParameterError

LIMITS = HardwareLimits(effort=2.0, velocity=1.5, position_min=-3.0, position_max=4.0, pwm=0.5)
SETPOINTS = ("position", "velocity", "effort", "pwm")
UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m", "pwm": "of the supply"}


def strategy_of(name: str) -> Strategy:
    return Strategy.DIRECT_PWM if name == "pwm" else Strategy.PARALLEL_PWM


@pytest.mark.parametrize("lifetime", [1e-6, 0.05, MAX_COMMAND_LIFETIME])
def test_a_lifetime_that_ends_is_taken(lifetime: float) -> None:
    assert check_lifetime(lifetime) == lifetime


@pytest.mark.parametrize("lifetime", [0.0, -0.05, 1.0001 * MAX_COMMAND_LIFETIME, math.inf, -math.inf, math.nan])
def test_a_lifetime_that_never_ends_is_refused(lifetime: float) -> None:
    with pytest.raises(ParameterError, match=r"command_lifetime is .*; expected > 0 and <= .* keep the last command"):
        check_lifetime(lifetime)


@pytest.mark.parametrize("name", SETPOINTS)
@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_an_infinite_setpoint_is_refused_and_not_limited(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=f"{name} setpoint is -?inf {UNITS[name]}; expected a finite number"):
        check_command(Command(**{name: value}), strategy_of(name), LIMITS)


@pytest.mark.parametrize("strategy", [each for each in Strategy if each is not Strategy.DIRECT_PWM])
def test_a_duty_is_refused_where_loops_make_it(strategy: Strategy) -> None:
    with pytest.raises(ParameterError, match=f"pwm setpoint under strategy {strategy.name}; expected one under DIRECT"):
        check_command(Command(pwm=0.0), strategy, LIMITS)


@pytest.mark.parametrize("name", ["position", "velocity", "effort"])
def test_a_setpoint_of_a_loop_is_refused_where_there_is_none(name: str) -> None:
    with pytest.raises(ParameterError, match="effort setpoint under DIRECT_PWM; expected pwm only"):
        check_command(Command(**{name: 0.0}), Strategy.DIRECT_PWM, LIMITS)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("position", -3.0, 4.0), ("velocity", -1.5, 1.5), ("effort", -2.0, 2.0), ("pwm", -0.5, 0.5)],
)
def test_a_setpoint_goes_to_its_limit_and_no_further_and_says_so(name: str, low: float, high: float) -> None:
    def sent(value: float) -> tuple[float, bool]:
        limited, changed = check_command(Command(**{name: value}), strategy_of(name), LIMITS)
        others = [getattr(limited, other) for other in SETPOINTS if other != name]
        assert all(math.isnan(other) for other in others), "a loop that was off is on"
        return getattr(limited, name), changed

    assert sent(low - 1e-9) == (low, True)
    assert sent(high + 1e-9) == (high, True)
    assert sent(-1e300) == (low, True)
    assert sent(1e300) == (high, True)
    for inside in (low, 0.0, high):
        assert sent(inside) == (inside, False)
    value, changed = sent(math.nan)
    assert math.isnan(value)
    assert not changed
