"""Several HEBI modules in one group, rule by rule, on hebi-py's own commands, with modules and a clock of ours."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge.backends import hebi_group
from pendulum_hw_bridge.backends.hebi_discovery import ModuleSelection, discover
from pendulum_hw_bridge.backends.hebi_emulated import _holds, _Of
from pendulum_hw_bridge.backends.hebi_group import GroupDrive, GroupEncoder, HebiGroup
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES
from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, CommandLock, Strategy, no_torque
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import GAIN_FIELDS, LOOPS
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.drive import Drive, DriveKind, Mode, PlantLimits
from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.contract.supervisor import PlantSupervisor
from pendulum_testing.scripted_port import DRIVETRAIN, PERIOD, STEP

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")

NAMES = ("shoulder", "elbow")
JOINTS = tuple(Joint(name) for name in NAMES)
BOTH = Coordinates(JOINTS, (0, 1))
ACROBOT = Coordinates(JOINTS, (1,))
PENDUBOT = Coordinates(JOINTS, (0,))
SETPOINTS = ("position", "velocity", "effort")
ENDS = [f"{what}_limit_{end}" for what in ("effort", "velocity", "position") for end in ("min", "max")]
SETTINGS = [
    "control_strategy",
    "mstop_strategy",
    *ENDS,
    "min_position_limit_strategy",
    "max_position_limit_strategy",
    *(f"{loop}_{name}" for loop in LOOPS for name in GAIN_FIELDS),
]


@pytest.fixture(autouse=True)
def _no_look_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hebi_group, "discover", functools.partial(discover, wait=lambda seconds: None))


class Fake:
    """One module: who it is, what was set in it, and what it sends."""

    def __init__(self, name: str, serial: str, mac: str) -> None:
        self.identity = {
            "family": "Lab",
            "name": name,
            "serial": serial,
            "firmware_revision": "1",
            "mechanical_type": "X5-9",
        }
        self.mac = mac
        self.settings: dict[str, Any] = dict.fromkeys(SETTINGS, 0.0) | {"control_strategy": 0, "mstop_strategy": 1}
        self.deaf = False
        self.keeps: set[str] = set()
        """Settings that it says to take, and does not."""
        self.record: dict[str, float] = {}
        self.packets: list[dict[str, float]] = []
        self.count = 0

    def take(self, command: Any) -> None:
        """Take what its part of a packet has, where it hears."""
        has = {name: getattr(command, name)[0] for name in (*SETPOINTS, *SETTINGS) if _holds(command, name, hebi)}
        self.packets.append(has)
        if not self.deaf:
            self.settings |= {
                name: value for name, value in has.items() if name in self.settings and name not in self.keeps
            }

    def read(self, name: str) -> Any:
        return self.identity.get(name, self.settings.get(name))


class Network:
    """hebi-py's lookup and its group of all modules asked for."""

    def __init__(self) -> None:
        self.clock = SteppedClock()
        # The order of the names is not that of the joints.
        self.modules = [Fake("z_first", "S-1", "00:00:00:00:00:0A"), Fake("a_second", "S-2", "00:00:00:00:00:0B")]
        self.chosen: list[Fake] = []
        self.rounds: list[str] = []
        self.works = self.connects = True
        self.lifetime, self.keeps_lifetime = 250, False
        self.feedback_frequency = 100.0
        self.breaks = ""
        self.frames = 0
        self.logs: list[str] = []
        self.answers = True
        self.timeouts: list[float] = []

    # as lookup
    @property
    def entrylist(self) -> list[Any]:
        return [
            SimpleNamespace(
                family="Lab", name=each.identity["name"], mac_address=each.mac, ip_address="10.0.0.1", is_stale=False
            )
            for each in self.modules
        ]

    def get_group_from_macs(self, addresses: list[str], timeout_ms: float) -> Any:
        found = [each for mac in addresses for each in self.modules if each.mac == mac]
        if len(addresses) == 1:
            return SimpleNamespace(request_info=lambda ms: _Infos(found))
        self.chosen = found
        self.timeouts.append(timeout_ms)
        return self if self.connects else None

    # as group
    @property
    def command_lifetime(self) -> int:
        return self.lifetime

    @command_lifetime.setter
    def command_lifetime(self, milliseconds: int) -> None:
        self.lifetime = 250 if self.keeps_lifetime else milliseconds

    @property
    def size(self) -> int:
        return len(self.chosen)

    def send_command(self, command: Any) -> bool:
        self.rounds.append("send")
        if self.breaks == "send":
            raise RuntimeError("broken")
        for index, module in enumerate(self.chosen):
            module.take(_Of(command, index))
        return self.works

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: float) -> bool:
        self.rounds.append("ask")
        for index, module in enumerate(self.chosen):
            module.take(_Of(command, index))
        return not any(module.deaf for module in self.chosen)

    def request_info(self, timeout_ms: float) -> Any:
        return _Infos(self.chosen) if self.answers else None

    def get_next_feedback(self, timeout_ms: float, reuse: Any) -> Any:
        self.frames += 1
        self.timeouts.append(timeout_ms)
        assert type(reuse) is hebi.GroupFeedback
        assert reuse.size == len(self.chosen)
        if not any(module.record for module in self.chosen):
            return None
        names = {name for module in self.chosen for name in module.record}
        return SimpleNamespace(**{name: [each.record.get(name, 0.0) for each in self.chosen] for name in names})

    def start_log(self, folder: str, name: str) -> None:
        self.logs.append(name)

    def stop_log(self) -> None:
        self.logs.append("stopped")


