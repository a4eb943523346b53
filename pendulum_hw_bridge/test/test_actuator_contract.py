"""One contract for every backend: the port is the same, whatever stands behind it."""

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pendulum_hw_bridge.backends import emulator_process
from pendulum_hw_bridge.backends import hebi as hebi_backend
from pendulum_hw_bridge.backends.dynamixel import DynamixelBackend
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.backends.hebi import HebiBackend
from pendulum_hw_bridge.backends.hebi_emulated import EmulatedGroup
from pendulum_hw_bridge.backends.replay import FeedbackRecording, ReplayBackend
from pendulum_hw_bridge.backends.torque_drive import TORQUE_LOOP, TorqueDrive
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.server import EmulatorServer
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorPort,
    Command,
    Feedback,
    HardwareLimits,
    MStopAction,
    Strategy,
)
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.command_check import check_command
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, differing_gain
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.drive_rigs import SteppedServo


def emulator() -> EmulatorBackend:
    return EmulatorBackend(EmulatedX5(load_emulator("thesis"), seed=1), SteppedClock())


def replay() -> ReplayBackend:
    time = np.arange(0.0, 5.0, 0.01)
    columns = {"time": time, "position": np.sin(time), "velocity": np.cos(time), "effort": 0.1 * time}
    return ReplayBackend(FeedbackRecording(columns), SteppedClock())


def hebi_imitation() -> HebiBackend:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    return HebiBackend(make_group=lambda: hebi.util.create_imitation_group(1), imitation=True)


def dynamixel() -> DynamixelBackend:
    pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
    return SteppedServo(model="XM430-W350").port


def hebi_on(where: str) -> HebiBackend:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    return HebiBackend(make_group=lambda: EmulatedGroup(where, hebi))


