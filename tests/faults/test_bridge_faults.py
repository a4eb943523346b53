"""Every fault that the bridge must survive, on the emulated actuator in simulated time."""

import pytest

from tests.faults.bridge_rig import SCENARIOS, Rig, Scenario, run_scenario

LARGEST_TIME_TO_ZERO_MS = 60.0


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name.replace(" ", "_"))
def test_fault_is_named_and_ends_torque_in_time(scenario: Scenario) -> None:
    for repetition in range(3):
        reaction = run_scenario(scenario, repetition)
        assert reaction.reaction == scenario.expected
        if scenario.zero:
            assert reaction.time_to_zero_ms <= LARGEST_TIME_TO_ZERO_MS
            assert reaction.stays_zero
        if not scenario.own_torque:
            assert reaction.uncommanded == 0.0


def test_at_least_25_kinds_of_fault_are_told_apart_by_name() -> None:
    assert len({scenario.name for scenario in SCENARIOS}) >= 25


def test_without_a_fault_regulation_goes_on_and_no_check_raises_a_false_alarm() -> None:
    rig = Rig(seed=5)
    rig.run(0.05)
    before_the_first_answer = rig.supervisor.starved_periods
    assert before_the_first_answer <= 2
    rig.run(60.0)
    assert rig.supervisor.mode.value == "armed_effort"
    assert not rig.bridge.faults
    assert rig.supervisor.starved_periods == before_the_first_answer


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0])
def test_no_false_alarm_at_any_rate(rate: float) -> None:
    rig = Rig(seed=6, rate=rate)
    rig.run(5.0)
    assert not rig.bridge.faults
    assert rig.supervisor.mode.value == "armed_effort"


def test_the_same_seed_gives_the_same_reaction_bit_by_bit() -> None:
    first, second = Rig(seed=9), Rig(seed=9)
    for rig in (first, second):
        rig.run(1.0)
    assert first.duties == second.duties