class _Infos:
    def __init__(self, modules: list[Fake]) -> None:
        self._modules = modules

    def __getattr__(self, name: str) -> Any:
        return [module.read(name) for module in self._modules]


class Rig:
    """A bridge on a group of two."""

    def __init__(self, coordinates: Coordinates = BOTH, *selections: ModuleSelection, **options: Any) -> None:
        self.network = Network()
        self.clock = self.network.clock
        self.fakes = self.network.modules
        self.coordinates = coordinates
        chosen = selections or (ModuleSelection(name="z_first"), ModuleSelection(serial="S-2"))
        self.shared = HebiGroup(
            list(zip(NAMES, chosen, strict=True)),
            coordinates.driven,
            look_time=0.01,
            lookup=lambda: self.network,
            **options,
        )
        limits = PlantLimits(effort=(8.0,) * len(coordinates.driven), feedback_timeout=1.0, starvation=100.0)
        self.supervisor = PlantSupervisor(limits, coordinates=coordinates)
        self.bridge = Bridge([self._module(index) for index in (0, 1)], self.supervisor)

    def _module(self, index: int) -> Module:
        monitor = SafetyMonitor(SafetyLimits(winding_current=0.0, pwm_tolerance=9.0, command_tolerance=9.0), PERIOD)
        if index not in self.coordinates.driven:
            return Module(GroupEncoder(self.shared, index, self.clock), monitor, BridgeSettings(), joint=NAMES[index])
        mapping = EffortMapping(EffortStrategy.DIRECT_PWM, DRIVETRAIN, effort_limit=2.0)
        port = GroupDrive(self.shared, index, self.clock)
        return DrivenModule(port, mapping, monitor, BridgeSettings(), joint=NAMES[index])

    def see(self, *given: dict[str, float] | None) -> Any:
        """Let a period pass, each module send a record, None for none, and the bridge observe them."""
        self.clock.wait_until(self.clock.now_ns() + STEP)
        for module, values in zip(self.network.chosen, given or ({}, {}), strict=True):
            if values is None:
                continue
            module.count += 1
            now_us = self.clock.now_ns() // 1000
            module.record = dict.fromkeys(ATTRIBUTES.values(), 0.0) | {
                "deflection": 1e-3 * module.count,
                "voltage": 32.0,
                "motor_winding_temperature": 30.0,
                "pwm_command": 0.0,
                "receive_time_us": now_us,
                "hardware_transmit_time_us": now_us + 1_000_000,
                "mstop_state": 1,
                "temperature_state": 0,
                "command_lifetime_state": 0,
                **dict.fromkeys(("position_limit_state", "velocity_limit_state", "effort_limit_state"), 2),
                **values,
            }
        return self.bridge.observe(0.0)

    def connected(self) -> Rig:
        self.bridge.connect()
        assert self.see() is not None
        return self

    def armed(self) -> Rig:
        self.connected()
        assert self.bridge.prepare() == ""
        assert self.supervisor.arm(self.clock.now_ns(), self.bridge.sample) == ""
        self.forget()
        return self

    def forget(self) -> None:
        self.network.rounds.clear()
        for module in self.fakes:
            module.packets.clear()

    def drive(self, *effort: float) -> Any:
        return self.bridge.carry_out(Drive(DriveKind.EFFORT, effort=effort, push=(0.0, 0.0)), was_armed=True)

    def efforts(self, index: int) -> list[float]:
        return [packet["effort"] for packet in self.fakes[index].packets if "effort" in packet]

    def all_off(self) -> bool:
        hearing = [module for module in self.fakes if not module.deaf]
        offs = [module.settings["control_strategy"] == 0 for module in hearing]
        asked = [any(packet.get("control_strategy") == 0 for packet in module.packets) for module in self.fakes]
        return all(offs) and all(asked) and not any(drive.driving for drive in self.bridge.drives)


