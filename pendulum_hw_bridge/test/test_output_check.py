"""The duty of each record against what setpoints and gains ask for, at each limit; constants make the numbers exact."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.port.actuator import Command, Strategy
from pendulum_hw_bridge.port.gains import GainSet, PidGains
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_testing.feedback_records import feedback_record

# R / (N V K_t) is 1/4 per newton metre at 32 V, K_e N / V is 1/32 per rad/s.
DRIVETRAIN = SeriesElasticParameters(
    gear_ratio=4.0, torque_constant=0.5, back_emf_constant=0.25, winding_resistance=16.0, supply_voltage=32.0
)
GAINS = GainSet(3, PidGains(kp=0.5), PidGains(kp=0.25), PidGains(kp=0.25, feed_forward=1.0))
FAST = 0.9 * MOTOR_SPEED_LIMIT / 4.0
"""Speed at the output above which the firmware may take the duty back [rad/s]."""


class Checked:
    """An output check and the records that it is shown."""

    def __init__(self, gains: GainSet = GAINS, effort_limit: float = 100.0, pwm_limit: float = 1.0) -> None:
        mapping = EffortMapping(EffortStrategy.DIRECT_PWM, DRIVETRAIN, gains=gains, effort_limit=effort_limit)
        self.check = OutputCheck(mapping, pwm_limit)

    def see(self, pwm: float, *candidates: Command, strategy: Strategy = Strategy.PARALLEL_PWM, **given: Any) -> str:
        """Show a record; return the name of its fault, or an empty string."""
        record = feedback_record(**{"voltage": 32.0, "pwm_command": pwm, **given})
        fault = self.check.check(record, strategy, candidates or (Command(),))
        return "" if fault is None else fault.name

    def agrees(self, pwm: float, *candidates: Command, **given: Any) -> bool:
        """Whether four records in a row with such a duty, a little different each, are no fault."""
        self.check.reset()
        return not any(self.see(pwm * (1.0 + 1e-9 * number), *candidates, **given) for number in range(4))


# --- torque of the motor ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", [Strategy.DIRECT_PWM, Strategy.PARALLEL_PWM])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_second_record_of_too_much_torque_is_a_fault(strategy: Strategy, sign: float) -> None:
    def see(torque: float, speed: float = 0.0) -> str:
        given = {"motor_velocity": sign * 4.0 * speed}
        return checked.see(sign * 0.25 * torque, Command(), strategy=strategy, **given)

    # One and a tenth of the limit, and half a newton metre: 1.6.
    checked = Checked(effort_limit=1.0)
    checked.check.gains = replace(GAINS, position=PidGains(ki=1.0))
    assert not any(see(1.6) for _ in range(3))
    assert see(1.61) == ""
    assert see(0.0) == ""
    assert [see(1.61), see(1.61), see(1.61)] == ["", "motor_effort", "motor_effort"]
    assert see(0.0) == ""
    # A speed of 8 rad/s takes one newton metre: what drives is the rest.
    assert not any(see(2.599, speed=8.0) for _ in range(3))
    assert [see(2.61, speed=8.0) for _ in range(2)] == ["", "motor_effort"]
    # Driven backwards, only what the duty makes at standstill is the motor's.
    assert not any(see(1.6, speed=-8.0) for _ in range(3))
    assert [see(1.61, speed=-8.0) for _ in range(2)] == ["", "motor_effort"]
    # At standstill it drives with what its duty makes.
    assert [see(0.0), see(1.61), see(1.61)] == ["", "", "motor_effort"]
    # Turned faster than its duty, or with none, it brakes whoever turns it.
    assert not any(see(3.9, speed=20.0) for _ in range(3))
    assert not any(see(0.0, speed=20.0) for _ in range(3))


@pytest.mark.parametrize(
    "given",
    [{"pwm": math.nan}, {"voltage": 0.0}, {"voltage": math.nan}, {"motor_velocity": math.inf}],
    ids=str,
)
def test_the_third_record_of_a_torque_that_is_not_known_is_a_fault(given: dict[str, float]) -> None:
    checked = Checked(effort_limit=1.0)

    def see() -> str:
        return checked.see(**{"pwm": 0.0, "strategy": Strategy.DIRECT_PWM, **given})  # type: ignore[arg-type]

    assert [see(), see(), checked.see(0.0, strategy=Strategy.DIRECT_PWM)] == ["", "", ""]
    assert [see(), see(), see(), see()] == ["", "", "motor_effort", "motor_effort"]
    checked.check.reset()
    assert see() == ""


def test_the_torque_at_a_low_supply_is_known() -> None:
    checked = Checked(effort_limit=1.0)
    assert not any(checked.see(0.5, strategy=Strategy.DIRECT_PWM, voltage=0.5) for _ in range(3))


def test_too_much_torque_is_forgotten_with_the_strategy() -> None:
    checked = Checked(effort_limit=1.0)
    for _ in range(2):
        assert checked.see(0.9, strategy=Strategy.DIRECT_PWM) == ""
        checked.check.reset()


def test_a_lower_supply_makes_less_torque_of_a_duty() -> None:
    checked = Checked(effort_limit=1.0)
    given = {"strategy": Strategy.DIRECT_PWM, "voltage": 16.0}
    assert not any(checked.see(0.8, **given) for _ in range(3))  # type: ignore[arg-type]
    assert [checked.see(0.81, **given) for _ in range(2)] == ["", "motor_effort"]  # type: ignore[arg-type]


# --- loops -----------------------------------------------------------------------------------------------------


def test_under_direct_pwm_no_loop_is_asked() -> None:
    checked = Checked()
    assert not any(checked.see(0.9, strategy=Strategy.DIRECT_PWM) for _ in range(9))
    assert not checked.agrees(0.9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_duty_is_the_sum_of_the_loops_within_a_tolerance(sign: float) -> None:
    checked = Checked()
    # Half of 0.5 rad and a quarter of 0.25 rad/s: 0.3125.
    command = Command(position=sign * 0.75, velocity=sign * 0.5)
    given = {"position": sign * 0.25, "velocity": sign * 0.25}
    for difference in (0.0149, -0.0149):
        assert checked.agrees(sign * (0.3125 + difference), command, **given)
    for difference in (0.0151, -0.0151):
        assert not checked.agrees(sign * (0.3125 + difference), command, **given)
    # Candidates that came just before or after: one that agrees is enough.
    assert checked.agrees(sign * 0.3125, Command(position=9.0), command, Command(), **given)
    # A loop without a setpoint is off.
    assert checked.agrees(sign * 0.25, Command(position=sign * 0.75), **given)
    assert checked.agrees(sign * 0.0625, Command(velocity=sign * 0.5), **given)


def test_a_disagreement_of_exactly_the_tolerance_is_none() -> None:
    assert Checked().agrees(0.0, Command(position=0.03))
    assert Checked(replace(GAINS, position=PidGains(kp=1.0))).agrees(0.0, Command(position=-0.015))


def test_the_third_of_four_records_that_disagree_is_a_fault() -> None:
    checked = Checked()
    right, wrong = (lambda: checked.see(0.0)), (lambda: checked.see(0.5))
    assert [wrong(), right(), wrong(), right(), wrong()] == [""] * 5
    assert [right(), wrong(), wrong()] == ["", "", "output_disagreement"]
    assert [right(), right(), right()] == ["", "", ""]
    checked.check.reset()
    assert [wrong(), wrong()] == ["", ""]
    checked.check.reset()
    assert [wrong(), wrong(), wrong()] == ["", "", "output_disagreement"]


def test_targets_and_outputs_of_a_loop_are_clamped() -> None:
    position = PidGains(kp=0.5, min_target=-1.0, max_target=0.5, min_output=-0.125, max_output=0.25)
    checked = Checked(replace(GAINS, position=position))
    for target, duty in ((0.25, 0.125), (9.0, 0.25), (-0.25, -0.125), (-9.0, -0.125)):
        assert checked.agrees(duty, Command(position=target))
        assert not checked.agrees(duty + 0.02, Command(position=target))
        assert not checked.agrees(duty - 0.02, Command(position=target))
    # A position goes through its error alone, however much of a setpoint is fed forward.
    assert Checked(replace(GAINS, position=PidGains(kp=0.5, feed_forward=0.5))).agrees(0.125, Command(position=0.25))
    position = PidGains(kp=0.5, min_target=-1.0, max_target=0.5)
    checked = Checked(replace(GAINS, position=position))
    assert checked.agrees(0.25, Command(position=9.0))
    assert checked.agrees(-0.5, Command(position=-9.0))
    for limit in (0.25, 0.5):
        checked = Checked(pwm_limit=limit)
        assert checked.agrees(limit, Command(position=9.0))
        assert checked.agrees(-limit, Command(position=-9.0))
        assert not checked.agrees(0.75, Command(position=9.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_velocitys_feed_forward_counts_with_the_nominal_or_the_present_supply(sign: float) -> None:
    gains = replace(GAINS, velocity=PidGains(feed_forward=0.5))
    checked = Checked(gains)
    command = Command(velocity=sign * 16.0)
    # Half of 16 rad/s is a duty of 1/4 at 32 V and 1/2 at 16 V; the tolerance is 0.015 and 15 of 100 of 1/4.
    for duty in (0.25, 0.5, 0.25 - 0.0524, 0.25 + 0.0524, 0.5 - 0.0524, 0.5 + 0.0524):
        assert checked.agrees(sign * duty, command, voltage=16.0)
    for duty in (0.25 - 0.0526, 0.25 + 0.0526, 0.5 - 0.0526, 0.5 + 0.0526, 0.0):
        assert not checked.agrees(sign * duty, command, voltage=16.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_near_its_speed_limit_the_firmware_may_take_the_loops_duty_back(sign: float) -> None:
    checked = Checked()
    command = Command(position=sign * 0.5)
    for turning in (1.0, -1.0):
        fast, slow = {"velocity": turning * 1.001 * FAST}, {"velocity": turning * FAST}
        for duty in (0.125, 0.0, -0.0149, 0.2649):
            assert checked.agrees(sign * duty, command, **fast)
        for duty in (-0.0151, 0.2651):
            assert not checked.agrees(sign * duty, command, **fast)
        assert not checked.agrees(sign * 0.125, command, **slow)


def test_a_duty_that_the_firmware_took_back_is_compared_inclusively() -> None:
    checked = Checked(replace(GAINS, position=PidGains(kp=1.0)))
    fast = {"velocity": 2.0 * FAST}
    tolerance = 0.015
    for wanted in (0.25, -0.25):
        for duty in (min(0.0, wanted) - tolerance, max(0.0, wanted) + tolerance):
            assert checked.check._agrees(feedback_record(pwm_command=duty, **fast), Command(position=wanted), wanted)


@pytest.mark.parametrize("name", ["ki", "kd", "dead_zone", "punch"])
@pytest.mark.parametrize("loop", ["position", "velocity"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_a_loop_with_a_memory_only_the_largest_output_can_be_reported(name: str, loop: str, sign: float) -> None:
    bounds = {"min_output": -0.25, "max_output": 0.25}
    gains = replace(GAINS, position=PidGains(kp=0.5, **bounds), velocity=PidGains(kp=0.25, **bounds))
    gains = replace(gains, **{loop: replace(gains.loop(loop), **{name: 1e-3})})
    checked = Checked(gains)
    for duty in (0.5149, 0.1, 0.0):
        assert checked.agrees(sign * duty)
    assert not checked.agrees(sign * 0.5151)
    assert checked.check._agrees(feedback_record(pwm_command=sign * 0.515), Command(), 0.0)
    # Nor does it tell whether a duty that stands still is stuck.
    checked.check.reset()
    assert not any(checked.see(0.0, Command(position=0.02 * number)) for number in (0, 1, 0, 1, 0))


def test_the_torque_loop_puts_out_no_more_than_its_clamp() -> None:
    gains = replace(GAINS, effort=replace(GAINS.effort, min_output=-0.25, max_output=0.5))
    checked = Checked(gains)
    command = Command(effort=1.0)
    for duty in (0.3, 0.5149, 0.0, -0.2649):
        assert checked.agrees(duty, command)
    for duty in (0.5151, -0.2651):
        assert not checked.agrees(duty, command)
    for duty in (0.515, -0.265):
        assert checked.check._agrees(feedback_record(pwm_command=duty), command, 0.0)


# --- stuck -----------------------------------------------------------------------------------------------------


def test_a_duty_that_stands_still_for_four_records_while_the_setpoint_moves_is_stuck() -> None:
    checked = Checked()

    def see(asked: float, duty: float = 0.25) -> str:
        return checked.see(duty, Command(position=2.0 * (0.25 + asked)))

    move = 2.0**-10
    faults = [see(move * (number % 2)) for number in range(5)]
    assert faults == ["", "", "", "output_disagreement", "output_disagreement"]
    # One that moves at all is not, nor is one that nothing asks to.
    assert see(0.0, 0.2501) == ""
    assert not any(see(4.9e-4 * (number % 2)) for number in range(3))
    assert not any(see(4.9e-4 * (number % 2)) for number in range(9))
    assert see(5.1e-4 + 4.9e-4) == "output_disagreement"
    # What was before another strategy does not count.
    checked.check.reset()
    assert [see(move), see(0.0), see(move)] == ["", "", ""]
    assert see(0.0) == "output_disagreement"


def test_a_setpoint_that_may_be_in_force_a_record_late_shows_no_stuck_output() -> None:
    checked = Checked()
    kept, new = Command(position=0.5), Command(position=0.5 + 2.0**-9)
    # The newest may not have arrived: the duty of the one before explains each record, and no two of three moving ones.
    assert not any(checked.see(0.25, new if number % 2 else kept, kept) for number in range(9))
    moving = [Command(position=0.5 + number * 2.0**-9) for number in range(6)]
    faults = [checked.see(0.25, after, before) for before, after in pairwise(moving)]
    assert faults[-1] == "output_disagreement"


def test_a_setpoint_that_moves_the_duty_by_no_more_than_two_steps_shows_no_stuck_output() -> None:
    checked = Checked(replace(GAINS, position=PidGains(kp=1.0)))
    assert not any(checked.see(0.0, Command(position=5e-4 * (number % 2))) for number in range(9))


def test_a_supply_that_changes_asks_no_duty_to_move() -> None:
    checked = Checked(replace(GAINS, velocity=PidGains(feed_forward=0.5)))
    assert not any(checked.see(0.0157, Command(velocity=1.0), voltage=30.0 + number) for number in range(5))


def test_under_the_torque_loop_a_duty_is_stuck_when_more_than_noise_asks_it_to_move_and_nothing_clamps_it() -> None:
    gains = replace(GAINS, effort=PidGains(kp=0.25, min_output=-0.25, max_output=0.5))

    def faults(duty: float, *measured: float) -> list[str]:
        checked = Checked(gains)
        return [checked.see(duty, Command(effort=0.0), effort=value) for value in measured]

    small, large = (0.0, 0.079, 0.0, 0.079), (0.0, 0.081, 0.0, 0.081)
    for duty in (0.1, 0.4994, -0.2494):
        assert faults(duty, *small) == [""] * 4
        assert faults(duty, *large) == ["", "", "", "output_disagreement"]
    for duty in (0.5, 0.5 - 5e-4, -0.25, -0.25 + 5e-4, 0.51, -0.26):
        assert faults(duty, *large) == [""] * 4


def test_what_the_low_pass_leaves_of_an_output_at_its_clamp_is_no_stuck_duty() -> None:
    # Setpoints that step throw the output from clamp to clamp: three quarters of one and a quarter of the other.
    gains = replace(GAINS, effort=PidGains(kp=0.25, min_output=-0.25, max_output=0.5, output_lowpass=0.75))

    def faults(duty: float) -> list[str]:
        checked = Checked(gains)
        return [checked.see(duty, Command(effort=0.0), effort=0.1 * (number % 2)) for number in range(4)]

    # Once, and after one, two or more cycles back.
    for duty in (0.5, 0.3125, 0.3129, 0.3121, 0.359375, -0.25, -0.0625, -0.109375):
        assert faults(duty) == [""] * 4
    # Every other cycle: four fifths of one and a fifth of the other.
    for duty in (0.35, 0.3504, 0.3496, -0.1):
        assert faults(duty) == [""] * 4
    # Every third, every fourth: a 1/(1 - 4^-3) and a 1/(1 - 4^-4) of what one throw leaves.
    for duty in (-0.0714286, 0.3214286, -0.0647059, 0.3147059):
        assert faults(duty) == [""] * 4
    # Between those nothing excuses a duty that stands still, near the limit as little as near none.
    for duty in (0.47, 0.42, 0.1, -0.0631, -0.0619, -0.22):
        assert faults(duty) == ["", "", "", "output_disagreement"]


@pytest.mark.parametrize("lowpass", [0.1, 0.5, 0.9, 1.0])
def test_however_slow_the_low_pass_a_duty_between_the_clamps_has_no_reason_to_stand_still(lowpass: float) -> None:
    gains = replace(GAINS, effort=PidGains(kp=0.25, min_output=-0.5, max_output=0.5, output_lowpass=lowpass))
    for duty in (0.47, 0.19, -0.22, -0.42):
        checked = Checked(gains)
        found = [checked.see(duty, Command(effort=0.0), effort=0.1 * (number % 2)) for number in range(4)]
        assert found == ["", "", "", "output_disagreement"]


def test_a_step_of_the_duty_beside_what_the_low_pass_leaves_is_excused_and_no_more() -> None:
    gains = replace(GAINS, effort=PidGains(kp=0.25, min_output=-0.5, max_output=0.5, output_lowpass=0.5))

    def fault(duty: float) -> str:
        checked = Checked(gains)
        return [checked.see(duty, Command(effort=0.0), effort=0.1 * (number % 2)) for number in range(4)][-1]

    # Half of either clamp is zero.
    assert [fault(duty) for duty in (5e-4, 5.1e-4)] == ["", "output_disagreement"]


# --- opposed ---------------------------------------------------------------------------------------------------


class Opposed(Checked):
    """A torque loop of which the duty stands still."""

    def __init__(self) -> None:
        super().__init__(replace(GAINS, effort=PidGains(kp=0.25)))

    def at(self, time_ms: float, pwm: float, asked: float) -> str:
        """Show a record with such a duty, of which the torque loop asks for another."""
        return self.see(pwm, Command(effort=0.0), Command(), effort=-4.0 * asked, stamp_ns=round(1e6 * time_ms))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_duty_that_stands_still_against_what_is_asked_for_is_stuck_after_8_ms(sign: float) -> None:
    checked = Opposed()
    # It stands still from the fourth record on.
    for time_ms in (0, 1, 2, 3, 10.999999):
        assert checked.at(time_ms, sign * 0.1, sign * -0.0175) == ""
    assert checked.at(11, sign * 0.1, sign * -0.0175) == "output_disagreement"
    # A record in between that asks for nothing begins anew.
    assert checked.at(12, sign * 0.1, 0.0) == ""
    for time_ms in (13, 20.999999):
        assert checked.at(time_ms, sign * 0.1, sign * -0.0175) == ""
    assert checked.at(21, sign * 0.1, sign * -0.0175) == "output_disagreement"
    # So does another strategy.
    checked.check.reset()
    for time_ms in (22, 23, 24, 25, 32.999999):
        assert checked.at(time_ms, sign * 0.1, sign * -0.0175) == ""
    assert checked.at(33, sign * 0.1, sign * -0.0175) == "output_disagreement"


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("pwm", "asked"), [(0.1, 0.1), (0.1, -0.0149), (0.0149, -0.1), (0.015, -0.1), (0.1, 0.0)])
def test_a_duty_with_what_is_asked_for_or_one_too_small_to_tell_is_not_stuck(
    sign: float, pwm: float, asked: float
) -> None:
    checked = Opposed()
    assert not any(checked.at(5 * number, sign * pwm, sign * asked) for number in range(9))


def test_a_torque_loop_that_was_just_switched_off_is_still_one() -> None:
    checked = Opposed()
    assert not any(checked.at(number, 0.1, 0.019 * (number % 2)) for number in range(9))
    # The same where each candidate moves as the other.
    both = Checked()
    for number in range(9):
        position = 0.2 + 0.01 * (number % 2)
        assert both.see(0.1, Command(position=position), Command(position=position, effort=0.0)) == ""


def test_the_duty_that_is_asked_for_is_reported_at_the_nominal_supply() -> None:
    check = Checked(replace(GAINS, velocity=PidGains(feed_forward=0.5))).check
    records = [feedback_record(voltage=16.0, pwm_command=0.5 + 1e-3 * number) for number in range(3)]
    *_, fault = [check.check(each, Strategy.PARALLEL_PWM, [Command(velocity=1.0)]) for each in records]
    nominal = 0.5 * check.mapping.back_emf_pwm(1.0, 32.0)
    assert fault is not None
    assert f"setpoints and gains ask for {nominal:.4f}" in fault.message
