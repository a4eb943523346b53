"""Bridge, supervisor and emulated machine of several joints in simulated time: refusals, and what ends torque."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge.backends.emulated_machine import DrivePort, JointPort
from pendulum_hw_bridge.bridge.assembly import assemble, for_plant
from pendulum_hw_bridge.bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.drive.derating import Derating
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.nodes.bridge_node import BridgeNode
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_msgs_py.contract.commands import Refusal
from pendulum_msgs_py.contract.supervisor import Input, Mode, PlantSupervisor
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.contract.values import JointCommand, JointSample, Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, write_plant

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
LATEST = 0.06
"""Time within which each fault ends all torque, as with one module [s]."""


class Machine:
    """A plant of several joints behind the bridge, as the node puts it together, and a controller that may answer."""

    def __init__(self, plant: str = "cart_pole", *, upright: float = 0.02, **given: Any) -> None:
        specs = for_plant(SPECS, plant)
        parameters = load_mechanism(plant)
        goal = [value + upright for value in parameters.coordinates.goal]
        values = {spec.name: spec.default for spec in specs} | {"plant": plant, "initial_positions": goal} | given
        assembly = assemble(values, specs)
        self.clock = SteppedClock(SECOND)
        self.coordinates = assembly.coordinates
        self.supervisor = PlantSupervisor(assembly.limits, coordinates=assembly.coordinates)
        self.bridge = Bridge(assembly.modules(self.clock), self.supervisor)
        port = self.bridge.modules[0].port
        assert isinstance(port, JointPort)
        self.emulated = port.machine
        self.controller = make_controller("lqr", parameters, 1.0 / values["feedback_rate"])
        self.answering = False
        self.source = "lqr"
        self.outcomes: list[Outcome] = []
        self.bridge.connect()
        self.cycles(2)

    def cycles(self, count: int) -> None:
        """Let periods pass; between them what ends torque is carried out, as in the actuator's loop."""
        for _ in range(count):
            sample = self.bridge.observe(0.005)
            if sample is not None and self.answering:
                self.answer(sample, self.controller.efforts(0.0, sample.position, sample.velocity))
            self.outcomes.append(self.bridge.act())
            self.supervisor.report_applied(self.outcomes[-1].effort)

    def answer(self, sample: JointSample, effort: Vector, joints: tuple[str, ...] | None = None) -> Refusal | None:
        names = self.coordinates.driven_names if joints is None else joints
        command = JointCommand(sample.stamp_ns, effort, self.source, names)
        return self.supervisor.offer(Input.EFFORT_COMMAND, command, self.clock.now_ns())

    def arm(self) -> str:
        return self.bridge.prepare() or self.supervisor.arm(self.clock.now_ns(), self.bridge.sample)

    def driving(self) -> bool:
        return any(self.emulated.state[2])

    def time_to_rest(self) -> float:
        """Return the time until no drive makes torque [s]: the lag of a current loop leaves less than a thousandth."""
        begin = self.clock.now_ns()
        while any(abs(effort) > 1e-3 for effort in self.emulated.state[2]):
            self.cycles(1)
            self.clock.wait_until(self.clock.now_ns() + MILLISECOND // 2)
            self.emulated.advance_to(self.clock.now_ns(), wholly=True)
            assert self.clock.now_ns() - begin < SECOND
        return (self.clock.now_ns() - begin) / SECOND


def held(plant: str = "cart_pole", **given: Any) -> Machine:
    machine = Machine(plant, **given)
    assert machine.arm() == ""
    machine.answering = True
    machine.cycles(40)
    assert machine.supervisor.mode is Mode.EFFORT, machine.supervisor.reason
    return machine


# --- it works -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "plant", ["cart_pole", "acrobot_frictionless", "pendubot_frictionless", "double_pendulum", "furuta", "qube_servo"]
)
def test_the_lqr_of_the_simulated_plant_holds_the_emulated_machine_upright(plant: str) -> None:
    machine = held(plant, upright=0.005)
    machine.cycles(600)
    assert machine.supervisor.mode is Mode.EFFORT, machine.supervisor.reason
    assert machine.bridge.faults == {}
    deviation = machine.coordinates.deviation(machine.emulated.state[0])
    assert max(map(abs, deviation)) < 0.03
    limits = machine.supervisor.limits.effort
    assert all(abs(e) <= limit for o in machine.outcomes for e, limit in zip(o.effort, limits, strict=True))


