"""Every way out of driving, by the motor's own record: no sample exceeds the torque before the request.

``python -m tests.tools.faults.ways_out`` writes a table. Real ports drive emulated modules, in simulated time or over
UDP, under each strategy of the firmware; packets of the way out are late, lost or doubled, with time between them.
"""

from __future__ import annotations

import contextlib
import heapq
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Protocol
from unittest import mock

import typer
from rich.progress import track

from pendulum_bags.runs.run_folder import write_json
from pendulum_hw_bridge.backends import emulator_process, hebi, hebi_group
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.backends.hebi import HebiBackend
from pendulum_hw_bridge.backends.hebi_discovery import ModuleSelection
from pendulum_hw_bridge.backends.hebi_emulated import EmulatedGroup, EmulatedLookup
from pendulum_hw_bridge.backends.hebi_group import GroupDrive, HebiGroup
from pendulum_hw_bridge.backends.hebi_log import import_hebi
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.server import EmulatorIdentity, EmulatorServer
from pendulum_hw_bridge.emulation.x5 import EmulatedX5, LinkState
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, Command, HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from tests.tools.faults.bridge_rig import Rig
from tests.tools.faults.motor import driving_torque

__all__ = [
    "BENCHES",
    "FADES",
    "FATES",
    "PHASES",
    "STRATEGIES",
    "WAYS",
    "Exit",
    "fade_out",
    "is_possible",
    "take_way_out",
]

STRATEGIES = tuple(Strategy)[1:]
PHASES = ("hold", "ramp", "regulation")
ANGLE = 0.9
"""Where the link hangs: its weight is 1.31 N m there [rad]."""
_RAMP = 0.4
_SWING = 0.8
_PERIOD = 0.01
_AFTER = 0.1
_PARAMETERS = load_emulator("thesis")
_DRIVE = _PARAMETERS.drivetrain
PER_DUTY = _DRIVE.supply_voltage * _DRIVE.gear_ratio * _DRIVE.torque_constant / _DRIVE.winding_resistance
_ATTEMPT = 0.015


class Fate(NamedTuple):
    """When packets of a way out arrive; a packet that never does is lost.

    Attributes:
        setpoints: Delays of the setpoints, each time that they arrive [s].
        settings: The same of each attempt to change the strategy, in their order; later ones arrive at once.
    """

    setpoints: tuple[float, ...] = (0.0,)
    settings: tuple[tuple[float, ...], ...] = ((0.002,),)


FATES = {
    "in time": Fate(),
    "settings 12 ms late": Fate(settings=((0.012,),)),
    "settings lost once": Fate(settings=((),)),
    "settings lost twice": Fate(settings=((), ())),
    "setpoints lost": Fate(()),
    "setpoints behind settings": Fate((0.006,)),
    "each packet doubled": Fate((0.0, 0.005), ((0.002, 0.008),)),
}


class Exit(NamedTuple):
    """What a motor did before and after the first packet of a way out arrived; until then nothing has changed.

    Attributes:
        torque_before: Largest driving torque [N m].
        torque_after: The same afterwards.
        duty_before: Largest duty [-].
        duty_after: The same afterwards.
        lasting: Time from that packet to the last duty [s].
    """

    torque_before: float
    torque_after: float
    duty_before: float
    duty_after: float
    lasting: float

    @property
    def exceeds(self) -> bool:
        """Whether a sample after the way out began exceeds those before, beyond the steps of duty and of time."""
        return self.torque_after > self.torque_before + 0.05 or self.duty_after > self.duty_before + 5e-4


