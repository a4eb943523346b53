"""Emulated modules in place of HEBI's network, for rehearsals: ``interface`` is ``emulator:HOST:PORT[,HOST:PORT...]``.

The backend ``hebi`` runs unchanged, with hebi-py's commands and files; only ``Lookup`` and ``Group`` are replaced, and
talk to emulator processes. Not emulated: broadcast search, the library's feedback thread, feedback objects and log, and
the firmware's checks of settings.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import socket
import time
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES
from pendulum_hw_bridge.backends.hebi_settings import LIMIT_DISABLED, LIMIT_MOTOR_OFF, M_STOPS
from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, Feedback
from pendulum_hw_bridge.port.gains import GAIN_FIELDS, LOOPS
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.lab_file import EMULATED_NETWORK

__all__ = ["EmulatedEntry", "EmulatedGroup", "EmulatedGroups", "EmulatedLookup"]

_LOOK_ATTEMPTS = 2


@dataclass(frozen=True)
class EmulatedEntry:
    """Lookup entry with hebi-py's field names; ``mac_address`` is derived from ``where``, ``HOST:PORT``."""

    family: str
    name: str
    mac_address: str
    ip_address: str
    is_stale: bool
    where: str


class EmulatedLookup:
    """Replaces hebi-py's ``Lookup`` on ``emulator:HOST:PORT[,...]``; ParameterError for an invalid address."""

    def __init__(self, interface: str, hebi: Any) -> None:
        self._hebi = hebi
        self._addresses = interface.removeprefix(EMULATED_NETWORK).split(",")
        for address in self._addresses:
            wire.parse_address(address)
        self._seen: dict[str, EmulatedEntry] = {}

    @property
    def entrylist(self) -> list[EmulatedEntry]:
        """Modules that reply, or have replied before."""
        entries = []
        for where in self._addresses:
            port = EmulatorProcessBackend(where, attempts=_LOOK_ATTEMPTS)
            try:
                port.connect()
                self._seen[where] = _entry(where, port.status())
            except ActuatorError:
                if where in self._seen:
                    entries.append(EmulatedEntry(**{**vars(self._seen[where]), "is_stale": True}))
            else:
                entries.append(self._seen[where])
            finally:
                port.release()
        return entries

    def get_group_from_macs(self, addresses: list[str], timeout_ms: float) -> EmulatedGroup | EmulatedGroups | None:
        """Return the group of the modules with these addresses, in order, or None if one does not reply."""
        where = {entry.mac_address: entry.where for entry in self._seen.values()}
        try:
            groups = [EmulatedGroup(where[address], self._hebi) for address in addresses]
        except (ActuatorError, KeyError):
            return None
        return groups[0] if len(groups) == 1 else EmulatedGroups(groups, self._hebi)