# --- which modules ------------------------------------------------------------------------------------------------


def test_each_joint_has_the_module_that_is_named_for_it_whatever_the_order_of_names() -> None:
    rig = Rig().connected()
    infos = [module.info for module in rig.bridge.modules]
    assert [(info.name, info.serial) for info in infos if info] == [("z_first", "S-1"), ("a_second", "S-2")]
    sample = rig.see({"position": 0.25}, {"position": -0.5})
    assert sample.position == (0.25, -0.5)
    other = Rig(BOTH, ModuleSelection(name="a_second"), ModuleSelection(name="z_first")).connected()
    assert [module.info.name for module in other.bridge.modules if module.info] == ["a_second", "z_first"]


@pytest.mark.parametrize(
    ("first", "second", "sentence"),
    [
        ({"serial": "S-1"}, {"name": "z_first"}, r"is meant for shoulder and for elbow; expected one for each"),
        ({"serial": "S-9"}, {"serial": "S-2"}, r"shoulder: no HEBI module \*/\* \(S-9\) answered"),
        ({"serial": "S-1"}, {}, r"elbow: HEBI module \*/\* is not the only one"),
        ({"serial": "S-1"}, {"serial": "S-2", "module_type": "X8-3"}, r"elbow: type of .* is 'X5-9'; expected 'X8-3'"),
    ],
)
def test_a_module_that_is_meant_twice_missing_not_the_only_one_or_of_another_type_is_refused(
    first: dict[str, str], second: dict[str, str], sentence: str
) -> None:
    rig = Rig(BOTH, ModuleSelection(**first), ModuleSelection(**second))
    for _ in range(2):
        with pytest.raises(ActuatorError, match=sentence):
            rig.bridge.connect()
    assert rig.network.rounds == [], "nothing is sent to modules that are not all there"


def test_modules_that_connect_only_in_part_are_refused() -> None:
    rig = Rig()
    rig.network.connects = False
    with pytest.raises(ActuatorError, match="were seen but do not connect as a group"):
        rig.bridge.connect()
    assert rig.network.rounds == []


def test_a_group_of_another_size_is_refused() -> None:
    rig = Rig()
    every = rig.network.get_group_from_macs
    rig.network.get_group_from_macs = lambda macs, ms: every(macs if len(macs) == 1 else [*macs, macs[0]], ms)  # type: ignore[method-assign]
    with pytest.raises(ActuatorError, match="HEBI group has 3 modules; expected 2"):
        rig.bridge.connect()
    assert rig.network.rounds == []


