"""Emulated Dynamixel servos of the X series: control table and protocol 2.0, on an emulated machine.

Independent of the vendor's library and of the backend: addresses, units and checksum are written down a second time.
Not known without a servo, and assumed: the Bus Watchdog sets the goal current to 0, and counts packets of any kind.
Source: Robotis e-Manual.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import struct
import tty
from collections import deque
from collections.abc import Callable, Iterable, Sequence

from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["EmulatedServo", "ServoLine", "checksum", "serve"]

_HEADER = b"\xff\xff\xfd\x00"
_BROADCAST = 0xFE
_PING, _READ, _WRITE, _REBOOT, _SYNC_WRITE = 0x01, 0x02, 0x03, 0x08, 0x83
_STATUS = 0x55
_RANGE, _ACCESS, _ALERT = 0x04, 0x07, 0x80
_TABLE = 160
_MODEL, _FIRMWARE, _MODE, _CURRENT_LIMIT, _ENABLE, _ERROR, _WATCHDOG, _GOAL = 0, 6, 11, 38, 64, 70, 98, 102
_FLASH = 64
"""Registers below this lie in flash memory: they survive a restart, and cannot be written while torque is on."""
_WRITABLE = (*range(7, 64), 64, 65, 68, *range(76, 112), *range(116, 120))
_LATE_NS = 80_000_000
_FOR_EVER = 1e9
_COUNTS = 4096.0 / math.tau
_PER_RPM = 60.0 / math.tau / 0.229


def checksum(data: bytes) -> int:
    """Return the CRC-16 of protocol 2.0: polynomial 0x8005, from 0, not reflected."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
        value &= 0xFFFF
    return value


