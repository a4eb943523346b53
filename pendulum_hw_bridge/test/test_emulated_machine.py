"""The emulated machine of several joints: the simulator's mechanics, its own drives, and the port of each module."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pendulum_hw_bridge.backends.emulated_machine import DrivePort, JointPort, machine_ports
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, Command, Feedback, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_testing.joint_plants import without_friction

MILLISECOND = 1_000_000
SECOND = 1_000_000_000
PRESETS = ("cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta", "qube_servo")
INSTANT = QuasiDirectDrive(current_loop=0.0, command_delay=0.0, feedback_delay=0.0)


def started(plant: str, hardware: QuasiDirectDrive | None = None, *, position: Vector | None = None) -> EmulatedMachine:
    machine = EmulatedMachine(load_mechanism(plant), hardware, position=position)
    for index in range(len(machine.drives)):
        machine.switch(index, 0, on=True)
        machine.set_lifetime(index, 5.0)
    return machine


# --- mechanics ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", ["acrobot_frictionless", "pendubot_frictionless", "double_pendulum_frictionless"])
def test_energy_stays_where_nothing_rubs_and_nobody_drives(plant: str) -> None:
    parameters = without_friction(load_mechanism(plant))
    machine = EmulatedMachine(parameters, position=(2.5, -1.0))
    begin = parameters.energy(*machine.state[:2])
    machine.advance_to(2 * SECOND, wholly=True)
    assert parameters.energy(*machine.state[:2]) == pytest.approx(begin, rel=1e-5)
    assert any(abs(velocity) > 0.1 for velocity in machine.state[1])


# --- drives ---------------------------------------------------------------------------------------------------------


def test_a_torque_comes_after_the_delay_and_with_the_lag_of_the_current_loop() -> None:
    machine = started("acrobot")
    machine.deliver(0, 3.0, 0)
    machine.advance_to(400_000, wholly=True)
    assert machine.state[2] == (0.0, 0.0)
    machine.advance_to(1_400_000, wholly=True)
    assert machine.state[2] == (0.0, pytest.approx(3.0 * (1.0 - math.exp(-1.0))))


@pytest.mark.parametrize("asked", [1e9, -1e9, 6.5])
def test_no_drive_makes_more_than_its_limit(asked: float) -> None:
    machine = started("acrobot")
    machine.deliver(0, asked, 0)
    machine.advance_to(50 * MILLISECOND, wholly=True)
    assert machine.state[2][1] == pytest.approx(math.copysign(6.0, asked))


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_a_torque_that_is_no_number_is_none(nothing: float) -> None:
    machine = started("acrobot")
    machine.deliver(0, nothing, 0)
    machine.advance_to(50 * MILLISECOND, wholly=True)
    assert machine.state[2] == (0.0, 0.0)


def test_a_torque_ends_by_itself_with_the_lifetime_of_its_command() -> None:
    machine = started("acrobot", INSTANT)
    machine.set_lifetime(0, 0.05)
    machine.deliver(0, 1.0, 0)
    machine.advance_to(50 * MILLISECOND, wholly=True)
    assert machine.state[2][1] == 1.0
    machine.advance_to(52 * MILLISECOND, wholly=True)
    assert machine.state[2][1] == 0.0
    assert machine.drives[0].expiries == 1


def test_a_motor_in_volts_takes_a_duty_and_brakes_by_its_back_emf_only_while_it_is_on() -> None:
    machine = started("qube_servo", INSTANT)
    machine.deliver(0, 5.0 / 24.0, 0)
    machine.advance_to(300 * MILLISECOND, wholly=True)
    speed, torque = machine.state[1][0], machine.state[2][0]
    assert speed > 1.0
    assert torque == pytest.approx(0.005 * 5.0 - 0.042**2 / 8.4 * speed, rel=1e-3)
    record = machine.feedback(0, SECOND)
    assert record is not None
    assert record.pwm_command == pytest.approx(5.0 / 24.0)
    machine.deliver(0, 1.0, 300 * MILLISECOND)
    machine.advance_to(302 * MILLISECOND, wholly=True)
    # 24 V are asked for, the amplifier gives 10.
    assert machine.state[2][0] < 0.005 * 10.0
    machine.switch(0, 302 * MILLISECOND, on=False)
    machine.advance_to(310 * MILLISECOND, wholly=True)
    assert abs(machine.state[1][0]) > 1.0
    assert machine.state[2] == (pytest.approx(0.0, abs=1e-9), 0.0)


def test_a_motor_that_is_off_does_not_brake() -> None:
    lossless = load_mechanism("qube_servo").with_values({"arm.damping": 0.0, "pendulum.damping": 0.0})
    losses = []
    for on in (False, True):
        machine = EmulatedMachine(lossless, INSTANT, position=(0.0, 2.5))
        machine.switch(0, 0, on=on)
        begin = lossless.energy(*machine.state[:2])
        machine.advance_to(400 * MILLISECOND, wholly=True)
        losses.append(1.0 - lossless.energy(*machine.state[:2]) / begin)
    assert abs(losses[0]) < 1e-4
    assert losses[1] > 0.02


def test_a_drive_that_is_off_makes_no_torque_and_forgets_what_was_on_its_way() -> None:
    machine = started("double_pendulum")
    machine.deliver(0, 1.0, 0)
    machine.deliver(1, 1.0, 0)
    machine.switch(0, 100_000, on=False)
    machine.switch(0, 200_000, on=True)
    machine.advance_to(20 * MILLISECOND, wholly=True)
    assert machine.state[2] == (0.0, pytest.approx(1.0))


def test_a_winding_warms_up_with_its_current_and_a_passive_joint_does_not() -> None:
    machine = started("acrobot", QuasiDirectDrive(thermal_time=0.1))
    machine.deliver(0, 6.0, 0)
    machine.advance_to(SECOND)
    joints = [machine.feedback(index, 2 * SECOND) for index in (0, 1)]
    assert all(record is not None for record in joints)
    assert [record.winding_temperature > 80.0 for record in joints if record is not None] == [False, True]


# --- feedback --------------------------------------------------------------------------------------------------------


def test_records_of_all_joints_are_of_one_instant_and_arrive_after_the_delay() -> None:
    machine = started("acrobot", position=(0.5, -0.25))
    machine.advance_to(0)
    assert [machine.feedback(index, 399_999) for index in (0, 1)] == [None, None]
    records = [machine.feedback(index, 400_000) for index in (0, 1)]
    assert [(r.stamp_ns, r.hardware_ns, r.sequence) for r in records if r] == 2 * [(400_000, 0, 1)]


@pytest.mark.parametrize("plant", PRESETS)
def test_a_measured_position_is_within_half_a_step_of_the_encoder(plant: str) -> None:
    machine = started(plant)
    own, driven = machine.hardware, machine.coordinates.driven
    machine.hold_push(0, 0.01, 0)
    machine.advance_to(200 * MILLISECOND)
    for index, joint in enumerate(machine.coordinates.joints):
        record = machine.feedback(index, SECOND)
        assert record is not None
        step = own.step(joint, driven=index in driven)
        assert abs(record.position - machine.state[0][index]) <= 0.5 * step + 1e-12
        assert record.position / step == pytest.approx(round(record.position / step), abs=1e-6)


def test_one_seed_gives_the_same_records_and_another_gives_others() -> None:
    def records(seed: int) -> list[Feedback | None]:
        machine = EmulatedMachine(load_mechanism("furuta"), seed=seed)
        machine.advance_to(20 * MILLISECOND)
        return [machine.feedback(index, SECOND) for index in (0, 1)]

    first = [None if r is None else r.velocity for r in records(1)]
    assert first == [None if r is None else r.velocity for r in records(1)]
    assert first != [None if r is None else r.velocity for r in records(2)]


@pytest.mark.parametrize(
    ("position", "words"),
    [((0.0,), "expected 2 finite numbers"), ((0.0, math.nan), "finite"), ((2.0, 0.0), "between its stops")],
)
def test_a_start_that_the_machine_cannot_have_is_refused(position: Vector, words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        EmulatedMachine(load_mechanism("cart_pole"), position=position)


# --- ports -----------------------------------------------------------------------------------------------------------


def ports_of(plant: str = "acrobot") -> tuple[EmulatedMachine, SteppedClock, tuple[JointPort, ...]]:
    clock = SteppedClock(SECOND)
    machine = EmulatedMachine(load_mechanism(plant), start_ns=SECOND)
    ports = machine_ports(machine, clock)
    for port in ports:
        port.connect()
    return machine, clock, ports


def test_a_passive_joint_has_a_port_without_any_way_to_give_torque() -> None:
    _, _, (shoulder, elbow) = ports_of()
    assert isinstance(elbow, ActuatorPort)
    for name in ("write", "set_strategy", "stop"):
        assert not hasattr(shoulder, name)


def test_a_read_waits_for_the_next_record_and_no_longer_than_configured() -> None:
    _, clock, (shoulder, elbow) = ports_of()
    assert shoulder.read(0.01) is not None
    assert clock.now_ns() == SECOND + 400_000
    assert elbow.read(0.0) is not None
    assert elbow.read(0.001) is None
    assert clock.now_ns() == SECOND + 1_400_000


@pytest.mark.parametrize(
    ("command", "strategy"),
    [
        (Command(position=1.0), Strategy.PARALLEL_PWM),
        (Command(velocity=1.0), Strategy.PARALLEL_PWM),
        (Command(pwm=0.5), Strategy.DIRECT_PWM),
        (Command(effort=1.0), Strategy.TORQUE_CASCADE),
    ],
)
def test_a_drive_takes_torques_alone(command: Command, strategy: Strategy) -> None:
    machine, clock, (_, elbow) = ports_of()
    assert isinstance(elbow, DrivePort)
    with pytest.raises(ActuatorError, match="expected"):
        elbow.set_strategy(strategy, command)
    assert elbow.strategy is Strategy.OFF
    assert not machine.drives[0].on
    clock.wait_until(2 * SECOND)
    machine.advance_to(2 * SECOND)
    assert machine.state[2] == (0.0, 0.0)


def test_a_stop_ends_torque_at_once_and_where_it_does_not_arrive_the_lifetime_does() -> None:
    machine, clock, (_, elbow) = ports_of()
    assert isinstance(elbow, DrivePort)
    elbow.set_command_lifetime(0.05)
    for cut in (False, True):
        elbow.set_strategy(Strategy.PARALLEL_PWM, Command(effort=2.0))
        clock.wait_until(clock.now_ns() + 20 * MILLISECOND)
        elbow.read(0.0)
        assert machine.state[2][1] == pytest.approx(2.0)
        if cut:
            machine.faults[1].add(ActuatorFault.COMMANDS_LOST)
            with pytest.raises(ActuatorError, match="did not confirm"):
                elbow.stop()
            clock.wait_until(clock.now_ns() + 31 * MILLISECOND)
        else:
            elbow.stop()
        clock.wait_until(clock.now_ns() + 10 * MILLISECOND)
        machine.advance_to(clock.now_ns(), wholly=True)
        assert machine.state[2][1] == pytest.approx(0.0, abs=1e-3)


def test_a_limit_lowers_what_a_drive_makes_and_cannot_raise_it() -> None:
    machine, _, (_, elbow) = ports_of()
    assert isinstance(elbow, DrivePort)
    for asked, kept in ((2.0, 2.0), (100.0, 6.0)):
        elbow.set_limits(replace(elbow.connect().limits, effort=asked))
        assert machine.drives[0].limit == kept


@pytest.mark.parametrize("band", [0.0, 4.0])
def test_a_limit_of_a_motor_in_volts_holds_with_a_dead_band_too(band: float) -> None:
    machine = EmulatedMachine(load_mechanism("qube_servo").with_values({"arm.dead_band": band}))
    arm = machine_ports(machine, SteppedClock())[0]
    assert isinstance(arm, DrivePort)
    for volts, kept in ((5.0, 5.0), (100.0, 10.0)):
        arm.set_limits(replace(arm.connect().limits, effort=0.005 * volts))
        assert machine.drives[0].limit * machine.constants[0].supply_voltage == pytest.approx(kept)


@pytest.mark.parametrize("ratio", [1.0, 14.0])
def test_a_record_has_angle_and_speed_of_the_motor_before_its_own_gears(ratio: float) -> None:
    plant = load_mechanism("qube_servo").with_values({"arm.gear_ratio": ratio})
    machine = EmulatedMachine(plant, INSTANT)
    machine.switch(0, 0, on=True)
    machine.set_lifetime(0, 5.0)
    machine.deliver(0, 0.1, 0)
    machine.advance_to(100 * MILLISECOND)
    record = machine.feedback(0, 100 * MILLISECOND)
    assert record is not None
    position, velocity = (values[0] for values in machine.state[:2])
    assert record.motor_velocity == pytest.approx(ratio * velocity, rel=0.05)
    assert record.motor_position == pytest.approx(ratio * position, rel=0.05)
    assert velocity > 0.5


def test_a_delay_of_the_plant_file_is_inside_the_drive_and_a_stop_does_not_wait_for_it() -> None:
    plant = load_mechanism("acrobot").with_values({"elbow.transport_delay": 0.02})
    machine = EmulatedMachine(plant, INSTANT)
    machine.switch(0, 0, on=True)
    machine.set_lifetime(0, 0.05)
    machine.deliver(0, 2.0, 0)
    machine.advance_to(19 * MILLISECOND, wholly=True)
    assert machine.state[2] == (0.0, 0.0)
    accepted = machine.feedback(1, 19 * MILLISECOND)
    assert accepted is not None
    assert accepted.effort_command == 2.0
    machine.advance_to(21 * MILLISECOND, wholly=True)
    assert machine.state[2][1] == 2.0
    machine.deliver(0, 3.0, 21 * MILLISECOND)
    machine.advance_to(30 * MILLISECOND, wholly=True)
    machine.switch(0, 30 * MILLISECOND, on=False)
    machine.switch(0, 31 * MILLISECOND, on=True)
    machine.advance_to(60 * MILLISECOND, wholly=True)
    assert machine.state[2] == (0.0, 0.0)