@pytest.mark.parametrize("plant", ["cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta", "qube_servo"])
def test_nothing_moves_before_somebody_arms(plant: str) -> None:
    machine = Machine(plant)
    machine.cycles(20)
    assert machine.supervisor.mode is Mode.DISARMED
    assert not machine.driving()
    assert {drive.on for drive in machine.emulated.drives} == {False}


@pytest.mark.parametrize(("key", "value"), [("transport_delay", 0.02), ("time_constant", 0.05)])
def test_a_machine_whose_drives_have_a_delay_or_a_lag_raises_no_false_alarm(
    key: str, value: float, tmp_path: Path
) -> None:
    slow = load_mechanism("cart_pole")
    slow = slow.with_values({f"{name}.{key}": value for name in slow.coordinates.driven_names})
    machine = held(str(write_plant(tmp_path / "slow.yaml", slow)), upright=0.02)
    machine.cycles(200)
    assert machine.bridge.faults == {}
    assert machine.driving()


@pytest.mark.parametrize("plant", ["cart_pole", "double_pendulum"])
def test_a_machine_that_moves_while_it_is_off_shows_no_fault_and_can_be_armed(plant: str) -> None:
    machine = Machine(plant, upright=0.3)
    machine.emulated.hold_push(0, 0.5, machine.clock.now_ns())
    for _ in range(200):
        machine.cycles(1)
        assert [module.monitor.present for module in machine.bridge.modules] == [None, None]
    assert min(map(abs, machine.emulated.state[1])) > 0.05
    assert machine.arm() == ""


# --- refusals -----------------------------------------------------------------------------------------------------

WRONG = [
    (("elbow", "shoulder"), (1.0, 2.0), Refusal.OTHER_JOINT),
    (("shoulder", "knee"), (1.0, 2.0), Refusal.OTHER_JOINT),
    (("elbow", "elbow"), (1.0, 2.0), Refusal.OTHER_JOINT),
    (("elbow",), (1.0,), Refusal.NOT_ONE_JOINT),
    (("shoulder", "elbow"), (1.0,), Refusal.NOT_ONE_JOINT),
    ((), (1.0, 2.0), Refusal.NOT_ONE_JOINT),
    (("shoulder", "elbow"), (1.0, math.nan), Refusal.NOT_FINITE),
    (("shoulder", "elbow"), (math.inf, 0.0), Refusal.NOT_FINITE),
]


@pytest.mark.parametrize(("joints", "effort", "reason"), WRONG)
def test_torques_for_swapped_missing_foreign_or_repeated_joints_and_nan_in_one_drive_nothing(
    joints: tuple[str, ...], effort: Vector, reason: Refusal
) -> None:
    machine = Machine("double_pendulum", upright=0.0)
    assert machine.arm() == ""
    for _ in range(20):
        machine.cycles(1)
        assert machine.bridge.sample is not None
        assert machine.answer(machine.bridge.sample, effort, joints) is reason
    assert machine.supervisor.mode is Mode.EFFORT
    assert not machine.driving()


def test_a_second_commander_is_refused_while_the_first_goes_on() -> None:
    machine = held()
    before = machine.outcomes[-1].drive.controller
    assert machine.bridge.sample is not None
    machine.source = "stranger"
    machine.clock.wait_until(machine.clock.now_ns() + 1)
    assert machine.answer(machine.bridge.sample, (2.0,)) is Refusal.SECOND_COMMANDER
    assert machine.bridge.act().drive.controller == before


def test_a_passive_joint_takes_no_torque_under_its_name() -> None:
    machine = held("acrobot_frictionless")
    assert machine.bridge.sample is not None
    assert machine.answer(machine.bridge.sample, (1.0, 1.0), ("shoulder", "elbow")) is Refusal.NOT_ONE_JOINT
    assert machine.answer(machine.bridge.sample, (1.0,), ("shoulder",)) is Refusal.OTHER_JOINT


