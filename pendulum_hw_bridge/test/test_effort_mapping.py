"""Torque to setpoint and back, with constants of which each result is exact: every factor, sign and limit shows."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.port.actuator import Command, Strategy, no_torque
from pendulum_hw_bridge.port.gains import GainSet, PidGains
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

DRIVETRAIN = SeriesElasticParameters(
    gear_ratio=4.0, torque_constant=0.5, back_emf_constant=0.25, winding_resistance=16.0, supply_voltage=32.0
)
GAINS = GainSet(3, PidGains(kp=2.0), PidGains(kp=0.25, feed_forward=0.5), PidGains(kp=0.25))
PWM, COMPENSATED, LOOP = EffortStrategy
NAN = math.nan


def mapping(kind: EffortStrategy = PWM, gains: GainSet = GAINS, effort_limit: float = 2.0) -> EffortMapping:
    """R / (eta N V K_t) is 1/4 per newton metre at 32 V, K_e N / V is 1/32 per rad/s."""
    return EffortMapping(kind, DRIVETRAIN, 1.0, 0.5, gains, effort_limit, velocity_limit=1.5)


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("efficiency", (0.0, -0.1, 1.01, NAN), (0.01, 1.0)),
        ("compensation", (-0.01, 1.01, NAN), (0.0, 1.0)),
        ("effort_limit", (0.0, -1.0, math.inf, NAN), (1e-3,)),
    ],
)
def test_constants_that_would_make_the_torque_meaningless_are_refused(
    name: str, refused: tuple[float, ...], taken: tuple[float, ...]
) -> None:
    for value in refused:
        with pytest.raises(ParameterError, match="expected"):
            replace(mapping(), **{name: value})
    for value in taken:
        assert getattr(replace(mapping(), **{name: value}), name) == value


def test_the_duty_of_a_torque_and_of_a_speed_follow_from_the_constants_and_the_supply() -> None:
    assert mapping().pwm_per_torque() == 0.25
    assert mapping().pwm_per_torque(16.0) == 0.5
    assert replace(mapping(), efficiency=0.5).pwm_per_torque() == 0.5
    assert mapping().back_emf_pwm(8.0, 16.0) == 0.5
    # A duty of 1/2 less 1/4 for the speed is 1/4: one newton metre.
    assert mapping().motor_effort(0.5, 8.0, 32.0) == 1.0


def test_each_way_to_make_a_torque_has_its_strategy_and_setpoint() -> None:
    motor = MotorState(16.0, velocity=8.0)
    assert [mapping(kind).strategy for kind in (PWM, COMPENSATED, LOOP)] == [
        Strategy.DIRECT_PWM,
        Strategy.DIRECT_PWM,
        Strategy.PARALLEL_PWM,
    ]
    assert mapping(PWM).command(1.0, motor).pwm == 0.5
    # Half of the back-EMF of 8 rad/s, a duty of 1/2 at 16 V.
    assert mapping(COMPENSATED).command(1.0, motor).pwm == 0.75
    command = mapping(LOOP).command(1.0, motor)
    assert command.effort == 1.0
    assert math.isnan(command.pwm)


@pytest.mark.parametrize("speed", [8.0, -8.0])
def test_a_motor_makes_the_limit_and_what_it_brakes_with_at_most(speed: float) -> None:
    # 8 rad/s take a duty of 1/4 at 32 V, which makes 1 N m at standstill.
    for kind in (PWM, COMPENSATED, LOOP):
        limited = replace(mapping(kind), effort_limit=2.5)
        assert limited.largest_effort(speed) == 3.5
        assert limited.largest_effort(0.0) == 2.5


def test_the_torque_that_setpoints_stand_for_is_the_way_back() -> None:
    motor = MotorState(16.0, velocity=8.0)
    for kind in (PWM, COMPENSATED, LOOP):
        for effort in (1.0, -0.25):
            assert mapping(kind).effort_of(mapping(kind).command(effort, motor), motor, 0.7) == effort
        assert mapping(kind).effort_of(no_torque(mapping(kind).strategy), motor, 0.7) == 0.0
    # Under position control the duty in force tells.
    assert mapping().effort_of(Command(position=1.0), motor, 0.5) == 1.0
    # The effort that brings this duty back: its own, with no speed compensated twice at a hand-over or a stop.
    assert mapping(COMPENSATED).effort_of(Command(position=1.0), motor, 0.75) == 1.0
    assert mapping().effort_of(Command(position=1.0), motor, NAN) == 0.0
    assert mapping().effort_of(Command(velocity=1.0), motor, 0.5) == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_is_sent_stays_inside_the_effort_limit(sign: float) -> None:
    def bounded(kind: EffortStrategy, motor: MotorState, **setpoint: float) -> float:
        command = mapping(kind, effort_limit=1.0).bounded(Command(**setpoint), motor)
        sent = {name: getattr(command, name) for name in setpoint}
        assert math.isnan(command.effort) == ("effort" not in setpoint)
        return sign * next(iter(sent.values()))

    still, turning = MotorState(32.0), MotorState(32.0, 0.0, lowest=-4.0, highest=8.0)
    assert bounded(LOOP, still, effort=sign * 9.0) == 1.0
    assert bounded(LOOP, still, effort=sign * 0.5) == 0.5
    assert bounded(PWM, still, pwm=sign * 0.9) == 0.25
    # Direct PWM has no more duty for a motor that turns; one whose back-EMF is compensated has what the speed takes.
    assert bounded(PWM, turning, pwm=sign * 0.9) == 0.25
    assert bounded(COMPENSATED, turning, pwm=sign * 0.9) == (0.5 if sign > 0.0 else 0.375)
    assert bounded(COMPENSATED, MotorState(8.0, 0.0, -4.0, 8.0), pwm=sign * 3.0) == 1.0
    # The velocity loop makes 3/10 of the limit, a duty of 0.075, at 0.075 / (0.25 + 0.5 / 32) rad/s.
    room = 0.3 * 0.25 / (0.25 + 0.5 / 32.0)
    assert bounded(LOOP, still, velocity=sign * 5.0) == pytest.approx(room)
    assert bounded(LOOP, still, velocity=sign * 0.01) == 0.01
    assert mapping(LOOP).bounded(Command(velocity=sign * 5.0), still).velocity == pytest.approx(sign * 2.0 * room)
    assert bounded(LOOP, turning, velocity=sign * 50.0) == pytest.approx(room + (8.0 if sign > 0.0 else 4.0))


def test_the_room_for_a_start_counts_with_the_lower_of_present_and_nominal_supply() -> None:
    for voltage, forward, duty in ((16.0, 0.5 / 16.0, 0.5), (64.0, 0.5 / 32.0, 0.125)):
        command = mapping(LOOP, effort_limit=1.0).bounded(Command(velocity=9.0), MotorState(voltage))
        assert command.velocity == pytest.approx(0.3 * duty / (0.25 + forward))


def test_a_velocity_loop_that_makes_no_duty_needs_no_bound_and_has_none() -> None:
    gains = replace(GAINS, velocity=PidGains())
    assert mapping(LOOP, gains).bounded(Command(velocity=9.0), MotorState(32.0)).velocity == 9.0


def test_the_firmwares_loops_put_out_no_more_than_the_limit_together() -> None:
    gains = mapping(LOOP).limited_gains(32.0)
    # Two newton metres are a duty of 1/2, of which 7 of 10 are the position loop's.
    assert gains.position.max_output == -gains.position.min_output == pytest.approx(0.35)
    # 3 of 10 are the velocity loop's, and what 1.5 rad/s take.
    assert gains.velocity.max_output == -gains.velocity.min_output == pytest.approx(0.15 + 1.5 / 32.0)
    assert gains.effort.max_output == -gains.effort.min_output == 0.5


def test_the_dither_moves_the_duty_by_two_steps_and_needs_a_position_loop() -> None:
    assert mapping().dither == pytest.approx(2.25e-4)
    assert mapping(gains=replace(GAINS, position=PidGains())).dither == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_weak_position_loop_has_its_dither_and_its_hand_over_too(sign: float) -> None:
    weak = mapping(gains=replace(GAINS, position=PidGains(kp=0.5)))
    assert weak.dither == pytest.approx(9e-4)
    assert weak.handover(sign * 0.5, sign * 0.25, 0.0, MotorState(16.0)) == (sign * 0.5, 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_hand_over_begins_at_the_torque_and_the_duty_in_force(sign: float) -> None:
    motor = MotorState(16.0)
    # One newton metre is a duty of 1/2 at 16 V; the rest, 1/8, is the velocity loop's, which feeds 1/64 forward.
    offset, speed = mapping().handover(sign * 1.0, sign * 0.625, sign * 2.0, motor)
    assert offset == sign * 0.25
    assert speed == pytest.approx(sign * (0.125 + 0.25 * 2.0) / (0.25 + 0.5 / 32.0))
    # The position loop has 7 of 10 of the limit, which is a duty of 1.
    offset, speed = mapping().handover(sign * 9.0, sign * 0.7, 0.0, motor)
    assert offset == pytest.approx(sign * 0.35)
    assert speed == pytest.approx(0.0)


def test_without_loops_or_a_duty_there_is_nothing_to_hand_over() -> None:
    motor = MotorState(16.0)
    assert mapping().handover(1.0, NAN, 2.0, motor) == (0.0, 0.0)
    assert mapping(gains=replace(GAINS, position=PidGains())).handover(1.0, 0.5, 2.0, motor) == (0.0, 0.0)
    assert mapping(gains=replace(GAINS, velocity=PidGains())).handover(1.0, 0.625, 2.0, motor) == (0.25, 0.0)
