"""The rules of a plant, attacked with any sequence of messages, requests, measurements and clock steps."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from pendulum_msgs_py.contract.supervisor import (
    PUSH_LIMIT_FACTOR,
    Drive,
    DriveKind,
    Input,
    Mode,
    PlantLimits,
    PlantSupervisor,
)
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

_MS = 1_000_000
_PERIOD_NS = 10 * _MS
_START_NS = 1_000 * NANOSECONDS
_ANY = st.floats(allow_nan=True, allow_infinity=True)
_USUAL = st.floats(-20.0, 20.0)


class PlantRules(RuleBasedStateMachine):
    """A plant's loop of 10 ms, and everybody who may speak to it."""

    def __init__(self) -> None:
        super().__init__()
        self.now = _START_NS
        self.supervisor = PlantSupervisor(PlantLimits(effort=(5.0,)))
        self.sample: JointSample | None = None
        self.drive = Drive(DriveKind.OFF)
        self.decided_ns = _START_NS
        self.decided_mode = Mode.DISARMED
        self.released = False

    @initialize(
        slew=st.sampled_from([math.inf, 50.0]),
        handover=st.sampled_from([0.0, 0.1]),
        window=st.sampled_from([(-math.inf, math.inf), (-1.0, 4.0)]),
    )
    def make(self, slew: float, handover: float, window: tuple[float, float]) -> None:
        self.limits = PlantLimits(
            effort=(5.0,),
            command_timeout=0.05,
            feedback_timeout=0.03,
            velocity=8.0,
            slew=slew,
            handover_time=handover,
            position_min=(window[0],),
            position_max=(window[1],),
            handover_effort=math.inf,
        )
        self.supervisor = PlantSupervisor(self.limits)
        self._measure(0.1, 0.0)

    # --- the world -----------------------------------------------------------------------------------------

    def _measure(self, position: float, velocity: float, effort: float = 0.0, late_ns: int = 0) -> None:
        self.sample = JointSample.of_one(self.now - late_ns, position, velocity, effort)

    def _period(self) -> None:
        before, elapsed = self.drive, self.now - self.decided_ns
        self.drive = self.supervisor.decide(self.now, self.sample)
        self.supervisor.report_applied(self.drive.effort)
        changed = {self.decided_mode, self.supervisor.mode} == {Mode.POSITION, Mode.EFFORT}
        if changed and not self.released and 0 <= elapsed <= _PERIOD_NS and self.limits.handover_time:
            # The fade from one torque to another, at most twice the limit away, over the hand-over time.
            slope = 2.0 * self.limits.effort[0] / self.limits.handover_time
            assert abs(self.drive.effort[0] - before.effort[0]) <= slope * _PERIOD_NS / NANOSECONDS + 1e-9
        self.decided_ns, self.decided_mode, self.released = self.now, self.supervisor.mode, False

    @rule(position=st.floats(-0.3, 0.3), velocity=st.floats(-2.0, 2.0), periods=st.integers(1, 8))
    def run(self, position: float, velocity: float, periods: int) -> None:
        for _ in range(periods):
            self.now += _PERIOD_NS
            self._measure(position, velocity)
            self._period()
            self.bounds()

    @rule(effort=_USUAL, disturbance=_USUAL, periods=st.integers(1, 15))
    def run_with_a_controller(self, effort: float, disturbance: float, periods: int) -> None:
        for _ in range(periods):
            self.now += _PERIOD_NS
            self._measure(0.1, 0.0)
            for kind, torque in ((Input.EFFORT_COMMAND, effort), (Input.DISTURBANCE, disturbance)):
                self._offer(kind, JointCommand.of_one(self.now, torque, "lqr"))
            self._period()
            self.bounds()

    @rule(effort=_USUAL)
    def bring_up(self, effort: float) -> None:
        """Do what a careful user does, so that many sequences start from an armed plant."""
        self.supervisor.set_commander_conflict("")
        self.e_stop()
        self.reset()
        # Twice, since a clock that stepped back lets an old command look fresh, and nobody arms under a command.
        for _ in range(2):
            self.now += NANOSECONDS
            self._measure(0.1, 0.0)
            self._period()
            refusal = self.supervisor.arm(self.now, self.sample)
            if not refusal:
                break
        assert refusal == ""
        self.run_with_a_controller(effort, 0.0, 3)
        assert self.supervisor.mode is Mode.EFFORT

    @precondition(lambda self: self.supervisor.mode is Mode.EFFORT)
    @rule(effort=_USUAL, duration=st.sampled_from([0.01, 0.05, 0.2]))
    def move_and_come_back(self, effort: float, duration: float) -> None:
        self._measure(0.1, 0.0)
        self.supervisor.accept_trajectory(from_points([0.0, duration], [0.1, 0.1], [0.0, 0.0]), self.now, self.sample)
        self.run_with_a_controller(effort, 0.0, 8)

    @rule(position=_ANY, velocity=_ANY, effort=_ANY)
    def any_measurement(self, position: float, velocity: float, effort: float) -> None:
        self.now += _PERIOD_NS
        self._measure(position, velocity, effort)
        self._period()

    @rule(late=st.integers(-10 * NANOSECONDS, 10 * NANOSECONDS))
    def stale_or_future_measurement(self, late: int) -> None:
        self.now += _PERIOD_NS
        self._measure(0.1, 0.0, late_ns=late)
        self._period()
        if abs(late) > 30 * _MS:
            assert self.drive.kind is DriveKind.OFF

    @rule(step=st.integers(-100 * NANOSECONDS, 100 * NANOSECONDS))
    def clock_steps(self, step: int) -> None:
        self.now += step

    # --- messages ------------------------------------------------------------------------------------------

    def _offer(self, kind: Input, command: JointCommand | None) -> None:
        self.supervisor.offer(kind, command, self.now)

    @rule(
        kind=st.sampled_from(Input),
        effort=_ANY,
        age=st.one_of(st.integers(-20 * _MS, 80 * _MS), st.integers(-(2**62), 2**62)),
        source=st.sampled_from(["lqr", "other", ""]),
        joints=st.sampled_from([(), ("pendulum_joint",), ("elbow",), ("pendulum_joint", "elbow")]),
    )
    def any_command(self, kind: Input, effort: float, age: int, source: str, joints: tuple[str, ...]) -> None:
        self._offer(kind, JointCommand.of_one(self.now - age, effort, source, joints))

    @rule(kind=st.sampled_from(Input))
    def malformed(self, kind: Input) -> None:
        self._offer(kind, None)

    @rule(goal=st.floats(-0.5, 0.5), duration=st.floats(0.01, 0.5), start=st.floats(-0.5, 0.5))
    def trajectory(self, goal: float, duration: float, start: float) -> None:
        points = from_points([0.0, duration], [start, goal], [0.0, 0.0])
        was_armed = self.supervisor.mode.armed
        assert self.sample is not None
        refusal = self.supervisor.accept_trajectory(points, self.now, self.sample)
        assert was_armed or refusal

    @rule(conflict=st.sampled_from(["", "two commanders named /lqr"]))
    def twins(self, conflict: str) -> None:
        self.supervisor.set_commander_conflict(conflict)

    # --- requests ------------------------------------------------------------------------------------------

    @rule()
    def arm(self) -> None:
        before = self.supervisor.mode
        refusal = self.supervisor.arm(self.now, self.sample)
        if before in {Mode.FAULT, Mode.E_STOP}:
            assert refusal
            assert self.supervisor.mode is before
        if not refusal:
            assert self.supervisor.mode.armed

    @rule()
    def disarm(self) -> None:
        self.released = True
        latched = self.supervisor.mode is Mode.E_STOP
        self.supervisor.disarm(self.now)
        assert self.supervisor.mode is (Mode.E_STOP if latched else Mode.DISARMED)

    @rule()
    def e_stop(self) -> None:
        self.released = True
        self.supervisor.e_stop(self.now)
        assert self.supervisor.mode is Mode.E_STOP

    @rule()
    def reset(self) -> None:
        self.released = True
        before = self.supervisor.mode
        refusal = self.supervisor.e_stop_reset(self.now)
        if before is Mode.E_STOP:
            assert self.supervisor.mode is Mode.DISARMED
        else:
            assert refusal
            assert self.supervisor.mode is before

    @rule()
    def fault(self) -> None:
        self.released = True
        latched = self.supervisor.mode is Mode.E_STOP
        self.supervisor.fault("somebody saw smoke", self.now)
        assert self.supervisor.mode is (Mode.E_STOP if latched else Mode.FAULT)

    # --- what always holds ---------------------------------------------------------------------------------

    @invariant()
    def bounds(self) -> None:
        drive = self.drive
        assert math.isfinite(drive.effort[0])
        assert abs(drive.effort[0]) <= self.supervisor.limits.effort[0]
        assert math.isfinite(drive.position[0])
        assert math.isfinite(drive.velocity[0])
        assert abs(drive.push[0]) <= PUSH_LIMIT_FACTOR * self.supervisor.limits.effort[0]
        if drive.kind is DriveKind.OFF:
            assert drive.effort[0] == 0.0
        if drive.starved:
            assert drive.effort[0] == 0.0

    @precondition(lambda self: not self.supervisor.mode.armed)
    @rule()
    def unarmed_is_off(self) -> None:
        self.now += _PERIOD_NS
        self._period()
        assert self.drive.kind is DriveKind.OFF
        assert self.drive.effort[0] == 0.0

    @precondition(lambda self: self.supervisor.mode is Mode.EFFORT)
    @rule()
    def silence_ends_in_zero_torque(self) -> None:
        # command_timeout + one period, and what a clock that steps back by less than a stamp may run ahead adds to it.
        for _ in range(7):
            self.now += _PERIOD_NS
            self._measure(0.1, 0.0)
            self._period()
        assert self.drive.effort[0] == 0.0

    @precondition(lambda self: self.supervisor.mode in {Mode.FAULT, Mode.E_STOP})
    @rule(effort=_USUAL)
    def latched_modes_stay(self, effort: float) -> None:
        mode = self.supervisor.mode
        self.run_with_a_controller(effort, 0.0, 3)
        self.arm()
        assert self.supervisor.mode is mode