class EmulatedServo:
    """Control table of a servo that drives one joint of a machine.

    Args:
        machine: Physics.
        index: Joint.
        number: ID.
        model: Model number.
        current_step: Unit of the currents [A].
        torque_per_ampere: [N m/A].
        voltage: Supply [V].

    Attributes:
        faults: Faults of servo and line in force.
        stubborn: Addresses that keep their value.
        expiries: How often the watchdog has ended the torque.
    """

    def __init__(
        self,
        machine: EmulatedMachine,
        index: int = 0,
        *,
        number: int = 1,
        model: int = 1200,
        current_step: float = 1e-3,
        torque_per_ampere: float = 0.52 / 1.47,
        voltage: float = 5.0,
    ) -> None:
        self.machine, self.index, self.number, self.voltage = machine, index, number, voltage
        self.step = current_step * torque_per_ampere
        self.table = bytearray(_TABLE)
        self._motor = machine.coordinates.driven.index(index)
        self.faults: set[ActuatorFault] = set()
        self.stubborn: set[int] = set()
        self._heard_ns = self._started_ns = 0
        self.expiries = 0
        self._stuck: float | None = None
        # The command lifetime is the servo's watchdog, not the machine's.
        machine.drives[self._motor].lifetime = _FOR_EVER
        for address, value in ((_MODEL, model & 0xFF), (_MODEL + 1, model >> 8), (_FIRMWARE, 53), (7, number)):
            self.table[address] = value
        # As delivered: position mode, 500 us return delay.
        self.table[_MODE], self.table[9], self.table[31] = 3, 250, 70
        struct.pack_into("<H", self.table, _CURRENT_LIMIT, 1750)

    @property
    def torque_on(self) -> bool:
        """Whether the motor is driven."""
        return self.table[_ENABLE] == 1 and not self.table[_ERROR]

    def restart(self, now_ns: int) -> None:
        """Lose what is not in flash memory, as by a brown-out [ns]."""
        self.table[_FLASH:] = bytes(_TABLE - _FLASH)
        self._started_ns = now_ns
        self._apply(now_ns)

    def fail(self, error: int, now_ns: int) -> None:
        """Set a hardware error, which ends the torque and stays until a restart [ns]."""
        self.table[_ERROR] |= error
        self.table[_ENABLE] = 0
        self._apply(now_ns)

    def advance(self, now_ns: int) -> None:
        """Let the physics and the watchdog run up to a time [ns]."""
        watchdog = self.table[_WATCHDOG]
        if self.torque_on and 0 < watchdog <= 127:
            end_ns = self._heard_ns + watchdog * 20_000_000
            if now_ns >= end_ns:
                self.machine.advance_to(end_ns, wholly=True)
                self.table[_WATCHDOG] = 0xFF
                struct.pack_into("<h", self.table, _GOAL, 0)
                self.expiries += 1
                self._apply(end_ns)
        self.machine.advance_to(now_ns, wholly=True)

    def hear(self, now_ns: int) -> None:
        """Count a packet for the watchdog [ns]."""
        self._heard_ns = now_ns

    def read(self, address: int, size: int, now_ns: int) -> bytes:
        """Return registers as they are at a time [ns]."""
        self._measure(now_ns)
        return bytes(self.table[address : address + size])

    def write(self, address: int, data: bytes, now_ns: int) -> int:
        """Write registers [ns]; return the error number, 0 for none."""
        if ActuatorFault.COMMANDS_LOST in self.faults or address in self.stubborn:
            return 0
        if any(each not in _WRITABLE for each in range(address, address + len(data))):
            return _ACCESS
        if address < _FLASH and self.table[_ENABLE]:
            return _ACCESS
        if address == _GOAL:
            goal, limit = *struct.unpack("<h", data), *struct.unpack_from("<H", self.table, _CURRENT_LIMIT)
            if abs(goal) > limit or self.table[_WATCHDOG] == 0xFF:
                return _RANGE
        if address == _WATCHDOG and self.table[_WATCHDOG] == 0xFF and data != b"\0":
            return _RANGE
        if address == _ENABLE and self.table[_ERROR]:
            data = b"\0"
        self.table[address : address + len(data)] = data
        self._apply(now_ns)
        return 0

    def _apply(self, now_ns: int) -> None:
        """Pass torque enable and goal current to the motor [ns]."""
        (goal,) = struct.unpack_from("<h", self.table, _GOAL)
        drive = self.machine.drives[self._motor]
        if drive.on is not self.torque_on:
            self.machine.switch(self._motor, now_ns, on=self.torque_on)
        if not self.torque_on:
            return
        effort = goal * self.step if self.table[_MODE] == 0 else 0.0
        if ActuatorFault.PWM_STUCK in self.faults:
            self._stuck = effort = drive.commanded if self._stuck is None else self._stuck
        if ActuatorFault.WINDING_OPEN in self.faults:
            effort = 0.0
        if ActuatorFault.PWM_RUNAWAY in self.faults:
            effort = drive.limit
        self.machine.deliver(self._motor, effort, now_ns)

    def _measure(self, now_ns: int) -> None:
        """Put the state of the machine into the table, in its steps."""
        faults, fault = self.faults, ActuatorFault
        if fault.FEEDBACK_FROZEN in faults:
            # A hung processor whose line still works.
            return
        (position,), (velocity,), (effort,) = ((part[self.index],) for part in self.machine.state)
        effort = 0.0 if fault.WINDING_OPEN in faults else effort
        voltage = {fault.VOLTAGE_LOW: 3.2, fault.VOLTAGE_HIGH: 7.9}
        supply = next((value for one, value in voltage.items() if one in faults), self.voltage)
        celsius = 90 if fault.WINDING_HOT in faults else round(self.machine.drives[self._motor].temperature)
        if fault.VELOCITY_SPIKE in faults:
            velocity = 20.0
        counts = round(position * _COUNTS) + 2048
        counts += 400 * (fault.POSITION_JUMP in faults) + 9000 * (fault.OUTSIDE_WINDOW in faults)
        if fault.POSITION_FROZEN in faults:
            (counts,) = struct.unpack_from("<i", self.table, 132)
        if fault.EFFORT_OFFSET in faults:
            effort += 2.0
        tick = (now_ns - self._started_ns) // 1_000_000 % 32_768
        struct.pack_into("<H", self.table, 120, tick)
        duty = round(effort / self.step / 2.0)
        struct.pack_into("<hh", self.table, 124, max(-885, min(885, duty)), round(effort / self.step))
        struct.pack_into("<ii", self.table, 128, round(velocity * _PER_RPM), counts)
        struct.pack_into("<HB", self.table, 144, round(supply * 10.0), celsius)