class _Packets:
    """Delays of packets while a way out is watched; without one, packets arrive at once.

    Attributes:
        fate: What becomes of the packets from now on.
        arrived_ns: When the first of them arrived [ns].
    """

    def __init__(self) -> None:
        self.fate: Fate | None = None
        self.arrived_ns: float = math.inf
        self._attempts = 0

    def delays(self, *, settings: bool) -> Sequence[float]:
        """Return after which delays the next packet arrives [s]."""
        if self.fate is None:
            return (0.0,)
        if not settings:
            return self.fate.setpoints
        self._attempts += 1
        attempts = self.fate.settings
        return attempts[self._attempts - 1] if self._attempts <= len(attempts) else (0.0,)

    def arrive(self, time_ns: int) -> None:
        """Take note of a packet that arrives [ns]."""
        if self.fate is not None:
            self.arrived_ns = min(self.arrived_ns, time_ns)


class Bench(Protocol):
    """Emulated modules, and the ports that drive them; the record of the first is judged."""

    @property
    def ports(self) -> Sequence[ActuatorPort]:
        """The ports of all modules."""

    @property
    def packets(self) -> Sequence[_Packets]:
        """What becomes of the packets to each module."""

    @property
    def record(self) -> list[LinkState]:
        """What the motor of the first did."""

    @property
    def before(self) -> float:
        """Time before a way out whose largest torque is that before it [s]: packets take theirs in real time."""

    @property
    def lifetime(self) -> float:
        """Command lifetime [s]; in real time a busy computer must not let commands lapse."""

    def reconnect(self) -> ActuatorPort:
        """Return another port of the first module, not connected yet."""

    def now_ns(self) -> int:
        """Return the time of the record [ns]."""

    def wait(self, seconds: float) -> None:
        """Let time pass, at the module too [s]."""

    def muted(self, call: Callable[[], object]) -> None:
        """Let a request reach the modules and no acknowledgement come back."""


class _SlowActuator(EmulatedX5):
    """An emulated module that settings and setpoints reach when its packets say, on a simulated clock."""

    def __init__(self, clock: SteppedClock, packets: _Packets) -> None:
        super().__init__(_PARAMETERS, position=ANGLE, start_ns=clock.now_ns())
        self._host, self._packets = clock, packets

    def deliver(self, command: Command, arrival_ns: int, sender: int = 1) -> None:
        for delay in self._packets.delays(settings=False):
            late_ns = arrival_ns + round(delay * NANOSECONDS)
            self._packets.arrive(late_ns)
            super().deliver(command, late_ns, sender)

    def configure(self, **changes: Any) -> None:
        if changes.get("strategy") is None or self._packets.fate is None:
            super().configure(**changes)
            return
        while not (delays := self._packets.delays(settings=True)):
            self._pass(_ATTEMPT)
        passed = 0.0
        for delay in delays:
            self._pass(delay - passed)
            passed = delay
            self._packets.arrive(self.now_ns)
            super().configure(**changes)

    def _pass(self, seconds: float) -> None:
        self._host.wait_until(self._host.now_ns() + round(seconds * NANOSECONDS))
        self.advance_to(self._host.now_ns())


class _SimulatedBench:
    """The backend ``emulator``, in simulated time."""

    before = 0.008
    lifetime = 0.05

    def __init__(self) -> None:
        self._clock = SteppedClock(NANOSECONDS)
        self.packets = [_Packets()]
        self._actuator = _SlowActuator(self._clock, self.packets[0])
        self.record: list[LinkState] = []
        self._actuator.trace = self.record.append
        self.ports = [self.reconnect()]

    def reconnect(self) -> ActuatorPort:
        return EmulatorBackend(self._actuator, self._clock)

    def muted(self, call: Callable[[], object]) -> None:
        raise NotImplementedError("an acknowledgement in one process is not lost")

    def now_ns(self) -> int:
        self._actuator.advance_to(self._clock.now_ns())
        return self._clock.now_ns()

    def wait(self, seconds: float) -> None:
        self._clock.wait_until(self._clock.now_ns() + round(seconds * NANOSECONDS))
        self._actuator.advance_to(self._clock.now_ns())