PlantRules.TestCase.settings = settings(max_examples=120, stateful_step_count=40, deadline=None)
TestTheRulesHoldForAnySequence = PlantRules.TestCase


class Loop:
    """A plant at 1 kHz that stays where it is, with a controller that can be muted."""

    def __init__(self, **limits: float) -> None:
        self.now = _START_NS
        self.position = 0.0
        self.supervisor = PlantSupervisor(PlantLimits(**{"effort": (5.0,), "feedback_timeout": 0.03, **limits}))
        self.applied: list[float] = []
        self.drives: list[Drive] = []
        self.servo = 0.0
        assert self.supervisor.arm(self.now, self.sample()) == ""

    def sample(self) -> JointSample:
        return JointSample.of_one(self.now, self.position, 0.0, 0.0)

    def run(self, seconds: float, command: float | None = None, source: str = "lqr") -> Drive:
        for _ in range(round(seconds * 1000)):
            self.now += _MS
            if command is not None:
                self.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(self.now, command, source), self.now)
            drive = self.supervisor.decide(self.now, self.sample())
            effort = drive.effort[0] + (self.servo if drive.kind is DriveKind.POSITION else 0.0)
            self.supervisor.report_applied((effort,))
            self.drives.append(drive)
            self.applied.append(effort)
        return self.drives[-1]

    def follow(self, trajectory: Trajectory) -> str:
        return self.supervisor.accept_trajectory(trajectory, self.now, self.sample())

    def largest_jump(self, since: int = 0) -> float:
        values = self.applied[since:]
        return max(abs(after - before) for before, after in itertools.pairwise(values))


