"""Who begins to command a plant begins near zero torque, and a plant that nobody commands does not stay armed."""

from __future__ import annotations

import math

import pytest

from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

_MS = 1_000_000


class Plant:
    """A plant at 100 Hz that stays where it is."""

    def __init__(self, **limits: float) -> None:
        self.now = 1000 * NANOSECONDS
        self.supervisor = PlantSupervisor(PlantLimits(**{"effort": (13.0,), "start_effort": 2.0, **limits}))
        assert self.supervisor.arm(self.now, self.sample()) == ""

    def sample(self) -> JointSample:
        return JointSample.of_one(self.now, 0.0, 0.0, 0.0)

    def run(
        self, seconds: float, command: float | None = None, source: str = "lqr", disturbance: float | None = None
    ) -> list[Drive]:
        drives = []
        for _ in range(round(100 * seconds)):
            self.now += 10 * _MS
            if command is not None:
                self.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(self.now, command, source), self.now)
            if disturbance is not None:
                self.supervisor.offer(Input.DISTURBANCE, JointCommand.of_one(self.now, disturbance, "d"), self.now)
            drives.append(self.supervisor.decide(self.now, self.sample()))
            self.supervisor.report_applied(drives[-1].effort)
        return drives


def test_the_first_command_after_arming_must_be_near_zero() -> None:
    plant = Plant()
    assert all(drive.effort[0] == 0.0 and drive.starved for drive in plant.run(0.5, 13.0))
    assert "lqr asks for 13.00 N m" in plant.supervisor.reason
    assert "expected at most 2.0 N m to begin" in plant.supervisor.reason
    assert plant.run(0.01, -2.0)[-1].effort[0] == -2.0
    # Once it commands, it may ask for what it likes.
    assert plant.run(0.01, 13.0)[-1].effort[0] == 13.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_just_above_the_limit_does_not_begin(sign: float) -> None:
    assert Plant().run(0.1, sign * 2.01)[-1].effort[0] == 0.0


@pytest.mark.parametrize("command", [0.0, 1.5])
def test_nobody_begins_under_a_disturbance_that_makes_the_sum_too_large(command: float) -> None:
    plant = Plant(start_sum=2.0)
    assert all(drive.effort[0] == 0.0 and drive.starved for drive in plant.run(0.3, command, disturbance=13.0))
    assert f"lqr asks for {command:.2f} N m and the disturbance for 13.00 N m" in plant.supervisor.reason
    # One within the limit is part of what begins, and whoever commands already may be disturbed by any.
    assert plant.run(0.01, command, disturbance=0.5)[-1].effort[0] == command + 0.5
    assert plant.run(0.01, command, disturbance=11.0)[-1].effort[0] == command + 11.0


def test_where_noise_begins_with_the_controller_it_may_have_any_size() -> None:
    assert Plant().run(0.01, 0.0, disturbance=2.5)[-1].effort[0] == 2.5


def test_a_disturbance_against_a_large_command_lets_it_not_begin() -> None:
    assert Plant(start_sum=2.0).run(0.1, 9.0, disturbance=-9.0)[-1].starved


def test_another_commander_begins_near_zero_too() -> None:
    plant = Plant()
    plant.run(0.2, 1.0, "first")
    plant.run(1.1)
    assert plant.run(0.3, 13.0, "second")[-1].effort[0] == 0.0
    assert plant.run(0.01, 1.5, "second")[-1].effort[0] == 1.5


def test_a_commander_that_was_silent_for_long_begins_near_zero_but_a_short_gap_is_none() -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.run(0.1, 9.0)
    plant.run(0.5)
    assert plant.run(0.01, 9.0)[-1].effort[0] == 9.0
    plant.run(1.1)
    assert plant.run(0.3, 9.0)[-1].effort[0] == 0.0


def test_a_controller_that_was_deactivated_and_activated_within_a_second_begins_near_zero() -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.run(0.1, 9.0)
    # Its last words are zero torque; then it is activated where it asks for much, or with another set point.
    plant.run(0.01, 0.0)
    plant.run(0.1)
    assert all(drive.starved and drive.effort[0] == 0.0 for drive in plant.run(0.3, 9.0))
    assert "lqr asks for 9.00 N m; expected at most 2.0 N m to begin" in plant.supervisor.reason
    assert plant.run(0.01, -2.0)[-1].effort[0] == -2.0
    assert plant.run(0.01, 9.0)[-1].effort[0] == 9.0