class _SlowServer(EmulatorServer):
    """An emulator that packets reach when they say."""

    packets: _Packets

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.packets = _Packets()
        self.is_muted = False
        self.turns = 0
        self._held: list[tuple[int, int, bytes, tuple[str, int]]] = []
        self._count = 0

    def _send(self, packet: bytes, receiver: tuple[str, int]) -> None:
        if not self.is_muted:
            super()._send(packet, receiver)

    def _turn(self, patience: float) -> None:
        self.turns += 1
        super()._turn(0.001 if self._held else patience)
        while self._held and self._held[0][0] <= self._clock():
            due, _, packet, sender = heapq.heappop(self._held)
            self._arrive(packet, sender, max(due, self.actuator.now_ns))

    def _receive(self, packet: bytes, sender: tuple[str, int], now: int) -> None:
        settings = "strategy" in ((wire.decode_json(packet) or {}).get("settings") or {})
        delays: Sequence[float] = (0.0,)
        if settings or wire.kind_of(packet) == wire.COMMAND:
            delays = self.packets.delays(settings=settings)
        for delay in delays:
            if delay == 0.0:
                self._arrive(packet, sender, now)
            else:
                self._count += 1
                heapq.heappush(self._held, (now + round(delay * NANOSECONDS), self._count, packet, sender))

    def _arrive(self, packet: bytes, sender: tuple[str, int], now: int) -> None:
        if wire.kind_of(packet) == wire.COMMAND:
            self.packets.arrive(now + round(self.actuator.parameters.timing.command_delay * NANOSECONDS))
        elif "settings" in wire.decode_json(packet):
            self.packets.arrive(now)
        super()._receive(packet, sender, now)


class _UdpBench:
    """Modules behind UDP in threads of this process, and one of the backends that speak to them."""

    before = 0.15
    lifetime = 0.3

    def __init__(self, backend: str, modules: int) -> None:
        self._clock = SteadyWallClock()
        self._running = threading.Event()
        self._running.set()
        self.record: list[LinkState] = []
        self._servers = servers = [self._serve(number) for number in range(modules)]
        self.packets = [server.packets for server in servers]
        self._actuator = servers[0].actuator
        self._actuator.trace = self.record.append
        self._threads = [threading.Thread(target=server.serve, args=(self._running.is_set,)) for server in servers]
        for thread in self._threads:
            thread.start()
        where = ["{}:{}".format(*server.address) for server in servers]
        self._backend, self._where = backend, where
        self.ports = self._group(where) if backend == "hebi_group" else [self.reconnect()]

    def _serve(self, number: int) -> _SlowServer:
        actuator = EmulatedX5(_PARAMETERS, position=ANGLE, start_ns=self._clock())
        identity = EmulatorIdentity("Lab", f"module_{number}", f"S-{number}")
        # Compiled before anybody listens.
        actuator.advance_to(self._clock())
        actuator.place(ANGLE)
        return _SlowServer(actuator, ("127.0.0.1", 0), self._clock, identity)

    def reconnect(self) -> ActuatorPort:
        if self._backend == "emulator_process":
            return EmulatorProcessBackend(self._where[0])
        return HebiBackend(make_group=lambda: EmulatedGroup(self._where[0], import_hebi()))

    def _group(self, where: list[str]) -> list[ActuatorPort]:
        joints = [(f"joint_{number}", ModuleSelection(serial=f"S-{number}")) for number in range(len(where))]
        lookup = EmulatedLookup("emulator:" + ",".join(where), import_hebi())
        shared = HebiGroup(joints, range(len(where)), look_time=0.5, lookup=lambda: lookup)
        return [GroupDrive(shared, number) for number in range(len(where))]

    def now_ns(self) -> int:
        return self._clock()

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)
        # Whatever was sent before has arrived: a turn that begins now takes it.
        turns = [server.turns for server in self._servers]
        while any(server.turns < before + 2 for server, before in zip(self._servers, turns, strict=True)):
            time.sleep(0.001)

    def muted(self, call: Callable[[], object]) -> None:
        for server in self._servers:
            server.is_muted = True
        with _patience(0.05), contextlib.suppress(ActuatorError):
            call()
        for server in self._servers:
            server.is_muted = False

    def end(self) -> None:
        for port in self.ports:
            with contextlib.suppress(ActuatorError):
                port.close()
        self._running.clear()
        for thread in self._threads:
            thread.join()