class EmulatedGroup:
    """Replaces hebi-py's ``Group`` of one module at ``HOST:PORT``; ActuatorError if it does not reply."""

    size = 1

    def __init__(self, where: str, hebi: Any) -> None:
        self._hebi = hebi
        self._port = EmulatorProcessBackend(where, attempts=_LOOK_ATTEMPTS)
        self._port.connect()
        self._status = self._port.status()

    def __del__(self) -> None:
        if "_port" in self.__dict__:
            self._port.release()

    @property
    def command_lifetime(self) -> int:
        """Command lifetime [ms]."""
        return round(1000.0 * float(self._status["command_lifetime"]))

    @command_lifetime.setter
    def command_lifetime(self, milliseconds: int) -> None:
        self._configure(500.0, command_lifetime=1e-3 * milliseconds)

    @property
    def feedback_frequency(self) -> float:
        """Feedback records per second [Hz]."""
        return float(self._status["feedback_rate"])

    @feedback_frequency.setter
    def feedback_frequency(self, rate: float) -> None:
        self._configure(500.0, feedback_rate=rate)

    def send_command(self, command: Any) -> bool:
        """Send a command without acknowledgement."""
        settings = self._settings_of(command)
        if settings:
            with contextlib.suppress(ActuatorError):
                self._configure(0.0, **settings)
        try:
            self._send_setpoints(command)
        except ActuatorError:
            return False
        return True

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: float) -> bool:
        """Send a command, and return whether the module acknowledged in time."""
        try:
            self._configure(timeout_ms, **self._settings_of(command))
            self._send_setpoints(command)
        except ActuatorError:
            return False
        return True

    def get_next_feedback(self, timeout_ms: float, reuse_fbk: Any = None) -> Any:
        """Return the newest record under hebi-py's names, or None after the timeout."""
        record = self._port.read(1e-3 * timeout_ms)
        return None if record is None else _feedback(record)

    def request_info(self, timeout_ms: float) -> Any:
        """Return all settings as a hebi-py command, or None if the module does not reply."""
        try:
            self._configure(timeout_ms)
        except ActuatorError:
            return None
        return _Info(self._status, self._hebi)

    def start_log(self, directory: str, name: str) -> str:
        """Refuse: hebi-py logs its own network only."""
        raise OSError(f"{directory}/{name}: hebi-py logs real modules only")

    def stop_log(self) -> None:
        """Do nothing."""

    def _configure(self, timeout_ms: float, **settings: Any) -> None:
        self._status = self._port.configure(patience=1e-3 * timeout_ms, **settings)

    def _send_setpoints(self, command: Any) -> None:
        has = {name: _holds(command, name, self._hebi) for name in ("position", "velocity", "effort")}
        if not any(has.values()):
            return
        values = {name: float(getattr(command, name)[0]) if held else math.nan for name, held in has.items()}
        self._port.transmit(Command(**values))

    def _settings_of(self, command: Any) -> dict[str, Any]:
        """Return the settings of a command, in packet format."""
        settings: dict[str, Any] = {}
        if _holds(command, "control_strategy", self._hebi):
            settings["strategy"] = int(command.control_strategy[0])
        limits = self._limits_of(command)
        if limits:
            settings["limits"] = _finite({**self._status["limits"], **limits})
        gains = {
            loop: {
                name: float(getattr(command, f"{loop}_{name}")[0])
                for name in GAIN_FIELDS
                if _holds(command, f"{loop}_{name}", self._hebi)
            }
            for loop in LOOPS
        }
        if any(gains.values()):
            now = self._status["gains"]
            merged = {loop: _finite({**now[loop], **given}) for loop, given in gains.items()}
            settings["gains"] = {"strategy": now["strategy"], **merged}
        return settings

    def _limits_of(self, command: Any) -> dict[str, Any]:
        limits: dict[str, Any] = {}
        for name in ("effort", "velocity"):
            if _holds(command, f"{name}_limit_max", self._hebi):
                limits[name] = float(getattr(command, f"{name}_limit_max")[0])
        for end in ("min", "max"):
            if _holds(command, f"position_limit_{end}", self._hebi):
                value = float(getattr(command, f"position_limit_{end}")[0])
                # NaN changes nothing here; what a real module does with it is not documented.
                limits |= {} if math.isnan(value) else {f"position_{end}": value}
            strategy = f"{end}_position_limit_strategy"
            if _holds(command, strategy, self._hebi) and int(getattr(command, strategy)[0]) == LIMIT_DISABLED:
                limits[f"position_{end}"] = -math.inf if end == "min" else math.inf
        if _holds(command, "mstop_strategy", self._hebi):
            limits["m_stop"] = M_STOPS[int(command.mstop_strategy[0])].value
        return limits


class EmulatedGroups:
    """Replaces hebi-py's ``Group`` of several modules.

    Emulators send asynchronously, whereas the library polls all modules at once: a frame is complete when each has sent
    a record, and omits a module that was silent for a period.
    """

    def __init__(self, groups: list[EmulatedGroup], hebi: Any) -> None:
        self._groups = groups
        self._hebi = hebi
        self._newest: list[Any] = [None] * len(groups)
        self._came: set[int] = set()
        self._since = 0.0

    @property
    def size(self) -> int:
        """Number of modules."""
        return len(self._groups)

    @property
    def command_lifetime(self) -> int:
        """Longest command lifetime of a module [ms]."""
        return max(group.command_lifetime for group in self._groups)

    @command_lifetime.setter
    def command_lifetime(self, milliseconds: int) -> None:
        for group in self._groups:
            group.command_lifetime = milliseconds

    @property
    def feedback_frequency(self) -> float:
        """Lowest rate of a module [Hz]."""
        return min(group.feedback_frequency for group in self._groups)

    @feedback_frequency.setter
    def feedback_frequency(self, rate: float) -> None:
        for group in self._groups:
            group.feedback_frequency = rate

    def send_command(self, command: Any) -> bool:
        """Send each module its part, without acknowledgement."""
        # To all modules, even if one fails.
        sent = [group.send_command(_Of(command, index)) for index, group in enumerate(self._groups)]
        return all(sent)

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: float) -> bool:
        """Send each module its part, and return whether all acknowledged in time."""
        said = [
            group.send_command_with_acknowledgement(_Of(command, index), timeout_ms)
            for index, group in enumerate(self._groups)
        ]
        return all(said)

    def get_next_feedback(self, timeout_ms: float, reuse_fbk: Any = None) -> Any:
        """Return the next frame, with the old record of a silent module, or None after the timeout."""
        deadline = time.monotonic() + 1e-3 * timeout_ms
        for index, group in enumerate(self._groups):
            if index in self._came:
                continue
            record = group.get_next_feedback(max(0.0, 1e3 * (deadline - time.monotonic())))
            if record is not None:
                self._since = self._since if self._came else time.monotonic()
                self._came.add(index)
                self._newest[index] = record
        over = self._came and time.monotonic() - self._since > 1.0 / self.feedback_frequency
        if None in self._newest or not (len(self._came) == self.size or over):
            return None
        self._came.clear()
        names = vars(self._newest[0])
        return SimpleNamespace(**{name: [vars(each)[name][0] for each in self._newest] for name in names})

    def request_info(self, timeout_ms: float) -> Any:
        """Return the settings of all, or None if a module does not reply."""
        found = [group.request_info(timeout_ms) for group in self._groups]
        return None if None in found else _Each(found)

    def start_log(self, directory: str, name: str) -> str:
        """Refuse: hebi-py logs its own network only."""
        return self._groups[0].start_log(directory, name)

    def stop_log(self) -> None:
        """Do nothing."""