@pytest.mark.parametrize("swapped", [0, 1])
def test_a_module_that_reads_as_another_one_is_refused_when_it_connects_and_when_it_arms(swapped: int) -> None:
    rig = Rig().connected()
    rig.forget()
    rig.fakes[swapped].identity["serial"] = "S-7"
    assert f"{NAMES[swapped]}: HEBI module reads as Lab/" in rig.bridge.prepare()
    assert not any(drive.driving for drive in rig.bridge.drives)
    rig.fakes[0].settings["control_strategy"] = 1
    rig.bridge.release()
    assert rig.all_off()


def test_modules_in_another_order_than_asked_for_are_refused() -> None:
    rig = Rig()
    every = rig.network.get_group_from_macs
    rig.network.get_group_from_macs = lambda macs, ms: every(list(reversed(macs)), ms)  # type: ignore[method-assign]
    with pytest.raises(
        ActuatorError, match=r"shoulder: HEBI module reads as Lab/a_second \(S-2\); expected Lab/z_first"
    ):
        rig.bridge.connect()


def test_modules_are_looked_for_patiently(monkeypatch: pytest.MonkeyPatch) -> None:
    patiences: list[float] = []

    def look(lookup: Any, *, look_time: float, patience: float) -> Any:
        patiences.append(patience)
        return discover(lookup, look_time=look_time, patience=patience, wait=lambda seconds: None)

    monkeypatch.setattr(hebi_group, "discover", look)
    for look_time in (1.0, 2.0, 9.0):
        rig = Rig()
        rig.shared._look_time = look_time
        rig.bridge.connect()
        assert rig.network.timeouts == [5000]
    assert patiences == [3.0, 5.0, 9.0]


def test_modules_that_do_not_tell_their_settings_are_refused() -> None:
    rig = Rig()
    rig.network.answers = False
    with pytest.raises(ActuatorError, match="HEBI modules did not all answer within 200 ms"):
        rig.bridge.connect()
    assert rig.shared.group is None


# --- one round of packets -----------------------------------------------------------------------------------------


def test_one_round_of_packets_carries_the_setpoints_of_all() -> None:
    rig = Rig().armed()
    outcome = rig.drive(1.0, -0.5)
    assert outcome.effort == (1.0, -0.5)
    assert rig.network.rounds == ["send"]
    assert [rig.efforts(0), rig.efforts(1)] == [[0.25], [-0.125]]
    rig.drive(0.0, 0.5)
    assert [rig.efforts(0), rig.efforts(1)] == [[0.25, 0.0], [-0.125, 0.125]]


@pytest.mark.parametrize(("coordinates", "passive"), [(ACROBOT, 0), (PENDUBOT, 1)])
def test_a_passive_module_never_gets_a_strategy_but_off_nor_a_setpoint_but_none(
    coordinates: Coordinates, passive: int
) -> None:
    rig = Rig(coordinates)
    rig.fakes[passive].settings["control_strategy"] = 3
    rig.connected()
    assert rig.fakes[passive].settings["control_strategy"] == 0, "whoever left it on"
    assert rig.bridge.prepare() == ""
    assert rig.supervisor.arm(rig.clock.now_ns(), rig.bridge.sample) == ""
    assert rig.drive(1.0).effort == (1.0,)
    assert rig.efforts(1 - passive)[-1] == 0.25
    rig.bridge.release()
    rig.bridge.close()
    packets = rig.fakes[passive].packets
    assert {packet["control_strategy"] for packet in packets if "control_strategy" in packet} == {0}
    given = [packet[name] for packet in packets for name in SETPOINTS if name in packet]
    assert all(math.isnan(value) for value in given)
    assert {name for packet in packets for name in packet} <= {"control_strategy", *SETPOINTS}


def test_a_passive_port_has_no_way_to_send() -> None:
    rig = Rig(ACROBOT).connected()
    port = rig.bridge.modules[0].port
    assert not any(
        hasattr(port, name) for name in ("write", "set_strategy", "set_gains", "set_limits", "flush", "stop")
    )
    rig.forget()
    with pytest.raises(ActuatorError, match="shoulder is passive: nothing is sent to its module but off"):
        rig.shared.acknowledged(0, hebi.GroupCommand(2), Strategy.DIRECT_PWM, 200)
    assert rig.network.rounds == []