BENCHES = ("emulator", "emulator_process", "hebi", "hebi_group")
"""Backends whose motors are judged; ``hebi`` and ``hebi_group`` are hebi-py's own commands to emulated modules."""


@contextlib.contextmanager
def bench_of(backend: str) -> Iterator[Bench]:
    """Return emulated modules and the ports of a backend; of two joints for ``hebi_group``."""
    if backend == "emulator":
        yield _SimulatedBench()
        return
    bench = _UdpBench(backend, 2 if backend == "hebi_group" else 1)
    # The acknowledgement of a thread on a busy computer comes late; what is lost is lost all the same.
    with _patience(5.0):
        try:
            yield bench
        finally:
            bench.end()


@contextlib.contextmanager
def _patience(seconds: float) -> Iterator[None]:
    """Let ports wait so long for an acknowledgement of settings [s]."""
    milliseconds = round(1e3 * seconds)
    with (
        mock.patch.object(emulator_process, "_ACKNOWLEDGE", seconds),
        mock.patch.object(hebi, "ACKNOWLEDGE_MS", milliseconds),
        mock.patch.object(hebi_group, "ACKNOWLEDGE_MS", milliseconds),
    ):
        yield


# --- driving -------------------------------------------------------------------------------------------------------


def _setpoints(strategy: Strategy, phase: str, cycle: int) -> Command:
    """Return the setpoints of a cycle: the weight held, a ramp, or a torque that swings around it."""
    weight = _PARAMETERS.plant.gravity * math.sin(ANGLE)
    swing = _SWING * math.sin(4.0 * math.pi * _PERIOD * cycle)
    if strategy is Strategy.DIRECT_PWM:
        effort = weight + {"hold": 0.0, "ramp": 3.0, "regulation": swing}[phase]
        return Command(pwm=effort / PER_DUTY)
    if phase == "regulation":
        return Command(effort=weight + swing)
    stiffness = DEFAULT_GAINS[int(strategy)].position.kp * (PER_DUTY if strategy is Strategy.PARALLEL_PWM else 1.0)
    target = ANGLE + weight / stiffness
    if phase == "hold":
        return Command(position=target)
    return Command(position=target + _RAMP * _PERIOD * cycle, velocity=_RAMP)


def _drive(bench: Bench, strategy: Strategy, phase: str, cycles: int) -> None:
    for port in bench.ports:
        port.connect()
        port.set_strategy(Strategy.OFF)
        port.set_limits(HardwareLimits(effort=13.0))
        port.set_command_lifetime(bench.lifetime)
        port.set_gains(DEFAULT_GAINS[int(strategy)])
    for port in bench.ports:
        port.set_strategy(strategy, _setpoints(strategy, phase, 0))
    for cycle in range(cycles):
        command = _setpoints(strategy, phase, cycle)
        for port in bench.ports:
            port.write(command)
        for port in bench.ports:
            getattr(port, "flush", lambda: None)()
        bench.wait(_PERIOD)


def _stop(bench: Bench, strategy: Strategy) -> int:
    request_ns = bench.now_ns()
    for port in bench.ports:
        # Each is asked, whatever another says.
        with contextlib.suppress(ActuatorError):
            port.stop()
    return request_ns


def _close(bench: Bench, strategy: Strategy) -> int:
    request_ns = bench.now_ns()
    for port in bench.ports:
        with contextlib.suppress(ActuatorError):
            port.close()
    return request_ns


def _hand_over(bench: Bench, strategy: Strategy) -> int:
    request_ns = bench.now_ns()
    for port in bench.ports:
        port.set_strategy(_another(strategy))
    return request_ns


