"""Backend for a Dynamixel servo of the X series in current mode, through the vendor's ``dynamixel-sdk``.

The SDK builds and parses packets; waiting, and telling a late reply from the awaited one, is done here: after one
silent request the SDK hands out each reply one request late, as a valid angle. So consecutive requests ask for
different numbers of bytes, and a reply of another length is dropped. Source: Robotis e-Manual, XL330-M288 and
XM430-W350, control table of protocol 2.0.
"""

from __future__ import annotations

import contextlib
import math
import select
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

from pendulum_hw_bridge.backends.torque_drive import DriveModel, Identity, TorqueDrive
from pendulum_hw_bridge.port.actuator import ActuatorError, CommandLock, Feedback
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError

__all__ = ["MODELS", "WATCHDOG_STEP", "DynamixelBackend", "ServoModel", "serial_port"]

WATCHDOG_STEP = 0.02
"""Unit of the Bus Watchdog [s]."""
_TICK_NS = 1_000_000
_TICKS = 32_768
"""The servo's clock counts milliseconds up to this."""
_POSITION_STEP, _CENTRE = math.tau / 4096.0, 2048
_VELOCITY_STEP = 0.229 * math.tau / 60.0
_PWM_STEP = 0.00113
_CURRENT_MODE = 0
_ALERT = 0x80
_ERRORS = {0x01: "input voltage", 0x04: "overheating", 0x08: "encoder", 0x10: "electric shock", 0x20: "overload"}
_PATIENCE = 0.05
"""Time to wait for the reply to a setting, and for the line to fall silent after a lost one [s]."""
_STOP_PATIENCE = 0.015
"""The same for a stop: three attempts take less than the command lifetime [s]."""
_ATTEMPTS = 3
_RESTART_NS = 250 * _TICK_NS
"""Disagreement of the servo's clock with this computer's that only a restart explains [ns]."""


class Register(NamedTuple):
    """A register of the control table: address and length [bytes]."""

    address: int
    size: int
    signed: bool = False


MODEL, FIRMWARE = Register(0, 2), Register(6, 1)
RETURN_DELAY, DRIVE_MODE = Register(9, 1), Register(10, 1)
OPERATING_MODE, CURRENT_LIMIT = Register(11, 1), Register(38, 2)
STARTUP, TORQUE_ENABLE, HARDWARE_ERROR = Register(60, 1), Register(64, 1), Register(70, 1)
WATCHDOG, GOAL_CURRENT, TICK = Register(98, 1), Register(102, 2, signed=True), Register(120, 2)
PRESENT_PWM, PRESENT_CURRENT = Register(124, 2, signed=True), Register(126, 2, signed=True)
PRESENT_VELOCITY, PRESENT_POSITION = Register(128, 4, signed=True), Register(132, 4, signed=True)
VOLTAGE, TEMPERATURE = Register(144, 2), Register(146, 1)
_SAFE = (
    (OPERATING_MODE, _CURRENT_MODE, "operating mode"),
    (DRIVE_MODE, 0, "drive mode"),
    (STARTUP, 0, "startup"),
    (RETURN_DELAY, 0, "return delay"),
)
"""Settings that must hold: current mode, no torque by a goal or by power alone, the manual's sign, prompt replies."""
_SPANS = tuple((98 - more, 49 + more) for more in range(15))
"""Address and length of consecutive requests, watchdog to temperature: no two of a round are of one length."""


@dataclass(frozen=True)
class ServoModel(DriveModel):
    """A servo model: also the number that it reports, and the unit of its currents [A]."""

    number: int
    current_step: float

    @property
    def step(self) -> float:
        """Torque of one step of the current [N m]."""
        return self.current_step * self.torque_per_ampere


_LARGEST_XM430 = 1193 * 2.69e-3
MODELS = {
    model.name: model
    for model in (
        ServoModel("XL330-M288", 0.52 / 1.47, 288.35, 1.75, 1200, 1e-3),
        ServoModel("XL330-M077", 0.228 / 1.47, 77.0, 1.75, 1190, 1e-3),
        ServoModel("XM430-W350", 4.1 / 2.3, 353.5, _LARGEST_XM430, 1020, 2.69e-3),
        ServoModel("XM430-W210", 3.0 / 2.3, 212.6, _LARGEST_XM430, 1030, 2.69e-3),
    )
}
"""Models by name, with stall torque over stall current. Source: e-Manual, specifications."""


