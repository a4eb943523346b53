"""No way out of driving adds torque, on any backend, by the motor's own record and with time between the packets."""

from __future__ import annotations

import math

import pytest

from pendulum_hw_bridge.backends.emulated_machine import DrivePort
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.port.actuator import Command, Strategy, no_torque
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from tests.tools.faults.bridge_rig import Rig
from tests.tools.faults.motor import driving_torque
from tests.tools.faults.ways_out import (
    ANGLE,
    BENCHES,
    FADES,
    FATES,
    PER_DUTY,
    PHASES,
    STOP_TIME,
    STRATEGIES,
    WAYS,
    Exit,
    fade_out,
    is_possible,
    take_way_out,
)

UDP = BENCHES[1:]
WAY = pytest.mark.parametrize("way", list(WAYS))
FATE = pytest.mark.parametrize("fate", list(FATES))
STRATEGY = pytest.mark.parametrize("strategy", STRATEGIES, ids=lambda strategy: strategy.name)


@STRATEGY
@pytest.mark.parametrize("phase", PHASES)
@FATE
def test_no_stop_drives_harder_than_before_while_an_effort_of_zero_woke_the_torque_loop(
    strategy: Strategy, phase: str, fate: str
) -> None:
    left = take_way_out("emulator", strategy, phase, "stop", FATES[fate])
    assert not left.exceeds, left


@STRATEGY
@WAY
def test_no_way_out_drives_harder_than_before(strategy: Strategy, way: str) -> None:
    if is_possible("emulator", way):
        left = take_way_out("emulator", strategy, "hold", way, FATES["settings 12 ms late"])
        assert not left.exceeds, left


@STRATEGY
@pytest.mark.parametrize("backend", UDP)
def test_no_stop_of_a_module_behind_udp_drives_harder_than_before(strategy: Strategy, backend: str) -> None:
    for fate in ("settings 12 ms late", "settings lost once", "setpoints behind settings", "each packet doubled"):
        left = take_way_out(backend, strategy, "hold", "stop", FATES[fate])
        assert left.torque_before > 1.0
        assert not left.exceeds, (fate, left)


@WAY
@pytest.mark.parametrize("backend", UDP)
def test_no_way_out_of_a_module_behind_udp_drives_harder_than_before(backend: str, way: str) -> None:
    for strategy in (Strategy.DIRECT_PWM, Strategy.PARALLEL_PWM):
        if is_possible(backend, way):
            left = take_way_out(backend, strategy, "hold", way, FATES["settings 12 ms late"])
            assert not left.exceeds, (strategy, left)


@STRATEGY
@pytest.mark.parametrize("backend", BENCHES)
def test_the_setpoints_of_a_stop_end_the_torque_while_off_is_missing(backend: str, strategy: Strategy) -> None:
    lost = FATES["settings lost twice"]
    left = take_way_out(backend, strategy, "hold", "stop", lost._replace(settings=((),) * 9))
    assert left.torque_before > 1.0
    assert left.lasting < 0.01


@pytest.mark.parametrize("kind", EffortStrategy)
def test_a_controller_that_ends_releases_at_once_while_its_zero_drove_the_torque_loop(kind: EffortStrategy) -> None:
    rig = Rig(kind=kind, effort_limit=3.0, start=ANGLE)
    rig.controlling = rig.disturbing = False
    stamps: list[int] = []

    def hold() -> None:
        assert rig.bridge.sample is not None
        stamps.append(rig.bridge.sample.stamp_ns)
        rig.send(JointCommand.of_one(stamps[-1], 1.31, "controller"))

    rig.break_cycle = hold
    rig.run(1.0)
    before = len(rig.duties)
    rig.break_cycle = lambda: None
    rig.send(JointCommand.of_one(stamps[-1] + 1, 0.0, "controller"))
    ended_ns = rig.clock.now_ns()
    rig.run(0.2)
    torques = [(time_ns, abs(driving_torque(pwm, torque, PER_DUTY))) for time_ns, pwm, torque in rig.duties]
    held = max(torque for _, torque in torques[before - 20 : before])
    assert held > 1.25
    assert max(torque for _, torque in torques[before:]) < held + 0.05
    assert max(time_ns for time_ns, torque in torques if torque > 0.01) - ended_ns < 0.015 * NANOSECONDS


@pytest.mark.parametrize("kind", tuple(EffortStrategy)[:2])
@pytest.mark.parametrize("way", FADES)
def test_a_stop_that_fades_drives_no_harder_and_ends_in_its_time(way: str, kind: EffortStrategy) -> None:
    for cycles in range(20, 26):
        left = fade_out(kind, way, cycles)
        assert left.torque_before > 1.0
        assert left.torque_after < left.torque_before + 0.05, left
        # Compensated, a duty follows the speed of the link, which falls while the torque fades.
        assert kind is EffortStrategy.DIRECT_PWM_COMPENSATED or not left.exceeds, left
        # A period to hear of it, and at worst one attempt to switch off that was lost.
        shortest, longest = (STOP_TIME - 0.02, STOP_TIME + 0.03) if way in {"e-stop", "disarm"} else (0.0, 0.02)
        assert shortest <= left.lasting < longest, left


def test_a_way_out_that_drives_harder_is_found() -> None:
    assert Exit(1.0, 1.1, 0.03, 0.03, 0.0).exceeds
    assert Exit(1.0, 0.9, 0.03, 0.04, 0.0).exceeds
    assert not Exit(1.0, 1.0, 0.03, 0.03, 0.0).exceeds


@pytest.mark.parametrize("command", [no_torque(Strategy.PARALLEL_PWM), None], ids=["no torque", "stop"])
def test_the_drive_of_a_machine_with_a_current_loop_drives_no_harder_after_it(command: Command | None) -> None:
    clock = SteppedClock(NANOSECONDS)
    machine = EmulatedMachine(load_mechanism("acrobot"), start_ns=clock.now_ns())
    (index,) = machine.coordinates.driven
    port = DrivePort(machine, index, clock)
    port.connect()
    port.set_command_lifetime(0.05)
    port.set_strategy(Strategy.PARALLEL_PWM, Command(effort=1.0))

    def pass_milliseconds(number: int) -> list[float]:
        efforts = []
        for _ in range(number):
            clock.wait_until(clock.now_ns() + 1_000_000)
            machine.advance_to(clock.now_ns())
            efforts.append(machine.state[2][index])
        return efforts

    before = pass_milliseconds(30)[-1]
    assert before == pytest.approx(1.0, abs=0.05)
    if command is None:
        port.stop()
    else:
        assert math.isnan(port.write(command).command.effort)
    after = pass_milliseconds(30)
    assert max(map(abs, after)) <= before + 1e-9
    assert abs(after[-1]) < 0.05
