"""Each check of a feedback record at its limit: the last value that is believed, and the first that is not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from pendulum_hw_bridge.actuator import Command, CommandLock, LimitState, Strategy, TemperatureState
from pendulum_hw_bridge.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.fault_table import FAULTS
from pendulum_hw_bridge.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.output_check import OutputCheck
from pendulum_hw_bridge.safety import SafetyLimits, SafetyMonitor
from pendulum_msgs_py.plants.plant_parameters import SeriesElasticParameters
from tests.feedback_records import feedback_record

PERIOD = 2.0**-6
"""Feedback period of which every multiple is exact, in seconds as in nanoseconds [s]."""
STEP = 15_625_000
TIMEOUT = 3 * STEP
MILLISECOND = 1_000_000
LIMITS = SafetyLimits(
    winding_current=0.0, position_disagreement=10.0, pwm_tolerance=2.0**-10, command_tolerance=2.0**-9
)
DRIVETRAIN = SeriesElasticParameters(
    gear_ratio=2.0,
    torque_constant=1.0,
    back_emf_constant=0.5,
    winding_resistance=4.0,
    resistance_temperature_coefficient=0.0,
)


class Watched:
    """A monitor and the records that it is shown, each a period after the one before and a little different."""

    def __init__(self, drivetrain: SeriesElasticParameters | None = None, **limits: Any) -> None:
        self.monitor = SafetyMonitor(replace(LIMITS, **limits), PERIOD, drivetrain)
        self.now_ns = 1_000_000_000
        self.count = 0

    def see(self, after_ns: int = STEP, **given: Any) -> str:
        """Show one more record; return the name of its fault, or an empty string."""
        self.now_ns += after_ns
        self.count += 1
        fault = self.monitor.check(feedback_record(self.now_ns, self.count, **{"effort": 1e-9 * self.count, **given}))
        assert self.monitor.present is fault
        assert fault is None or fault.name in FAULTS
        return "" if fault is None else fault.name

    def tell(self, strategy: Strategy = Strategy.DIRECT_PWM, **setpoints: float) -> None:
        """Tell what is sent at the time of the newest record."""
        self.monitor.told(Command(**setpoints), strategy, self.now_ns)


# --- new, old, silent ------------------------------------------------------------------------------------------


def test_a_record_is_new_if_number_and_time_of_measurement_both_moved() -> None:
    watched = Watched()
    assert watched.monitor.is_new(feedback_record(5, 1))
    assert not watched.see(0)
    for stamp, number in ((watched.now_ns, 2), (watched.now_ns + 1, 1), (watched.now_ns, 1)):
        assert not watched.monitor.is_new(feedback_record(stamp, number))
    assert watched.monitor.is_new(feedback_record(watched.now_ns + 1, 2))


def test_the_age_is_that_of_the_newest_new_record_and_infinite_before_the_first() -> None:
    watched = Watched()
    assert watched.monitor.age(5) == math.inf
    assert watched.monitor.silence(10 * TIMEOUT) is None
    watched.monitor.is_new(feedback_record(TIMEOUT, 1))
    watched.monitor.check(feedback_record(TIMEOUT, 1))
    assert watched.monitor.age(3 * TIMEOUT) == 6 * PERIOD
    assert not watched.monitor.is_new(feedback_record(2 * TIMEOUT, 1))
    assert watched.monitor.age(3 * TIMEOUT) == 6 * PERIOD


def test_silence_is_a_fault_beyond_the_timeout_and_named_by_whether_the_same_record_comes_again() -> None:
    monitor = Watched().monitor
    assert monitor.timeout == 3 * PERIOD
    first = feedback_record(STEP, 1)
    assert monitor.is_new(first)
    monitor.check(first)
    assert monitor.silence(STEP + TIMEOUT) is None
    fault = monitor.silence(STEP + TIMEOUT + 1)
    assert fault is not None
    assert fault.name == "feedback_lost"
    for _ in range(2):
        assert not monitor.is_new(first)
    assert monitor.silence(STEP + TIMEOUT) is None
    fault = monitor.silence(STEP + TIMEOUT + 1)
    assert fault is not None
    assert fault.name == "feedback_frozen"
    assert "the same record has come 2 times" in fault.message
    assert monitor.is_new(feedback_record(2 * STEP, 2))
    fault = monitor.silence(2 * STEP + TIMEOUT + 1)
    assert fault is not None
    assert fault.name == "feedback_lost"


@pytest.mark.parametrize("name", ["position", "velocity", "effort"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_a_fault_and_the_record_after_it_is_judged_by_itself(name: str, value: float) -> None:
    watched = Watched()
    assert not watched.see()
    assert watched.see(**{name: value}) == "feedback_not_finite"
    assert not watched.see()


# --- time of measurement ---------------------------------------------------------------------------------------


def test_a_clock_that_goes_back_is_a_restart_and_the_new_clock_is_believed_from_then_on() -> None:
    watched = Watched()
    assert not watched.see(hardware_ns=50 * STEP)
    assert not watched.see(hardware_ns=50 * STEP)
    assert watched.see(hardware_ns=50 * STEP - 1) == "module_restarted"
    assert watched.see(hardware_ns=STEP) == "module_restarted"
    # By the old clock's offset it would be late for ever.
    assert not watched.see(hardware_ns=2 * STEP)


@pytest.mark.parametrize(("extra_ns", "fault"), [(0, ""), (1, "feedback_late")])
def test_a_record_is_late_beyond_the_timeout_after_the_fastest_way(extra_ns: int, fault: str) -> None:
    watched = Watched()
    for delay in (5 * MILLISECOND, 2 * MILLISECOND, 3 * MILLISECOND):
        assert not watched.see(hardware_ns=watched.now_ns + STEP - delay)
    # The reference follows by 1562 ns a record: clocks that part by 100 ppm stay in step.
    delay = 2 * MILLISECOND + 2 * 1562 + TIMEOUT + extra_ns
    assert watched.see(10 * STEP, hardware_ns=watched.now_ns + 10 * STEP - delay) == fault


def test_a_module_that_does_not_tell_its_time_yet_gives_no_reference() -> None:
    watched = Watched()
    assert not watched.see(hardware_ns=0)
    assert not watched.see(10 * TIMEOUT, hardware_ns=1)
    assert watched.see(2 * TIMEOUT, hardware_ns=2) == "feedback_late"


# --- one value at a time ---------------------------------------------------------------------------------------


SENSED = ("position", "velocity", "effort", "motor_position", "motor_velocity", "deflection", "winding_current")


def test_the_fourth_record_that_measures_the_same_is_frozen_and_any_quantity_that_moves_shows_life() -> None:
    watched = Watched()
    for _ in range(2):
        faults = [watched.see(effort=0.0) for _ in range(4)]
        assert faults == ["", "", "", "feedback_frozen"]
        assert not watched.see(effort=0.5)
    for name in SENSED:
        for number in range(6):
            assert not watched.see(**{"effort": 0.0, name: 1e-12 * number})


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"m_stop": True}, "m_stop"),
        ({"temperature_state": TemperatureState.CRITICAL}, "over_temperature"),
        ({"temperature_state": 77}, "over_temperature"),
        ({"winding_temperature": 120.0}, ""),
        ({"winding_temperature": 120.1}, "over_temperature"),
        ({"winding_temperature": math.inf}, "over_temperature"),
        ({"winding_temperature": math.nan}, ""),
        ({"lock": CommandLock.LOCKED_BY_OTHER}, "locked_by_other"),
        ({"lock": CommandLock.LOCKED_BY_SENDER}, ""),
        ({"voltage": 22.0}, ""),
        ({"voltage": 21.9}, "voltage"),
        ({"voltage": 50.0}, ""),
        ({"voltage": 50.1}, "voltage"),
        ({"voltage": math.nan}, "voltage"),
        ({"position_limit": LimitState.BELOW}, "firmware_limit"),
        ({"velocity_limit": LimitState.ABOVE}, "firmware_limit"),
        ({"effort_limit": LimitState.BELOW}, "firmware_limit"),
        ({"effort_limit": LimitState.AT_UPPER}, ""),
        ({"effort": 14.0}, ""),
        ({"effort": 14.1}, "effort_measured"),
        ({"effort": -14.1}, "effort_measured"),
    ],
    ids=str,
)
def test_a_state_is_believed_up_to_its_limit(given: dict[str, Any], fault: str) -> None:
    assert Watched().see(**given) == fault


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_the_third_unknown_winding_temperature_in_a_row_is_a_fault(value: float) -> None:
    watched = Watched()
    assert not watched.see(winding_temperature=value)
    assert not watched.see(winding_temperature=value)
    assert not watched.see()
    faults = [watched.see(winding_temperature=value) for _ in range(4)]
    assert faults == ["", "", "over_temperature", "over_temperature"]


@pytest.mark.parametrize("voltage", [31.0, 49.0])
def test_the_second_record_of_a_supply_that_stepped_by_more_than_15_percent_is_a_fault(voltage: float) -> None:
    watched = Watched()
    assert not watched.see(voltage=40.0)
    assert not watched.see(voltage=voltage)
    assert not watched.see(voltage=40.0)
    assert not watched.see(voltage=voltage)
    assert watched.see(voltage=voltage) == "voltage"


def test_a_step_of_the_supply_by_15_percent_is_none() -> None:
    watched = Watched()
    assert not watched.see(voltage=40.0)
    assert not watched.see(voltage=46.0)
    assert not watched.see(voltage=50.0)
    assert watched.see(voltage=50.0) == "voltage"


def test_a_supply_that_sags_or_rises_slowly_is_no_fault() -> None:
    watched = Watched()
    for number in range(240):
        assert not watched.see(voltage=24.0 + 0.1 * number)


# --- motion ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("jump", "fault"), [(0.125, ""), (0.126, "position_jump")])
def test_position_may_change_by_so_much_beside_the_velocity(sign: float, jump: float, fault: str) -> None:
    watched = Watched(position_jump=0.125)
    assert not watched.see(position=sign)
    assert watched.see(position=sign * (1.0 + jump)) == fault
    # Velocity 4 and 12 rad/s: 8 times the period is 0.125 rad, which is no jump.
    watched = Watched(position_jump=0.125)
    assert not watched.see(position=sign, velocity=sign * 4.0)
    assert watched.see(position=sign * (1.125 + jump), velocity=sign * 12.0) == fault


def test_after_a_pause_of_twice_the_timeout_a_position_is_no_jump() -> None:
    for pause_ns, fault in ((2 * TIMEOUT - 1, "position_jump"), (2 * TIMEOUT, "")):
        watched = Watched()
        assert not watched.see()
        assert watched.see(pause_ns, position=1.0) == fault


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("gap", "fault"), [(0.25, ""), (0.251, "motion_disagreement")])
def test_velocity_and_position_over_a_fifth_of_a_second_may_differ_by_so_much(
    sign: float, gap: float, fault: str
) -> None:
    watched = Watched(position_jump=10.0, position_disagreement=0.25)
    assert not watched.see(velocity=sign * 4.0)
    # Thirteen periods of a 64th of a second; what is further back counts no more.
    for number in range(1, 16):
        seen = watched.see(position=sign * (4.0 * number * PERIOD + gap), velocity=sign * 4.0)
        assert seen == (fault if number <= 13 else "")


def test_after_a_pause_or_a_velocity_that_is_no_number_a_motion_is_compared_anew() -> None:
    watched = Watched(position_jump=10.0, position_disagreement=0.25)
    assert not watched.see()
    assert not watched.see(2 * TIMEOUT, position=1.0)
    assert watched.see(position=1.0, velocity=math.nan) == "feedback_not_finite"
    assert not watched.see(position=2.0)
    assert watched.see(position=2.26) == "motion_disagreement"


def test_the_velocities_of_a_motion_count_with_the_time_between_their_records() -> None:
    watched = Watched(position_jump=10.0, position_disagreement=0.001)
    position, last = 0.0, 0.0
    for number in range(30):
        velocity, periods = math.sin(number), 1.0 + 0.25 * (number % 3)
        if number:
            position += 0.5 * (velocity + last) * periods * PERIOD
        assert not watched.see(round(periods * STEP), position=position, velocity=velocity)
        last = velocity


def test_motion_between_records_of_which_some_are_missing_is_not_compared() -> None:
    for after_ns, fault in ((8 * STEP // 5, "motion_disagreement"), (8 * STEP // 5 + 1, "")):
        watched = Watched(position_jump=10.0, position_disagreement=0.05)
        # It turned to and fro while nobody looked, and stands still whenever somebody does.
        found = {watched.see(after_ns, position=0.02 * number) for number in range(12)}
        assert fault in found
        assert found <= {"", fault}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_stuck_encoder_is_found_between_the_gaps(sign: float) -> None:
    watched = Watched(position_jump=10.0, position_disagreement=0.09)
    # One radian a second: after each gap of two periods comes one record that counts, of a 64th of a radian.
    found = [watched.see(STEP * (1 + number % 2), velocity=sign) for number in range(13)]
    assert found == [*([""] * 12), "motion_disagreement"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_where_records_are_missing_a_link_may_have_turned_as_fast_as_the_motor_can(sign: float) -> None:
    # 2 rad/s at the output, for the two of three periods of which nothing is known: 0.0625 rad.
    drivetrain = replace(DRIVETRAIN, gear_ratio=MOTOR_SPEED_LIMIT / 2.0)
    for position, fault in ((0.1875, ""), (0.188, "position_jump")):
        watched = Watched(drivetrain, position_jump=0.125)
        assert not watched.see()
        assert watched.see(3 * STEP, position=sign * position) == fault
    # With none missing, or of a motor that nobody knows, it has jumped.
    for motor, after_ns in ((drivetrain, 8 * STEP // 5), (None, 3 * STEP)):
        watched = Watched(motor, position_jump=0.125)
        assert not watched.see()
        assert watched.see(after_ns, position=sign * 0.126) == "position_jump"


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


def test_a_record_may_show_the_newest_command_that_arrived_and_those_around_it() -> None:
    monitor = SafetyMonitor(LIMITS, PERIOD)
    now = 1_000_000_000
    window = round(1.2 * STEP) + MILLISECOND

    def shown(*ages: int) -> list[float]:
        monitor.stopped()
        for age in ages:
            monitor.told(Command(pwm=float(age)), Strategy.DIRECT_PWM, now - age)
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
    monitor.told(Command(effort=1.0), Strategy.PARALLEL_PWM, now - window)
    assert [command.effort for command in monitor._in_force(now)] == [1.0, 1.0]


def test_as_many_commands_are_remembered_as_the_way_back_may_take() -> None:
    monitor = SafetyMonitor(LIMITS, PERIOD)
    for number in range(20):
        monitor.told(Command(pwm=float(number)), Strategy.DIRECT_PWM, number)
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
