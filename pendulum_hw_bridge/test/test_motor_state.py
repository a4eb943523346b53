"""Supply and motor speed as far as they are believed: each bound at its value, with numbers that are exact."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT, MotorState, MotorWatch
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_testing.feedback_records import feedback_record

GEAR = 64.0
STEP = 15_625_000
"""2^-6 s, longer than the span over which an angle tells a speed [ns]."""
ELAPSED = 2.0**-6
SLACK = math.pi / 3.0 / GEAR / ELAPSED + 0.25
"""How far the speed that the angle tells may be off: a commutation's step over the span, and a change in it [rad/s]."""
FASTEST = MOTOR_SPEED_LIMIT / GEAR


class Moving:
    """A motor watch and records of a motor and a link that turn."""

    def __init__(self) -> None:
        self.watch = MotorWatch(SeriesElasticParameters(gear_ratio=GEAR), 22.0, 50.0)
        self.now_ns = 1_000_000_000
        self.motor = self.link = 0.0

    def see(self, after_ns: int = STEP, **given: Any) -> MotorState:
        """Show one more record, of the angles as they are; speeds and angles at the output [rad, rad/s]."""
        self.now_ns += after_ns
        fields = {"motor_position": GEAR * self.motor, "position": self.link, **given}
        fields["motor_velocity"] = GEAR * fields.get("motor_velocity", 0.0)
        return self.watch.update(feedback_record(self.now_ns, **fields))

    def turn(self, motor: float, link: float, told: float, velocity: float) -> MotorState:
        """Turn motor and link for one step at speeds that their angles tell, and tell others."""
        self.motor += motor * ELAPSED
        self.link += link * ELAPSED
        return self.see(motor_velocity=told, velocity=velocity)


def test_the_voltage_is_the_highest_of_five_records_within_its_window() -> None:
    moving = Moving()
    assert moving.watch.state == MotorState(50.0, 0.0, 0.0, 0.0)
    assert moving.see(voltage=math.nan).voltage == 50.0
    assert moving.see(voltage=5.0).voltage == 22.0
    assert moving.see(voltage=40.0).voltage == 40.0
    for voltage in (36.0, math.nan, 30.0, 30.0, 30.0):
        assert moving.see(voltage=voltage).voltage == 40.0
    assert moving.see(voltage=30.0).voltage == 36.0
    assert moving.see(voltage=1e9).voltage == 50.0
    assert moving.watch.state.voltage == 50.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_speed_reported_is_believed_as_far_as_the_angle_bears_it_out(sign: float) -> None:
    for told, believed in ((1.0, 1.0), (2.25, 2.25), (2.0 + 1.5 * SLACK, 2.0 + SLACK), (-9.0, 2.0 - SLACK)):
        moving = Moving()
        assert moving.see().velocity == 0.0
        assert moving.turn(sign * 2.0, 0.0, sign * told, 0.0).velocity == pytest.approx(sign * believed)


def test_no_speed_beyond_the_motors_largest_is_believed() -> None:
    for sign in (1.0, -1.0):
        moving = Moving()
        moving.see()
        state = moving.turn(*4 * [sign * 2.0 * FASTEST])
        assert state.velocity == sign * FASTEST
        assert (state.lowest, state.highest) == ((0.0, FASTEST) if sign > 0.0 else (-FASTEST, 0.0))


@pytest.mark.parametrize(
    ("speeds", "lowest", "highest"),
    [
        ((2.0, 3.0, 4.0, 5.0), 0.0, 2.0),
        ((5.0, 2.0, 3.0, 4.0), 0.0, 2.0),
        ((4.0, 5.0, 2.0, 3.0), 0.0, 2.0),
        ((3.0, 4.0, 5.0, 2.0), 0.0, 2.0),
        ((-2.0, -3.0, -4.0, -5.0), -2.0, 0.0),
        ((-3.0, -4.0, -5.0, -2.0), -2.0, 0.0),
        ((2.0, 3.0, 4.0, -1.0), 0.0, 0.0),
        ((-2.0, -3.0, -4.0, 1.0), 0.0, 0.0),
    ],
)
def test_the_range_of_speeds_is_what_no_sensor_contradicts(
    speeds: tuple[float, float, float, float], lowest: float, highest: float
) -> None:
    moving = Moving()
    moving.motor, moving.link = 3.0, 5.0
    moving.see()
    state = moving.turn(*speeds)
    assert (state.lowest, state.highest) == (lowest, highest)


@pytest.mark.parametrize("name", ["motor_position", "position", "motor_velocity", "velocity"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_sensor_that_tells_no_number_leaves_no_speed_for_that_record(name: str, value: float) -> None:
    moving = Moving()
    moving.see()
    moving.motor = moving.link = 2.0 * ELAPSED
    assert moving.see(**{"motor_velocity": 2.0, "velocity": 2.0, name: value})[1:] == (0.0, 0.0, 0.0)
    # It is no reference for the next record either.
    moving.motor = moving.link = 4.0 * ELAPSED
    assert moving.see(motor_velocity=2.0, velocity=2.0)[1:] == pytest.approx((2.0, 0.0, 2.0))


def test_a_speed_needs_a_reference_of_at_most_a_tenth_of_a_second_and_of_this_clock() -> None:
    for pause_ns, speed in ((100_000_000, 2.0), (100_000_001, 0.0), (1, 2.0), (0, 0.0)):
        moving = Moving()
        moving.see()
        moving.motor = moving.link = 2.0 * pause_ns * 1e-9
        state = moving.see(pause_ns, motor_velocity=2.0, velocity=2.0)
        assert state.velocity == pytest.approx(speed)
        assert state.highest == pytest.approx(speed)
    # A clock that goes back is a new one.
    moving.see(-STEP)
    moving.motor = moving.link = moving.motor + 2.0 * ELAPSED
    assert moving.see(motor_velocity=2.0, velocity=2.0).velocity == pytest.approx(2.0)


def test_a_clock_that_goes_back_has_no_speed_at_first() -> None:
    moving = Moving()
    for _ in range(3):
        moving.see()
    assert moving.see(-STEP // 2, motor_velocity=2.0)[1:] == (0.0, 0.0, 0.0)


def test_the_reference_is_the_newest_that_is_old_enough() -> None:
    # Records of 5 ms: the angle of two ago is 10 ms old.
    moving = Moving()
    for _ in range(4):
        moving.see(5_000_000)
    moving.motor = 0.02
    told = moving.see(5_000_000, motor_velocity=100.0).velocity
    assert told == pytest.approx(0.02 / 0.01 + math.pi / 3.0 / GEAR / 0.01 + 0.25)
    # One more of the same time has the same reference.
    assert moving.see(0, motor_velocity=100.0).velocity == pytest.approx(told)
    # Of 9.999999 ms: it takes two of them.
    moving = Moving()
    for _ in range(4):
        moving.see(9_999_999)
    moving.motor = 0.02
    told = moving.see(9_999_999, motor_velocity=100.0).velocity
    assert told == pytest.approx((0.02 + math.pi / 3.0 / GEAR) / 0.019999998 + 0.25)