def _hold(duration: float = 0.2, position: float = 0.0) -> Trajectory:
    return from_points([0.0, duration], [position, position], [0.0, 0.0])


def test_torque_passes_from_effort_to_position_control_without_a_jump() -> None:
    loop = Loop()
    loop.run(0.1, command=4.0)
    start = len(loop.applied) - 1
    assert loop.follow(_hold()) == ""
    loop.run(0.15)
    # 4 N m fade over 100 ms: 0.04 N m in each millisecond.
    assert loop.largest_jump(start) <= 4.0 / 100 + 1e-9
    assert loop.applied[-1] == 0.0


def test_torque_passes_from_position_to_effort_control_without_a_jump() -> None:
    loop = Loop(handover_effort=math.inf)
    loop.servo = 1.7
    assert loop.follow(_hold(0.2)) == ""
    loop.run(0.25, command=-3.0)
    assert loop.supervisor.mode is Mode.EFFORT
    start = loop.drives.index(next(drive for drive in loop.drives if drive.kind is DriveKind.EFFORT)) - 1
    loop.run(0.15, command=-3.0)
    assert loop.largest_jump(start) <= 4.7 / 100 + 1e-9
    assert loop.applied[-1] == -3.0


def test_a_controller_that_dies_during_the_fade_leaves_zero_torque() -> None:
    loop = Loop()
    loop.servo = 1.7
    loop.follow(_hold(0.05))
    loop.run(0.1, command=3.0)
    assert loop.supervisor.mode is Mode.EFFORT
    drive = loop.run(0.052)
    assert drive.starved
    assert loop.applied[-1] == 0.0
    # It comes back by itself, and the fade, whose torque is long gone, does not.
    assert loop.run(0.001, command=3.0).effort[0] == 3.0