def test_settings_reach_each_driven_module_and_only_it() -> None:
    rig = Rig().connected()
    for module in rig.fakes:
        assert module.settings["effort_limit_max"] == pytest.approx(13.0)
    rig.forget()
    drive = rig.bridge.drives[1]
    drive.port.set_strategy(Strategy.DIRECT_PWM)
    assert [module.settings["control_strategy"] for module in rig.fakes] == [0, 1]
    assert rig.fakes[0].packets == [{}]


def test_a_round_has_the_setpoints_of_this_round_and_nothing_else() -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    rig.drive(1.0, -0.5)
    # Neither the strategy of an earlier packet, nor the setpoint of a joint that has none in this round.
    assert [set(packet) for module in rig.fakes for packet in module.packets] == 2 * [set(SETPOINTS)]
    rig.forget()
    second.write(Command(pwm=0.125))
    first.flush()  # type: ignore[attr-defined]
    assert [rig.fakes[0].packets, rig.efforts(1)] == [[{}], [0.125]]


def test_what_is_set_when_it_is_armed_again_does_not_switch_a_module_on() -> None:
    rig = Rig().armed()
    rig.drive(1.0, -0.5)
    rig.bridge.release()
    rig.see()
    rig.forget()
    assert rig.bridge.prepare() == ""
    for module in rig.fakes:
        with_strategy = [packet for packet in module.packets if "control_strategy" in packet]
        assert [(packet["control_strategy"], packet["effort"]) for packet in with_strategy] == [(1, 0.0)]
        assert module.packets.index(with_strategy[0]) > 0, "settings come before the strategy"
        assert not any(name in packet for packet in module.packets for name in SETPOINTS if packet not in with_strategy)


def test_a_duty_that_was_kept_does_not_become_a_torque_under_another_strategy() -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    first.write(Command(pwm=0.25))
    first.set_strategy(Strategy.PARALLEL_PWM, Command(position=0.0))
    rig.forget()
    second.flush()  # type: ignore[attr-defined]
    assert rig.efforts(0) == []


def test_a_setpoint_that_is_kept_after_the_stop_of_another_joint_dies_with_its_own() -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    first.stop()
    second.write(Command(pwm=0.25))
    second.stop()
    rig.forget()
    first.flush()  # type: ignore[attr-defined]
    assert rig.network.rounds == []


def test_setpoints_that_were_kept_do_not_outlive_the_connection_and_a_new_one_is_stopped_anew() -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    first.stop()
    # What the other joint has kept is still there, since it is let go without a stop.
    rig.shared.keep(1, Command(pwm=0.25))
    rig.shared._stop_reported = {0}
    for port in (first, second):
        port.release()  # type: ignore[attr-defined]
    for port in (first, second):
        port.connect()
    rig.forget()
    first.flush()  # type: ignore[attr-defined]
    assert rig.network.rounds == []
    second.stop()
    assert rig.network.rounds == ["ask"]


def test_setpoints_that_were_kept_do_not_outlive_a_stop() -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    rig.bridge.drives[0].send(Strategy.DIRECT_PWM, no_torque(Strategy.DIRECT_PWM))
    second.stop()
    rig.forget()
    first.flush()  # type: ignore[attr-defined]
    assert rig.network.rounds == []


@pytest.mark.parametrize("stalled", [0, 1])
def test_a_host_that_stood_still_between_the_setpoints_of_two_joints_sends_none_of_them(stalled: int) -> None:
    rig = Rig().armed()
    port = rig.bridge.drives[stalled].port
    write = port.write

    def stall(command: Command) -> Any:
        applied = write(command)
        rig.clock.wait_until(rig.clock.now_ns() + 30_000_000_000)
        return applied

    port.write = stall  # type: ignore[method-assign]
    outcome = rig.drive(1.0, -0.5)
    assert (outcome.fault, outcome.effort) == ("host_stalled", (0.0, 0.0))
    assert rig.all_off()
    given = [effort for index in (0, 1) for effort in rig.efforts(index) if not math.isnan(effort)]
    assert given == [0.0, 0.0], "only the zero before off"


