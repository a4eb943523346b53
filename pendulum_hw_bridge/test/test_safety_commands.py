"""What a feedback record must show of the commands that were sent: setpoints, torque of the motor, winding current."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.drive.safety import SafetyMonitor
from pendulum_hw_bridge.port.actuator import Command, Strategy
from pendulum_hw_bridge.port.gains import GainSet, PidGains
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.watched_monitor import DRIVETRAIN, LIMITS, MILLISECOND, PERIOD, STEP, Watched

# --- what the module acts on -----------------------------------------------------------------------------------


def settled(watched: Watched, strategy: Strategy, acts: dict[str, float], **setpoints: float) -> None:
    """Drive until the setpoints are settled, each record showing what the module acts on."""
    watched.see(**acts)
    for _ in range(6):
        watched.tell(strategy, **setpoints)
        assert not watched.see(**acts)


SHOWN = [
    (Strategy.DIRECT_PWM, "pwm", "pwm_command", 2.0**-10),
    (Strategy.PARALLEL_PWM, "effort", "effort_command", 2.0**-9),
    (Strategy.PARALLEL_PWM, "position", "position_command", 2.0**-9),
]


@pytest.mark.parametrize(("strategy", "sent", "shown", "tolerance"), SHOWN, ids=str)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_second_record_of_another_setpoint_is_a_fault_if_it_lasts(
    strategy: Strategy, sent: str, shown: str, tolerance: float, sign: float
) -> None:
    nothing = {"position_command": math.nan, "effort_command": math.nan}
    watched = Watched()
    settled(watched, strategy, {**nothing, shown: 0.25}, **{sent: 0.25})

    def see(difference: float, after_ns: int = STEP) -> str:
        watched.tell(strategy, **{sent: 0.25})
        return watched.see(after_ns, **{**nothing, shown: 0.25 + sign * difference})

    for _ in range(3):
        assert not see(tolerance)
    # One record may come before its command.
    assert not see(1.01 * tolerance)
    assert not see(0.0)
    # Two that come in a heap show one packet.
    assert not see(1.01 * tolerance)
    assert not see(1.01 * tolerance, 8 * MILLISECOND - 1)
    assert see(1.01 * tolerance, 1) == "command_not_in_force"
    assert not see(0.0)
    assert not see(1.01 * tolerance)
    assert see(1.01 * tolerance, 8 * MILLISECOND) == "command_not_in_force"


def test_a_strategy_has_the_timeout_to_come_into_force_and_a_changed_one_again() -> None:
    watched = Watched()
    watched.see()
    # Before anything was sent nothing is wrong.
    assert not any(watched.see(pwm_command=0.5) for _ in range(5))
    for strategy, setpoint in ((Strategy.DIRECT_PWM, "pwm"), (Strategy.PARALLEL_PWM, "effort")):
        watched.tell(strategy, **{setpoint: 0.25})
        wrong = {"pwm_command": 0.1, "effort_command": 0.1}
        assert [watched.see(**wrong) for _ in range(5)] == ["", "", "", "", "command_not_in_force"]


def test_after_a_stop_nothing_is_compared_any_more() -> None:
    watched = Watched()
    settled(watched, Strategy.DIRECT_PWM, {"pwm_command": 0.25}, pwm=0.25)
    watched.tell(pwm=0.25)
    assert not watched.see(pwm_command=0.0)
    watched.monitor.stopped()
    assert not any(watched.see(pwm_command=0.5) for _ in range(5))
    # The wrong record before the stop is none of the new drive's.
    watched.tell(pwm=0.25)
    wrong = [watched.see(pwm_command=0.5) for _ in range(5)]
    assert wrong == ["", "", "", "", "command_not_in_force"]


def test_no_duty_is_shown_as_zero_and_a_loop_that_is_off_as_zero_or_as_no_number() -> None:
    watched = Watched()
    settled(watched, Strategy.DIRECT_PWM, {"pwm_command": 0.0}, pwm=math.nan)
    for shown in (0.0, math.nan):
        settled(Watched(), Strategy.PARALLEL_PWM, {"effort_command": shown}, effort=math.nan)
    watched = Watched()
    settled(watched, Strategy.PARALLEL_PWM, {"effort_command": 0.0}, effort=math.nan)
    watched.tell(Strategy.PARALLEL_PWM)
    assert not watched.see(effort_command=1e-6)
    assert watched.see(effort_command=1e-6) == "command_not_in_force"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_near_its_speed_limit_the_firmware_may_take_the_duty_back_but_never_up_or_round(sign: float) -> None:
    drivetrain = replace(DRIVETRAIN, gear_ratio=1000.0)
    fast = 0.9 * 25_000.0 * 2.0 * math.pi / 60.0 / 1000.0

    def faults(shown: float, velocity: float, known: bool = True) -> list[str]:
        watched = Watched(drivetrain if known else None, position_jump=10.0)
        settled(watched, Strategy.DIRECT_PWM, {"pwm_command": sign * 0.25}, pwm=sign * 0.25)
        given = {"pwm_command": sign * shown, "velocity": velocity}
        answers = []
        for _ in range(2):
            watched.tell(pwm=sign * 0.25)
            answers.append(watched.see(**given))
        return answers

    wrong = ["", "command_not_in_force"]
    for turning in (1.0, -1.0):
        assert faults(0.1, turning * 1.001 * fast) == ["", ""]
        assert faults(0.0, turning * 1.001 * fast) == ["", ""]
        assert faults(0.26, turning * 1.001 * fast) == wrong
        assert faults(-0.01, turning * 1.001 * fast) == wrong
        assert faults(0.1, turning * fast) == wrong
        assert faults(0.1, turning * 1.001 * fast, known=False) == wrong


def test_under_strategy_3_no_setpoint_is_taken_back_near_the_speed_limit() -> None:
    watched = Watched(replace(DRIVETRAIN, gear_ratio=1000.0), position_jump=10.0)
    settled(watched, Strategy.PARALLEL_PWM, {"effort_command": 0.25, "position_command": math.nan}, effort=0.25)
    answers = []
    for _ in range(2):
        watched.tell(Strategy.PARALLEL_PWM, effort=0.25)
        answers.append(watched.see(effort_command=0.1, position_command=math.nan, velocity=3.0))
    assert answers == ["", "command_not_in_force"]


def test_while_a_setpoint_changes_a_record_may_show_either() -> None:
    fast = {"velocity": 3.0}
    for before, after, shown in ((0.25, 0.5, {"pwm_command": 0.25}), (0.25, -0.25, {"pwm_command": 0.1, **fast})):
        watched = Watched(replace(DRIVETRAIN, gear_ratio=1000.0), position_jump=10.0)
        settled(watched, Strategy.DIRECT_PWM, {"pwm_command": before}, pwm=before)
        for _ in range(3):
            watched.tell(pwm=before)
            watched.now_ns += STEP
            watched.tell(pwm=after)
            assert not watched.see(0, **shown)


def test_under_strategy_3_the_newest_command_tells_which_loop_counts() -> None:
    watched = Watched()
    settled(watched, Strategy.PARALLEL_PWM, {"effort_command": 0.25, "position_command": math.nan}, effort=0.25)
    for _ in range(3):
        watched.tell(Strategy.PARALLEL_PWM, effort=0.25)
        watched.now_ns += STEP
        watched.tell(Strategy.PARALLEL_PWM, position=0.5)
        assert not watched.see(0, position_command=0.5, effort_command=0.75)


@pytest.mark.parametrize(
    ("late", "has_clock"), [(0, True), (12 * MILLISECOND, True), (25 * MILLISECOND, True), (0, False)]
)
def test_a_record_that_a_busy_host_reads_late_is_compared_with_what_had_been_sent_when_it_was_measured(
    late: int, has_clock: bool
) -> None:
    """Commands go on while records wait; what the module acts on is the newest that it had."""
    watched, begin, told = Watched(), 1_000_000_000, 0

    def see(count: int, waits: int, wrong: float = 0.0) -> str:
        nonlocal told
        measured = begin + count * STEP
        # The command that answers record n leaves half a millisecond after it was measured.
        while begin + told * STEP + MILLISECOND // 2 <= measured + waits:
            watched.monitor.note_sent(
                Command(pwm=0.01 * told), Strategy.DIRECT_PWM, begin + told * STEP + MILLISECOND // 2
            )
            told += 1
        record = feedback_record(measured, count, effort=1e-9 * count, pwm_command=0.01 * (count - 1) + wrong)
        # By a clock of the module's own, or by none.
        own = measured - 500_000_000 if has_clock else 0
        fault = watched.monitor.check(record._replace(stamp_ns=measured + waits, hardware_ns=own))
        return "" if fault is None else fault.name

    assert not any(see(count, 0) for count in range(1, 10))
    assert not any(see(count, late) for count in range(10, 30))
    # The rule is as strict as it was: a setpoint that was never sent is a fault after as many records.
    assert [see(count, late, wrong=0.5) for count in range(30, 32)] == ["", "command_not_in_force"]


def test_setpoints_that_a_stalled_host_sent_late_had_not_arrived_before_they_had_left() -> None:
    monitor = SafetyMonitor(LIMITS, PERIOD)
    now = 1_000_000_000
    monitor.left(now)  # nothing was sent
    monitor.note_sent(Command(pwm=1.0), Strategy.DIRECT_PWM, now)
    monitor.note_sent(Command(pwm=2.0), Strategy.DIRECT_PWM, now + STEP)
    monitor.left(now + 3 * STEP)
    before, after = now + 3 * STEP - MILLISECOND, now + 3 * STEP + MILLISECOND
    assert [command.pwm for command in monitor._in_force(before)] == [1.0, 2.0]
    assert [command.pwm for command in monitor._in_force(after)] == [2.0, 2.0]


def test_a_record_may_show_the_newest_command_that_arrived_and_those_around_it() -> None:
    monitor = SafetyMonitor(LIMITS, PERIOD)
    now = 1_000_000_000
    window = round(1.2 * STEP) + MILLISECOND

    def shown(*ages: int) -> list[float]:
        monitor.stopped()
        for age in ages:
            monitor.note_sent(Command(pwm=float(age)), Strategy.DIRECT_PWM, now - age)
        return [command.pwm for command in monitor._in_force(now)]

    assert shown(window + 1) == [window + 1]
    assert shown(2 * window, window + 1, MILLISECOND) == [MILLISECOND, MILLISECOND]
    assert shown(2 * window, window + 1, MILLISECOND - 1) == [window + 1, MILLISECOND - 1]
    assert shown(2 * window, window) == [window, window]
    assert shown(2 * window, 0) == [2 * window, 0]
    assert shown(2 * window, -1) == [2 * window]
    # None has arrived: the newest is what comes.
    assert shown(-5, -3, -1) == [-1]
    # Those of another strategy are no setpoints of this one.
    shown(window)
    monitor.note_sent(Command(effort=1.0), Strategy.PARALLEL_PWM, now - window)
    assert [command.effort for command in monitor._in_force(now)] == [1.0, 1.0]


def test_as_many_commands_are_remembered_as_the_way_back_may_take() -> None:
    monitor = SafetyMonitor(LIMITS, PERIOD)
    for number in range(20):
        monitor.note_sent(Command(pwm=float(number)), Strategy.DIRECT_PWM, number)
    assert [command.pwm for command in monitor._in_force(19)] == list(range(4, 20))


# --- torque of the motor ---------------------------------------------------------------------------------------


def test_the_torque_of_the_motor_is_watched_from_the_second_period_of_a_strategy_on() -> None:
    watched = Watched(pwm_tolerance=2.0)
    watched.monitor.output = OutputCheck(EffortMapping(EffortStrategy.DIRECT_PWM, DRIVETRAIN, effort_limit=1e-3))

    def told(strategy: Strategy = Strategy.DIRECT_PWM) -> list[str]:
        watched.tell(strategy)
        return [watched.see(pwm_command=0.9, effort_command=math.nan) for _ in range(3)]

    watched.see()
    assert not any(watched.see(pwm_command=0.9) for _ in range(5))
    assert told() == ["", "", "motor_effort"]
    assert told() == ["motor_effort"] * 3
    # Another strategy or a stop begins to count anew.
    assert told(Strategy.PARALLEL_PWM) == ["", "", "motor_effort"]
    watched.monitor.stopped()
    assert not any(watched.see(pwm_command=0.9) for _ in range(5))
    assert told(Strategy.PARALLEL_PWM) == ["", "", "motor_effort"]


@pytest.mark.parametrize("late", [True, False])
def test_a_setpoint_that_the_record_reports_as_late_explains_a_constant_duty_and_no_other_does(late: bool) -> None:
    watched = Watched()
    gains = GainSet(3, PidGains(kp=1.0), PidGains(), PidGains())
    watched.monitor.output = OutputCheck(EffortMapping(EffortStrategy.DIRECT_PWM, DRIVETRAIN, gains=gains))
    held = {"position_command": 0.0, "velocity_command": 0.0, "effort_command": math.nan, "pwm_command": 0.0}
    settled(watched, Strategy.PARALLEL_PWM, held, position=0.0, velocity=0.0)
    faults = []
    for number in range(1, 5):
        sent = number * 2.0**-11
        watched.tell(Strategy.PARALLEL_PWM, position=sent, velocity=0.0)
        # The late record reports a setpoint that was sent; the other one a position near it that was not.
        faults.append(watched.see(**{**held, "position_command": 0.0 if late else sent - 2e-5}))
    assert faults == (["", "", "", ""] if late else ["", *["output_disagreement"] * 3])


# --- winding current -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_third_winding_current_that_does_not_fit_duty_and_speed_is_a_fault(sign: float) -> None:
    watched = Watched(DRIVETRAIN, winding_current=0.25)

    def see(current: float, duty: float = 0.0, **given: float) -> str:
        return watched.see(pwm_command=sign * duty, winding_current=sign * current, voltage=32.0, **given)

    assert [see(9.0), see(9.0)] == ["", ""]
    # After a stop it begins to count anew.
    watched.monitor.stopped()
    assert [see(9.0), see(9.0), see(9.0)] == ["", "", "winding_current"]
    for current in (0.25, -0.25):
        assert not any(see(current) for _ in range(5))
    assert not see(4.0, 0.5)
    assert [see(0.26), see(0.26), see(4.0, 0.5)] == ["", "", ""]
    for current in (0.26, -0.26, math.nan):
        assert [see(current), see(current), see(current), see(4.0, 0.5)] == ["", "", "winding_current", ""]
    # Half the duty of 32 V on 4 ohm: 4 A, of which a fifth may be an error of the resistance.
    assert not any(see(current, 0.5) for current in (5.0, 5.0, 5.0, 3.0, 3.0, 3.0))
    assert [see(5.1, 0.5) for _ in range(3)] == ["", "", "winding_current"]
    assert [see(2.9, 0.5) for _ in range(3)] == ["winding_current"] * 3
    # A motor at 8 rad/s, 4 at the output: 4 V, one ampere less.
    assert not any(see(3.0, 0.5, motor_velocity=sign * 8.0) for _ in range(3))
    assert [see(4.0, 0.5, motor_velocity=sign * 8.0) for _ in range(3)] == ["", "", "winding_current"]


@pytest.mark.parametrize(("duty", "third"), [(0.0390625, "winding_current"), (0.0391, ""), (-0.0391, "")])
def test_a_record_that_asks_for_next_to_no_current_excuses_no_wrong_one(duty: float, third: str) -> None:
    watched = Watched(DRIVETRAIN, winding_current=0.25)

    def see(current: float, after: float = 0.0) -> str:
        return watched.see(pwm_command=after, winding_current=current, voltage=32.0)

    # Up to 0.3125 A, a record without any current could not be told from a good one.
    assert [see(0.5), see(8.0 * duty, duty), see(0.5), see(8.0 * duty, duty), see(0.5)] == ["", "", "", "", third]


@pytest.mark.parametrize(("pause_ns", "third"), [(500 * MILLISECOND, "winding_current"), (500 * MILLISECOND + 1, "")])
def test_wrong_currents_count_together_for_half_a_second(pause_ns: int, third: str) -> None:
    watched = Watched(DRIVETRAIN, winding_current=0.25)
    wrong = {"pwm_command": 0.0, "winding_current": 0.5, "voltage": 32.0}
    assert not watched.see(**wrong)
    assert not watched.see(STEP, **wrong)
    assert watched.see(pause_ns - STEP, **wrong) == third
    # What counts anew counts from here.
    assert not third or not watched.see(pwm_command=0.5, winding_current=4.0, voltage=32.0)
    assert [watched.see(**wrong) for _ in range(2)] == ["", "winding_current" if not third else ""]


@pytest.mark.parametrize(
    ("drivetrain", "limit", "duty"), [(None, 0.25, 0.5), (DRIVETRAIN, 0.0, 0.5), (DRIVETRAIN, 0.25, math.nan)]
)
def test_without_constants_limit_or_duty_the_winding_current_is_not_judged(
    drivetrain: SeriesElasticParameters | None, limit: float, duty: float
) -> None:
    watched = Watched(drivetrain, winding_current=limit)
    assert not any(watched.see(pwm_command=duty, winding_current=50.0) for _ in range(5))


def test_wrong_currents_count_from_none_on_whatever_the_clock() -> None:
    watched = Watched(DRIVETRAIN, winding_current=0.25)
    watched.now_ns = 0
    faults = [watched.see(pwm_command=0.5, winding_current=9.0, voltage=32.0) for _ in range(3)]
    assert faults == ["", "", "winding_current"]


def test_a_warm_winding_takes_less_current() -> None:
    drivetrain = replace(DRIVETRAIN, resistance_temperature_coefficient=0.0625)
    watched = Watched(drivetrain, winding_current=0.25)
    # 36 degC doubles the resistance.
    assert not any(watched.see(pwm_command=0.5, winding_current=2.25, winding_temperature=36.0) for _ in range(3))
    faults = [watched.see(pwm_command=0.5, winding_current=4.5, winding_temperature=36.0) for _ in range(3)]
    assert faults == ["", "", "winding_current"]