def test_commands_during_a_trajectory_wait_for_its_end() -> None:
    loop = Loop()
    loop.follow(_hold(0.1))
    loop.servo = 2.5
    loop.run(0.09, command=3.0)
    assert loop.supervisor.mode is Mode.POSITION
    loop.run(0.02, command=3.0)
    assert loop.supervisor.mode is Mode.EFFORT


def test_a_controller_for_another_place_takes_over_nothing() -> None:
    loop = Loop(handover_effort=2.0)
    loop.servo = 0.2
    loop.follow(_hold(0.1))
    loop.run(0.5, command=-4.9)
    assert loop.supervisor.mode is Mode.POSITION
    assert "lqr asks for -4.90 N m" in loop.supervisor.reason
    loop.run(0.01, command=2.1)
    assert loop.supervisor.mode is Mode.EFFORT


def test_a_command_that_answers_a_state_before_the_end_takes_over_nothing() -> None:
    loop = Loop()
    loop.follow(_hold(0.1))
    loop.run(0.099, command=3.0)
    loop.run(0.01)
    assert loop.supervisor.trajectory_finished
    assert loop.supervisor.mode is Mode.POSITION


def test_a_new_trajectory_in_the_middle_of_another_starts_at_the_pendulum() -> None:
    loop = Loop()
    loop.follow(from_points([0.0, 1.0], [0.0, 0.2], [0.0, 0.0]))
    loop.run(0.5)
    loop.position = 0.1
    assert loop.follow(_hold(1.0, 0.2)) == ""
    assert abs(loop.run(0.001).position[0] - 0.1) < 1e-3


def test_the_gap_to_a_trajectory_is_closed_no_faster_than_a_ramp() -> None:
    loop = Loop(velocity=0.35)
    assert loop.follow(_hold(0.01, 0.29)) == ""
    loop.position = 0.1
    loop.run(1.2)
    positions = [drive.position[0] for drive in loop.drives]
    assert max(abs(b - a) for a, b in itertools.pairwise(positions)) <= 0.3e-3 + 1e-9
    assert positions[-1] == 0.29


