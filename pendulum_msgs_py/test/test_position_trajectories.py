"""Trajectories: the thesis's ramp, and what no position controller should be asked to follow."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.contract.trajectory import MAX_RAMP_VELOCITY, RAMP_INCREMENT, RAMP_PERIOD, Trajectory, thesis_ramp
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

_ANGLES = st.floats(-10.0, 10.0)


@given(_ANGLES, _ANGLES)
def test_a_ramp_joins_start_and_goal_in_small_equal_steps_at_100_hz(start: float, goal: float) -> None:
    ramp = thesis_ramp(start, goal)
    positions = [point.position for point in ramp.points]
    assert positions[0] == start
    assert positions[-1] == pytest.approx(goal, abs=1e-12)
    steps = [abs(after - before) for before, after in itertools.pairwise(positions)]
    assert max(steps) <= RAMP_INCREMENT * (1.0 + 1e-6)
    assert ramp.duration == pytest.approx(RAMP_PERIOD * len(steps))
    assert all(abs(point.velocity) <= MAX_RAMP_VELOCITY for point in ramp.points)


def test_the_velocity_of_a_ramp_is_a_half_sine_that_ends_at_rest() -> None:
    ramp = thesis_ramp(0.0, math.pi)
    middle = ramp.points[len(ramp.points) // 2]
    assert middle.velocity == pytest.approx(MAX_RAMP_VELOCITY, rel=1e-3)
    assert ramp.points[0].velocity == 0.0
    assert ramp.points[-1].velocity == pytest.approx(0.0, abs=1e-12)
    assert ramp.at(ramp.duration) == (pytest.approx(math.pi), 0.0)


@given(_ANGLES, _ANGLES, st.floats(-5.0, 100.0))
def test_between_its_points_a_trajectory_stays_between_them(start: float, goal: float, time: float) -> None:
    position, velocity = thesis_ramp(start, goal).at(time)
    assert min(start, goal) - 1e-9 <= position <= max(start, goal) + 1e-9
    assert abs(velocity) <= MAX_RAMP_VELOCITY


def test_before_its_first_point_a_trajectory_rests() -> None:
    trajectory = from_points([1.0, 2.0], [0.5, 1.0], [0.2, 0.3])
    assert trajectory.at(0.0) == (0.5, 0.0)
    assert trajectory.at(1.5) == (0.75, 0.25)


@given(_ANGLES, _ANGLES, st.floats(0.05, 20.0))
def test_a_single_point_is_reached_from_here_without_a_jump(here: float, goal: float, time: float) -> None:
    move = from_points([time], [goal], [0.0]).from_position(here)
    assert move.at(0.0) == (pytest.approx(here, abs=1e-12), 0.0)
    assert move.at(time) == (goal, 0.0)
    assert move.duration == time
    # Velocity is the derivative of position, and nowhere above that of half a cosine.
    peak = 0.5 * math.pi * abs(goal - here) / time
    assert move.max_speed <= peak * (1.0 + 1e-9) + 1e-12
    for before, after in itertools.pairwise(move.points):
        mean = 0.5 * (before.velocity + after.velocity)
        assert mean * (after.time - before.time) == pytest.approx(after.position - before.position, rel=0.25, abs=1e-6)


def test_where_the_start_is_said_a_trajectory_stays_as_it_is_and_else_takes_all_the_time_it_was_given() -> None:
    at_once = from_points([0.0], [1.0], [0.0])
    assert at_once.from_position(0.0) is at_once
    near = from_points([8.0], [0.25], [0.0]).from_position(0.0)
    assert near.at(0.0) == (0.0, 0.0)
    assert near.at(4.0)[0] == pytest.approx(0.125)
    assert near.max_speed < 0.05
    several = from_points([1.0, 2.0], [0.5, 1.0], [0.2, 0.0]).from_position(0.0)
    assert several.at(0.5) == (0.25, 0.1)
    assert len(several.points) == 3


@given(_ANGLES, _ANGLES)
def test_the_largest_speed_is_at_least_that_of_every_interval(start: float, goal: float) -> None:
    ramp = thesis_ramp(start, goal)
    assert ramp.max_speed >= abs(goal - start) / ramp.duration - 1e-9


@pytest.mark.parametrize(
    ("times", "positions", "velocities", "message"),
    [
        ([], [], [], "0 points"),
        ([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], "later than 0.0 s"),
        ([0.0, -1.0], [0.0, 0.0], [0.0, 0.0], "later than 0.0 s"),
        ([-1.0], [0.0], [0.0], "trajectory point 0 is at -1.0 s; expected >= 0 s"),
        ([math.nan], [0.0], [0.0], "expected finite numbers"),
        ([0.0], [math.inf], [0.0], "expected finite numbers"),
        ([0.0], [0.0], [math.nan], "expected finite numbers"),
        ([0.0], [1e300], [0.0], "expected at most 1e+06 rad"),
    ],
)
def test_bad_points_are_refused(
    times: list[float], positions: list[float], velocities: list[float], message: str
) -> None:
    with pytest.raises(ParameterError) as caught:
        from_points(times, positions, velocities)
    assert message in str(caught.value)


def test_a_first_point_is_compared_with_0_alone() -> None:
    with pytest.raises(ParameterError, match=r"is at -1.0 s; expected >= 0 s$"):
        from_points([-1.0], [0.0], [0.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": math.nan}, "ramp goal is nan"),
        ({"goal": 1.0, "increment": 0.0}, "expected both > 0"),
        ({"goal": 1.0, "period": -0.01}, "expected both > 0"),
        ({"goal": 1.0, "max_velocity": -0.3}, "max_velocity is -0.3 rad/s; expected >= 0"),
        ({"goal": 1.0, "max_velocity": math.nan}, "max_velocity is nan"),
        ({"goal": 1e9}, "too long"),
        ({"goal": 1.0, "increment": 1e-300}, "too long"),
    ],
)
def test_a_ramp_that_cannot_be_is_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        thesis_ramp(0.0, **arguments)
    assert message in str(caught.value)


def test_a_ramp_to_where_we_are_is_one_step_at_rest() -> None:
    ramp = thesis_ramp(0.4, 0.4)
    assert isinstance(ramp, Trajectory)
    assert {point.position for point in ramp.points} == {0.4}
    assert ramp.max_speed == 0.0
