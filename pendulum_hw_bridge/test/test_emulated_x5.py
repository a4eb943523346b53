"""The emulated X5-9 against closed forms, its datasheet, and itself interpreted instead of compiled."""

import math
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pendulum_hw_bridge.emulation import kernel
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.firmware import gain_rows
from pendulum_hw_bridge.emulation.parameters import EmulatorParameters, load_emulator
from pendulum_hw_bridge.emulation.thermal import ThermalParameters
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import Command, CommandLock, HardwareLimits, Strategy, TemperatureState
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.loops.machine_code import NoMachineCodeError
from pendulum_msgs_py.plants.plant_parameters import load_plant

SECOND = 1_000_000_000


def x5(parameters: EmulatorParameters, **settings: float) -> EmulatedX5:
    return EmulatedX5(parameters, **settings)  # type: ignore[arg-type]


def turned_by(actuator: EmulatedX5, torque: float, seconds: float) -> float:
    """Return the final speed of a flat link under a constant torque of a hand."""
    actuator.push = torque
    actuator.advance_to(actuator.now_ns + round(seconds * SECOND))
    return actuator.link.velocity


@pytest.mark.parametrize(("temperature", "damping"), [(20.0, 11.87), (22.0, 11.77), (40.0, 10.8)])
def test_shorted_winding_damping_is_the_thesiss(temperature: float, damping: float) -> None:
    assert load_emulator("x5_9").shorted_winding_damping(temperature) == pytest.approx(damping, rel=4e-3)


@pytest.mark.parametrize("temperature", [20.0, 22.0, 40.0])
def test_a_link_turned_by_hand_feels_that_damping(temperature: float) -> None:
    parameters = load_emulator("thesis").with_drivetrain(
        motor_damping=0.0, winding_temperature=temperature, hysteresis_torque=0.0
    )
    flat = replace(
        parameters,
        flat=True,
        plant=parameters.plant.with_values(damping=0.0, coulomb_friction=0.0, static_friction=0.0),
    )
    actuator = x5(flat)
    speed = turned_by(actuator, 6.0, 2.0)
    assert 6.0 / speed == pytest.approx(flat.shorted_winding_damping(temperature), rel=1e-3)