@pytest.fixture(params=["emulator", "emulator_process", "replay", "hebi", "hebi_emulated", "dynamixel"])
def port(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[ActuatorPort]:
    # The emulator's thread may have to wait for a core; how long a stop waits is no part of the contract.
    monkeypatch.setattr(emulator_process, "_STOP_PATIENCE", 5.0)
    monkeypatch.setattr(hebi_backend, "STOP_ACKNOWLEDGE_MS", 5000)
    monkeypatch.setattr(hebi_backend, "ACKNOWLEDGE_MS", 5000)
    if request.param not in {"emulator_process", "hebi_emulated"}:
        makers: dict[str, Callable[[], ActuatorPort]] = {
            "emulator": emulator,
            "replay": replay,
            "hebi": hebi_imitation,
            "dynamixel": dynamixel,
        }
        backend = makers[request.param]()
        yield backend
        backend.close()
        return
    clock = SteadyWallClock()
    actuator = EmulatedX5(load_emulator("thesis"), seed=1, start_ns=clock())
    server = EmulatorServer(actuator, ("127.0.0.1", 0), clock)
    running = threading.Event()
    running.set()
    thread = threading.Thread(target=server.serve, args=(running.is_set,))
    thread.start()
    host, number = server.address
    make = EmulatorProcessBackend if request.param == "emulator_process" else hebi_on
    process_backend: ActuatorPort = make(f"{host}:{number}")
    yield process_backend
    process_backend.close()
    running.clear()
    thread.join()


def next_feedback(port: ActuatorPort) -> Feedback:
    for _ in range(20):
        feedback = port.read(0.2)
        if feedback is not None:
            return feedback
    pytest.fail("no feedback")


def test_it_is_a_port(port: ActuatorPort) -> None:
    assert isinstance(port, ActuatorPort)


def test_using_it_before_connecting_is_refused_by_name(port: ActuatorPort) -> None:
    with pytest.raises(ActuatorError) as caught:
        port.set_command_lifetime(0.1)
    assert caught.value.fault == "not_connected"


def test_it_connects_and_says_who_it_is(port: ActuatorPort) -> None:
    info = port.connect()
    assert info.backend == port.name  # type: ignore[attr-defined]
    assert info.strategy is Strategy.OFF
    assert info.command_lifetime > 0.0
    assert info.feedback_rate > 0.0


def test_connecting_twice_changes_nothing(port: ActuatorPort) -> None:
    first = port.connect()
    assert port.connect().strategy is first.strategy


def test_settings_read_back(port: ActuatorPort) -> None:
    port.connect()
    assert port.set_command_lifetime(0.06) == pytest.approx(0.06)
    assert port.set_feedback_rate(100.0) == pytest.approx(100.0)
    # hebi-py keeps single precision: what has few bits comes back as it went.
    limits = HardwareLimits(effort=5.0, velocity=1.25, position_min=-4.0, position_max=4.0)
    without_stop = replace(limits, m_stop=MStopAction.DISABLED)
    assert port.set_limits(limits) == (without_stop if isinstance(port, TorqueDrive) else limits)
    assert not differing_gain(port.set_gains(DEFAULT_GAINS[3]), DEFAULT_GAINS[3])
    for strategy in (TORQUE_LOOP, Strategy.OFF) if isinstance(port, TorqueDrive) else Strategy:
        assert port.set_strategy(strategy) is strategy
        assert port.strategy is strategy


@pytest.mark.parametrize("lifetime", [0.0, -1.0, 6.0, math.nan, math.inf])
def test_a_command_lifetime_that_never_ends_is_refused(port: ActuatorPort, lifetime: float) -> None:
    port.connect()
    with pytest.raises(ParameterError, match="command_lifetime is"):
        port.set_command_lifetime(lifetime)


def test_feedback_is_complete_new_and_stamped_with_the_ports_clock(port: ActuatorPort) -> None:
    port.connect()
    port.set_feedback_rate(100.0)
    first, second = next_feedback(port), next_feedback(port)
    assert second.sequence > first.sequence
    assert second.stamp_ns > first.stamp_ns
    assert 0 <= port.now_ns() - second.stamp_ns < 1_000_000_000
    assert len(second) == len(Feedback._fields)


def test_write_returns_what_was_really_applied(port: ActuatorPort) -> None:
    port.connect()
    port.set_limits(HardwareLimits(effort=5.0, velocity=1.2, pwm=0.3))
    if isinstance(port, TorqueDrive):
        port.set_strategy(TORQUE_LOOP)
        applied = port.write(Command(effort=-7.0))
        assert applied.limited
        assert applied.command.effort == pytest.approx(-5.0, abs=0.005)
        assert applied.command.effort >= -5.0
        return
    port.set_strategy(Strategy.DIRECT_PWM)
    applied = port.write(Command(pwm=0.9))
    assert applied.command.pwm == 0.3
    assert applied.limited
    assert applied.strategy is Strategy.DIRECT_PWM
    port.set_strategy(Strategy.PARALLEL_PWM)
    applied = port.write(Command(effort=-7.0, velocity=0.5))
    assert (applied.command.effort, applied.command.velocity, applied.limited) == (-5.0, 0.5, True)


def test_a_setpoint_that_the_strategy_does_not_know_is_refused(port: ActuatorPort) -> None:
    port.connect()
    if isinstance(port, TorqueDrive):
        with pytest.raises(ActuatorError, match="strategy is DIRECT_PWM; expected OFF or PARALLEL_PWM"):
            port.set_strategy(Strategy.DIRECT_PWM)
    else:
        port.set_strategy(Strategy.DIRECT_PWM)
        with pytest.raises(ParameterError, match="under DIRECT_PWM"):
            port.write(Command(effort=1.0))
    port.set_strategy(Strategy.PARALLEL_PWM)
    with pytest.raises(ParameterError, match="pwm setpoint under strategy PARALLEL_PWM"):
        port.write(Command(pwm=0.1))


@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_an_infinite_setpoint_is_refused_before_it_is_sent(port: ActuatorPort, value: float) -> None:
    port.connect()
    port.set_strategy(Strategy.PARALLEL_PWM)
    with pytest.raises(ParameterError, match="effort setpoint is"):
        port.write(Command(effort=value))


def test_stop_ends_with_strategy_off_and_may_be_called_at_any_time(port: ActuatorPort) -> None:
    port.stop()
    port.connect()
    if isinstance(port, TorqueDrive):
        port.set_strategy(TORQUE_LOOP)
        port.write(Command(effort=0.1))
    else:
        port.set_strategy(Strategy.DIRECT_PWM)
        port.write(Command(pwm=0.1))
    port.stop()
    assert port.strategy is Strategy.OFF
    port.stop()
    port.close()
    port.close()


def test_limits_and_commands_are_checked_in_one_place() -> None:
    limited, changed = check_command(Command(position=9.0), Strategy.PARALLEL_PWM, HardwareLimits(position_max=4.0))
    assert (limited.position, changed) == (4.0, True)
    with pytest.raises(ParameterError, match=r"effort limit is 0.0 N m; expected a finite number > 0"):
        HardwareLimits(effort=0.0)
    with pytest.raises(ParameterError, match="expected min < max"):
        HardwareLimits(position_min=1.0, position_max=1.0)


def test_a_hebi_group_is_not_touched_from_a_second_thread() -> None:
    backend = hebi_imitation()
    backend.connect()
    caught: list[BaseException] = []

    def intrude() -> None:
        try:
            backend.write(Command())
        except ActuatorError as error:
            caught.append(error)

    thread = threading.Thread(target=intrude)
    thread.start()
    thread.join()
    assert "second thread" in str(caught[0])
    backend.close()