class _Of:
    """One module's part of a group command, as a command for one module."""

    def __init__(self, command: Any, index: int) -> None:
        self._view = command.create_view([index])
        self.refs = [command.refs[index]]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._view, name)


class _Each:
    """Settings of several modules, as lists by name."""

    def __init__(self, infos: list[Any]) -> None:
        self._infos = infos

    def __getattr__(self, name: str) -> Any:
        return [getattr(info, name)[0] for info in self._infos]


class _Info:
    """Settings as a hebi-py command, and the module's identity under the names of ``GroupInfo``."""

    def __init__(self, status: dict[str, Any], hebi: Any) -> None:
        self.family, self.name = [status["family"]], [status["name"]]
        self.serial, self.mechanical_type = [status["serial"]], [status["type"]]
        self.firmware_revision = [status["firmware"]]
        settings = self._settings = hebi.GroupCommand(1)
        settings.control_strategy = int(status["strategy"])
        gains = wire.gains_from_json(status["gains"])
        for loop in LOOPS:
            for name in GAIN_FIELDS:
                value = getattr(gains.loop(loop), name)
                setattr(settings, f"{loop}_{name}", bool(value) if name == "d_on_error" else value)
        limits = wire.limits_from_json(status["limits"])
        settings.effort_limit_min, settings.effort_limit_max = -limits.effort, limits.effort
        settings.velocity_limit_min, settings.velocity_limit_max = -limits.velocity, limits.velocity
        settings.position_limit_min, settings.position_limit_max = limits.position_min, limits.position_max
        settings.mstop_strategy = M_STOPS.index(limits.m_stop)
        for end, angle in (("min", limits.position_min), ("max", limits.position_max)):
            strategy = LIMIT_MOTOR_OFF if math.isfinite(angle) else LIMIT_DISABLED
            setattr(settings, f"{end}_position_limit_strategy", strategy)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._settings, name)


@cache
def _bits(name: str, hebi: Any) -> tuple[int, ...]:
    """Return the bits by which hebi-py marks a field as set; the values of unset fields often read as 0."""
    probe = hebi.GroupCommand(1)
    setattr(probe, name, True if name.endswith("d_on_error") else 1)
    return tuple(int(probe.refs[0].message_bitfield_[word]) for word in range(3))


def _holds(command: Any, name: str, hebi: Any) -> bool:
    given = command.refs[0].message_bitfield_
    return all(int(given[word]) & bits == bits for word, bits in enumerate(_bits(name, hebi)))


def _finite(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings without infinite values: packets represent those by omission."""
    return {name: value for name, value in settings.items() if isinstance(value, str) or math.isfinite(value)}


def _entry(where: str, status: dict[str, Any]) -> EmulatedEntry:
    host, number = wire.parse_address(where)
    packed = ipaddress.IPv4Address(socket.gethostbyname(host)).packed[2:] + number.to_bytes(2, "big")
    # Locally administered, so that it cannot be a real card's.
    mac = ":".join(f"{part:02X}" for part in (0x02, 0x00, *packed))
    return EmulatedEntry(status["family"], status["name"], mac, where, False, where)


def _feedback(record: Feedback) -> Any:
    values = {ATTRIBUTES.get(name, name): value for name, value in record._asdict().items()}
    values |= {
        "receive_time_us": record.stamp_ns * 1_000_000 // NANOSECONDS,
        "hardware_transmit_time_us": record.hardware_ns * 1_000_000 // NANOSECONDS,
        "mstop_state": int(not record.m_stop),
        "command_lifetime_state": int(record.lock),
        "position_limit_state": int(record.position_limit),
        "velocity_limit_state": int(record.velocity_limit),
        "effort_limit_state": int(record.effort_limit),
    }
    return SimpleNamespace(**{name: [value] for name, value in values.items()})
