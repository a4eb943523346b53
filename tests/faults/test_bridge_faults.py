"""Every fault that the bridge must survive, through its node and loop, on the emulated actuator in simulated time."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial

import pytest
from builtin_interfaces.msg import Duration
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.nodes.bridge_node import BridgeNode
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_msgs_py.errors import ParameterError
from tests.tools.faults.bridge_rig import MILLISECOND, Rig
from tests.tools.faults.bridge_scenarios import CASES, SCENARIOS, Case, Scenario, run_scenario
from tests.tools.faults.node_rig import NodeRig, ros_of_its_own


def _tries() -> Iterator[tuple[Scenario, Case]]:
    """Yield each fault in two of the cases in which it can come, in turn."""
    for index, scenario in enumerate(SCENARIOS):
        cases = [case for case in CASES if case.phase in scenario.phases]
        for step in range(2 if scenario.own_torque or not scenario.zero else 1):
            yield scenario, cases[(index + 2 * step) % len(cases)]


@pytest.fixture(scope="module", autouse=True)
def ros() -> Iterator[None]:
    with reserve_domain() as domain, ros_of_its_own(domain):
        yield


# ``make faults`` tries each in every strategy and phase, twenty times.
@pytest.mark.parametrize(("scenario", "case"), list(_tries()), ids=lambda part: part.name.replace(" ", "_"))
def test_fault_is_named_and_ends_torque_in_time(scenario: Scenario, case: Case) -> None:
    reaction = run_scenario(scenario, case, 1)
    assert reaction.complaints(scenario) == []


def test_every_fault_of_the_emulated_actuator_is_tried() -> None:
    begun: set[ActuatorFault] = set()

    class Noted:
        def inject(self, fault: ActuatorFault) -> None:
            begun.add(fault)

    class Probe:
        actuator = Noted()

    for scenario in SCENARIOS:
        if scenario.begin.__qualname__.startswith("_inject"):
            scenario.begin(Probe())  # type: ignore[arg-type]  # of the rig, only the actuator is asked
    assert begun == set(ActuatorFault)


def test_without_a_fault_regulation_goes_on_and_no_check_raises_a_false_alarm() -> None:
    rig = Rig(seed=5)
    rig.run(0.05)
    before_the_first_answer = rig.supervisor.starved_periods
    assert before_the_first_answer <= 2
    rig.run(20.0)
    assert rig.supervisor.mode.value == "armed_effort"
    assert not rig.bridge.faults
    assert rig.supervisor.starved_periods == before_the_first_answer


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0])
def test_no_false_alarm_at_any_rate(rate: float) -> None:
    rig = Rig(seed=6, rate=rate)
    rig.run(2.0)
    assert not rig.bridge.faults
    assert rig.supervisor.mode.value == "armed_effort"


@pytest.mark.parametrize("kind", list(EffortStrategy), ids=lambda kind: kind.value)
def test_a_controller_that_ends_at_the_limit_is_no_fault_of_the_output(kind: EffortStrategy) -> None:
    for seed in range(1000, 1006):
        rig = Rig(seed, kind=kind, effort_limit=3.0)
        rig.run(0.8)
        rig.controlling = rig.disturbing = False
        rig.run(0.3)
        assert not rig.bridge.faults
        assert rig.supervisor.mode is Mode.EFFORT


def test_what_a_commander_asks_for_counts_when_it_wants_to_take_over_from_a_hold_and_not_what_the_limit_leaves() -> (
    None
):
    rig = Rig(moving=True, effort_limit=1.0, start=0.0, goal=0.1)
    rig.run(1.5)
    assert rig.supervisor.trajectory_finished
    rig.controlling = True
    rig.send = lambda answer: rig._send(JointCommand.of_one(answer.stamp_ns, 100.0, "controller for upright"))
    rig.run(0.5)
    assert rig.supervisor.mode is Mode.POSITION
    assert "asks for 100.00 N m" in rig.supervisor.reason


@pytest.mark.parametrize("speed", [0.06, 0.2])
def test_a_stuck_encoder_is_found_by_the_time_the_link_has_turned_by_two_degrees(speed: float) -> None:
    rig = Rig(start=0.5)
    rig.disturbing = False
    rig.send = lambda answer: rig._send(JointCommand.of_one(answer.stamp_ns, 0.0, "controller"))
    rig.actuator.hand = lambda time, position, velocity: 100.0 * (speed - velocity) + 1.678 * math.sin(position)
    rig.run(1.0)
    begin = rig.actuator.link.position
    rig.actuator.inject(ActuatorFault.POSITION_FROZEN)
    rig.run(1.0)
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.bridge.last_fault == "motion_disagreement"
    fault_ns = rig.supervisor.transitions[-1][0]
    trace = zip(rig.duties, rig.positions, strict=True)
    turned = next(position for (time, _, _), position in trace if time >= fault_ns) - begin
    assert turned < 0.02


def test_an_encoder_that_is_stuck_at_rest_drives_nothing_and_is_found_when_the_link_moves() -> None:
    rig = Rig(start=0.0)
    rig.disturbing = False
    rig.send = lambda answer: rig._send(JointCommand.of_one(answer.stamp_ns, 0.0, "controller"))
    rig.run(0.5)
    rig.actuator.inject(ActuatorFault.POSITION_FROZEN)
    rig.run(1.0)
    assert rig.supervisor.mode is Mode.EFFORT
    assert not any(duty for _, duty, _ in rig.duties)
    rig.actuator.hand = lambda time, position, velocity: 1.0
    rig.run(0.3)
    assert rig.bridge.last_fault == "motion_disagreement"


@pytest.mark.parametrize(
    ("early_ns", "mode"), [(1_000_000, Mode.EFFORT), (-1_000_000, Mode.POSITION), (3600 * 10**9, Mode.EFFORT)]
)
def test_a_trajectory_that_waited_while_the_plant_armed_is_refused(early_ns: int, mode: Mode) -> None:
    with NodeRig(start=0.0) as rig:
        rig.controlling = rig.disturbing = False
        interface = rig.node._interface
        move = JointTrajectory(joint_names=[names.JOINT])
        move.points = [JointTrajectoryPoint(positions=[0.0], time_from_start=Duration(sec=1))]
        # It arrives by the system clock, and the plant is armed by the steady one.
        armed_ns = time.time_ns() - (time.monotonic_ns() - round(interface._armed_at))
        interface._on_trajectory(serialize_message(move), armed_ns - early_ns)
        rig.run(0.1)
        assert rig.supervisor.mode is mode
        assert interface.refused_trajectories.total() == (mode is Mode.EFFORT)


def test_the_same_seed_gives_the_same_reaction_bit_by_bit() -> None:
    first, second = Rig(seed=9), Rig(seed=9)
    for rig in (first, second):
        rig.run(1.0)
    assert first.duties == second.duties


def test_a_node_with_parameters_that_are_wrong_together_does_not_come_up() -> None:
    values = {"clock": "lockstep", "autostart": False, "command_lifetime": 0.019}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    with pytest.raises(ParameterError, match=r"command_lifetime is 0.019 s; expected at least two periods"):
        BridgeNode(lambda: None, parameter_overrides=overrides, enable_rosout=False)


def _ask_for_nothing_beside_13_newton_metres(rig: NodeRig) -> None:
    sample = rig.bridge.sample
    assert sample is not None
    rig.disturb(JointCommand.of_one(sample.stamp_ns, 13.0, "disturbance"))
    rig._send(JointCommand.of_one(sample.stamp_ns, 0.0, "controller"))


def test_a_disturbance_that_waits_for_a_commander_moves_nothing() -> None:
    with NodeRig(start=0.0) as rig:
        rig.controlling = rig.disturbing = False
        rig.run(0.1)
        rig.loop.answer = partial(_ask_for_nothing_beside_13_newton_metres, rig)
        rig.run(0.3)
        assert rig.supervisor.mode is Mode.EFFORT
        assert "the disturbance for 13.00 N m; expected a sum of at most 2.0 N m" in rig.supervisor.reason
        assert max(abs(duty) for _, duty, _ in rig.duties) < 0.05


def test_a_disturbance_that_waits_for_a_hand_over_moves_nothing() -> None:
    with NodeRig(start=0.0, moving=True, goal=0.1) as rig:
        rig.run(1.0)
        assert rig.supervisor.trajectory_finished
        rig.loop.answer = partial(_ask_for_nothing_beside_13_newton_metres, rig)
        rig.run(0.3)
        assert rig.supervisor.mode is Mode.POSITION
        assert "controller asks for 0.00 N m and the disturbance for 13.00 N m" in rig.supervisor.reason


def test_where_the_check_of_feedback_is_blind_the_rules_behind_it_end_torque_one_period_later() -> None:
    with NodeRig() as rig:
        rig.run(0.5)
        rig.module.monitor.silence = lambda now_ns: None  # type: ignore[method-assign]
        rig.actuator.inject(ActuatorFault.FEEDBACK_LOST)
        rig.run(0.2)
        sample = rig.bridge.sample
        assert sample is not None
        ended_ns, mode, reason = rig.supervisor.transitions[-1]
        assert mode is Mode.FAULT
        assert "measurement is" in reason
        # Three periods are the check's own; the loop looks every 5 ms.
        assert 40 * MILLISECOND < ended_ns - sample.stamp_ns <= 50 * MILLISECOND
        # Longer than a duty acts after the last command.
        assert all(duty == 0.0 for time_ns, duty, _ in rig.duties if time_ns > ended_ns + MILLISECOND)
