"""Backend for an emulated X5-9 in another process, which outlives the bridge as a real one does."""

from __future__ import annotations

import math
import select
import socket
from collections.abc import Mapping
from typing import Any

from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    Feedback,
    HardwareLimits,
    Strategy,
    no_torque,
)
from pendulum_hw_bridge.port.clocks import Clock, WallClock
from pendulum_hw_bridge.port.command_check import check_command, check_lifetime
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["EmulatorProcessBackend"]

_ACKNOWLEDGE = 0.25
_ATTEMPTS = 3
_CONNECT_ATTEMPTS = 40
_STOP_PATIENCE = 0.015
_RENEW_NS = NANOSECONDS // 2


class EmulatorProcessBackend:
    """Actuator port of an emulator at ``HOST:PORT``; it is tried ``attempts`` times, four per second."""

    name = "emulator_process"

    def __init__(self, address: str, clock: Clock | None = None, *, attempts: int = _CONNECT_ATTEMPTS) -> None:
        self._address = wire.parse_address(address)
        self._attempts = attempts
        self._clock = clock or WallClock()
        self._socket: socket.socket | None = None
        self._strategy = Strategy.OFF
        self._possible = {Strategy.OFF}
        self._limits = HardwareLimits()
        self._requests = 0
        self._push = 0.0
        self._newest: Feedback | None = None
        self._renewed_ns = 0

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], clock: Clock, **_: Any) -> EmulatorProcessBackend:
        """Return the port of the emulator at the address in the bridge's parameters."""
        return cls(values["emulator_address"], clock)

    @property
    def strategy(self) -> Strategy:
        """Last confirmed strategy."""
        return self._strategy

    def connect(self) -> ActuatorInfo:
        """Request the actuator's settings; waits some seconds for an emulator that is starting."""
        attempts = _ATTEMPTS
        if self._socket is None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.connect(self._address)
            self._socket.setblocking(False)
            attempts = self._attempts
        status = self._request({}, attempts=attempts)
        self._strategy = Strategy(status["strategy"])
        self._possible = {self._strategy}
        return ActuatorInfo(
            backend=self.name,
            family=str(status["family"]),
            name=str(status["name"]),
            serial=str(status["serial"]),
            firmware=str(status["firmware"]),
            strategy=self._strategy,
            feedback_rate=float(status["feedback_rate"]),
            command_lifetime=float(status["command_lifetime"]),
            limits=wire.limits_from_json(status["limits"]),
            gains=wire.gains_from_json(status["gains"]),
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self._clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the newest feedback, waiting for one at most ``timeout`` [s]."""
        self._renew()
        deadline = self._clock.now_ns() + round(timeout * NANOSECONDS)
        while True:
            self._receive()
            if self._newest is not None:
                newest, self._newest = self._newest, None
                return newest
            remaining = (deadline - self._clock.now_ns()) / NANOSECONDS
            if remaining <= 0.0:
                return None
            select.select([self._require_socket()], [], [], remaining)

    def write(self, command: Command) -> Applied:
        """Send setpoints, checked and limited first."""
        limited, changed = check_command(command, self._strategy, self._limits)
        now = self._clock.now_ns()
        self._send(wire.encode_command(limited))
        return Applied(limited, self._strategy, changed, now)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Set the strategy, then send first setpoints."""
        limited = None if command is None else check_command(command, strategy, self._limits)[0]
        # A requested strategy may be in force until confirmed: the acknowledgement can get lost.
        self._possible.add(strategy)
        self._strategy = Strategy(self._request({"settings": {"strategy": int(strategy)}})["strategy"])
        self._possible = {self._strategy}
        if limited is not None and self._strategy is strategy:
            self._send(wire.encode_command(limited))
        return self._strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Set the gains of all loops."""
        return wire.gains_from_json(self._request({"settings": {"gains": wire.gains_to_json(gains)}})["gains"])

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the firmware's limits."""
        status = self._request({"settings": {"limits": wire.limits_to_json(limits)}})
        self._limits = wire.limits_from_json(status["limits"])
        return self._limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s]."""
        status = self._request({"settings": {"command_lifetime": check_lifetime(lifetime)}})
        return float(status["command_lifetime"])

    def set_feedback_rate(self, rate: float) -> float:
        """Set the feedback rate [Hz]."""
        return float(self._request({"settings": {"feedback_rate": rate}})["feedback_rate"])

    def push(self, torque: float) -> None:
        """Hold an external torque on the link [N m]."""
        torque = torque if math.isfinite(torque) else 0.0
        if torque != self._push:
            self._push = torque
            self._send(wire.encode_json(wire.REQUEST, {"push": torque}))

    def stop(self) -> None:
        """Remove torque, then set strategy off, with retries because packets can get lost."""
        driving = self._possible - {Strategy.OFF}
        if self._socket is None or not driving:
            return
        self._strategy = Strategy.OFF
        try:
            self._send(wire.encode_command(no_torque(*driving)))
        finally:
            try:
                self._request({"settings": {"strategy": int(Strategy.OFF)}}, patience=_STOP_PATIENCE)
            except ActuatorError as error:
                raise ActuatorError("stop_unacknowledged", f"{error}; the command lifetime ends its torque") from error
        self._possible = {Strategy.OFF}

    def close(self) -> None:
        """Stop and release."""
        try:
            self.stop()
        finally:
            self.release()

    def release(self) -> None:
        """Release without stopping, for callers that only listened while another may be driving."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def status(self) -> dict[str, Any]:
        """Return the emulator's internal state, including the truth behind the feedback."""
        return self._request({})

    def configure(self, *, patience: float = _ACKNOWLEDGE, **settings: Any) -> dict[str, Any]:
        """Request settings in packet format, once, with ``patience`` [s]; return the emulator's status.

        Raises:
            ActuatorError: Not acknowledged, or refused.
        """
        return self._request({"settings": settings}, attempts=1, patience=patience)

    def transmit(self, command: Command) -> None:
        """Send setpoints unchecked: finding errors is the emulated firmware's task."""
        self._send(wire.encode_command(command))

    def inject(self, *faults: str) -> None:
        """Start faults, by name."""
        self._request({"inject": list(faults)})

    def clear_faults(self) -> None:
        """End all faults."""
        self._request({"clear_faults": True})

    def _require_socket(self) -> socket.socket:
        if self._socket is None:
            raise ActuatorError("not_connected", "emulator process is not connected; call connect() first")
        return self._socket

    def _send(self, packet: bytes) -> None:
        try:
            self._require_socket().send(packet)
        except ConnectionRefusedError:
            # Reply to an earlier packet: the emulator has gone. The missing feedback shows that.
            return
        except OSError as error:
            raise ActuatorError("send_failed", f"command could not be sent: {error.strerror}") from error

    def _renew(self) -> None:
        now = self._clock.now_ns()
        if now - self._renewed_ns > _RENEW_NS:
            self._renewed_ns = now
            self._send(wire.encode_json(wire.REQUEST, {"renew": True}))

    def _receive(self) -> dict[str, Any]:
        """Receive all waiting packets; return the last reply among them, or an empty object."""
        reply: dict[str, Any] = {}
        while True:
            try:
                packet = self._require_socket().recv(wire.MAX_PACKET)
            except BlockingIOError:
                return reply
            except OSError:
                return reply  # "connection refused": not listening, or not yet
            kind = wire.kind_of(packet)
            if kind == wire.FEEDBACK:
                feedback = wire.decode_feedback(packet)
                if feedback is not None:
                    self._newest = feedback._replace(stamp_ns=self._clock.now_ns())
            elif kind == wire.REPLY:
                answer = wire.decode_json(packet)
                if answer.get("id") == self._requests:
                    reply = answer

    def _request(
        self, request: dict[str, Any], *, attempts: int = _ATTEMPTS, patience: float = _ACKNOWLEDGE
    ) -> dict[str, Any]:
        self._requests += 1
        packet = wire.encode_json(wire.REQUEST, {"id": self._requests, **request})
        for _ in range(attempts):
            self._send(packet)
            deadline = self._clock.now_ns() + round(patience * NANOSECONDS)
            while (remaining := (deadline - self._clock.now_ns()) / NANOSECONDS) > 0.0:
                select.select([self._require_socket()], [], [], remaining)
                reply = self._receive()
                if "error" in reply:
                    raise ActuatorError("no_acknowledgement", f"emulator refused: {reply['error']}")
                if reply:
                    return reply
        host, port = self._address
        raise ActuatorError(
            "no_acknowledgement",
            f"emulator at {host}:{port} does not answer; start it with: python -m pendulum_hw_bridge emulator",
        )
