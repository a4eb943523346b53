"""How the backend ``emulator_process`` stops, packet by packet, on a real socket."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator

import pytest

from pendulum_hw_bridge.backends import emulator_process
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.server import EmulatorServer
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, Strategy
from pendulum_msgs_py.contract.timing import SteadyWallClock


class Server(EmulatorServer):
    """An emulator that keeps what it is sent, and may not hear or not reply."""

    def __init__(self) -> None:
        clock = SteadyWallClock()
        super().__init__(EmulatedX5(load_emulator("thesis"), start_ns=clock()), ("127.0.0.1", 0), clock)
        self.packets: list[Command | int] = []
        self.is_muted = self.is_deaf = False

    def _receive(self, packet: bytes, sender: tuple[str, int], now: int) -> None:
        if wire.kind_of(packet) == wire.COMMAND:
            command = wire.decode_command(packet)
            assert command is not None
            self.packets.append(command)
        elif "strategy" in (wire.decode_json(packet).get("settings") or {}):
            self.packets.append(wire.decode_json(packet)["settings"]["strategy"])
        if not self.is_deaf:
            super()._receive(packet, sender, now)

    def _send(self, packet: bytes, receiver: tuple[str, int]) -> None:
        if not self.is_muted:
            super()._send(packet, receiver)


@pytest.fixture
def server() -> Iterator[Server]:
    served, running = Server(), threading.Event()
    running.set()
    thread = threading.Thread(target=served.serve, args=(running.is_set,))
    thread.start()
    yield served
    running.clear()
    thread.join()


@pytest.fixture
def port(server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[EmulatorProcessBackend]:
    # The emulator's thread may have to wait for a core.
    monkeypatch.setattr(emulator_process, "_ACKNOWLEDGE", 5.0)
    monkeypatch.setattr(emulator_process, "_STOP_PATIENCE", 5.0)
    backend = EmulatorProcessBackend("{}:{}".format(*server.address))
    backend.connect()
    yield backend
    backend.release()


def impatient(call: Callable[[], object], fault: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulator_process, "_ACKNOWLEDGE", 0.02)
        patch.setattr(emulator_process, "_STOP_PATIENCE", 0.02)
        with pytest.raises(ActuatorError) as caught:
            call()
        assert caught.value.fault == fault


def is_empty(packet: Command | int) -> bool:
    assert isinstance(packet, Command)
    return all(map(math.isnan, (packet.position, packet.velocity, packet.effort, packet.pwm)))


def test_a_stop_sends_no_torque_then_off_and_nothing_where_off_is_confirmed(
    server: Server, port: EmulatorProcessBackend
) -> None:
    port.stop()
    assert server.packets == []
    port.set_strategy(Strategy.PARALLEL_PWM)
    # Confirmed, so that a duty of zero is certain to be one.
    port.set_strategy(Strategy.DIRECT_PWM)
    port.stop()
    (_, _, first, off) = server.packets
    assert isinstance(first, Command)
    assert (first.pwm, off, port.strategy) == (0.0, 0, Strategy.OFF)
    port.stop()
    assert len(server.packets) == 4


@pytest.mark.parametrize("strategy", [Strategy.TORQUE_CASCADE, Strategy.PARALLEL_PWM, Strategy.MIXED])
def test_the_first_packet_of_a_stop_wakes_no_loop(
    server: Server, port: EmulatorProcessBackend, strategy: Strategy
) -> None:
    port.set_strategy(strategy)
    port.stop()
    assert is_empty(server.packets[1])
    assert server.packets[2] == 0


def test_a_stop_that_is_not_confirmed_is_an_error_and_the_next_one_asks_again(
    server: Server, port: EmulatorProcessBackend
) -> None:
    port.set_strategy(Strategy.PARALLEL_PWM)
    server.is_muted = True
    impatient(port.stop, "stop_unacknowledged")
    assert port.strategy is Strategy.OFF
    server.is_muted = False
    count = len(server.packets)
    port.stop()
    assert is_empty(server.packets[count])
    assert server.packets[-1] == 0
    count = len(server.packets)
    port.stop()
    assert len(server.packets) == count


@pytest.mark.parametrize("first", [Strategy.DIRECT_PWM, Strategy.PARALLEL_PWM])
def test_a_stop_wakes_no_loop_where_the_acknowledgement_of_the_strategy_was_lost(
    server: Server, port: EmulatorProcessBackend, first: Strategy
) -> None:
    port.set_strategy(first)
    other = Strategy.PARALLEL_PWM if first is Strategy.DIRECT_PWM else Strategy.DIRECT_PWM
    server.is_muted = True
    impatient(lambda: port.set_strategy(other), "no_acknowledgement")
    server.is_muted = False
    count = len(server.packets)
    port.stop()
    assert is_empty(server.packets[count])


def test_a_module_that_may_have_switched_on_is_stopped(server: Server, port: EmulatorProcessBackend) -> None:
    server.is_muted = True
    impatient(lambda: port.set_strategy(Strategy.DIRECT_PWM), "no_acknowledgement")
    server.is_muted = False
    port.close()
    assert isinstance(server.packets[-2], Command)
    assert (server.packets[-2].pwm, server.packets[-1]) == (0.0, 0)


def test_a_module_that_drives_when_it_is_found_is_stopped_in_its_own_strategy(
    server: Server, port: EmulatorProcessBackend
) -> None:
    port.set_strategy(Strategy.PARALLEL_PWM)
    second = EmulatorProcessBackend("{}:{}".format(*server.address))
    assert second.connect().strategy is Strategy.PARALLEL_PWM
    second.close()
    assert is_empty(server.packets[-2])
    assert server.packets[-1] == 0


def test_setpoints_come_with_a_strategy_that_was_confirmed_only(server: Server, port: EmulatorProcessBackend) -> None:
    assert port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.01)) is Strategy.DIRECT_PWM
    port.write(Command(pwm=0.02))
    port.set_strategy(Strategy.OFF)
    server.is_muted = True
    impatient(lambda: port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.03)), "no_acknowledgement")
    assert [packet.pwm for packet in server.packets if isinstance(packet, Command)] == [0.01, 0.02]