def _restart(bench: Bench, strategy: Strategy) -> int:
    """Let another bridge take the module, as one does that starts while an earlier one drives or has gone."""
    request_ns = bench.now_ns()
    port = bench.reconnect()
    port.connect()
    port.set_strategy(Strategy.OFF)
    port.close()
    return request_ns


def _uncertain(bench: Bench, strategy: Strategy) -> int:
    """Stop after a change of strategy that arrived and whose acknowledgement did not."""
    request_ns = bench.now_ns()
    bench.muted(lambda: bench.ports[0].set_strategy(_another(strategy)))
    return min(request_ns, _stop(bench, strategy))


def _frozen(bench: Bench, strategy: Strategy) -> int:
    """Stop after a pause in which the command lifetime ended, as after SIGSTOP and SIGCONT."""
    bench.wait(2.0 * bench.lifetime)
    return _stop(bench, strategy)


def _killed(bench: Bench, strategy: Strategy) -> int:
    """Send nothing any more: the command lifetime ends the torque."""
    bench.wait(1.1 * bench.lifetime)
    return bench.now_ns()


def _another(strategy: Strategy) -> Strategy:
    return Strategy.PARALLEL_PWM if strategy is Strategy.DIRECT_PWM else Strategy.DIRECT_PWM


WAYS: dict[str, Callable[[Bench, Strategy], int]] = {
    "stop": _stop,
    "close": _close,
    "hand-over without torque": _hand_over,
    "another bridge": _restart,
    "stop, strategy uncertain": _uncertain,
    "stop after a pause": _frozen,
    "killed": _killed,
}
"""Ways out; each returns when it was requested [ns]."""
FADING = "bridge with stop_time"
STOP_TIME = 0.2
"""[s]"""
FADES: dict[str, Callable[[Rig], None]] = {
    "e-stop": Rig.e_stop,
    "disarm": Rig.disarm,
    "close": Rig.close,
    "fault": lambda rig: rig.bridge.fail("host_stalled", "did not run"),
}
"""Stops of a bridge whose torque fades; its end and a fault cut it."""
_PAUSED = {"stop after a pause", "killed"}
"""Ways that begin when the command lifetime has ended all torque: packets may bring none back."""


def is_possible(backend: str, way: str) -> bool:
    """Return whether a backend has this way: no acknowledgement is lost in one process, and a group is one port."""
    if way == "stop, strategy uncertain":
        return backend != "emulator"
    return way != "another bridge" or backend != "hebi_group"


def take_way_out(backend: str, strategy: Strategy, phase: str, way: str, fate: Fate, cycles: int = 25) -> Exit:
    """Drive a module, leave, and return what its motor did.

    Args:
        backend: One of :data:`BENCHES`.
        strategy: Of the firmware, not off.
        phase: One of :data:`PHASES`.
        way: One of :data:`WAYS`.
        fate: When the packets of the way out arrive.
        cycles: How long to drive before [10 ms].
    """
    with bench_of(backend) as bench:
        _drive(bench, strategy, phase, cycles)
        # Between two cycles of the firmware, wherever that is.
        bench.wait(1e-3 * (cycles % 7))
        for packets in bench.packets:
            packets.fate = fate
        begin_ns: float = WAYS[way](bench, strategy)
        bench.wait(_AFTER)
        record = list(bench.record)
    if way not in _PAUSED:
        begin_ns = min(packets.arrived_ns for packets in bench.packets[:1])
    return _exit_of([(link.time_ns, link.pwm, link.motor_torque) for link in record], begin_ns, bench.before)


