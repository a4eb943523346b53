"""``emulator``: emulate the X5-9; ``emulator_fault``: inject its faults; ``emulator_hand``: turn the link a little."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pendulum_hw_bridge.emulation import EMULATOR_PRESET_NAMES
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["fault_main", "hand_main", "main"]

_HAND_PATIENCE_NS = 10 * 10**9
_ADDRESS = "127.0.0.1:17590"


def emulator(
    address: Annotated[str, typer.Option(help="HOST:PORT to listen on (UDP).")] = _ADDRESS,
    plant: Annotated[
        str | None,
        typer.Option(help=f"{EMULATOR_PRESET_NAMES}, or a plant file with a drivetrain; with --drive any plant."),
    ] = None,
    drive: Annotated[
        str, typer.Option(help="Backend of another drive to emulate: dynamixel, on a pseudo-terminal.")
    ] = "",
    link: Annotated[
        Path | None, typer.Option(help="With --drive: new link to its terminal, under a fixed name.")
    ] = None,
    position: Annotated[float, typer.Option(help="Where the pendulum is at the start [rad].")] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of sensor noise and timing jitter.")] = 0,
    flat: Annotated[bool, typer.Option(help="The pendulum lies flat: no gravity.")] = False,
    heating: Annotated[bool, typer.Option(help="Let the motor of the preset thesis warm up too.")] = False,
    truth: Annotated[
        Path | None, typer.Option(help="New CSV file for what link and motor really do, each millisecond.")
    ] = None,
    family: Annotated[str, typer.Option(help="HEBI family that it reports.")] = "emulated",
    name: Annotated[str, typer.Option(help="HEBI name that it reports; by default the plant's.")] = "",
    serial: Annotated[str, typer.Option(help="Serial number that it reports.")] = "X5-9-E0001",
    module_type: Annotated[str, typer.Option(help="Module type that it reports.")] = "X5-9",
) -> None:
    """Serve an emulated X5-9, or another drive, that goes on when the bridge ends, as a real one does.

    Example: python -m pendulum_hw_bridge emulator --plant x5_9 --position 3.14
    """
    from pendulum_hw_bridge.emulation import wire
    from pendulum_hw_bridge.emulation.parameters import load_emulator
    from pendulum_hw_bridge.emulation.server import EmulatorIdentity, EmulatorServer
    from pendulum_hw_bridge.emulation.truth_log import truth_log
    from pendulum_hw_bridge.emulation.x5 import EmulatedX5
    from pendulum_msgs_py.contract.timing import SteadyWallClock
    from pendulum_msgs_py.programs.realtime import run_ahead, thread_numbers

    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: stopped.append(received))
    clock = SteadyWallClock()
    if drive:
        with nullcontext() if link is None else _linked(link) as ready:
            _serve_drive(drive, plant, position, seed, clock, lambda: not stopped, ready or str)
        return
    plant = plant or "thesis"
    parameters = replace(load_emulator(plant, heating=heating), flat=flat)
    actuator = EmulatedX5(parameters, seed=seed, position=position, start_ns=clock())
    # Compile before listening: the first seconds would not be in real time.
    actuator.advance_to(clock())
    identity = EmulatorIdentity(family, name, serial, module_type)
    server = EmulatorServer(actuator, wire.parse_address(address), clock, identity)
    host, port = server.address
    # A real module does not compete with other programs for a processor.
    run_ahead(thread_numbers())
    print(f"emulated X5-9 ({parameters.plant.name}) listens on {host}:{port}", flush=True)
    with nullcontext() if truth is None else truth_log(truth) as actuator.trace:
        server.serve(lambda: not stopped)
    print("emulated X5-9 ends", flush=True)


@contextmanager
def _linked(link: Path) -> Iterator[Callable[[str], str]]:
    """Yield a function that makes a link to a path; the link is removed afterwards."""
    if link.exists() or link.is_symlink():
        raise ParameterError(f"link {link} is there already; expected a new one")

    def make(path: str) -> str:
        link.symlink_to(path)
        return str(link)

    try:
        yield make
    finally:
        link.unlink(missing_ok=True)


def _serve_drive(
    drive: str,
    plant: str | None,
    position: float,
    seed: int,
    clock: Callable[[], int],
    running: Callable[[], bool],
    name: Callable[[str], str],
) -> None:
    from pendulum_hw_bridge.backends import BACKENDS
    from pendulum_hw_bridge.emulation.dynamixel_servo import EmulatedServo, ServoLine, serve
    from pendulum_hw_bridge.emulation.machine import EmulatedMachine
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism
    from pendulum_msgs_py.programs.realtime import run_ahead, thread_numbers

    drives = [name for name, backend in BACKENDS.items() if backend.torque_drive]
    if drive not in drives:
        raise ParameterError(f"drive is {drive!r}; expected one of {', '.join(drives)}")
    parameters = load_mechanism(plant or str(BACKENDS[drive].defaults["plant"]))
    start = [position] * len(parameters.joints)
    machine = EmulatedMachine(parameters, seed=seed, position=tuple(start), start_ns=clock(), rate=1.0)
    machine.advance_to(clock(), wholly=True)
    servos = [EmulatedServo(machine, index, number=index + 1) for index in machine.coordinates.driven]
    numbers = ", ".join(str(servo.number) for servo in servos)

    # A real servo does not compete with other programs for a processor.
    run_ahead(thread_numbers())

    def ready(path: str) -> None:
        print(f"emulated {drive} ({parameters.name}), number {numbers}, on {name(path)}", flush=True)

    serve(ServoLine(servos), clock, running, ready)


def emulator_fault(
    faults: Annotated[list[str] | None, typer.Argument(help="Names of faults to begin; none lists them.")] = None,
    clear: Annotated[bool, typer.Option("--clear", help="End all faults first.")] = False,
    address: Annotated[str, typer.Option(help="HOST:PORT of the emulator.")] = _ADDRESS,
    as_json: Json = False,
) -> None:
    """Let faults begin or end in a running emulator.

    Example: python -m pendulum_hw_bridge emulator_fault m_stop
    """
    from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend

    known = [fault.value for fault in ActuatorFault]
    for name in faults or []:
        if name not in known:
            raise ParameterError(f"fault is {name!r}; expected one of {', '.join(known)}")
    if not faults and not clear:
        if as_json:
            print(json.dumps({"faults": known}))
            return
        table = WholeTable("fault", "what fails", title="Faults of the emulated actuator")
        for fault in ActuatorFault:
            table.add_row(fault.value, fault.meaning)
        make_console().print(table)
        return
    backend = EmulatorProcessBackend(address)
    backend.connect()
    if clear:
        backend.clear_faults()
    if faults:
        backend.inject(*faults)
    # Not closed, because that would stop a motor that another program drives.
    if as_json:
        print(json.dumps({"in_force": backend.status()["faults"]}))
        return
    print("faults in force: " + (", ".join(backend.status()["faults"]) or "none"))


def emulator_hand(
    clockwise: Annotated[bool, typer.Option("--clockwise", help="The other way.")] = False,
    angle: Annotated[float, typer.Option(help="How far to turn the link [rad].", min=0.01, max=1.0)] = 0.2,
    address: Annotated[str, typer.Option(help="HOST:PORT of the emulator.")] = _ADDRESS,
) -> None:
    """Turn the link of a running emulator a little, counter-clockwise, and let go: a person's hand in a rehearsal.

    Example: python -m pendulum_hw_bridge emulator_hand --clockwise
    """
    from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
    from pendulum_hw_bridge.checks.nudge import EmulatedHand

    backend = EmulatorProcessBackend(address)
    backend.connect()
    hand = EmulatedHand(backend.push, -1 if clockwise else 1)
    start = backend.status()["link"]["position"]
    until = backend.now_ns() + _HAND_PATIENCE_NS
    hand.begin()
    try:
        while abs(turned := backend.status()["link"]["position"] - start) < angle:
            if backend.now_ns() > until:
                raise ParameterError(f"link turned by {turned:.2f} rad; expected {angle:g} rad: is the motor driven?")
    finally:
        hand.end()
        # A reply to a later request proves that the hand has released.
        backend.status()
        backend.release()
    print(f"turned by {turned:+.2f} rad, and let go")


main = command_line(emulator, "python -m pendulum_hw_bridge emulator")
hand_main = command_line(emulator_hand, "python -m pendulum_hw_bridge emulator_hand")
fault_main = command_line(emulator_fault, "python -m pendulum_hw_bridge emulator_fault")