# --- feedback -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stale", [0, 1])
@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
def test_a_frame_with_one_stale_module_is_no_state_and_a_module_that_stays_away_releases_all(
    coordinates: Coordinates, stale: int
) -> None:
    rig = Rig(coordinates).armed()
    given = [None if index == stale else {} for index in (0, 1)]
    assert rig.see(*given) is None
    assert rig.see() is not None
    assert rig.supervisor.mode.armed, rig.supervisor.reason
    rig.drive(*(1.0 for _ in coordinates.driven))
    rig.forget()
    assert [rig.see(*given) for _ in range(5)] == 5 * [None]
    assert rig.all_off()
    assert rig.supervisor.reason.startswith(f"feedback_lost: {NAMES[stale]}: "), rig.supervisor.reason


def test_a_module_that_was_never_heard_makes_no_state_and_is_named() -> None:
    rig = Rig()
    rig.bridge.connect()
    for _ in range(3):
        assert rig.see({}, None) is None
    assert rig.bridge.prepare() == "elbow: no feedback yet"


def test_no_state_is_made_of_two_frames() -> None:
    rig = Rig().connected()
    assert rig.network.frames == 1, "one round of feedback for all"
    assert rig.see({}, None) is None
    assert rig.see(None, {}) is None
    assert rig.see(None, {}) is None
    assert rig.see() is not None


def test_only_the_first_joint_waits_for_a_frame() -> None:
    rig = Rig().connected()
    rig.network.timeouts.clear()
    start = rig.clock.now_ns()
    rig.bridge.observe(0.25)
    assert rig.network.timeouts == [250.0]
    assert rig.clock.now_ns() - start == 250_000_000


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("faulty", [0, 1])
@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ({"hardware_transmit_time_us": 5.0}, "module_restarted"),
        ({"command_lifetime_state": int(CommandLock.LOCKED_BY_OTHER)}, "locked_by_other"),
        ({"mstop_state": 0}, "m_stop"),
        ({"position": math.nan}, "feedback_not_finite"),
    ],
)
def test_a_fault_of_any_module_switches_all_off(
    coordinates: Coordinates, faulty: int, given: dict[str, float], fault: str
) -> None:
    rig = Rig(coordinates).armed()
    rig.drive(*(1.0 for _ in coordinates.driven))
    rig.forget()
    rig.see(*(given if index == faulty else {} for index in (0, 1)))
    assert rig.all_off()
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.supervisor.reason.startswith(f"{fault}: {NAMES[faulty]}: ")


# --- settings and strategies ---------------------------------------------------------------------------------------


def test_modules_that_do_not_all_confirm_that_they_are_off_are_no_plant() -> None:
    rig = Rig()
    rig.fakes[1].deaf = True
    with pytest.raises(ActuatorError, match="did not all confirm within 200 ms that they are off"):
        rig.bridge.connect()


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("stuck", [0, 1])
def test_a_module_that_does_not_go_off_is_refused(coordinates: Coordinates, stuck: int) -> None:
    rig = Rig(coordinates)
    rig.fakes[stuck].settings["control_strategy"] = 3
    rig.fakes[stuck].keeps = {"control_strategy"}
    with pytest.raises(ActuatorError, match=rf"{NAMES[stuck]}: strategy reads back as 3; expected OFF \(0\)"):
        rig.bridge.connect()


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("changed", [0, 1])
def test_a_module_with_a_strategy_that_nobody_here_asked_for_is_not_armed(
    coordinates: Coordinates, changed: int
) -> None:
    rig = Rig(coordinates).connected()
    rig.fakes[changed].settings["control_strategy"] = 2
    rig.fakes[changed].keeps = {"control_strategy"}
    rig.forget()
    assert "strategy reads back as" in rig.bridge.prepare()
    assert not any(drive.driving for drive in rig.bridge.drives)
    assert not [effort for index in (0, 1) for effort in rig.efforts(index) if abs(effort) > 0.0]


