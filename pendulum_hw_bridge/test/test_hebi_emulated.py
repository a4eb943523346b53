"""HEBI's network with emulated modules on it: the backend ``hebi`` as it is, with hebi-py's own commands and files."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pendulum_hw_bridge.backends import hebi as backend_module
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.backends.hebi import HebiBackend, connect_group, open_lookup
from pendulum_hw_bridge.backends.hebi_discovery import ModuleSelection, discover, select_module
from pendulum_hw_bridge.backends.hebi_emulated import EmulatedGroup
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.server import EmulatorIdentity, EmulatorServer
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.lab.module_files import backup_group, limits_of_group, restore_group
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, HardwareLimits, MStopAction, Strategy
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.fixtures import wait_for

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")


class Served:
    """An emulated module that listens in a thread."""

    def __init__(self, serial: str, kind: str = "X5-9") -> None:
        clock = SteadyWallClock()
        self.actuator = EmulatedX5(load_emulator("thesis"), seed=1, start_ns=clock())
        # Code is compiled before anybody listens.
        self.actuator.advance_to(clock())
        identity = EmulatorIdentity("Lab", "Pendulum", serial, kind)
        server = EmulatorServer(self.actuator, ("127.0.0.1", 0), clock, identity)
        self.where = "{}:{}".format(*server.address)
        self._running = threading.Event()
        self._running.set()
        self._thread = threading.Thread(target=server.serve, args=(self._running.is_set,))
        self._thread.start()

    def end(self) -> None:
        self._running.clear()
        self._thread.join()


@pytest.fixture
def bench() -> Iterator[tuple[Served, Served]]:
    pair = Served("X5-9-1"), Served("X5-9-2")
    yield pair
    for served in pair:
        served.end()


@pytest.fixture
def served() -> Iterator[Served]:
    one = Served("X5-9-1")
    yield one
    one.end()


def test_twins_are_distinguished_by_serial_and_one_that_falls_silent_is_stale(bench: tuple[Served, Served]) -> None:
    lookup = open_lookup(f"emulator:{bench[0].where},{bench[1].where}")
    seen = sorted(discover(lookup, look_time=0.25), key=lambda one: one.serial)
    assert [(one.serial, one.type, one.stale) for one in seen] == [("X5-9-1", "X5-9", False), ("X5-9-2", "X5-9", False)]
    assert len({one.mac_address for one in seen}) == 2
    with pytest.raises(ActuatorError, match="is not the only one"):
        select_module(seen, ModuleSelection("Lab"), seconds=1.0)
    for wanted in (ModuleSelection(serial="X5-9-2"), ModuleSelection(mac_address=seen[1].mac_address.lower())):
        assert select_module(seen, wanted, seconds=1.0) == seen[1]
    group = connect_group(ModuleSelection(serial="X5-9-2"), f"emulator:{bench[0].where},{bench[1].where}", 0.25)
    assert group.request_info(500).serial[0] == "X5-9-2"
    bench[1].end()
    stale = {one.serial or "silent": one.stale for one in discover(lookup, look_time=0.25)}
    assert stale in ({"X5-9-1": False, "X5-9-2": True}, {"X5-9-1": False, "silent": True})


def test_who_looks_does_not_stop_a_motor_that_another_drives(served: Served) -> None:
    served.actuator.configure(strategy=Strategy.DIRECT_PWM)
    discover(open_lookup(f"emulator:{served.where}"), look_time=0.25)
    assert served.actuator.strategy is Strategy.DIRECT_PWM


def test_a_command_brings_what_it_has_and_nothing_else(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    # The module's thread may have to wait for a core.
    monkeypatch.setattr(backend_module, "ACKNOWLEDGE_MS", 5000)
    monkeypatch.setattr(backend_module, "STOP_ACKNOWLEDGE_MS", 5000)
    port = HebiBackend(make_group=lambda: EmulatedGroup(served.where, hebi))
    port.connect()
    port.set_limits(HardwareLimits(effort=2.0, velocity=1.0, m_stop=MStopAction.HOLD_POSITION))
    before = served.actuator.gains
    # hebi-py reads a position that nobody gave as 0: gains alone must not become a wish to go there.
    port.set_strategy(Strategy.PARALLEL_PWM, Command(position=0.1))
    port.set_gains(DEFAULT_GAINS[3])
    record = next(record for _ in range(100) if (record := port.read(0.1)) is not None)
    assert record.position_command != 0.0
    assert served.actuator.limits.effort == 2.0
    assert served.actuator.limits.m_stop is MStopAction.HOLD_POSITION
    assert served.actuator.gains.strategy == before.strategy
    port.close()
    assert served.actuator.strategy is Strategy.OFF


def test_open_position_limits_are_given_back(served: Served, tmp_path: Path) -> None:
    group = EmulatedGroup(served.where, hebi)
    assert served.actuator.limits.position_max == math.inf
    backup_group(group, tmp_path / "before")
    served.actuator.configure(limits=HardwareLimits(effort=1.0, position_min=-4.0, position_max=4.0))
    restore_group(group, tmp_path / "before", backend_module.new_command, print)
    assert (served.actuator.limits.position_min, served.actuator.limits.position_max) == (-math.inf, math.inf)
    safety = tmp_path / "before" / "safety.xml"
    safety.write_text(safety.read_text().replace("-inf", "-nan"))
    with pytest.raises(ParameterError, match="min_limit of the position is no number"):
        restore_group(group, tmp_path / "before", backend_module.new_command, print)


def test_the_limits_that_a_module_holds_are_read_and_others_at_its_ends_refused(served: Served) -> None:
    group = EmulatedGroup(served.where, hebi)
    limits = HardwareLimits(effort=1.0, velocity=1.0, position_min=-4.0, position_max=4.0)
    with pytest.raises(ActuatorError, match="strategy at the min position limit reads back as 3; expected 2"):
        limits_of_group(group, limits)
    served.actuator.configure(limits=limits)
    assert limits_of_group(group, replace(limits, effort=5.0)) == limits


class TwoEnds(EmulatedGroup):
    """A module that does something else at either end of its position limits."""

    ends: tuple[int, int] = (2, 1)

    def request_info(self, timeout_ms: float) -> Any:
        info = super().request_info(timeout_ms)
        info.min_position_limit_strategy, info.max_position_limit_strategy = ([end] for end in self.ends)
        return info

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: float) -> bool:
        if int(command.min_position_limit_strategy[0]) or int(command.max_position_limit_strategy[0]):
            low, high = command.min_position_limit_strategy, command.max_position_limit_strategy
            self.ends = int(low[0]), int(high[0])
        return super().send_command_with_acknowledgement(command, timeout_ms)


class DeafAtTheEnds(TwoEnds):
    """One that keeps what it does there, and acknowledges all the same."""

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: float) -> bool:
        return EmulatedGroup.send_command_with_acknowledgement(self, command, timeout_ms)


def test_what_a_module_does_at_either_end_of_its_limits_is_given_back(served: Served, tmp_path: Path) -> None:
    group = TwoEnds(served.where, hebi)
    backup_group(group, tmp_path / "before")
    group.ends = 2, 2
    restore_group(group, tmp_path / "before", backend_module.new_command, print)
    assert group.ends == (2, 1)
    deaf = DeafAtTheEnds(served.where, hebi)
    deaf.ends = 2, 2
    with pytest.raises(ActuatorError, match=r"reads back .*: 2\}; expected .*: 1\}"):
        restore_group(deaf, tmp_path / "before", backend_module.new_command, print)


def test_a_backup_that_cannot_be_written_leaves_no_half_of_one(served: Served, tmp_path: Path) -> None:
    group = EmulatedGroup(served.where, hebi)
    (tmp_path / "file").touch()
    with pytest.raises(ParameterError, match="cannot be made"):
        backup_group(group, tmp_path / "file" / "before")
    info = group.request_info(500)
    info.write_safety_params = lambda path: Path(path).touch()  # a disk that is full
    group.request_info = lambda timeout_ms: info  # type: ignore[method-assign]
    with pytest.raises(ParameterError, match="is the disk full"):
        backup_group(group, tmp_path / "before")
    assert not (tmp_path / "before").exists()


def test_no_emulator_is_one_sentence() -> None:
    with pytest.raises(ActuatorError, match=r"no HEBI module \*/\* answered"):
        connect_group(ModuleSelection(), "emulator:127.0.0.1:9", 0.25)
    with pytest.raises(ParameterError, match="expected HOST:PORT"):
        open_lookup("emulator:nowhere")
    assert EmulatorProcessBackend("127.0.0.1:9").strategy is Strategy.OFF


def test_a_group_of_several_takes_its_parts_and_a_frame_waits_for_all(bench: tuple[Served, Served]) -> None:
    lookup = open_lookup(f"emulator:{bench[0].where},{bench[1].where}")
    macs = {one.serial: one.mac_address for one in discover(lookup, look_time=0.25)}
    assert lookup.get_group_from_macs([macs["X5-9-1"], "02:00:00:00:00:00"], 500) is None
    group = lookup.get_group_from_macs([macs["X5-9-2"], macs["X5-9-1"]], 500)
    assert (group.size, group.request_info(500).serial) == (2, ["X5-9-2", "X5-9-1"])
    group.command_lifetime = 70
    assert [served.actuator.command_lifetime for served in bench] == [0.07, 0.07]
    command = hebi.GroupCommand(2)
    command.create_view([1]).control_strategy = int(Strategy.DIRECT_PWM)
    assert group.send_command_with_acknowledgement(command, 500)
    assert [served.actuator.strategy for served in bench] == [Strategy.DIRECT_PWM, Strategy.OFF]
    frames = [frame for _ in range(50) if (frame := group.get_next_feedback(100.0)) is not None][:3]
    for before, after in itertools.pairwise(frames):
        assert all(a < b for a, b in zip(before.receive_time_us, after.receive_time_us, strict=True))
    bench[0].end()
    command.clear()
    command.control_strategy = int(Strategy.OFF)
    assert not group.send_command_with_acknowledgement(command, 50)
    assert group.request_info(50) is None
    # What was sent to the one that hears comes, and a frame without the other one keeps its old record.
    wait_for(lambda: bench[1].actuator.strategy is Strategy.OFF, 10.0, "the one that hears to be off")
    late = [frame for _ in range(20) if (frame := group.get_next_feedback(50.0)) is not None]
    assert late[-1].receive_time_us[0] > late[-2].receive_time_us[0]
    assert late[-1].receive_time_us[1] == late[-2].receive_time_us[1]
