"""The edges of a plant's rules: what holds exactly at a limit, just beyond it, on either side, and after a reset."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from pendulum_msgs_py.contract import shared_supervisor
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

_MS = 1_000_000


class Plant:
    """A plant at 1 kHz that stays where it is."""

    def __init__(self, **limits: float) -> None:
        self.now = 1000 * NANOSECONDS
        self.position = 0.0
        self.servo = 0.0
        usual = {"effort": (5.0,), "feedback_timeout": 0.03, "handover_effort": math.inf}
        self.supervisor = PlantSupervisor(PlantLimits(**{**usual, **limits}))
        assert self.supervisor.arm(self.now, self.sample()) == ""

    def sample(self, *, late_ns: int = 0, velocity: float = 0.0) -> JointSample:
        return JointSample.of_one(self.now - late_ns, self.position, velocity, 0.0)

    def decide(self) -> Drive:
        drive = self.supervisor.decide(self.now, self.sample())
        self.supervisor.report_applied((drive.effort[0] + (self.servo if drive.kind is DriveKind.POSITION else 0.0),))
        return drive

    def offer(self, effort: float, kind: Input = Input.EFFORT_COMMAND) -> None:
        self.supervisor.offer(kind, JointCommand.of_one(self.now, effort, "lqr"), self.now)

    def run(self, milliseconds: int, command: float | None = None, disturbance: float | None = None) -> Drive:
        drive = Drive(DriveKind.OFF)
        for _ in range(milliseconds):
            self.now += _MS
            if command is not None:
                self.offer(command)
            if disturbance is not None:
                self.offer(disturbance, Input.DISTURBANCE)
            drive = self.decide()
        return drive

    def follow(self, trajectory: Trajectory) -> None:
        assert self.supervisor.accept_trajectory(trajectory, self.now, self.sample()) == ""


def _hold(duration: float = 0.1, position: float = 0.0) -> Trajectory:
    return from_points([0.0, duration], [position, position], [0.0, 0.0])


# --- measurements ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late_ms", [30, 10, 0, -10, -30])
def test_a_measurement_as_old_as_the_limit_is_believed_and_one_as_far_ahead(late_ms: int) -> None:
    plant = Plant()
    drive = plant.supervisor.decide(plant.now, plant.sample(late_ns=late_ms * _MS))
    assert drive.kind is DriveKind.EFFORT


@pytest.mark.parametrize("late_ns", [30 * _MS + 1, -30 * _MS - 1])
def test_a_measurement_older_or_further_ahead_than_the_limit_ends_torque(late_ns: int) -> None:
    plant = Plant()
    assert plant.supervisor.decide(plant.now, plant.sample(late_ns=late_ns)).kind is DriveKind.OFF
    assert plant.supervisor.mode is Mode.FAULT


@pytest.mark.parametrize(("position", "ends"), [(1.0, False), (1.001, True), (-2.0, False), (-2.001, True)])
def test_leaving_the_position_window_ends_torque(position: float, ends: bool) -> None:
    plant = Plant(position_min=(-2.0,), position_max=(1.0,))
    plant.position = position
    assert (plant.run(1, 1.0).effort[0] == 0.0) == ends
    assert (plant.supervisor.mode is Mode.FAULT) == ends


@pytest.mark.parametrize(("velocity", "ends"), [(8.0, False), (8.001, True), (-8.0, False), (-8.001, True)])
def test_turning_faster_than_the_limit_ends_torque(velocity: float, ends: bool) -> None:
    plant = Plant(velocity=8.0)
    plant.supervisor.decide(plant.now, plant.sample(velocity=velocity))
    assert (plant.supervisor.mode is Mode.FAULT) == ends


# --- arming and release ----------------------------------------------------------------------------------------


def test_a_command_of_just_the_arming_limit_may_wait() -> None:
    plant = Plant(arm_effort=0.5)
    plant.supervisor.disarm(plant.now)
    plant.offer(-0.5)
    assert plant.supervisor.arm(plant.now, plant.sample()) == ""


def test_arming_what_is_armed_changes_nothing() -> None:
    plant = Plant()
    plant.follow(_hold(1.0))
    assert plant.supervisor.arm(plant.now, plant.sample()) == ""
    assert plant.run(1).kind is DriveKind.POSITION


def test_a_command_that_waited_while_the_plant_was_armed_makes_no_torque() -> None:
    plant = Plant(arm_effort=0.5)
    plant.supervisor.disarm(plant.now)
    plant.offer(0.4)
    assert plant.supervisor.arm(plant.now, plant.sample()) == ""
    assert plant.run(1).effort[0] == 0.0


def test_a_torque_that_is_reported_after_the_release_starts_no_fade_when_armed_again() -> None:
    plant = Plant()
    plant.supervisor.disarm(plant.now)
    plant.supervisor.report_applied((3.0,))
    assert plant.supervisor.arm(plant.now, plant.sample()) == ""
    plant.follow(_hold())
    assert plant.run(1).effort[0] == 0.0


def test_each_change_of_mode_is_kept_with_time_and_reason_and_the_newest_fifty() -> None:
    plant = Plant()
    supervisor = plant.supervisor
    supervisor.disarm(plant.now, "enough")
    assert supervisor.transitions == [(plant.now, Mode.EFFORT, "armed"), (plant.now, Mode.DISARMED, "enough")]
    supervisor.disarm(plant.now, "once more")
    assert len(supervisor.transitions) == 2
    for number in range(60):
        supervisor.e_stop(plant.now, f"press {number}")
        supervisor.e_stop_reset(plant.now)
    assert len(supervisor.transitions) == 50
    assert supervisor.transitions[-2][2] == "press 59"


# --- effort ----------------------------------------------------------------------------------------------------


def test_without_a_push_there_is_none() -> None:
    assert Plant().run(1).push[0] == 0.0


def test_a_sum_within_the_limit_is_not_saturated_and_one_beyond_it_is_counted() -> None:
    plant = Plant()
    for command, disturbance, saturated in ((1.0, 1.0, False), (4.0, 1.0, False), (4.0, 1.5, True)):
        plant.now += _MS
        plant.offer(disturbance, Input.DISTURBANCE)
        plant.offer(command)
        drive = plant.decide()
        assert drive.saturated == saturated
        assert drive.effort[0] == min(5.0, command + disturbance)
    assert plant.supervisor.saturated_periods == 1
    assert plant.supervisor.reason == "commanded by lqr"


def test_each_period_without_a_command_is_counted() -> None:
    plant = Plant()
    plant.run(7)
    assert plant.supervisor.starved_periods == 7


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_torque_rises_at_the_slew_limit_and_not_without_time(side: float) -> None:
    plant = Plant(slew=10.0)
    assert plant.run(10, side * 5.0).effort[0] == pytest.approx(side * 0.1)
    assert plant.decide().effort[0] == plant.decide().effort[0]
    assert plant.run(10, side * 5.0).effort[0] == pytest.approx(side * 0.2)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("less", [0.0, 0.5])
def test_torque_falls_at_once_whatever_the_slew_limit(side: float, less: float) -> None:
    plant = Plant(slew=0.5)
    assert plant.run(3000, side * 1.5).effort[0] == pytest.approx(side * 1.5)
    assert plant.run(1, side * less).effort[0] == side * less


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_torque_of_the_other_sign_rises_from_zero_at_the_slew_limit(side: float) -> None:
    plant = Plant(slew=10.0)
    plant.run(200, side * 2.0)
    assert plant.run(1, side * -2.0).effort[0] == pytest.approx(side * -0.01)
    assert plant.run(9, side * -2.0).effort[0] == pytest.approx(side * -0.1)


def test_after_a_silence_torque_rises_from_zero_again() -> None:
    plant = Plant(slew=10.0)
    assert plant.run(100, 1.0).effort[0] == pytest.approx(1.0)
    assert plant.run(60).starved
    assert plant.run(1, 1.0).effort[0] == pytest.approx(0.01)


def test_a_commander_may_go_on_after_a_silence_of_just_the_hold() -> None:
    def after(pause_ns: int) -> float:
        plant = Plant(start_effort=2.0)
        plant.run(1, 1.0)
        plant.now += pause_ns
        plant.offer(4.0)
        return plant.decide().effort[0]

    assert after(NANOSECONDS) == 4.0
    assert after(NANOSECONDS + 1) == 0.0


# --- trajectories ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_being_as_far_from_the_trajectory_as_allowed_is_no_fault_and_further_is(side: float) -> None:
    plant = Plant(tracking_error=0.25)
    plant.follow(_hold(1.0))
    plant.position = side * 0.25
    assert plant.run(1).kind is DriveKind.POSITION
    plant.position = side * 0.2501
    assert plant.run(1).kind is DriveKind.OFF
    assert plant.supervisor.mode is Mode.FAULT


def test_a_trajectory_is_finished_at_its_end_not_before_and_not_when_another_follows() -> None:
    plant = Plant()
    assert not plant.supervisor.trajectory_finished
    plant.follow(_hold(0.1))
    plant.run(99)
    assert not plant.supervisor.trajectory_finished
    plant.run(1)
    assert plant.supervisor.trajectory_finished
    assert plant.supervisor.reason == "holding the end of a trajectory"
    plant.follow(_hold(0.1))
    assert not plant.supervisor.trajectory_finished
    plant.supervisor.disarm(plant.now)
    assert not plant.supervisor.trajectory_finished


def test_a_trajectory_is_not_finished_while_the_gap_at_its_start_is_closed() -> None:
    plant = Plant()
    plant.follow(_hold(0.01, 0.29))
    plant.position = 0.1
    plant.run(100, 0.0)
    assert plant.supervisor.mode is Mode.POSITION
    assert not plant.supervisor.trajectory_finished


def test_time_that_stands_still_moves_no_setpoint() -> None:
    plant = Plant()
    plant.follow(from_points([0.0, 1.0], [0.0, 0.3], [0.0, 0.0]))
    position = plant.run(200).position[0]
    assert [plant.decide().position[0] for _ in range(3)] == 3 * [position]


def test_a_fade_waits_while_the_plant_was_stopped() -> None:
    plant = Plant(handover_time=1.0)
    plant.run(1, 4.0)
    plant.follow(_hold(10.0))
    assert plant.run(200).effort[0] == pytest.approx(0.8 * 4.0)
    plant.now += 5 * NANOSECONDS
    # As far as the longest step, a tenth of a second, takes it.
    assert plant.decide().effort[0] == pytest.approx(0.7 * 4.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_trajectory_may_start_as_far_from_the_pendulum_as_the_tracking_error_and_no_further(side: float) -> None:
    plant = Plant(tracking_error=0.25)
    far = _hold(1.0, side * 0.2501)
    refusal = plant.supervisor.accept_trajectory(far, plant.now, plant.sample())
    assert refusal.startswith(f"trajectory starts at {side * 0.2501:.4f} rad")
    plant.follow(_hold(1.0, side * 0.25))


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("handover_time", "speed"),
    # Over a long hand-over the gap has all that time; over a short one it is closed as fast as a ramp may be.
    [(1.0, 0.25), (0.5, 0.3)],
)
def test_closing_the_gap_counts_for_the_speed_on_either_side(side: float, handover_time: float, speed: float) -> None:
    gap = _hold(1.0, side * 0.25)
    slow = Plant(handover_time=handover_time, velocity=speed - 1e-3)
    assert "rad/s; expected at most" in slow.supervisor.accept_trajectory(gap, slow.now, slow.sample())
    Plant(handover_time=handover_time, velocity=speed + 1e-9).follow(gap)


def test_a_trajectory_of_just_the_largest_speed_is_followed() -> None:
    Plant(handover_time=1.0, velocity=0.25).follow(_hold(1.0, 0.25))


@pytest.mark.parametrize(("position", "inside"), [(1.0, True), (1.01, False), (-2.0, True), (-2.01, False)])
def test_a_trajectory_may_touch_the_ends_of_the_window_and_not_pass_them(
    position: float,
    inside: bool,
) -> None:
    plant = Plant(position_min=(-2.0,), position_max=(1.0,))
    plant.position = max(-2.0, min(1.0, position))
    refusal = plant.supervisor.accept_trajectory(_hold(1.0, position), plant.now, plant.sample())
    assert (refusal == "") == inside


# --- hand-over -------------------------------------------------------------------------------------------------


def test_a_command_stamped_just_at_the_end_takes_over_and_one_before_it_does_not() -> None:
    plant = Plant()
    plant.follow(_hold(0.1))
    plant.run(99, 3.0)
    plant.run(10)
    assert plant.supervisor.mode is Mode.POSITION
    plant = Plant()
    plant.follow(_hold(0.1))
    drive = plant.run(100, 3.0)
    assert plant.supervisor.mode is Mode.EFFORT
    assert drive.kind is DriveKind.EFFORT


def test_a_command_as_far_from_what_holds_as_allowed_takes_over() -> None:
    plant = Plant(handover_effort=2.0)
    plant.follow(_hold(0.1))
    plant.run(150, 2.001)
    assert plant.supervisor.mode is Mode.POSITION
    plant.run(1, 2.0)
    assert plant.supervisor.mode is Mode.EFFORT


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sum_with_a_disturbance_as_far_from_what_holds_as_allowed_takes_over_and_one_further_does_not(
    side: float,
) -> None:
    plant = Plant(handover_sum=2.0)
    plant.servo = side
    plant.follow(_hold(0.1))
    plant.run(150, 0.5 * side, disturbance=2.501 * side)
    assert plant.supervisor.mode is Mode.POSITION
    wanted = (
        "lqr asks for 0.50 N m and the disturbance for 2.50 N m, 2.00 N m from what holds; expected at most 2.0 N m"
    )
    assert (side < 0.0) or wanted in plant.supervisor.reason
    plant.run(1, 0.5 * side, disturbance=2.5 * side)
    assert plant.supervisor.mode is Mode.EFFORT
    # Whoever commands already may be disturbed by any.
    assert plant.run(200, 0.0, disturbance=-4.0 * side).effort[0] == -4.0 * side


@pytest.mark.parametrize(
    ("command", "disturbance"),
    [
        pytest.param(2.0, 0.5, id="a command just as far from what holds as allowed"),
        pytest.param(4.0, -4.0, id="a disturbance that outweighs the command"),
        pytest.param(-2.0, -0.5, id="the other way"),
    ],
)
def test_a_command_is_judged_by_itself_and_with_the_disturbance(command: float, disturbance: float) -> None:
    plant = Plant(handover_effort=2.0, handover_sum=2.0)
    plant.follow(_hold(0.1))
    plant.run(150, command, disturbance=disturbance)
    assert plant.supervisor.mode is Mode.POSITION


def test_a_disturbance_that_has_fallen_silent_keeps_nobody_from_taking_over() -> None:
    plant = Plant(handover_sum=2.0)
    plant.follow(_hold(0.1))
    plant.run(150, 0.5, disturbance=4.0)
    assert plant.supervisor.mode is Mode.POSITION
    plant.run(60, 0.5)
    assert plant.supervisor.mode is Mode.EFFORT


def test_where_noise_begins_with_the_controller_it_may_have_any_size_at_a_hand_over_too() -> None:
    plant = Plant(handover_effort=2.0)
    plant.follow(_hold(0.1))
    plant.run(150, 0.5, disturbance=4.0)
    assert plant.supervisor.mode is Mode.EFFORT


def test_who_took_over_with_more_than_a_beginner_may_ask_goes_on() -> None:
    plant = Plant(start_effort=0.5)
    plant.follow(_hold(0.1))
    assert plant.run(300, 1.5).effort[0] == 1.5


def test_without_a_hand_over_time_torque_is_at_once_what_is_asked_for() -> None:
    plant = Plant(handover_time=0.0)
    plant.servo = 1.7
    plant.follow(_hold(0.1))
    assert plant.run(100, -3.0).effort[0] == -3.0


def test_the_slew_limit_begins_at_the_torque_that_held() -> None:
    plant = Plant(handover_time=0.0, slew=10.0)
    plant.servo = 1.7
    plant.follow(_hold(0.1))
    assert plant.run(100, 3.0).effort[0] == pytest.approx(1.7)
    assert plant.run(1, 3.0).effort[0] == pytest.approx(1.71)


def test_a_fade_that_a_silence_ended_does_not_come_back() -> None:
    plant = Plant(handover_time=1.0)
    plant.servo = 1.7
    plant.follow(_hold(0.1))
    assert plant.run(110, 3.0).effort[0] == pytest.approx(1.7, abs=0.05)
    assert plant.run(60).starved
    assert plant.run(1, 3.0).effort[0] == 3.0


# --- limits ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "limits",
    [
        {"effort": (0.0,)},
        {"command_timeout": 0.0},
        {"handover_effort": 0.0},
        {"handover_sum": 0.0},
        {"tracking_error": 0.0},
        {"position_min": (1.0,), "position_max": (1.0,)},
    ],
)
def test_a_limit_of_nothing_at_all_is_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match="expected"):
        PlantLimits(**{"effort": (5.0,), **limits})


@pytest.mark.parametrize(
    "limits",
    [
        {"effort": (0.5,)},
        {"handover_effort": 0.5},
        {"handover_sum": 0.5},
        {"tracking_error": 0.1},
        {"velocity": 0.5, "slew": 0.5, "start_effort": 0.5, "starvation": 0.5, "feedback_timeout": 0.5},
        {"handover_time": 0.0, "arm_effort": 0.0},
    ],
)
def test_a_small_limit_is_one(limits: dict[str, float]) -> None:
    assert PlantLimits(**{"effort": (5.0,), **limits})


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_effort_beyond_a_small_limit_keeps_its_sign(sign: float) -> None:
    supervisor = PlantSupervisor(PlantLimits((0.5,)))
    sample = JointSample.of_one(0, 0.0, 0.0)
    assert supervisor.arm(0, sample) == ""
    assert supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(0, 0.7 * sign, "/me"), 0) is None
    assert supervisor.decide(0, sample).effort == (0.5 * sign,)


def _wait_for(supervisor: SharedSupervisor, step: Callable[[], object]) -> threading.Thread:
    """Return a thread that waits to take a step until nobody has the supervisor alone any more."""
    waiting = ctypes.c_int64.from_address(supervisor.waiting_at)
    thread = threading.Thread(target=step)
    thread.start()
    ends = time.monotonic() + 60.0
    while not waiting.value:
        assert thread.is_alive(), "it did not wait"
        assert time.monotonic() < ends
        time.sleep(0.0)
    return thread


def test_who_has_waited_for_the_supervisor_is_next(monkeypatch: pytest.MonkeyPatch) -> None:
    # Nothing but the lock's own fairness would decide else, and it has none: a plant would act once more.
    monkeypatch.setattr(shared_supervisor, "_LONGEST_YIELD", 60.0)
    for _ in range(20):
        supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
        assert supervisor.arm(0, JointSample.of_one(0, 0.0, 0.0)) == ""
        with supervisor.alone():
            disarms = _wait_for(supervisor, lambda supervisor=supervisor: supervisor.disarm(0))
        assert supervisor.mode is Mode.DISARMED
        disarms.join()
        assert not ctypes.c_int64.from_address(supervisor.waiting_at).value


def test_a_press_counts_from_when_it_is_made_however_late_its_thread_runs() -> None:
    sample = JointSample.of_one(0, 0.0, 0.0)
    for next_step in (
        lambda supervisor: supervisor.decide(0, sample),
        lambda supervisor: supervisor.arm(0, sample),
        lambda supervisor: supervisor.e_stop_reset(0),
        lambda supervisor: supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(0, 1.0, "/me"), 0),
        lambda supervisor: supervisor.report_applied((0.0,)),
        lambda supervisor: supervisor.disarm(0),
        lambda supervisor: supervisor.fault("x", 0),
        lambda supervisor: supervisor.set_commander_conflict(""),
    ):
        supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
        assert supervisor.arm(0, sample) == ""
        # Its thread hangs between press and lock.
        supervisor._presses.append((0, "e-stop pressed"))
        next_step(supervisor)
        assert supervisor.mode is Mode.E_STOP
        assert supervisor.reason == "e-stop pressed"
        assert supervisor.decide(0, sample).effort == (0.0,)


def test_compiled_code_begins_behind_a_press() -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    supervisor._presses.append((0, "e-stop pressed"))
    with supervisor.alone():
        assert supervisor.mode is Mode.E_STOP


def test_a_decision_stops_for_a_press_that_no_thread_has_read_yet() -> None:
    waiting = [(7, "e-stop pressed")]
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    assert supervisor.arm(0, JointSample.of_one(0, 0.0, 0.0)) == ""
    supervisor.watch_for_presses(lambda: waiting.pop() if waiting else None)
    supervisor.decide(8, JointSample.of_one(8, 0.0, 0.0))
    assert supervisor.transitions[1:] == [(7, Mode.E_STOP, "e-stop pressed")]
    # Nor is it taken back by a reset, or run past by compiled code.
    assert supervisor.e_stop_reset(9) == ""
    waiting.append((9, "once more"))
    assert supervisor.e_stop_reset(10) == "the e-stop has just been pressed; reset it once more"
    assert supervisor.e_stop_reset(11) == ""
    waiting.append((11, "once more"))
    with supervisor.alone():
        assert supervisor.mode is Mode.E_STOP


def test_the_step_behind_a_press_knows_of_it_though_its_thread_still_waits() -> None:
    for _ in range(20):
        supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
        assert supervisor.arm(0, JointSample.of_one(0, 0.0, 0.0)) == ""
        with supervisor.alone():
            stop = _wait_for(supervisor, lambda supervisor=supervisor: supervisor.e_stop(7, "button"))
            assert supervisor.decide(8, JointSample.of_one(8, 0.0, 0.0)).effort == (0.0,)
            assert supervisor.mode is Mode.E_STOP
        stop.join()
        assert supervisor.transitions[1:] == [(7, Mode.E_STOP, "button")]


def test_an_exception_while_a_press_is_carried_out_does_not_lose_it(monkeypatch: pytest.MonkeyPatch) -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    assert supervisor.arm(0, JointSample.of_one(0, 0.0, 0.0)) == ""
    with monkeypatch.context() as patch:
        patch.setattr(supervisor, "_release", _interrupted)
        with pytest.raises(KeyboardInterrupt):
            supervisor.e_stop(0)
    assert supervisor.mode is Mode.EFFORT
    supervisor.decide(1, JointSample.of_one(1, 0.0, 0.0))
    assert supervisor.mode is Mode.E_STOP


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_of_several_presses_the_newest_says_why() -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    supervisor._presses.extend([(1, "first"), (2, "second")])
    supervisor.decide(3, None)
    assert (supervisor.mode, supervisor.reason) == (Mode.E_STOP, "second")


def test_a_reset_that_has_waited_does_not_take_back_a_press_of_meanwhile() -> None:
    for _ in range(20):
        supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
        supervisor.e_stop(0)
        said: list[str] = []
        with supervisor.alone():
            reset = _wait_for(
                supervisor, lambda supervisor=supervisor, said=said: said.append(supervisor.e_stop_reset(2))
            )
            stop = threading.Thread(target=supervisor.e_stop, args=(1, "meanwhile"))
            stop.start()
            while not supervisor._presses:
                time.sleep(0.0)
            # Whoever steps first carries it out.
            supervisor.decide(3, None)
        reset.join()
        stop.join()
        assert said == ["the e-stop has just been pressed; reset it once more"]
        assert (supervisor.mode, supervisor.reason) == (Mode.E_STOP, "meanwhile")


def test_no_reset_takes_back_a_press_that_nobody_has_carried_out_yet() -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    supervisor.e_stop(0)
    supervisor._presses.append((0, "once more"))
    assert supervisor.e_stop_reset(0) == "the e-stop has just been pressed; reset it once more"
    assert (supervisor.mode, supervisor.reason) == (Mode.E_STOP, "once more")
    assert supervisor.e_stop_reset(0) == ""


@pytest.mark.parametrize(
    "step",
    [
        lambda plant: plant.offer(Input.EFFORT_COMMAND, JointCommand.of_one(0, 0.0, "/c"), 0),
        lambda plant: plant.set_commander_conflict(""),
        lambda plant: plant.receive_enable(0, held=False),
        lambda plant: plant.end_stop(),
        lambda plant: plant.accept_trajectory(_hold(), 0, JointSample.of_one(0, 0.0, 0.0)),
        lambda plant: plant.arm(0, JointSample.of_one(0, 0.0, 0.0)),
        lambda plant: plant.disarm(0),
        lambda plant: plant.e_stop(0),
        lambda plant: plant.e_stop_reset(0),
        lambda plant: plant.fault("broken", 0),
        lambda plant: plant.decide(0, None),
        lambda plant: plant.report_applied((0.0,)),
        lambda plant: plant.alone().__enter__(),
    ],
)
@pytest.mark.parametrize("armed", [False, True])
def test_each_step_waits_for_the_lock(step: Callable[[SharedSupervisor], object], armed: bool) -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    if armed:
        assert supervisor.arm(0, JointSample.of_one(0, 0.0, 0.0)) == ""
    thread = threading.Thread(target=step, args=(supervisor,))
    with supervisor._lock:
        thread.start()
        # It cannot end, however long it is waited for.
        thread.join(0.02)
        assert thread.is_alive()
    thread.join()


def test_a_shared_plant_that_is_prepared_fades_no_more() -> None:
    supervisor, sample = SharedSupervisor(PlantLimits(effort=(5.0,), stop_time=1.0)), JointSample.of_one(0, 0.0, 0.0)
    assert supervisor.arm(0, sample) == ""
    supervisor.report_applied((4.0,))
    supervisor.disarm(0)
    assert supervisor.decide(0, sample).effort == (4.0,)
    supervisor.end_stop()
    assert supervisor.decide(0, sample).kind is DriveKind.OFF


def test_a_trajectory_waits_for_the_lock_and_takes_no_e_stop_of_meanwhile_back() -> None:
    supervisor, sample = SharedSupervisor(PlantLimits(effort=(5.0,))), JointSample.of_one(0, 0.0, 0.0)
    assert supervisor.arm(0, sample) == ""
    told: list[str] = []
    with supervisor.alone():
        follows = _wait_for(supervisor, lambda: told.append(supervisor.accept_trajectory(_hold(), 0, sample)))
        supervisor._presses.append((1, "meanwhile"))
    follows.join()
    assert told[0]
    assert (supervisor.mode, supervisor.reason) == (Mode.E_STOP, "meanwhile")


def test_many_presses_at_once_are_all_carried_out_before_they_return() -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    for _ in range(50):
        with ThreadPoolExecutor(8) as pool:
            modes = list(pool.map(lambda _: (supervisor.e_stop(0), supervisor.mode)[1], range(16)))
        assert modes == [Mode.E_STOP] * 16
        assert supervisor.e_stop_reset(0) == ""
        assert not ctypes.c_int64.from_address(supervisor.waiting_at).value
