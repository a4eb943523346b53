"""A stop of category 0 cuts the torque; one of category 1 lets it fade within the stated time, and a fault cuts it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.contract.supervisor import DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

_PERIOD_NS = NANOSECONDS // 100
_STOPS: dict[str, Callable[[PlantSupervisor, int], None]] = {
    "e-stop": lambda supervisor, now_ns: supervisor.e_stop(now_ns),
    "disarmed": lambda supervisor, now_ns: supervisor.disarm(now_ns),
}


class Plant:
    """A plant at 100 Hz that stays where it is, commanded with 8 N m."""

    def __init__(self, stop_time: float) -> None:
        self.now_ns = 1000 * NANOSECONDS
        self.supervisor = PlantSupervisor(PlantLimits(effort=(13.0,), stop_time=stop_time, feedback_timeout=0.1))
        self.measured = True
        self.sample = self._measure()
        assert self.supervisor.arm(self.now_ns, self.sample) == ""

    def _measure(self) -> JointSample:
        return JointSample.of_one(self.now_ns, 0.0, 0.0, 0.0)

    def period(self, command: float | None = 8.0) -> tuple[DriveKind, float]:
        self.now_ns += _PERIOD_NS
        if self.measured:
            self.sample = self._measure()
        if command is not None:
            self.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(self.now_ns, command, "lqr"), self.now_ns)
            self.supervisor.offer(Input.DISTURBANCE, JointCommand.of_one(self.now_ns, 1.0, "noise"), self.now_ns)
        drive = self.supervisor.decide(self.now_ns, self.sample)
        self.supervisor.report_applied(drive.effort)
        return drive.kind, drive.effort[0]

    def drive(self) -> None:
        for _ in range(5):
            assert self.period() == (DriveKind.EFFORT, 9.0)

    def fade(self, periods: int) -> list[float]:
        return [self.period()[1] for _ in range(periods)]


@pytest.mark.parametrize("stop", _STOPS)
def test_category_0_is_the_default_and_cuts_the_torque_at_once(stop: str) -> None:
    assert PlantLimits(effort=(13.0,)).stop_time == 0.0
    plant = Plant(0.0)
    plant.drive()
    _STOPS[stop](plant.supervisor, plant.now_ns)
    assert plant.period() == (DriveKind.OFF, 0.0)


@pytest.mark.parametrize("stop", _STOPS)
def test_category_1_fades_from_what_acted_in_the_stated_time_whatever_is_commanded(stop: str) -> None:
    plant = Plant(0.1)
    plant.drive()
    _STOPS[stop](plant.supervisor, plant.now_ns)
    assert not plant.supervisor.mode.armed
    assert plant.fade(9) == pytest.approx([9.0 * left / 10 for left in range(9, 0, -1)])
    assert plant.period() == (DriveKind.OFF, 0.0)
    assert plant.fade(20) == [0.0] * 20


@pytest.mark.parametrize("stop", _STOPS)
def test_a_stop_between_decision_and_report_fades_from_the_torque_that_is_under_way(stop: str) -> None:
    for before, under_way in ((None, 5.0), (2.0, 8.0), (8.0, -4.0)):
        plant = Plant(0.1)
        plant.period(command=before)
        plant.period(command=before)
        plant.now_ns += _PERIOD_NS
        plant.sample = JointSample.of_one(plant.now_ns, 0.0, 0.0, 0.0)
        command = JointCommand.of_one(plant.now_ns, under_way, "lqr")
        plant.supervisor.offer(Input.EFFORT_COMMAND, command, plant.now_ns)
        decided = plant.supervisor.decide(plant.now_ns, plant.sample)
        _STOPS[stop](plant.supervisor, plant.now_ns)
        plant.supervisor.report_applied(decided.effort)
        assert plant.fade(3) == pytest.approx([decided.effort[0] * left for left in (0.9, 0.8, 0.7)])


def test_a_position_that_is_held_fades_too() -> None:
    plant = Plant(0.1)
    hold = from_points([0.0, 10.0], [0.0, 0.0], [0.0, 0.0])
    assert plant.supervisor.accept_trajectory(hold, plant.now_ns, plant.sample) == ""
    assert plant.period()[0] is DriveKind.POSITION
    plant.supervisor.report_applied((4.0,))
    plant.supervisor.e_stop(plant.now_ns)
    assert plant.period() == (DriveKind.EFFORT, pytest.approx(3.6))


@pytest.mark.parametrize("stop", _STOPS)
def test_a_stop_where_no_torque_acts_is_off_at_once_while_an_effort_of_zero_woke_the_torque_loop(stop: str) -> None:
    never_commanded = Plant(0.5)
    assert never_commanded.period(command=None) == (DriveKind.EFFORT, 0.0)
    just_armed = Plant(0.5)
    at_zero = Plant(0.5)
    at_zero.drive()
    assert at_zero.period(command=-1.0) == (DriveKind.EFFORT, 0.0)
    silent = Plant(0.5)
    silent.drive()
    assert [silent.period(command=None) for _ in range(6)][-1] == (DriveKind.EFFORT, 0.0)
    # The effort that a module reports for no duty where it compensates its speed, or a report that comes late.
    silent.supervisor.report_applied((3.0,))
    for plant in (never_commanded, just_armed, at_zero, silent):
        _STOPS[stop](plant.supervisor, plant.now_ns)
        assert plant.period() == (DriveKind.OFF, 0.0)


def test_a_position_that_is_held_after_a_gap_in_commands_fades_too() -> None:
    plant = Plant(0.1)
    plant.drive()
    for _ in range(6):
        plant.period(command=None)
    hold = from_points([0.0, 10.0], [0.0, 0.0], [0.0, 0.0])
    assert plant.supervisor.accept_trajectory(hold, plant.now_ns, plant.sample) == ""
    plant.period(command=None)
    plant.supervisor.report_applied((4.0,))
    plant.supervisor.e_stop(plant.now_ns)
    assert plant.period() == (DriveKind.EFFORT, pytest.approx(3.6))


def test_a_fault_cuts_the_torque_of_a_plant_that_drives_and_of_one_that_fades() -> None:
    for stops_first in (False, True):
        plant = Plant(0.5)
        plant.drive()
        if stops_first:
            plant.supervisor.disarm(plant.now_ns)
            assert plant.period()[1] > 8.0
        plant.supervisor.fault("something broke", plant.now_ns)
        assert plant.period() == (DriveKind.OFF, 0.0)
    # One behind a latched e-stop likewise.
    plant = Plant(0.5)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns)
    plant.supervisor.fault("something broke", plant.now_ns)
    assert plant.period() == (DriveKind.OFF, 0.0)
    assert plant.supervisor.mode is Mode.E_STOP


def test_without_measurements_nothing_fades() -> None:
    plant = Plant(1.0)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns)
    plant.measured = False
    assert [effort > 0.0 for effort in plant.fade(11)] == [True] * 10 + [False]
    plant.measured = True
    assert plant.period() == (DriveKind.OFF, 0.0)


@pytest.mark.parametrize("again", [*_STOPS, "reset"])
def test_a_second_stop_does_not_lengthen_the_first(again: str) -> None:
    plant = Plant(0.1)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns) if again == "reset" else plant.supervisor.disarm(plant.now_ns)
    plant.fade(4)
    if again == "reset":
        assert plant.supervisor.e_stop_reset(plant.now_ns) == ""
    else:
        _STOPS[again](plant.supervisor, plant.now_ns)
    assert plant.fade(6) == pytest.approx([4.5, 3.6, 2.7, 1.8, 0.9, 0.0])


def test_arming_ends_what_is_left_of_a_stop() -> None:
    plant = Plant(1.0)
    plant.drive()
    plant.supervisor.disarm(plant.now_ns)
    plant.fade(2)
    plant.now_ns += NANOSECONDS // 10
    plant.sample = JointSample.of_one(plant.now_ns, 0.0, 0.0, 0.0)
    assert plant.supervisor.arm(plant.now_ns, plant.sample) == ""
    assert plant.period(command=None) == (DriveKind.EFFORT, 0.0)
    plant.supervisor.e_stop(plant.now_ns)
    assert plant.period() == (DriveKind.OFF, 0.0) or plant.period()[1] == 0.0


def test_a_drive_that_is_prepared_fades_no_more() -> None:
    plant = Plant(1.0)
    plant.drive()
    plant.supervisor.disarm(plant.now_ns)
    assert plant.period()[1] > 8.0
    plant.supervisor.end_stop()
    assert plant.period() == (DriveKind.OFF, 0.0)


def test_a_clock_that_steps_lengthens_no_stop() -> None:
    plant = Plant(0.1)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns)
    plant.now_ns += NANOSECONDS
    assert plant.period() == (DriveKind.OFF, 0.0)
    plant = Plant(0.1)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns)
    plant.now_ns -= 10 * NANOSECONDS
    assert plant.fade(12)[-1] == 0.0


def test_a_clock_that_was_ahead_when_the_stop_was_asked_for_does_not_put_it_off() -> None:
    plant = Plant(0.1)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns + 100 * NANOSECONDS)
    assert plant.fade(11) == pytest.approx([9.0 * left / 10 for left in range(10, -1, -1)])


def test_of_several_joints_one_without_torque_does_not_keep_another_from_fading() -> None:
    joints = tuple(Joint(name) for name in ("hip", "knee"))
    limits = PlantLimits(effort=(9.0, 9.0), stop_time=0.1)
    supervisor = PlantSupervisor(limits, coordinates=Coordinates(joints, (0, 1)))
    now_ns = 1000 * NANOSECONDS
    sample = JointSample(now_ns, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    assert supervisor.arm(now_ns, sample) == ""
    supervisor.offer(Input.EFFORT_COMMAND, JointCommand(now_ns, (0.0, 4.0), "lqr", ("hip", "knee")), now_ns)
    supervisor.report_applied(supervisor.decide(now_ns, sample).effort)
    supervisor.e_stop(now_ns)
    drive = supervisor.decide(now_ns + 5 * _PERIOD_NS, sample)
    assert (drive.kind, drive.effort) == (DriveKind.EFFORT, pytest.approx((0.0, 2.0)))


@pytest.mark.parametrize("step", [-_PERIOD_NS // 2, -3 * _PERIOD_NS, -10 * NANOSECONDS])
def test_a_clock_that_steps_back_gives_no_stop_its_torque_back(step: int) -> None:
    plant = Plant(0.1)
    plant.drive()
    plant.supervisor.e_stop(plant.now_ns)
    assert plant.fade(5)[-1] == pytest.approx(4.5)
    plant.now_ns += step - _PERIOD_NS
    # The period in which it stepped counts for nothing, none before it is lost.
    assert plant.fade(6) == pytest.approx([4.5, 3.6, 2.7, 1.8, 0.9, 0.0])


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_stop_time_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(ParameterError, match="stop_time is"):
        PlantLimits(effort=(5.0,), stop_time=value)