def serial_port(path: str, rate: int) -> Any:
    """Return the SDK's port handler of a serial device, which sleeps while it waits; not open yet.

    Raises:
        ActuatorError: dynamixel-sdk is not installed.
    """
    sdk = _sdk()
    import termios

    import serial

    class Port(sdk.PortHandler):  # type: ignore[name-defined]  # the SDK has no types
        def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802
            # Exclusive: two programs on one bus take each other's replies.
            self.ser = serial.Serial(self.port_name, cflag_baud, timeout=0, exclusive=True)
            with contextlib.suppress(OSError, ValueError, AttributeError):
                self.ser.set_low_latency_mode(True)
            self.is_open = True
            self.tx_time_per_byte = 1e4 / cflag_baud
            return True

        def clearPort(self) -> None:  # noqa: N802
            try:
                self.ser.reset_input_buffer()
            except termios.error as error:
                # Of an adapter that was pulled; it is no OSError.
                raise OSError(*error.args) from error

        def getCurrentTime(self) -> float:  # noqa: N802
            return time.monotonic() * 1e3

        def readPort(self, length: int) -> bytes:  # noqa: N802
            left = self.packet_timeout - self.getTimeSinceStart()
            if left > 0.0 and not self.ser.in_waiting:
                select.select([self.ser.fileno()], [], [], left * 1e-3)
            return bytes(self.ser.read(length))

    port = Port(path)
    port.baudrate = rate
    return port


def _sdk() -> Any:
    try:
        import dynamixel_sdk
    except ImportError as error:
        raise ActuatorError(
            "not_installed", f"dynamixel-sdk is not installed ({error}); pip install 'pendulum_hw_bridge[dynamixel]'"
        ) from error
    return dynamixel_sdk


def _device(values: Mapping[str, Any]) -> str:
    if not values["interface"]:
        raise ParameterError("interface is empty; expected the serial device of the servos, such as /dev/ttyUSB0")
    return str(values["interface"])


def _open_line(port: Any) -> None:
    if not port.is_open and not port.openPort():
        raise ActuatorError("module_lost", f"serial device {port.port_name} refuses {port.baudrate} baud")


