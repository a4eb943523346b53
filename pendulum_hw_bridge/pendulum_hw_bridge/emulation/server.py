"""Server process of an emulated actuator on UDP, independent of its clients."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError, PendulumError

__all__ = ["EmulatorIdentity", "EmulatorServer"]

_LEASE = 2.0
"""Time for which a client receives feedback after its last packet [s]."""
_BATCH = 64
_TIMESTAMPS = 35
"""``SO_TIMESTAMPNS`` of Linux, missing in :mod:`socket`: system time of a packet's arrival."""
_TIME = struct.Struct("@ll")
_NOTES = socket.CMSG_SPACE(_TIME.size)
_UNREACHABLE = {ActuatorFault.COMMANDS_LOST, ActuatorFault.LOCKED_BY_OTHER}

Address = tuple[str, int]


@dataclass(frozen=True)
class EmulatorIdentity:
    """Identity that an emulated module reports; an empty name stands for that of its plant."""

    family: str = "emulated"
    name: str = ""
    serial: str = "X5-9-E0001"
    type: str = "X5-9"
    firmware: str = "emulated"


class EmulatorServer:
    """Serves one emulated actuator on UDP; its clock must start at the present of ``clock`` [ns]. Port 0 takes any.

    Raises:
        PendulumError: The address is in use or not ours.
    """

    def __init__(
        self,
        actuator: EmulatedX5,
        address: Address,
        clock: Callable[[], int] | None = None,
        identity: EmulatorIdentity | None = None,
    ) -> None:
        self.actuator = actuator
        self._identity = identity or EmulatorIdentity()
        self._clock = clock or SteadyWallClock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise PendulumError(f"emulator cannot listen on {address[0]}:{address[1]}: {error.strerror}") from error
        self._socket.setblocking(False)
        # Kernel timestamps: a busy machine delays this process, but would not delay packets to a real module.
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
        self._turned_ns = 0
        self._listeners: dict[Address, int] = {}

    @property
    def address(self) -> Address:
        """Host and port that it listens on."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def serve(self, running: Callable[[], bool]) -> None:
        """Serve while ``running()``, which is called at least ten times a second."""
        try:
            while running():
                self._turn(0.1)
        finally:
            self._socket.close()

    def _turn(self, patience: float) -> None:
        actuator = self.actuator
        now = self._clock()
        due = min(
            actuator.next_sample_ns,
            actuator.next_delivery_ns if actuator.next_delivery_ns is not None else actuator.next_sample_ns,
        )
        wait = min(patience, max(0.0, (due - now) / NANOSECONDS))
        ready, _, _ = select.select([self._socket], [], [], wait)
        now = self._clock()
        if ready:
            for _ in range(_BATCH):
                try:
                    packet, notes, _, sender = self._socket.recvmsg(wire.MAX_PACKET, _NOTES)
                except (BlockingIOError, ConnectionRefusedError):
                    break
                # Never before the computed state, whatever the system clock does.
                self._receive(packet, sender, min(now, max(self._turned_ns, now - _age_ns(notes))))
        self._turned_ns = now
        actuator.advance_to(now)
        feedback = actuator.feedback(now)
        if feedback is not None:
            packet = wire.encode_feedback(feedback)
            for listener, until in list(self._listeners.items()):
                if until < now:
                    del self._listeners[listener]
                else:
                    self._send(packet, listener)

    def _receive(self, packet: bytes, sender: Address, now: int) -> None:
        kind = wire.kind_of(packet)
        if kind == wire.COMMAND:
            command = wire.decode_command(packet)
            if command is not None:
                timing = self.actuator.parameters.timing
                arrival = now + round(timing.command_delay * NANOSECONDS)
                self.actuator.deliver(command, arrival, sender=hash(sender) & 0x7FFFFFFF)
                self._listeners[sender] = now + round(_LEASE * NANOSECONDS)
        elif kind == wire.REQUEST:
            request = wire.decode_json(packet)
            if request:
                self._listeners[sender] = now + round(_LEASE * NANOSECONDS)
                self.actuator.advance_to(now)
                self._answer(request, sender)

    def _answer(self, request: dict[str, Any], sender: Address) -> None:
        settings = request.get("settings")
        if settings is not None and self.actuator.faults & _UNREACHABLE:
            return  # the packet was lost, or the module listens to another sender: no acknowledgement
        reply: dict[str, Any] = {"id": request.get("id")}
        try:
            if settings is not None:
                self._configure(settings)
            if "push" in request:
                push = float(request["push"])
                if not math.isfinite(push):
                    raise ParameterError(f"push is {push} N m; expected a finite number")
                self.actuator.push = push
            for name in request.get("inject", []):
                self.actuator.inject(ActuatorFault(name))
            if request.get("clear_faults"):
                self.actuator.clear_faults()
        except (PendulumError, ArithmeticError, TypeError, ValueError, KeyError) as error:
            reply["error"] = str(error)
        reply.update(self._status())
        self._send(wire.encode_json(wire.REPLY, reply), sender)

    def _configure(self, settings: dict[str, Any]) -> None:
        changes: dict[str, Any] = {}
        if "strategy" in settings:
            changes["strategy"] = Strategy(int(settings["strategy"]))
        if "gains" in settings:
            changes["gains"] = wire.gains_from_json(settings["gains"])
        if "limits" in settings:
            changes["limits"] = wire.limits_from_json(settings["limits"])
        for name in ("command_lifetime", "feedback_rate"):
            if name in settings:
                changes[name] = float(settings[name])
        self.actuator.configure(**changes)

    def _status(self) -> dict[str, Any]:
        actuator = self.actuator
        return {
            **asdict(self._identity),
            "name": self._identity.name or actuator.parameters.plant.name,
            "strategy": int(actuator.strategy),
            "feedback_rate": actuator.feedback_rate,
            "command_lifetime": actuator.command_lifetime,
            "limits": wire.limits_to_json(actuator.limits),
            "gains": wire.gains_to_json(actuator.gains),
            "lifetime_expiries": actuator.lifetime_expiries,
            "last_command_ns": actuator.last_command_ns,
            "faults": sorted(fault.value for fault in actuator.faults),
            "link": actuator.link._asdict(),
        }

    def _send(self, packet: bytes, receiver: Address) -> None:
        try:
            self._socket.sendto(packet, receiver)
        except OSError:
            self._listeners.pop(receiver, None)


def _age_ns(notes: Sequence[tuple[int, int, bytes]]) -> int:
    """Return how long a packet has waited for this process [ns]; 0 without a kernel timestamp."""
    for level, kind, data in notes:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _TIMESTAMPS, _TIME.size):
            seconds, nanoseconds = _TIME.unpack(data)
            return time.time_ns() - (seconds * NANOSECONDS + nanoseconds)
    return 0