def test_a_goal_of_one_point_is_a_move_from_here_as_it_is_to_a_joint_trajectory_controller() -> None:
    loop = Loop(velocity=2.0)
    goal = from_points([4.0], [math.pi], [0.0])
    assert loop.follow(goal) == ""
    assert loop.drives == []
    loop.run(0.001)
    assert abs(loop.drives[-1].position[0]) < 1e-3
    assert "rad/s" in Loop(velocity=1.0).follow(goal)
    assert "trajectory covers" in Loop(position_max=(3.0,), position_min=(-3.0,)).follow(goal)


def test_a_goal_nearby_takes_the_time_that_it_was_given() -> None:
    """0.25 rad in 8 s were there after 1 s, and began with the velocity of a ramp at once."""
    loop = Loop()
    assert loop.follow(from_points([8.0], [0.25], [0.0])) == ""
    loop.run(0.5)
    assert all(abs(drive.velocity[0]) < 0.05 for drive in loop.drives)
    assert loop.drives[-1].position[0] == pytest.approx(0.5 * 0.25 * (1.0 - math.cos(math.pi * 0.5 / 8.0)), abs=1e-3)


def test_a_gap_counts_for_the_speed_limit() -> None:
    loop = Loop(velocity=0.2)
    assert "rad/s" in loop.follow(_hold(1.0, 0.29))


def test_a_trajectory_waits_while_the_plant_was_stopped() -> None:
    loop = Loop(feedback_timeout=math.inf)
    loop.follow(from_points([0.0, 10.0], [0.0, 3.0], [0.0, 0.0]))
    before = loop.run(0.2).position[0]
    loop.now += 5 * NANOSECONDS
    assert abs(loop.run(0.001).position[0] - before) < 0.04
    loop.now -= 5 * NANOSECONDS
    assert abs(loop.run(0.001).position[0] - before) < 0.04
    assert loop.supervisor.mode is Mode.POSITION


def test_a_trajectory_that_comes_after_a_pause_starts_at_once() -> None:
    loop = Loop(feedback_timeout=math.inf)
    loop.run(0.01)
    loop.now += 5 * NANOSECONDS
    loop.follow(from_points([0.0, 1.0], [0.0, 0.2], [0.0, 0.0]))
    assert loop.run(0.5).position[0] > 0.09


def test_a_trajectory_is_refused_on_a_stale_measurement() -> None:
    loop = Loop()
    stale = JointSample.of_one(loop.now - NANOSECONDS, 0.0, 0.0)
    assert "ms old" in loop.supervisor.accept_trajectory(_hold(), loop.now, stale)


def test_arming_needs_a_fresh_measurement_and_a_command_near_zero() -> None:
    supervisor = PlantSupervisor(PlantLimits(effort=(5.0,), feedback_timeout=0.03))
    now = _START_NS
    fresh = JointSample.of_one(now, 0.0, 0.0)
    assert supervisor.arm(now, None) == "no measurement"
    assert "ms old" in supervisor.arm(now, JointSample.of_one(now - NANOSECONDS, 0.0, 0.0))
    assert "ahead" in supervisor.arm(now, JointSample.of_one(now + NANOSECONDS, 0.0, 0.0))
    assert "not finite" in supervisor.arm(now, JointSample.of_one(now, math.nan, 0.0))
    supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(now, 3.0, "lqr"), now)
    refusal = supervisor.arm(now, fresh)
    assert "lqr already commands 3.000 N m" in refusal
    # In this order it can be armed.
    steps = [refusal.index(step) for step in ("deactivate", ", arm", "joint_trajectory", "then activate")]
    assert steps == sorted(steps)
    supervisor.set_commander_conflict("two of them")
    assert supervisor.arm(now, fresh) == "two of them"
    supervisor.set_commander_conflict("")
    assert supervisor.arm(now + 60 * _MS, JointSample.of_one(now + 60 * _MS, 0.0, 0.0)) == ""