class DynamixelBackend(TorqueDrive):
    """Actuator port of one servo.

    Args:
        number: ID of the servo.
        make_port: Returns the SDK's port handler, not open yet.
        clock: Host clock.
        joint: Name of the joint.
        model: Expected model.
    """

    name = "dynamixel"
    fastest = 500.0

    def __init__(
        self, number: int, make_port: Callable[[], Any], clock: Clock, *, joint: str = "", model: str = "XL330-M288"
    ) -> None:
        super().__init__(clock, joint)
        self._id = number
        self._make_port = make_port
        self._model = self.drive_of(model)
        self._port: Any = None
        self._packets: Any = None
        self._watchdog = round(self._lifetime / WATCHDOG_STEP)
        self._largest = self._turn = self._silent = 0
        self._ticks: int | None = None
        self._tick_ns = self._counted = 0

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], clock: Clock, **_: Any) -> DynamixelBackend:
        """Return the port of the servo that the bridge's parameters name."""
        path = _device(values)
        ports: list[Any] = []

        def shared() -> Any:
            if not ports:
                ports.append(serial_port(path, values["bus_rate"]))
            return ports[0]

        return cls(int(values["drive_id"]), shared, clock, model=values["drive_model"])

    @classmethod
    def drive_of(cls, model: str) -> ServoModel:
        """Return a model of :data:`MODELS`."""
        if model not in MODELS:
            raise ParameterError(f"drive_model is {model!r}; expected one of {', '.join(MODELS)}")
        return MODELS[model]

    @classmethod
    def scan(cls, values: Mapping[str, Any]) -> list[Identity]:
        """Return the servos that reply to a broadcast."""
        port = serial_port(_device(values), values["bus_rate"])
        try:
            _open_line(port)
            found, _ = _sdk().PacketHandler(2.0).broadcastPing(port)
            port.closePort()
        except (OSError, ValueError) as error:
            raise ActuatorError("module_lost", f"serial line failed: {error}") from error
        names = {model.number: model for model in MODELS.values()}
        unknown = ServoModel("unknown", math.nan, 1.0, math.nan, 0, math.nan)
        return [
            Identity(
                "Dynamixel", names.get(model, replace(unknown, name=f"number {model}")), str(number), str(firmware)
            )
            for number, (model, firmware) in sorted(found.items())
        ]

    def on_this_bus(self, values: Mapping[str, Any]) -> DynamixelBackend:
        """Return the port of another servo on the same line."""
        other = DynamixelBackend(int(values["drive_id"]), self._make_port, self.clock, model=values["drive_model"])
        self._share_bus(other)
        return other

    # --- packets ----------------------------------------------------------------------------------------------

    def _open(self) -> Identity:
        if self._port is None:
            port = self._make_port()
            self._packets = _sdk().PacketHandler(2.0)
            with self._line("module_lost"):
                _open_line(port)
            self._port = port
        number = self._get(MODEL)
        if number != self._model.number:
            found = next((known.name for known in MODELS.values() if known.number == number), f"number {number}")
            raise ActuatorError(
                "module_lost", f"servo {self._id} is of model {found}; expected {self._model.name} (drive_model)"
            )
        return Identity("Dynamixel", self._model, str(self._id), str(self._get(FIRMWARE)))

    @contextlib.contextmanager
    def _line(self, fault: str) -> Iterator[None]:
        """Name errors of the serial line: its library raises an OSError when the adapter is pulled."""
        try:
            yield
        except (OSError, ValueError) as error:
            if self._port is not None:
                self._port.is_using = False
            raise ActuatorError(fault, f"serial line failed: {error}") from error

    def _ask(self, address: int, size: int, patience: float) -> tuple[bytes, int] | None:
        """Read bytes of the control table; return them and the error byte, or None without the reply to this request.

        Whatever has another length, or is of another servo, is the reply to an earlier request.
        """
        packet = [0] * 14
        packet[4:12] = [self._id, 7, 0, 2, address & 0xFF, address >> 8, size & 0xFF, size >> 8]
        with self._line("feedback_lost"):
            if self._packets.txPacket(self._port, packet) != 0:
                raise ActuatorError("send_failed", f"request to servo {self._id} could not be sent")
            self._port.setPacketTimeoutMillis(patience * 1e3)
            end = self.now_ns() + round(patience * NANOSECONDS)
            while True:
                reply, result = self._packets.rxPacket(self._port, False)
                if result == 0 and list(reply[4:7]) == [self._id, size + 4, 0]:
                    return bytes(reply[9 : 9 + size]), int(reply[8])
                if self.now_ns() >= end:
                    return None

    def _settle(self) -> None:
        """Wait until no reply to an earlier request can come any more."""
        self.clock.wait_until(self.now_ns() + round(_PATIENCE * NANOSECONDS))

    def _get(self, register: Register) -> int:
        """Read a register; ActuatorError without a reply, or if the servo reports an error of its own."""
        for _ in range(_ATTEMPTS):
            # Of another length than the requests before, whose replies may be late.
            self._turn = (self._turn + 1) % len(_SPANS)
            reply = self._ask(register.address, 4 + self._turn, _PATIENCE)
            if reply is not None and not reply[1] & ~_ALERT:
                return int.from_bytes(reply[0][: register.size], "little", signed=register.signed)
            self._settle()
        raise ActuatorError(
            "module_lost",
            f"servo {self._id} does not answer on {self._port.port_name} at {self._port.baudrate} baud; expected a "
            f"reply within {_PATIENCE * 1e3:g} ms: look at its supply, its ID and its baud rate",
        )

    def _put(self, register: Register, value: int) -> None:
        """Write a register without asking for a reply: reading back shows more than an acknowledgement."""
        data = list(value.to_bytes(register.size, "little", signed=register.signed))
        parameters = [self._id, *data]
        with self._line("send_failed"):
            result = self._packets.syncWriteTxOnly(
                self._port, register.address, register.size, parameters, len(parameters)
            )
        if result != 0:
            raise ActuatorError("send_failed", f"command to servo {self._id} could not be sent")

    def _set(self, register: Register, value: int, what: str) -> None:
        """Write a register that differs; ActuatorError unless it reads back. Flash memory wears with each write."""
        for _ in range(_ATTEMPTS):
            reads = self._get(register)
            if reads == value:
                return
            self._put(register, value)
        reads = self._get(register)
        if reads != value:
            raise ActuatorError("settings", f"{what} of servo {self._id} reads back as {reads}; expected {value}")

    def _refuse_alert(self) -> None:
        if errors := self._get(HARDWARE_ERROR):
            self._refuse_error(errors, "reports an error")

    def _refuse_error(self, errors: int, what: str) -> NoReturn:
        names = ", ".join(name for bit, name in _ERRORS.items() if errors & bit) or "unknown"
        raise ActuatorError(
            "drive_error",
            f"servo {self._id} {what}, hardware error status 0x{errors:02x} ({names}); expected none. Remove "
            "the cause, then switch its supply off and on",
        )

    # --- the drive --------------------------------------------------------------------------------------------

    def _request(self, patience: float) -> Feedback | None:
        address, size = _SPANS[self._turn]
        self._turn = (self._turn + 1) % len(_SPANS)
        reply = self._ask(address, size, patience)
        now = self.now_ns()
        if reply is None:
            self._silent += 1
            if self._silent % len(_SPANS) == 0:
                # The next round has the same lengths: let late replies come first, and be discarded.
                self._bus.quiet_until_ns = now + round(_PATIENCE * NANOSECONDS)
            return None
        self._silent = 0
        data, error = reply
        if self._possibly_on and error:
            reply = self._ask(HARDWARE_ERROR.address, HARDWARE_ERROR.size, patience)
            if reply is None:
                raise ActuatorError(
                    "drive_error", f"servo {self._id} replies with error 0x{error:02x}, then is silent; expected none"
                )
            self._refuse_error(reply[0][0], f"replies with error 0x{error:02x}")

        def value(register: Register) -> int:
            start = register.address - address
            return int.from_bytes(data[start : start + register.size], "little", signed=register.signed)

        if self._strategy is not self._strategy.OFF:
            self._refuse_watchdog(value(WATCHDOG))
        celsius = float(value(TEMPERATURE))
        model, current = self._model, value(PRESENT_CURRENT) * self._model.current_step
        goal, duty = value(GOAL_CURRENT) * model.step, value(PRESENT_PWM) * _PWM_STEP
        position, velocity = (value(PRESENT_POSITION) - _CENTRE) * _POSITION_STEP, value(PRESENT_VELOCITY)
        return Feedback(
            stamp_ns=now,
            hardware_ns=self._measured_ns(value(TICK), now),
            sequence=0,
            position=position,
            velocity=velocity * _VELOCITY_STEP,
            effort=current * model.torque_per_ampere,
            position_command=math.nan,
            velocity_command=math.nan,
            effort_command=goal,
            pwm_command=duty,
            motor_current=duty * current,
            winding_current=current,
            motor_position=position,
            motor_velocity=velocity * _VELOCITY_STEP,
            # No spring. NaN also says that equal records prove nothing: at rest no step of a servo changes.
            deflection=math.nan,
            deflection_velocity=math.nan,
            voltage=value(VOLTAGE) * 0.1,
            winding_temperature=celsius,
            housing_temperature=celsius,
            motor_sensor_temperature=celsius,
            board_temperature=math.nan,
            processor_temperature=math.nan,
            lock=CommandLock.LOCKED_BY_SENDER if self._possibly_on else CommandLock.UNLOCKED,
        )

    def _measured_ns(self, tick: int, now_ns: int) -> int:
        """Return the servo's clock, without its overflow [ns]; a restart resets it."""
        before = self._ticks
        passed = 0 if before is None else (tick - before) % _TICKS
        elapsed = now_ns - self._tick_ns
        rounds = round((elapsed / _TICK_NS - passed) / _TICKS)
        passed += max(0, rounds) * _TICKS
        restarted = before is not None and abs(passed * _TICK_NS - elapsed) > _RESTART_NS + elapsed // 50
        self._counted = tick if before is None or restarted else self._counted + passed
        self._ticks, self._tick_ns = tick, now_ns
        return self._counted * _TICK_NS

    def _refuse_watchdog(self, reads: int) -> None:
        if reads == self._watchdog:
            return
        if reads == 0xFF:
            raise ActuatorError(
                "command_not_in_force",
                f"servo {self._id} stopped by its Bus Watchdog: no request for {self._lifetime:g} s",
            )
        raise ActuatorError(
            "module_restarted",
            f"Bus Watchdog of servo {self._id} reads {reads}; expected {self._watchdog}, as set: has the servo lost "
            "power, or has another program written to it?",
        )

    def _code(self, effort: float) -> int:
        code = round(effort / self._model.step)
        return min(self._largest, max(-self._largest, code))

    def _send(self, effort: float) -> float:
        code = self._code(effort)
        self._put(GOAL_CURRENT, code)
        return code * self._model.step

    def _switch_on(self, effort: float) -> None:
        self._refuse_alert()
        self._set(TORQUE_ENABLE, 0, "torque enable")
        for register, wanted, what in _SAFE:
            self._set(register, wanted, what)
        # A watchdog that has acted refuses every goal, also 0, until then.
        self._set(WATCHDOG, 0, "Bus Watchdog")
        self._set(GOAL_CURRENT, 0, "goal current")
        self._set(WATCHDOG, self._watchdog, "Bus Watchdog")
        self._set(TORQUE_ENABLE, 1, "torque enable")
        self._send(effort)

    def _switch_off(self) -> None:
        self._put(GOAL_CURRENT, 0)
        self._put(TORQUE_ENABLE, 0)
        reply = self._ask(TORQUE_ENABLE.address, TORQUE_ENABLE.size, _STOP_PATIENCE)
        if reply is None or reply[0] != b"\0":
            reads = "is silent" if reply is None else f"reads torque enable {reply[0][0]}"
            raise ActuatorError("stop_unacknowledged", f"servo {self._id} {reads}; expected 0")

    def _limit_effort(self, limit: float) -> float:
        model = self._model
        if limit > model.peak:
            raise ParameterError(f"effort_limit is {limit:g} N m; expected at most {model.peak:.3g} N m: {model.name}")
        # Down, so that no rounding passes the limit.
        code = math.floor(limit / model.step)
        if code < 1:
            raise ParameterError(f"effort_limit is {limit:g} N m; expected at least a step, {model.step:.2g} N m")
        self._refuse_alert()
        if self._possibly_on:
            self._switch_off()
        for register, wanted, what in _SAFE:
            self._set(register, wanted, what)
        self._set(CURRENT_LIMIT, code, "current limit")
        self._largest = code
        return limit

    def _limit_lifetime(self, lifetime: float) -> float:
        steps = round(lifetime / WATCHDOG_STEP)
        if not (1 <= steps <= 127 and math.isclose(steps * WATCHDOG_STEP, lifetime, rel_tol=1e-6)):
            raise ParameterError(
                f"command_lifetime is {lifetime:g} s; expected a multiple of {WATCHDOG_STEP:g} s up to 2.54 s, the "
                "unit of the Bus Watchdog"
            )
        if self._possibly_on:
            self._switch_off()
        self._watchdog = steps
        self._set(WATCHDOG, 0, "Bus Watchdog")
        self._set(WATCHDOG, steps, "Bus Watchdog")
        return steps * WATCHDOG_STEP

    def _release(self) -> None:
        port, self._port = self._port, None
        with self._line("module_lost"):
            port.closePort()