def test_friction_that_grows_with_the_load_holds_the_emulated_link() -> None:
    def swing(load: float) -> float:
        parameters = load_emulator("thesis")
        plant = parameters.plant.with_values(coulomb_friction=0.0, damping=0.0, load_friction=load)
        actuator = x5(replace(parameters, plant=plant), position=0.5)
        actuator.advance_to(actuator.now_ns + SECOND // 5)
        return abs(actuator.link.position - 0.5)

    # More than gravity itself: it stays where it was left, but for what the spring's swing moves it.
    assert swing(2.0) < 0.05 * swing(0.0)


def test_with_the_command_gone_the_winding_stays_shorted() -> None:
    parameters = replace(load_emulator("thesis"), flat=True)
    driven, left = x5(parameters), x5(parameters)
    driven.configure(strategy=Strategy.DIRECT_PWM)
    assert turned_by(driven, 5.0, 1.0) == turned_by(left, 5.0, 1.0)


def test_static_effort_differs_between_loading_and_unloading_by_the_hysteresis() -> None:
    parameters = load_emulator("x5_9").with_drivetrain(motor_coulomb_friction=0.0, motor_static_friction=0.0)
    quiet = replace(parameters, sensors=replace(parameters.sensors, effort_noise=0.0))
    efforts = []
    for before in (0.0, math.pi / 2):
        actuator = x5(quiet, position=before)
        actuator.configure(strategy=Strategy.PARALLEL_PWM, command_lifetime=5.0)
        steps = 400
        for index in range(steps + 1):
            target = before + (math.pi / 4 - before) * index / steps
            actuator.deliver(Command(position=target, velocity=0.0), actuator.now_ns)
            actuator.advance_to(actuator.now_ns + SECOND // 50)
        feedback = actuator.feedback(actuator.now_ns)
        assert feedback is not None
        efforts.append(feedback.effort - actuator.link.spring_torque)
    loading, unloading = efforts
    assert unloading - loading == pytest.approx(2.0 * quiet.drivetrain.hysteresis_torque, rel=0.1)


def _after_400_steps(strategy: Strategy) -> bytes:
    """Return the whole memory of an actuator that a strategy has driven for a while."""
    actuator = kernel.Actuator()
    actuator.state[5:8] = 22.0
    actuator.state[2] = 0.3
    actuator.constants[:] = load_emulator("x5_9").constants(HardwareLimits(effort=0.35), 36.0, enabled=True)
    actuator.gains[:] = gain_rows(DEFAULT_GAINS[max(1, int(strategy))])
    actuator.setpoints[:] = (math.nan, math.nan, 0.2) if strategy is Strategy.DIRECT_PWM else (0.5, 0.1, 0.4)
    actuator.advance(int(strategy), 0.7, 0, 400)
    # Beyond the torque clamp as well: who reads it later finds what was asked for.
    assert actuator.setpoints[2] in {0.2, 0.4}
    return actuator.state.tobytes() + actuator.memory.tobytes()


@pytest.mark.parametrize("strategy", list(Strategy))
def test_compiled_and_interpreted_steps_are_the_same(strategy: Strategy, monkeypatch: pytest.MonkeyPatch) -> None:
    if kernel._machine_code() is None:
        pytest.skip("there is no machine code here: there is only the interpreted one")
    compiled = _after_400_steps(strategy)
    monkeypatch.setattr(kernel, "_machine_code", lambda: None)
    monkeypatch.setattr(kernel, "_elsewhere", lambda: kernel.advance)
    assert _after_400_steps(strategy) == compiled


def test_where_no_loop_can_be_loaded_numba_compiles_the_same_function_and_without_it_python_runs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As on a Raspberry Pi."""
    pytest.importorskip("numba")

    def refuse(*_: object, **__: object) -> None:
        raise NoMachineCodeError("another processor")

    monkeypatch.setattr(kernel, "load_loop", refuse)
    assert kernel._machine_code.__wrapped__() is None
    found: Any = kernel._elsewhere.__wrapped__()
    assert (found is kernel.advance, found.py_func.__code__) == (False, kernel.advance.__code__)
    monkeypatch.setitem(sys.modules, "numba", None)
    assert kernel._elsewhere.__wrapped__() is kernel.advance


@pytest.mark.parametrize("stiffness", [40.0, 100.0, 1000.0])
def test_the_step_stays_finite_and_brings_a_pushed_pendulum_to_rest(stiffness: float) -> None:
    actuator = x5(load_emulator("x5_9").with_drivetrain(stiffness=stiffness), position=1.5)
    actuator.advance_to(60 * SECOND)
    link = actuator.link
    assert math.isfinite(link.position)
    assert abs(link.velocity) < 1e-3
    assert abs(link.position) < 0.3


def test_a_hardening_spring_is_soft_at_rest_and_stiff_under_load() -> None:
    parameters = load_emulator("x5_9").with_drivetrain(stiffness=50.0, stiffness_hardening=2e4)
    actuator = x5(replace(parameters, flat=True))
    actuator.configure(strategy=Strategy.PARALLEL_PWM, command_lifetime=5.0)
    deflections = []
    for torque in (0.5, 8.0):
        actuator.push = torque
        for _ in range(10):
            actuator.deliver(Command(position=0.0, velocity=0.0), actuator.now_ns)
            actuator.advance_to(actuator.now_ns + SECOND // 2)
        deflections.append(torque / (actuator.link.position - actuator.link.motor_position))
    assert 45.0 < deflections[0] < 60.0
    assert deflections[1] > 120.0


def test_torque_at_standstill_is_the_feed_forwards() -> None:
    parameters = load_emulator("thesis")
    drive = parameters.drivetrain
    actuator = x5(replace(parameters, flat=True))
    actuator.configure(strategy=Strategy.DIRECT_PWM)
    duty = 2.4e-4 * 1000
    actuator.deliver(Command(pwm=duty), 0)
    actuator.advance_to(kernel.STEP_NS)
    expected = duty * drive.supply_voltage * drive.torque_constant * drive.gear_ratio / drive.winding_resistance
    # 22 degC: copper is 0.8 % up, magnets 0.07 % down.
    assert actuator.link.motor_torque == pytest.approx(expected, rel=0.02)


def test_firmware_holds_its_speed_limit() -> None:
    actuator = x5(replace(load_emulator("thesis"), flat=True))
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=5.0)
    actuator.deliver(Command(pwm=1.0), 0)
    actuator.advance_to(3 * SECOND)
    assert 1.4 < actuator.link.velocity < 1.5027


def test_controllers_are_off_when_the_command_lifetime_ends() -> None:
    actuator = x5(load_emulator("thesis"))
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=0.05)
    actuator.deliver(Command(pwm=0.2), 0)
    actuator.advance_to(49_000_000)
    assert actuator.link.pwm == pytest.approx(0.2, abs=2e-4)
    actuator.advance_to(52_000_000)
    assert actuator.link.pwm == 0.0
    assert actuator.lifetime_expiries == 1


def test_a_second_sender_is_locked_out_while_the_lifetime_runs() -> None:
    actuator = x5(load_emulator("thesis"))
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=0.05)
    actuator.deliver(Command(pwm=0.2), 0, sender=1)
    actuator.deliver(Command(pwm=-0.5), 10_000_000, sender=2)
    actuator.advance_to(20_000_000)
    assert actuator.link.pwm > 0.0
    actuator.deliver(Command(pwm=-0.5), 60_000_000, sender=2)
    actuator.advance_to(70_000_000)
    assert actuator.link.pwm < 0.0


def test_two_actuators_with_one_seed_give_the_same_feedback_and_another_seed_another() -> None:
    def records(seed: int) -> list[object]:
        actuator = x5(load_emulator("x5_9"), seed=seed, position=1.0)
        found = []
        for instant in range(0, SECOND, 10_000_000):
            actuator.advance_to(instant)
            found.append(actuator.feedback(instant))
        # NaN, the setpoint of a loop that is off, is equal to nothing: compare as text.
        return [str(record) for record in found]

    assert records(3) == records(3)
    assert records(3) != records(4)


def test_feedback_has_the_measured_rate_jitter_and_steps() -> None:
    actuator = x5(load_emulator("x5_9"))
    stamps, records = [], []
    for instant in range(0, 20 * SECOND, 1_000_000):
        actuator.advance_to(instant)
        record = actuator.feedback(instant)
        if record is not None:
            stamps.append(record.stamp_ns)
            records.append(record)
    periods = np.diff(stamps) * 1e-6
    assert np.mean(periods) == pytest.approx(10.0, abs=0.01)
    assert np.std(periods) == pytest.approx(0.68, abs=0.12)
    steps = np.array([record.motor_position for record in records]) / (math.pi / 3)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    voltages = np.array([record.voltage for record in records]) / 15.3e-3
    np.testing.assert_allclose(voltages, np.rint(voltages), atol=1e-6)
    noise = np.array([record.deflection for record in records[len(records) // 2 :]])
    assert np.ptp(noise) / 2 <= 2.1e-4


def steady_rise(power: float, ladder: ThermalParameters) -> float:
    """How far the winding ends above ambient under constant heat in it [K]."""
    return power * (ladder.winding_housing + ladder.housing_body + ladder.body_ambient)


def test_motor_warms_to_what_its_thermal_resistances_say() -> None:
    thermal = ThermalParameters(winding_capacity=0.02, housing_capacity=0.02, body_capacity=0.02, ambient=22.0)
    parameters = replace(load_emulator("x5_9"), thermal=thermal, flat=True)
    locked = replace(parameters, plant=parameters.plant.with_values(inertia=1e9))
    actuator = EmulatedX5(locked)
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=5.0)
    actuator.deliver(Command(pwm=0.1), 0)
    actuator.advance_to(4 * SECOND)
    current = actuator.link.motor_torque / (parameters.drivetrain.torque_constant * parameters.drivetrain.gear_ratio)
    winding = actuator.link.winding_temperature
    resistance = parameters.drivetrain.winding_resistance * (1.0 + 0.004 * (winding - 20.0))
    rise = steady_rise(current**2 * resistance, thermal)
    assert winding - 22.0 == pytest.approx(rise, rel=0.03)


def test_nine_newton_metres_for_ever_stay_just_below_the_winding_limit() -> None:
    drive = load_plant("x5_9").drivetrain
    assert drive is not None
    current = 9.0 / (drive.torque_constant * drive.gear_ratio * drive.efficiency**0.5)
    rise = steady_rise(current**2 * drive.winding_resistance * 1.4, ThermalParameters())
    assert 100.0 < 22.0 + rise < 260.0


def test_a_hot_motor_is_taken_off_by_its_firmware() -> None:
    actuator = x5(load_emulator("x5_9"))
    actuator.place(0.0, temperature=160.0)
    actuator.configure(strategy=Strategy.DIRECT_PWM)
    actuator.deliver(Command(pwm=0.3), 0)
    actuator.advance_to(20_000_000)
    record = actuator.feedback(20_000_000)
    assert record is not None
    assert record.temperature_state == TemperatureState.EXCEED_MAX_MOTOR
    assert actuator.link.pwm == 0.0


def test_lock_is_reported_in_the_feedback() -> None:
    actuator = x5(load_emulator("x5_9"))
    actuator.inject(ActuatorFault.LOCKED_BY_OTHER)
    actuator.advance_to(20_000_000)
    record = actuator.feedback(20_000_000)
    assert record is not None
    assert record.lock == CommandLock.LOCKED_BY_OTHER


def test_it_runs_a_hundred_times_faster_than_real_time() -> None:
    actuator = x5(load_emulator("x5_9"))
    actuator.configure(strategy=Strategy.DIRECT_PWM)
    actuator.advance_to(SECOND)
    begin = time.process_time()
    for instant in range(SECOND, 21 * SECOND, 10_000_000):
        actuator.deliver(Command(pwm=0.05), instant)
        actuator.advance_to(instant)
        actuator.feedback(instant)
    assert 20.0 / (time.process_time() - begin) > 100.0


def test_a_rigid_plant_cannot_be_emulated_and_says_so() -> None:
    with pytest.raises(ParameterError, match="'dfki', a rigid one"):
        load_emulator("dfki")
    with pytest.raises(ParameterError, match="has no drivetrain"):
        EmulatorParameters(load_plant("thesis"))


def test_a_feedback_rate_of_nothing_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"feedback_rate is 0\.0 Hz"):
        x5(load_emulator("thesis")).configure(feedback_rate=0.0)
