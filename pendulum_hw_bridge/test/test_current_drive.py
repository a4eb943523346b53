"""Drives with a current loop: the setpoints that leave the bridge, and the check that the torque follows them."""

from __future__ import annotations

import math

import pytest

from pendulum_hw_bridge.bridge.assembly import for_plant
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.drive.current_drive import CurrentCheck, CurrentMapping, VoltageMapping
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import Command, Strategy
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.joints import Joint
from pendulum_testing.feedback_records import feedback_record

MOTOR = MotorState(24.0)
SLIDE = Joint("cart", unit="m", turns=False)


def mapping(*, late: int = 0) -> CurrentMapping:
    drive = QuasiDirectDrive().constants(Joint("elbow"), 6.0)
    return CurrentMapping(EffortStrategy.EFFORT_LOOP, drive, gains=DEFAULT_GAINS[3], effort_limit=2.0, late=late)


@pytest.mark.parametrize(("asked", "sent"), [(1.5, 1.5), (9.0, 2.0), (-9.0, -2.0), (math.inf, 2.0)])
def test_a_torque_is_its_own_setpoint_within_the_limit(asked: float, sent: float) -> None:
    assert mapping().bounded(mapping().command(asked, MOTOR), MOTOR).effort == sent


def test_nothing_but_an_effort_leaves_the_bridge() -> None:
    bounded = mapping().bounded(Command(1.0, 2.0, 0.5, 0.25), MOTOR)
    assert bounded.effort == 0.5
    assert all(map(math.isnan, (bounded.position, bounded.velocity, bounded.pwm)))
    assert math.isnan(mapping().bounded(Command(), MOTOR).effort)
    assert mapping().strategy is Strategy.PARALLEL_PWM
    assert mapping().limited_gains(24.0) is DEFAULT_GAINS[3]
    assert mapping().largest_effort(9.0) == mapping().effort_limit


@pytest.mark.parametrize("supply", [12.0, 24.0])
def test_a_voltage_is_a_duty_of_the_supply_as_measured(supply: float) -> None:
    drive, motor = QuasiDirectDrive().constants(Joint("elbow"), 6.0), MotorState(supply)
    volts = VoltageMapping(EffortStrategy.DIRECT_PWM, drive)
    assert volts.command(6.0, motor).pwm == 6.0 / supply
    assert volts.effort_of(volts.command(6.0, motor), motor, math.nan) == pytest.approx(6.0)
    assert volts.effort_of(Command(), motor, 0.5) == 0.0


def faults(check: CurrentCheck, *pairs: tuple[float, float]) -> list[str]:
    seen = []
    for number, (measured, commanded) in enumerate(pairs):
        fault = check.check(
            feedback_record(number, number, effort=measured), Strategy.PARALLEL_PWM, [Command(effort=commanded)]
        )
        seen.append("" if fault is None else fault.name)
    return seen


def test_an_effort_that_is_not_the_commanded_one_is_a_fault_in_its_third_record() -> None:
    assert faults(CurrentCheck(mapping()), *3 * [(1.0, 0.0)]) == ["", "", "output_disagreement"]
    assert faults(CurrentCheck(mapping()), *3 * [(0.0, math.nan)]) == ["", "", ""]
    assert faults(CurrentCheck(mapping()), *3 * [(1.0, math.nan)]) == ["", "", "output_disagreement"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_effort_within_a_tenth_of_the_limit_is_the_commanded_one(sign: float) -> None:
    assert faults(CurrentCheck(mapping()), *4 * [(sign * 1.2, sign)]) == 4 * [""]
    assert faults(CurrentCheck(mapping()), *4 * [(sign * 0.8, sign)])[2:] == ["", ""]
    assert faults(CurrentCheck(mapping()), *4 * [(sign * 1.21, sign)])[2:] == 2 * ["output_disagreement"]


def test_an_effort_on_its_way_from_the_setpoint_before_is_no_fault_and_from_an_older_one_is() -> None:
    commanded = [1.5, -1.5] * 4
    assert faults(CurrentCheck(mapping()), *zip([0.0, *commanded], commanded, strict=False)) == 8 * [""]
    older = faults(CurrentCheck(mapping()), *4 * [(0.0, 0.0)], *3 * [(0.0, 1.5)])
    assert older == 7 * [""]
    assert faults(CurrentCheck(mapping()), *4 * [(0.0, 1.5)]) == ["", "", "", "output_disagreement"]


@pytest.mark.parametrize("measured", [1.6, 0.0, -1.6])
def test_an_effort_between_two_setpoints_that_may_be_in_force_is_no_fault(measured: float) -> None:
    check = CurrentCheck(mapping())
    both = [Command(effort=-1.5), Command(effort=1.5)]
    records = [feedback_record(number, number, effort=measured) for number in range(4)]
    assert [check.check(record, Strategy.PARALLEL_PWM, both) for record in records] == 4 * [None]


def test_a_drive_with_a_delay_may_follow_so_many_records_later_also_after_another_strategy() -> None:
    check = CurrentCheck(mapping(late=2))
    for _ in range(2):
        assert faults(check, *5 * [(0.0, 1.5)]) == 5 * [""]
        assert faults(check, (0.0, 1.5)) == ["output_disagreement"]
        check.reset()
    faults(check, (1.5, 1.5))
    check.reset()
    assert faults(check, *3 * [(1.5, 0.0)])[2:] == ["output_disagreement"]


def test_a_record_alone_accuses_nobody_and_another_strategy_begins_anew() -> None:
    check = CurrentCheck(mapping())
    assert faults(check, (1.9, 0.0), (0.0, 0.0), (1.9, 0.0), (0.0, 0.0)) == 4 * [""]
    check.reset()
    assert faults(check, (1.9, 0.0), (1.9, 0.0)) == ["", ""]


@pytest.mark.parametrize(("joint", "limit"), [(Joint("elbow"), 6.0), (SLIDE, 10.0), (Joint("arm"), 0.1)])
def test_the_constants_give_the_effort_limit_at_the_peak_current(joint: Joint, limit: float) -> None:
    own = QuasiDirectDrive()
    drive = own.constants(joint, limit)
    assert own.peak_current * drive.torque_constant * drive.gear_ratio == pytest.approx(limit)
    assert drive.gear_ratio == pytest.approx(6.0 if joint.turns else 300.0)


def test_an_encoder_before_the_gears_is_finer_than_one_at_the_joint() -> None:
    own = QuasiDirectDrive()
    assert own.step(Joint("elbow"), driven=False) == pytest.approx(2.0 * math.pi / 16384)
    assert own.step(Joint("elbow"), driven=True) == pytest.approx(2.0 * math.pi / 16384 / 6.0)
    assert own.step(SLIDE, driven=True) == pytest.approx(2.0 * math.pi / 16384 / 6.0 * 0.02)


def test_the_defaults_of_the_bridge_fit_the_joints_of_the_plant_and_stay_those_of_an_x5_for_one() -> None:
    assert for_plant(SPECS, "thesis") == SPECS
    defaults = {spec.name: spec.default for spec in for_plant(SPECS, "cart_pole")}
    assert defaults["position_window"] == [-1.8, 1.8, 0.0, 0.0]
    assert (defaults["velocity_limit"], defaults["feedback_rate"]) == (30.0, 500.0)
    assert defaults["start_effort_limit"] == 2.0