def test_a_passive_module_that_is_on_is_no_part_of_the_plant() -> None:
    rig = Rig(ACROBOT).connected()
    rig.fakes[0].settings["control_strategy"] = 3
    with pytest.raises(ActuatorError, match=r"shoulder: strategy reads back as 3; expected OFF \(0\)"):
        rig.bridge.modules[0].port.connect()


@pytest.mark.parametrize("broken", [0, 1])
@pytest.mark.parametrize(
    ("setting", "sentence"), [("position_kp", "position gain kp"), ("effort_limit_max", "effort limits? read")]
)
def test_gains_and_limits_must_read_back_from_each(broken: int, setting: str, sentence: str) -> None:
    rig = Rig()
    rig.fakes[broken].keeps = {setting}
    with pytest.raises(ActuatorError, match=sentence):
        rig.bridge.connect()


def test_the_command_lifetime_is_set_for_all_and_must_read_back() -> None:
    rig = Rig().connected()
    assert rig.network.command_lifetime == 50
    rig.network.keeps_lifetime = True
    rig.network.command_lifetime = 100
    assert "command lifetime reads back as 0.25 s; expected 0.05 s" in rig.bridge.prepare()


# --- stop ---------------------------------------------------------------------------------------------------------


def first_effort(rig: Rig, index: int) -> float:
    """Stop all modules, and return the effort field of the first packet to one of them."""
    rig.forget()
    rig.bridge.drives[0].port.stop()
    return float(rig.fakes[index].packets[0]["effort"])


def test_a_stop_wakes_no_torque_loop_of_a_group_and_is_a_duty_of_zero_where_direct_pwm_is_confirmed() -> None:
    rig = Rig().armed()
    first = rig.bridge.drives[0].port
    first.set_strategy(Strategy.PARALLEL_PWM, Command(position=0.5))
    assert math.isnan(first_effort(rig, 0))
    assert rig.fakes[1].packets[0]["effort"] == 0.0
    rig.forget()
    first.stop()
    # Off is confirmed: there is nothing that a first packet could end.
    assert rig.network.rounds == ["ask"]
    first.set_strategy(Strategy.PARALLEL_PWM)
    first.set_strategy(Strategy.DIRECT_PWM)
    assert first_effort(rig, 0) == 0.0


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("before", [Strategy.DIRECT_PWM, Strategy.PARALLEL_PWM])
def test_a_stop_wakes_no_loop_of_a_group_where_the_acknowledgement_of_the_strategy_was_lost(
    before: Strategy, index: int
) -> None:
    rig = Rig().armed()
    port = rig.bridge.drives[index].port
    port.set_strategy(before)
    rig.fakes[index].deaf = True
    with pytest.raises(ActuatorError, match="did not acknowledge its strategy"):
        port.set_strategy(Strategy.PARALLEL_PWM if before is Strategy.DIRECT_PWM else Strategy.DIRECT_PWM)
    rig.fakes[index].deaf = False
    assert math.isnan(first_effort(rig, index))


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("deaf", [0, 1])
def test_zero_and_off_are_sent_to_every_module_also_when_one_does_not_acknowledge(
    coordinates: Coordinates, deaf: int
) -> None:
    rig = Rig(coordinates).armed()
    rig.drive(*(1.0 for _ in coordinates.driven))
    rig.forget()
    rig.fakes[deaf].deaf = True
    rig.bridge.fail("m_stop", "pressed")
    # One round of no torque, three of off, for all joints together: not as many for each.
    assert rig.network.rounds == ["send", "ask", "ask", "ask"]
    assert rig.all_off()
    for index in coordinates.driven:
        first = rig.fakes[index].packets[0]
        assert list(first) == list(SETPOINTS)
        assert first["effort"] == 0.0
    for module in rig.fakes:
        # Off, and no setpoint that a strategy put in force by somebody else could begin with.
        for off in module.packets[1:]:
            assert off.pop("control_strategy") == 0
            assert list(off) == list(SETPOINTS)
            assert all(math.isnan(value) for value in off.values())
    assert [drive.port.strategy for drive in rig.bridge.drives] == [Strategy.OFF] * len(coordinates.driven)
    assert rig.bridge.stop_pending
    assert rig.bridge.prepare() == "the module has not confirmed that it is off"
    rig.fakes[deaf].deaf = False
    rig.forget()
    rig.clock.wait_until(rig.clock.now_ns() + 100_000_000)
    rig.bridge.insist()
    assert rig.network.rounds == ["send", "ask"]
    assert not rig.bridge.stop_pending
    assert [module.settings["control_strategy"] for module in rig.fakes] == [0, 0]