def fade_out(kind: EffortStrategy, way: str, cycles: int = 25) -> Exit:
    """Hold the weight through a bridge whose stops fade, stop, and return what the motor did.

    Args:
        kind: How a torque is made; by the torque loop no stop fades.
        way: One of :data:`FADES`.
        cycles: How long to drive before [10 ms].
    """
    rig = Rig(kind=kind, start=ANGLE)
    rig.supervisor.limits = replace(rig.supervisor.limits, stop_time=STOP_TIME)
    rig.controlling = rig.disturbing = False

    def command() -> None:
        assert rig.bridge.sample is not None
        weight = _PARAMETERS.plant.gravity * math.sin(ANGLE)
        rig.send(JointCommand.of_one(rig.bridge.sample.stamp_ns, weight, "controller"))

    rig.break_cycle = command
    rig.run(cycles * _PERIOD)
    begin_ns = rig.clock.now_ns()
    FADES[way](rig)
    rig.run(STOP_TIME + _AFTER)
    return _exit_of(rig.duties, begin_ns, 2.0 * _PERIOD)


def _exit_of(record: Sequence[tuple[int, float, float]], begin_ns: float, before: float) -> Exit:
    """Return what a motor did before and after an instant, from its times [ns], duties [-] and torques [N m]."""
    parts: tuple[list[tuple[int, float, float]], ...] = ([], [])
    for each in record:
        if each[0] > begin_ns - before * NANOSECONDS:
            parts[each[0] > begin_ns].append(each)
    (torque_before, duty_before), (torque_after, duty_after) = (
        (
            max(abs(driving_torque(pwm, torque, PER_DUTY)) for _, pwm, torque in part),
            max(abs(pwm) for _, pwm, _ in part),
        )
        for part in parts
    )
    last_ns = max((time_ns for time_ns, pwm, _ in parts[1] if pwm != 0.0), default=begin_ns)
    return Exit(torque_before, torque_after, duty_before, duty_after, (last_ns - begin_ns) / NANOSECONDS)


# --- table ---------------------------------------------------------------------------------------------------------

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m tests.tools.faults.ways_out --repetitions 20")
def ways_out(
    backends: Annotated[str, typer.Option(help="Backends, with commas between.")] = ",".join(BENCHES),
    repetitions: Annotated[int, typer.Option(help="Of each way out, strategy and phase.", min=1)] = 20,
    out: Annotated[Path, typer.Option(help="Where the rows go.")] = Path("build", "ways_out.json"),
) -> int:
    """Leave in every way and print what the motors did; exit code 1 where torque exceeds that before the request."""
    rows: list[tuple[str, str, Strategy | EffortStrategy, str]] = [
        (backend, way, strategy, phase)
        for backend in backends.split(",")
        for way in WAYS
        if is_possible(backend, way)
        for strategy in STRATEGIES
        for phase in PHASES
    ]
    rows += [(FADING, way, EffortStrategy.DIRECT_PWM, "hold") for way in FADES]
    names = (
        "backend",
        "way out",
        "strategy",
        "phase",
        "tried",
        "beyond",
        "N m before",
        "N m after",
        "duty before",
        "duty after",
        "s to zero",
    )
    table = WholeTable(*names)
    results = []
    beyond = 0
    fates = list(FATES.values())
    for number, (backend, way, strategy, phase) in enumerate(
        track(rows, "ways out", transient=True, disable=not sys.stdout.isatty())
    ):
        exits = [
            fade_out(strategy, way, 20 + repetition)
            if isinstance(strategy, EffortStrategy)
            else take_way_out(backend, strategy, phase, way, fates[(number + repetition) % len(fates)], 20 + repetition)
            for repetition in range(repetitions)
        ]
        worst = max(exits, key=lambda one: one.torque_after - one.torque_before)
        wrong = sum(one.exceeds for one in exits)
        beyond += wrong
        figures = (f"{value:.3f}" for value in worst)
        cells = (backend, way, strategy.name, phase, str(len(exits)), str(wrong), *figures)
        table.add_row(*cells)
        results.append(dict(zip(names, cells, strict=True)))
    make_console().print(table)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, results)
    return int(beyond > 0)


if __name__ == "__main__":
    raise SystemExit(cli_main(app, sys.argv[1:], name="ways_out"))
