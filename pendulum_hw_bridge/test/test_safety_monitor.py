"""Each check of a feedback record by itself, at its limit: the last value believed, and the first that is not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.port.actuator import CommandLock, LimitState, TemperatureState
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.watched_monitor import DRIVETRAIN, MILLISECOND, PERIOD, STEP, TIMEOUT, Watched

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