def test_preflight_can_refuse_arming() -> None:
    supervisor = PlantSupervisor(PlantLimits(effort=(5.0,)), preflight=lambda: "strategy not confirmed")
    assert supervisor.arm(_START_NS, JointSample.of_one(_START_NS, 0.0, 0.0)) == "strategy not confirmed"
    assert supervisor.mode is Mode.DISARMED


def test_the_first_torque_after_arming_again_keeps_the_slew_limit() -> None:
    loop = Loop(slew=10.0)
    loop.run(0.01, command=1.0)
    loop.supervisor.disarm(loop.now)
    loop.now += 10 * NANOSECONDS
    assert loop.supervisor.arm(loop.now, loop.sample()) == ""
    assert abs(loop.run(0.001, command=5.0).effort[0]) <= 10.0 * 0.001 + 1e-12


def test_an_applied_torque_that_is_no_number_starts_no_fade() -> None:
    loop = Loop()
    loop.run(0.01, command=1.0)
    loop.supervisor.report_applied((math.nan,))
    loop.follow(_hold())
    assert loop.run(0.001).effort[0] == 0.0


def test_a_push_acts_in_every_mode_and_stays_finite() -> None:
    loop = Loop()
    supervisor = loop.supervisor
    for enter in (
        lambda: None,
        lambda: loop.follow(_hold(10.0)),
        lambda: supervisor.fault("x", loop.now),
        lambda: supervisor.e_stop(loop.now),
        lambda: supervisor.e_stop_reset(loop.now),
    ):
        enter()
        loop.now += _MS
        supervisor.offer(Input.PUSH, JointCommand.of_one(loop.now, 0.7, "hand"), loop.now)
        drive = supervisor.decide(loop.now, loop.sample())
        assert drive.push[0] == 0.7
        assert drive.effort[0] == 0.0
    loop.now += _MS
    supervisor.offer(Input.PUSH, JointCommand.of_one(loop.now, 1e308, "hand"), loop.now)
    assert supervisor.decide(loop.now, loop.sample()).push[0] == PUSH_LIMIT_FACTOR * 5.0


def test_twins_get_no_torque_until_one_is_gone() -> None:
    loop = Loop()
    loop.run(0.01, command=1.0)
    loop.supervisor.set_commander_conflict("2 commanders named /lqr")
    assert loop.run(0.01, command=1.0).starved
    assert loop.supervisor.reason == "2 commanders named /lqr"
    loop.supervisor.set_commander_conflict("")
    assert loop.run(0.001, command=1.0).effort[0] == 1.0


def test_leaving_the_trajectory_is_a_fault() -> None:
    loop = Loop()
    loop.follow(_hold(1.0))
    loop.position = 0.31
    assert loop.run(0.001).kind is DriveKind.OFF
    assert loop.supervisor.mode is Mode.FAULT
    assert "expected at most 0.3 rad" in loop.supervisor.reason


def test_two_huge_torques_of_opposite_sign_stay_finite() -> None:
    loop = Loop()
    for kind, torque in ((Input.EFFORT_COMMAND, 1.7e308), (Input.DISTURBANCE, 1.7e308)):
        loop.supervisor.offer(kind, JointCommand.of_one(loop.now, torque, "x"), loop.now)
    drive = loop.supervisor.decide(loop.now, loop.sample())
    assert drive.effort[0] == 5.0
    assert drive.saturated


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(
            (name, math.nan)
            for name in sorted({field.name for field in dataclasses.fields(PlantLimits)} - {"coordinates"})
        ),
        *((name, -1.0) for name in ("effort", "command_timeout", "velocity", "slew", "handover_time", "arm_effort")),
        ("effort", math.inf),
        ("effort", 0.0),
        ("command_timeout", math.inf),
        ("handover_time", math.inf),
        ("tracking_error", 0.0),
    ],
)
def test_limits_that_limit_nothing_or_everything_are_refused(name: str, value: float) -> None:
    several = name in {"effort", "push", "position_min", "position_max"}
    with pytest.raises(ParameterError, match="expected"):
        PlantLimits(**{"effort": (5.0,), name: (value,) if several else value})