@pytest.mark.parametrize("sends", ["strategy", "setpoints"])
def test_what_is_sent_after_a_stop_is_stopped_anew(sends: str) -> None:
    rig = Rig().armed()
    first, second = (drive.port for drive in rig.bridge.drives)
    first.stop()
    if sends == "strategy":
        second.set_strategy(Strategy.DIRECT_PWM)
    else:
        second.write(no_torque(Strategy.DIRECT_PWM))
        second.flush()  # type: ignore[attr-defined]
    rig.forget()
    second.stop()
    assert rig.network.rounds[-1:] == ["ask"]
    assert [module.settings["control_strategy"] for module in rig.fakes] == [0, 0]


def test_off_is_sent_even_where_the_zero_before_it_breaks() -> None:
    rig = Rig().armed()
    rig.drive(1.0, 1.0)
    rig.forget()
    rig.network.breaks = "send"
    rig.bridge.release()
    assert rig.all_off()
    assert rig.bridge.stop_pending, "whatever broke, all are asked again"


def test_setpoints_that_cannot_be_sent_release_all() -> None:
    rig = Rig().armed()
    rig.network.works = False
    rig.forget()
    outcome = rig.drive(1.0, 1.0)
    assert (outcome.fault, outcome.effort) == ("send_failed", (0.0, 0.0))
    assert rig.all_off()


def test_a_stop_from_a_second_thread_does_nothing_and_a_write_is_refused() -> None:
    rig = Rig().armed()
    port = rig.bridge.drives[0].port
    caught: list[BaseException] = []

    def run() -> None:
        port.stop()
        for call in (lambda: port.write(no_torque(Strategy.DIRECT_PWM)), port.flush):  # type: ignore[attr-defined]
            try:
                call()
            except ActuatorError as error:
                caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert ["second thread" in str(error) for error in caught] == [True, True]
    assert rig.network.rounds == []


def test_a_drive_that_is_closed_alone_switches_all_off() -> None:
    rig = Rig().armed()
    rig.drive(1.0, 1.0)
    rig.forget()
    rig.bridge.drives[1].port.close()
    assert [rig.efforts(0)[0], rig.efforts(1)[0]] == [0.0, 0.0]
    assert [module.settings["control_strategy"] for module in rig.fakes] == [0, 0]


def test_closing_switches_all_off_and_lets_the_group_go_when_the_last_has_closed(tmp_path: Path) -> None:
    rig = Rig(ACROBOT, log=tmp_path / "run.hebilog").armed()
    rig.drive(1.0)
    rig.forget()
    rig.bridge.modules[0].port.close()
    assert rig.shared.group is not None
    rig.bridge.close()
    assert rig.all_off()
    assert rig.shared.group is None
    assert rig.network.logs == ["run.hebilog", "stopped"]
    rig.bridge.close()
    rig.forget()
    rig.shared._log = None
    rig.bridge.connect()
    assert rig.shared.group is rig.network


def test_the_last_port_releases_the_librarys_group_under_a_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig().connected()
    held: list[bool] = []

    @contextmanager
    def guard() -> Iterator[None]:
        held.append(rig.shared.group is not None)
        yield
        held.append(rig.shared.group is not None)

    monkeypatch.setattr("pendulum_hw_bridge.backends.hebi_group.hang_guard", guard)
    rig.bridge.close()
    assert held == [True, False]