@pytest.mark.parametrize(
    ("again", "applied"), [(9.0, 9.0), (7.0, 7.0), (11.0, 11.0), (6.9, 0.0), (11.1, 0.0), (-9.0, 0.0)]
)
def test_after_a_short_gap_a_commander_goes_on_from_its_last_torque_alone(again: float, applied: float) -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.run(0.1, 9.0)
    plant.run(0.2)
    assert plant.run(0.01, again)[-1].effort[0] == applied
    # What was refused in the gap is no torque to go on from.
    assert plant.run(0.01, again)[-1].effort[0] == applied


def test_a_controller_at_its_limit_goes_on_after_a_short_gap_whatever_it_asks_for_beyond_the_limit() -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.run(0.1, 100.0)
    plant.run(0.2)
    assert plant.run(0.01, 60.0)[-1].effort[0] == 13.0


def test_a_conflict_of_a_moment_is_a_gap_too() -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.supervisor.set_commander_conflict("2 commanders named /lqr")
    plant.run(0.1, 1.0)
    plant.supervisor.set_commander_conflict("")
    assert plant.run(0.01, 9.0)[-1].effort[0] == 0.0


def test_two_commanders_of_one_name_that_part_begin_near_zero() -> None:
    plant = Plant()
    plant.run(0.1, 1.0)
    plant.supervisor.set_commander_conflict("2 commanders named /lqr")
    assert plant.run(1.2, 9.0)[-1].effort[0] == 0.0
    plant.supervisor.set_commander_conflict("")
    assert plant.run(0.1, 9.0)[-1].effort[0] == 0.0


def test_arming_again_starts_anew() -> None:
    plant = Plant()
    plant.run(0.1, 0.2)
    plant.supervisor.disarm(plant.now)
    assert plant.supervisor.arm(plant.now, plant.sample()) == ""
    assert plant.run(0.1, 9.0)[-1].effort[0] == 0.0


def test_who_took_over_from_position_control_has_begun() -> None:
    plant = Plant(handover_effort=2.0, handover_time=0.1)
    hold = from_points([0.0, 0.1], [0.0, 0.0], [0.0, 0.0])
    assert plant.supervisor.accept_trajectory(hold, plant.now, plant.sample()) == ""
    plant.run(0.3, 1.0)
    assert plant.supervisor.mode is Mode.EFFORT
    assert plant.run(0.3, 9.0)[-1].effort[0] == 9.0


def test_whoever_commanded_before_a_trajectory_begins_anew_after_it() -> None:
    plant = Plant(handover_effort=2.0)
    plant.run(0.1, 1.0)
    assert plant.run(0.1, 9.0)[-1].effort[0] == 9.0
    hold = from_points([0.0, 0.1], [0.0, 0.0], [0.0, 0.0])
    assert plant.supervisor.accept_trajectory(hold, plant.now, plant.sample()) == ""
    plant.run(0.3, 9.0)
    assert plant.supervisor.mode is Mode.POSITION


def test_without_a_limit_anything_may_begin() -> None:
    assert Plant(start_effort=math.inf).run(0.01, 13.0)[-1].effort[0] == 13.0


def test_a_plant_that_nobody_commands_disarms_itself() -> None:
    plant = Plant(starvation=1.0)
    plant.run(0.5, 1.0)
    # The last command counts for 50 ms.
    plant.run(1.05)
    assert plant.supervisor.mode is Mode.EFFORT
    drive = plant.run(0.02)[-1]
    assert plant.supervisor.mode is Mode.DISARMED
    assert drive.kind is DriveKind.OFF
    assert "no command for 1" in plant.supervisor.reason
    assert plant.run(0.2, 1.0)[-1].effort[0] == 0.0


def test_a_plant_that_never_was_commanded_disarms_too_and_commands_that_may_not_begin_do_not_keep_it() -> None:
    plant = Plant(starvation=1.0)
    plant.run(1.1, 13.0)
    assert plant.supervisor.mode is Mode.DISARMED


def test_holding_a_position_is_no_starvation_and_commands_keep_a_plant_armed() -> None:
    plant = Plant(starvation=1.0)
    plant.run(3.0, 1.0)
    hold = from_points([0.0, 0.1], [0.0, 0.0], [0.0, 0.0])
    assert plant.supervisor.accept_trajectory(hold, plant.now, plant.sample()) == ""
    plant.run(3.0)
    assert plant.supervisor.mode is Mode.POSITION


@pytest.mark.parametrize("name", ["start_effort", "start_sum", "starvation"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_limits_that_limit_nothing_or_everything_are_refused(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=f"{name} is"):
        PlantLimits(effort=(5.0,), **{name: value})
