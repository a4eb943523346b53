"""The judge of the live faults: what a motor did against what had rightfully been asked for."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest

from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.truth_log import truth_log
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import Command, Strategy
from pendulum_msgs_py.errors import PendulumError
from tests.tools.faults.live import EFFORT_LIMIT
from tests.tools.faults.motor import ROUNDING, Asked, Drive, ModuleTruth, Witness, beyond_asked, driving_torque
from tests.tools.faults.outcome import Outcome, demand_limit

MS = 1_000_000
LIMIT = 5.0
COMMANDS = [Asked(10 * MS * number, 1.0) for number in range(100)]
DISTURBANCES = [Asked(10 * MS * number, -2.0) for number in range(100)]


def excess(time_ms: float, torque: float, commands: list[Asked], disturbances: list[Asked]) -> float:
    return beyond_asked([Drive(round(time_ms * MS), torque)], commands, disturbances, LIMIT).torque


@pytest.mark.parametrize(
    ("torque", "beyond"), [(1.0, 0.0), (1.19, 0.0), (-2.19, 0.0), (0.0, 0.0), (5.0, 3.8), (-5.0, 2.8)]
)
def test_a_motor_may_drive_as_controller_and_disturbance_asked_and_no_further(torque: float, beyond: float) -> None:
    assert excess(500.0, torque, COMMANDS, DISTURBANCES) == pytest.approx(beyond)


def test_nothing_is_right_long_after_the_last_command_or_by_a_disturbance_alone() -> None:
    assert excess(990 + 129, 1.0, COMMANDS, []) == 0.0
    assert excess(990 + 131, 1.0, COMMANDS, []) == pytest.approx(0.8)
    assert excess(500.0, -1.0, [], DISTURBANCES) == pytest.approx(0.8)
    assert excess(500.0, 1.0, [Asked(600 * MS, 1.0)], []) == pytest.approx(0.8)
    assert excess(500.0, 0.0, [], []) == 0.0
    # A simulator's torque acts 2 ms before the command that answers its state, and no sooner.
    assert excess(500.0, 1.0, [Asked(502 * MS, 1.0)], []) == 0.0
    assert excess(500.0, 1.0, [Asked(503 * MS, 1.0)], []) == pytest.approx(0.8)


def test_the_limit_holds_whatever_was_asked_for_and_the_worst_instant_is_reported() -> None:
    commands = [Asked(500 * MS, 100.0)]
    drives = [Drive(505 * MS, 5.1), Drive(510 * MS, 7.2), Drive(515 * MS, 6.2)]
    when, torque = beyond_asked(drives, commands, [], LIMIT)
    assert when == 510 * MS
    assert torque == pytest.approx(2.0)
    assert excess(505.0, -7.2, [Asked(500 * MS, -100.0)], []) == pytest.approx(2.0)
    assert excess(505.0, -5.1, [Asked(500 * MS, -100.0)], []) == 0.0


def test_what_a_witness_did_not_hear_is_counted_and_may_have_been_anything_for_as_long() -> None:
    witness = Witness(LIMIT)
    witness.hear(Asked(1000 * MS, 1.0), 4)
    witness.hear(Asked(1010 * MS, 1.0), 5)
    # Three lives of 50 ms before the first.
    for time_ms, beyond in ((845.0, 4.7), (851.0, 0.0), (1050.0, 0.0), (1031.0 + 50.0, 3.7)):
        for sign in (1.0, -1.0):
            expected = beyond + (1.0 if beyond == 3.7 and sign < 0.0 else 0.0)
            assert excess(time_ms, sign * 4.9, sorted(witness.asked), []) == pytest.approx(expected), time_ms
    # One is lost between two.
    witness.hear(Asked(2000 * MS, 1.0), 104)
    witness.hear(Asked(2010 * MS, 1.0), 105)
    witness.hear(Asked(2030 * MS, 1.0), 107)
    assert [asked for asked in witness.asked if 2000 * MS < asked.stamp_ns < 2030 * MS] == [
        Asked(2010 * MS, 1.0),
        Asked(2010 * MS, -LIMIT),
        Asked(2010 * MS, LIMIT),
    ]


@pytest.mark.parametrize(("number", "begin_ms"), [(2, 4950), (12, 4450), (41, 3000), (61, 2000), (4000, 2000)])
def test_a_witness_excuses_as_many_lives_as_were_counted_and_three_seconds_at_most(number: int, begin_ms: int) -> None:
    witness = Witness(LIMIT)
    witness.hear(Asked(5000 * MS, 1.0), number)
    assert min(witness.asked).stamp_ns == begin_ms * MS


def test_a_witness_tells_publishers_apart_by_their_numbers() -> None:
    witness = Witness(LIMIT)
    witness.hear(Asked(5000 * MS, 1.0), 4000)
    # The new one of two under one name, and an old one whose numbers go on: neither has missed anything.
    heard = len(witness.asked)
    witness.hear(Asked(5005 * MS, 1.0), 1)
    witness.hear(Asked(5010 * MS, 1.0), 4001)
    witness.hear(Asked(5015 * MS, 1.0), 2)
    assert len(witness.asked) == heard + 3
    # Who comes anew is not taken for one who has ended at a number below.
    witness.hear(Asked(9000 * MS, 1.0), 6)
    assert min(asked.stamp_ns for asked in witness.asked if asked.stamp_ns > 6000 * MS) == 8750 * MS


def test_a_torque_beyond_the_limit_is_noted_but_for_the_rounding_of_a_module() -> None:
    for largest, measured, survived in (
        (EFFORT_LIMIT, False, True),
        (EFFORT_LIMIT + 0.001, False, False),
        (EFFORT_LIMIT + 0.9 * ROUNDING, True, True),
        (EFFORT_LIMIT + 1.1 * ROUNDING, True, False),
        (math.nan, True, False),
    ):
        outcome = Outcome()
        demand_limit(outcome, largest, measured=measured)
        assert outcome.survived is survived, largest
        assert ("N m applied; expected at most" in outcome.detail) is not survived


def test_a_motor_that_is_turned_brakes_and_drives_with_what_its_duty_makes_at_most() -> None:
    assert driving_torque(0.1, -3.0, 40.0) == 0.0
    assert driving_torque(0.1, 9.0, 40.0) == pytest.approx(4.0)
    assert driving_torque(-0.1, -3.0, 40.0) == pytest.approx(-3.0)
    assert driving_torque(0.0, 3.0, 40.0) == 0.0


def test_the_truth_of_an_emulator_is_on_file_each_millisecond_and_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    truth = ModuleTruth(path)
    assert truth.read() == []
    actuator = EmulatedX5(load_emulator("thesis"))
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=0.05)
    with truth_log(path) as actuator.trace:
        actuator.deliver(Command(pwm=0.1), 0)
        actuator.advance_to(20 * MS)
        first = truth.read()
        steps = [after.time_ns - before.time_ns for before, after in pairwise(first)]
        assert first[-1].time_ns == 20 * MS
        assert max(first[0].time_ns, *steps) <= MS
        assert all(drive.torque > 1.0 for drive in first if drive.time_ns > 3 * MS)
        actuator.advance_to(100 * MS)
    second = truth.read()
    assert second[-1] == Drive(100 * MS, 0.0)
    # The command lifetime, by the motor's own clock.
    assert max(drive.time_ns for drive in second if drive.torque != 0.0) == 50 * MS
    # A line that is still being written waits for its end.
    with path.open("a", encoding="ascii") as file:
        file.write("101000000,0.0,0.0,1.0,")
        file.flush()
        assert truth.read() == []
        file.write("0.5\n")
    assert truth.read() == [Drive(101 * MS, 1.0)]


def test_a_truth_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    expected = r"truth of the emulator .* cannot be written: No such file"
    with pytest.raises(PendulumError, match=expected), truth_log(tmp_path / "nowhere" / "truth.csv"):
        pass