def test_a_trajectory_is_refused_by_a_machine_that_cannot_be_moved_by_one() -> None:
    machine = held()
    sample = machine.bridge.sample
    assert sample is not None
    refusal = machine.supervisor.accept_trajectory(thesis_ramp(0.0, 1.0), machine.clock.now_ns(), sample)
    assert refusal == (
        "plant has cart, pole and follows no trajectory; one that does has one joint alone; expected effort_command"
    )
    assert machine.supervisor.mode is Mode.EFFORT


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"backend": "hebi"}, "joint 'cart' slides, and a module of backend 'hebi' turns"),
        ({"backend": "replay"}, "backend 'replay' has one module, and plant 'cart_pole' has the joints cart, pole"),
        ({"backend": "emulator_process"}, "backend 'emulator_process' has one module"),
        ({"serial": "X-1"}, "serial is 'X-1', which is for one module"),
        ({"serials": ["X-1"]}, "serials is ['X-1'], which is for backend 'hebi'"),
        ({"joint_sign": -1}, "joint_sign is -1, which is for one module"),
        ({"effort_strategy": "effort_loop"}, "effort_strategy is 'effort_loop', which is for one module"),
        ({"initial_positions": [0.0, 0.0, 0.0]}, "expected 2, for cart [m], pole [rad], or one for all"),
        ({"position_window": [-1.0, 1.0]}, "position_window has 2 values; expected 4"),
        ({"effort_limit": 11.0}, "effort_limit is 11.0 N; expected at most 10.0 N, the limit of the plant file"),
    ],
)
def test_parameters_that_do_not_fit_the_joints_are_refused_in_a_sentence(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as refused:
        Machine(**given)
    assert sentence in str(refused.value)


@pytest.mark.parametrize(
    ("plant", "changes", "sentence"),
    [
        (
            "cart_pole",
            {"cart.transport_delay": 5.0},
            "transport_delay of plant 'cart_pole' is 5 s; expected at most 0.1 s",
        ),
        ("cart_pole", {"cart.time_constant": 1.0}, "time_constant of plant 'cart_pole' is 1 s; expected at most 0.1 s"),
        (
            "double_pendulum",
            {"elbow.transport_delay": 0.02},
            "transport_delay is 0.0 s and 0.02 s on plant 'double_pendulum'; expected the same for all actuators",
        ),
    ],
)
def test_drives_that_cannot_be_watched_or_differ_in_their_delay_are_refused(
    plant: str, changes: dict[str, float], sentence: str, tmp_path: Path
) -> None:
    file = tmp_path / "plant.yaml"
    write_plant(file, load_mechanism(plant).with_values(changes), provenance={})
    with pytest.raises(ParameterError, match=re.escape(sentence)):
        Machine(str(file))


def test_limits_of_a_motor_in_volts_reach_the_drive_in_volts_and_pushes_in_newton_metres() -> None:
    machine = Machine("qube_servo", effort_limit=5.0)
    assert machine.emulated.drives[0].limit * machine.emulated.constants[0].supply_voltage == pytest.approx(5.0)
    assert machine.bridge.sample is not None
    push = JointCommand(machine.bridge.sample.stamp_ns, (1e3,), "hand", ("arm",))
    assert machine.supervisor.offer(Input.PUSH, push, machine.clock.now_ns()) is None
    machine.cycles(1)
    # Ten times the effort of 10 V at standstill.
    assert machine.outcomes[-1].drive.push[0] == pytest.approx(0.5)


def test_a_geared_motor_in_volts_that_is_reversed_at_speed_is_no_fault(tmp_path: Path) -> None:
    geared = load_mechanism("qube_servo").with_values({"arm.gear_ratio": 14.0})
    machine = Machine(
        str(write_plant(tmp_path / "geared.yaml", geared)), upright=0.0, start_effort_limit=0.0, effort_limit=6.0
    )
    assert machine.arm() == ""
    fastest = strongest = 0.0
    for volts in 60 * [6.0] + 10 * [-6.0]:
        machine.cycles(1)
        assert machine.bridge.sample is not None
        machine.answer(machine.bridge.sample, (volts,))
        fastest, strongest = (
            max(a, abs(b[0])) for a, b in zip((fastest, strongest), machine.emulated.state[1:], strict=True)
        )
    assert machine.bridge.faults == {}, machine.supervisor.reason
    assert machine.supervisor.mode is Mode.EFFORT
    assert fastest > 4.0
    # More than that of 6 V at standstill, by the back EMF.
    assert strongest > 1.5 * 6.0 * geared.gains[0]


def test_positions_of_several_joints_are_refused_for_one() -> None:
    values = {spec.name: spec.default for spec in SPECS} | {"initial_positions": [0.0, 1.0]}
    with pytest.raises(ParameterError, match="initial_positions is for several joints"):
        assemble(values, SPECS)


# --- faults -------------------------------------------------------------------------------------------------------

FAULTS = [
    (ActuatorFault.FEEDBACK_LOST, "feedback_lost"),
    (ActuatorFault.POSITION_NAN, "feedback_not_finite"),
    (ActuatorFault.VELOCITY_NAN, "feedback_not_finite"),
    (ActuatorFault.POSITION_JUMP, "position_jump"),
    (ActuatorFault.M_STOP, "m_stop"),
]


@pytest.mark.parametrize("plant", ["cart_pole", "double_pendulum"])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(("fault", "name"), FAULTS)
def test_a_fault_of_any_joint_ends_all_torque_in_time_and_is_reported_by_its_name(
    plant: str, joint: int, fault: ActuatorFault, name: str
) -> None:
    machine = held(plant)
    assert machine.driving()
    machine.emulated.faults[joint].add(fault)
    assert machine.time_to_rest() < LATEST
    machine.cycles(20)
    assert machine.supervisor.mode is Mode.FAULT
    assert machine.supervisor.reason.startswith(f"{name}: {machine.coordinates.names[joint]}: ")
    assert not any(drive.on for drive in machine.emulated.drives)
    # It does not come back by itself.
    machine.emulated.faults[joint].clear()
    machine.cycles(50)
    assert not any(drive.on for drive in machine.emulated.drives)


def test_faults_of_a_cart_are_reported_in_metres_and_newtons() -> None:
    machine = held()
    machine.emulated.faults[0].add(ActuatorFault.VELOCITY_NAN)
    machine.cycles(20)
    assert "cart: velocity reads nan m/s" in machine.supervisor.reason
    refusal = Machine(measured_effort_limit=1e-9).arm()
    assert re.search(r"cart: measured force is \S+ N; expected at most 1e-09 N$", refusal)


def test_an_effort_for_a_cart_that_is_no_number_is_refused_in_newtons() -> None:
    machine = held()
    sample = machine.bridge.sample
    assert sample is not None
    machine.answer(sample._replace(stamp_ns=machine.clock.now_ns()), (math.nan,))
    problem = machine.supervisor.gates[Input.EFFORT_COMMAND].problems[Refusal.NOT_FINITE]
    assert problem == "effort is nan N; expected a finite number"


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(
    ("fault", "name"),
    [(ActuatorFault.SEND_FAILED, "send_failed"), (ActuatorFault.COMMANDS_LOST, "command_not_in_force")],
)
def test_a_drive_that_hears_nothing_stops_by_itself_and_the_other_is_switched_off(
    joint: int, fault: ActuatorFault, name: str
) -> None:
    machine = held("double_pendulum")
    machine.emulated.faults[joint].add(fault)
    machine.time_to_rest()
    machine.cycles(50)
    assert machine.bridge.faults[name] == 1
    assert machine.supervisor.mode is Mode.FAULT
    assert not machine.emulated.drives[1 - joint].on
    assert machine.emulated.drives[joint].expiries == 1
    assert machine.bridge.stop_pending
    assert machine.arm() == "the module has not confirmed that it is off"
    machine.emulated.faults[joint].clear()
    machine.cycles(100)
    assert {machine.bridge.stop_pending} == {False}
    assert not machine.emulated.drives[joint].on


def test_a_machine_that_nobody_read_for_a_minute_stands_still_meanwhile_and_an_armed_bridge_calls_it_a_stall() -> None:
    machine = held()
    before = machine.emulated.state[0]
    machine.clock.wait_until(machine.clock.now_ns() + 60 * SECOND)
    machine.bridge.observe(0.0)
    assert machine.bridge.faults == {"host_stalled": 1}
    assert machine.supervisor.reason.startswith("host_stalled: bridge did not run for 600")
    assert not machine.driving()
    assert machine.emulated.stood_still == pytest.approx(59.0, abs=0.01)
    # The second that is caught up with begins where the machine was: a pole that is 0.02 rad off falls in it, once.
    assert machine.emulated.state[0] != before
    assert abs(machine.emulated.state[0][0] - before[0]) < 2.0


def test_a_bridge_that_dies_leaves_torque_for_the_lifetime_of_its_last_command() -> None:
    machine = held()
    assert machine.driving()
    now = machine.clock.now_ns()
    machine.emulated.advance_to(now + 45 * MILLISECOND, wholly=True)
    assert machine.driving()
    machine.emulated.advance_to(now + 65 * MILLISECOND, wholly=True)
    assert max(map(abs, machine.emulated.state[2])) < 1e-3


def test_a_disturbance_that_is_frozen_or_killed_loses_its_share_and_the_controller_goes_on() -> None:
    machine = held("double_pendulum")
    sample = machine.bridge.sample
    assert sample is not None
    noise = JointCommand(machine.clock.now_ns(), (2.0,), "disturbance", ("shoulder",))
    assert machine.supervisor.offer(Input.DISTURBANCE, noise, machine.clock.now_ns()) is None
    machine.cycles(2)
    assert machine.outcomes[-1].drive.disturbance == (2.0, 0.0)
    machine.cycles(round(0.06 * machine.emulated.rate))
    assert machine.outcomes[-1].drive.disturbance == (0.0, 0.0)
    assert machine.outcomes[-1].drive.controller != (0.0, 0.0)
    assert machine.supervisor.mode is Mode.EFFORT


def test_without_a_controller_the_torque_is_zero_and_comes_back_with_it() -> None:
    machine = held()
    machine.answering = False
    machine.cycles(30)
    assert machine.outcomes[-1].drive.starved
    assert machine.outcomes[-1].effort == (0.0,)
    assert max(map(abs, machine.emulated.state[2])) < 1e-3
    machine.answering = True
    machine.cycles(2)
    assert machine.supervisor.mode is Mode.EFFORT
    after: Outcome = machine.outcomes[-1]
    assert {after.drive.starved} == {False}
    assert after.effort != (0.0,)


@pytest.mark.parametrize("hot", [0, 1])
def test_a_hot_drive_gets_less_torque_and_the_others_all_of_theirs(hot: int) -> None:
    machine = held("double_pendulum")
    machine.emulated.drives[hot].temperature = 112.5
    machine.cycles(1)
    node: Any = SimpleNamespace(
        _bridge=machine.bridge, _supervisor=machine.supervisor, _derating=Derating(105.0, 120.0)
    )
    drive = machine.outcomes[-1].drive._replace(effort=(6.0, -6.0))
    left = BridgeNode._derated(node, drive).effort
    assert left[hot] == pytest.approx((3.0, -3.0)[hot], abs=0.05)
    assert left[1 - hot] == (6.0, -6.0)[1 - hot]


def test_a_drive_that_is_too_hot_releases_all() -> None:
    machine = held("double_pendulum")
    machine.emulated.drives[1].temperature = 121.0
    machine.cycles(2)
    assert machine.supervisor.reason.startswith("over_temperature: elbow: winding is at 121 degC")
    assert not any(drive.on for drive in machine.emulated.drives)


def test_a_drive_whose_torque_does_not_follow_is_found() -> None:
    machine = held("double_pendulum")
    stuck = machine.emulated.drives[1]
    stuck.on = False  # a drive that has switched itself off says nothing
    machine.answering = False
    for _ in range(20):
        sample = machine.bridge.observe(0.005)
        assert sample is not None
        machine.answer(sample, (0.0, 1.5))
        machine.bridge.act()
    assert machine.supervisor.mode is Mode.FAULT
    assert "elbow: " in machine.supervisor.reason
    assert not machine.emulated.drives[0].on


def test_the_e_stop_and_the_end_of_the_bridge_switch_all_drives_off() -> None:
    for end in ("e_stop", "close"):
        machine = held("double_pendulum")
        if end == "e_stop":
            machine.supervisor.e_stop(machine.clock.now_ns())
            machine.bridge.act()
        else:
            machine.bridge.close()
        assert not any(drive.on for drive in machine.emulated.drives)
        assert all(d.port.strategy is Strategy.OFF for d in machine.bridge.drives if isinstance(d.port, DrivePort))