class ServoLine:
    """Servos on one serial line: bytes in, and bytes out at their time.

    Args:
        servos: All on one machine.
        rate: Bits per second [1/s].

    Attributes:
        output: Replies with the times at which they are complete at the host [ns].
        tamper: Called with each reply and its time; returns what comes instead, now or later.
    """

    def __init__(self, servos: Sequence[EmulatedServo], rate: int = 1_000_000) -> None:
        self.servos = {servo.number: servo for servo in servos}
        self._byte_ns = round(10 * NANOSECONDS / rate)
        self._input = bytearray()
        self._free_ns = 0
        self._requests = 0
        self.output: deque[tuple[int, bytes]] = deque()
        self.tamper: Callable[[int, bytes], Iterable[tuple[int, bytes]]] = lambda due_ns, packet: [(due_ns, packet)]

    def advance(self, now_ns: int) -> None:
        """Let the servos run up to a time [ns]."""
        for servo in self.servos.values():
            servo.advance(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take bytes that were sent at a time [ns]; replies come to ``output`` with their times."""
        self._input += data
        arrival_ns = max(now_ns, self._free_ns) + len(data) * self._byte_ns
        while (start := self._input.find(_HEADER)) >= 0:
            del self._input[:start]
            if len(self._input) < 7:
                return
            size = 7 + int.from_bytes(self._input[5:7], "little")
            if len(self._input) < size:
                return
            packet = bytes(self._input[:size])
            del self._input[:size]
            if checksum(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                self._obey(packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"), arrival_ns)

    def take(self, now_ns: int) -> bytes:
        """Return what has arrived at the host by a time [ns]."""
        taken = b""
        while self.output and self.output[0][0] <= now_ns:
            taken += self.output.popleft()[1]
        return taken

    def _obey(self, number: int, instruction: int, given: bytes, now_ns: int) -> None:
        self.advance(now_ns)
        for servo in self.servos.values():
            servo.hear(now_ns)
        if instruction == _SYNC_WRITE:
            address, size = struct.unpack_from("<HH", given)
            for start in range(4, len(given), size + 1):
                if given[start] in self.servos:
                    self.servos[given[start]].write(address, given[start + 1 : start + 1 + size], now_ns)
            return
        if (instruction, number) == (_PING, _BROADCAST):
            for servo in self.servos.values():
                self._reply(servo, 0, servo.read(_MODEL, 2, now_ns) + servo.read(_FIRMWARE, 1, now_ns), now_ns)
            return
        if number not in self.servos:
            return
        servo = self.servos[number]
        if instruction == _PING:
            self._reply(servo, 0, servo.read(_MODEL, 2, now_ns) + servo.read(_FIRMWARE, 1, now_ns), now_ns)
        elif instruction == _READ:
            address, size = struct.unpack("<HH", given)
            inside = address + size <= _TABLE
            self._reply(servo, 0 if inside else _ACCESS, servo.read(address, size, now_ns) if inside else b"", now_ns)
        elif instruction == _WRITE:
            self._reply(servo, servo.write(int.from_bytes(given[:2], "little"), given[2:], now_ns), b"", now_ns)
        elif instruction == _REBOOT:
            self._reply(servo, 0, b"", now_ns)
            servo.restart(now_ns)

    def _reply(self, servo: EmulatedServo, error: int, data: bytes, now_ns: int) -> None:
        faults, fault = servo.faults, ActuatorFault
        self._requests += 1
        if fault.FEEDBACK_LOST in faults or (fault.FEEDBACK_SLOW in faults and self._requests % 10):
            return
        error |= _ALERT if servo.table[_ERROR] else 0
        body = bytes((_STATUS, error)) + data
        stuffed = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = _HEADER + bytes((servo.number,)) + struct.pack("<H", len(stuffed) + 2) + stuffed
        packet += struct.pack("<H", checksum(packet))
        delay = servo.table[9] * 2_000 + (_LATE_NS if fault.FEEDBACK_LATE in faults else 0)
        self._free_ns = now_ns + servo.table[9] * 2_000 + len(packet) * self._byte_ns
        self.output.extend(self.tamper(now_ns + delay + len(packet) * self._byte_ns, packet))


def serve(line: ServoLine, clock: Callable[[], int], running: Callable[[], bool], ready: Callable[[str], None]) -> None:
    """Serve a line on a pseudo-terminal while ``running()``, which is called at least ten times a second.

    Args:
        line: Servos, whose clock must start at the present of ``clock`` [ns].
        ready: Called with the path of the terminal.
    """
    master, slave = os.openpty()
    try:
        tty.setraw(slave)
        os.set_blocking(master, False)
        ready(os.ttyname(slave))
        while running():
            due = line.output[0][0] - clock() if line.output else NANOSECONDS // 10
            inputs, _, _ = select.select([master], [], [], max(0.0, due / NANOSECONDS))
            now = clock()
            if inputs:
                line.receive(os.read(master, 4096), now)
            else:
                line.advance(now)
            if reply := line.take(now):
                with contextlib.suppress(BlockingIOError):
                    os.write(master, reply)
    finally:
        os.close(master)
        os.close(slave)
