"""Several HEBI modules as one hebi-py group: one round of packets carries all setpoints, one all feedback.

Each driven joint has a :class:`GroupDrive`, the backend ``hebi`` on its part of the group; a passive joint has a
:class:`GroupEncoder`, which cannot send. Modules are identified by address, in the order of the joints.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pendulum_hw_bridge.backends.hebi import (
    ACKNOWLEDGE_MS,
    LOOKUP_TIMEOUT,
    STOP_ACKNOWLEDGE_MS,
    STOP_ATTEMPTS,
    HebiBackend,
    open_lookup,
)
from pendulum_hw_bridge.backends.hebi_discovery import LOOK_TIME, ModuleRecord, ModuleSelection, discover, select_module
from pendulum_hw_bridge.backends.hebi_log import import_hebi, start_log, stop_log
from pendulum_hw_bridge.port.actuator import (
    NO_SETPOINT,
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    Feedback,
    Strategy,
    no_torque,
)
from pendulum_hw_bridge.port.clocks import Clock, WallClock
from pendulum_hw_bridge.port.command_check import check_command
from pendulum_msgs_py.programs.hang_guard import hang_guard

__all__ = ["GroupDrive", "GroupEncoder", "HebiGroup"]


class HebiGroup:
    """Modules of a plant. All calls must come from one thread.

    Args:
        joints: Name and module of each joint, in the order of the model.
        driven: Indices of the joints with a motor.
        interface: Network address to search; empty for all.
        look_time: Shortest search time [s].
        lookup: Returns hebi-py's ``Lookup``; by default that of the interface.
        log: File to which the library logs all feedback while connected, or None.
    """

    def __init__(
        self,
        joints: Sequence[tuple[str, ModuleSelection]],
        driven: Sequence[int],
        *,
        interface: str = "",
        look_time: float = LOOK_TIME,
        lookup: Callable[[], Any] | None = None,
        log: Path | None = None,
    ) -> None:
        self.names = [name for name, _ in joints]
        self.driven = tuple(driven)
        self._wanted = [wanted for _, wanted in joints]
        self._look_time = look_time
        self._lookup = lookup or (lambda: open_lookup(interface))
        self._log = log
        self.group: Any = None
        self._records: list[ModuleRecord] = []
        self._packet: Any = None
        self._buffer: Any = None
        self._frame: Any = None
        self._asked: list[Strategy] = []
        self._possible: list[set[Strategy]] = []
        self._setpoints: dict[int, Command] = {}
        self._stop_reported: set[int] | None = None
        self._stop_error: Exception | None = None
        self._users = 0

    def join(self) -> None:
        """Register a port; the first finds the modules and switches all of them off.

        Raises:
            ActuatorError: A module is missing, silent, of another type, selected twice, or does not switch off.
        """
        if self.group is None:
            self._connect()
        self._users += 1

    def leave(self) -> None:
        """Unregister a port; the last releases the group and its thread."""
        self._users -= 1
        if self._users == 0:
            if self._log is not None:
                stop_log(self.group)
            # As in HebiBackend.close: of thousands of groups one is never released.
            with hang_guard():
                self.group = self._packet = self._buffer = self._frame = None

    def _connect(self) -> None:
        hebi = import_hebi()
        lookup = self._lookup()
        patience = max(self._look_time, min(LOOKUP_TIMEOUT, 3.0 * self._look_time))
        seen = discover(lookup, look_time=self._look_time, patience=patience)
        records: list[ModuleRecord] = []
        for name, wanted in zip(self.names, self._wanted, strict=True):
            try:
                record = select_module(seen, wanted, seconds=patience)
            except ActuatorError as error:
                raise ActuatorError(error.fault, f"{name}: {error}") from error
            if record.mac_address in [each.mac_address for each in records]:
                other = self.names[[each.mac_address for each in records].index(record.mac_address)]
                raise ActuatorError(
                    "module_lost", f"HEBI module {record} is meant for {other} and for {name}; expected one for each"
                )
            records.append(record)
        # By address, never by name: the group has the order of the joints.
        group = lookup.get_group_from_macs([each.mac_address for each in records], round(1000 * LOOKUP_TIMEOUT))
        if group is None:
            listed = ", ".join(map(str, records))
            raise ActuatorError("module_lost", f"HEBI modules {listed} were seen but do not connect as a group")
        if group.size != len(records):
            raise ActuatorError("module_lost", f"HEBI group has {group.size} modules; expected {len(records)}")
        packet = hebi.GroupCommand(group.size)
        self._fill_off(packet)
        if not group.send_command_with_acknowledgement(packet, ACKNOWLEDGE_MS):
            raise ActuatorError(
                "no_acknowledgement", f"HEBI modules did not all confirm within {ACKNOWLEDGE_MS} ms that they are off"
            )
        self._records, self._asked = records, [Strategy.OFF] * group.size
        self._possible = [{Strategy.OFF} for _ in records]
        self._check_info(_answered(group.request_info(ACKNOWLEDGE_MS)))
        self._setpoints.clear()
        self._stop_reported = self._frame = None
        self._packet, self._buffer = packet, hebi.GroupFeedback(group.size)
        if self._log is not None:
            start_log(group, self._log)
        # Only now: a refused group must not count as connected on the next call.
        self.group = group

    def keep(self, index: int, command: Command) -> None:
        """Store a joint's setpoints for the next round of packets."""
        self._stop_reported = None
        self._setpoints[index] = command

    def send(self) -> None:
        """Send the stored setpoints in one round; ActuatorError if that fails."""
        if not self._setpoints:
            return
        setpoints, self._setpoints = self._setpoints, {}
        if not self._send_setpoints(setpoints):
            raise ActuatorError("send_failed", "commands could not be sent to the HEBI modules: network down?")

    def acknowledged(self, index: int, packet: Any, strategy: Strategy | None, timeout_ms: float) -> bool:
        """Send settings of one joint, with a strategy or None; return whether all modules acknowledged in time [ms].

        Raises:
            ActuatorError: The joint is passive.
        """
        if index not in self.driven:
            raise ActuatorError("exception", f"{self.names[index]} is passive: nothing is sent to its module but off")
        self._stop_reported = None
        if strategy is not None:
            # A requested strategy may be in force: the acknowledgement can get lost.
            self._asked[index] = strategy
            self._possible[index].add(strategy)
            # Stored setpoints were for the previous strategy: a duty would become a torque.
            self._setpoints.pop(index, None)
        return bool(self.group.send_command_with_acknowledgement(packet, timeout_ms))

    def info(self, index: int, timeout_ms: float) -> Any:
        """Return the settings of all modules, or None.

        Raises:
            ActuatorError: A module was exchanged, or has a strategy that this group did not set.
        """
        info = self.group.request_info(timeout_ms)
        if info is not None:
            self._check_info(info, but=index if index in self.driven else None)
        return info

    def receive(self, timeout_ms: float) -> Any:
        """Return the next frame of feedback, or None after the timeout."""
        frame = self.group.get_next_feedback(timeout_ms, self._buffer)
        if frame is not None:
            self._frame = frame
        return frame

    @property
    def frame(self) -> Any:
        """Newest frame of feedback; None before the first."""
        return self._frame

    def stop(self, index: int) -> None:
        """Remove torque and switch all modules off, in one round for all joints; later joints get the same result.

        Raises:
            ActuatorError: A module has not confirmed that it is off.
        """
        if self._stop_reported is None or index in self._stop_reported:
            self._stop_reported, self._stop_error = set(), None
            try:
                self._stop_all()
            except Exception as error:  # noqa: BLE001  (each joint gets it)
                self._stop_error = error
        self._stop_reported.add(index)
        if self._stop_error is not None:
            raise self._stop_error

    def _stop_all(self) -> None:
        self._setpoints.clear()
        self._asked = [Strategy.OFF] * len(self._asked)
        driving = {index: possible - {Strategy.OFF} for index, possible in enumerate(self._possible)}
        try:
            nothing = {index: no_torque(*strategies) for index, strategies in driving.items() if strategies}
            if nothing:
                self._send_setpoints(nothing)
        finally:
            self._switch_off()

    def _send_setpoints(self, setpoints: Mapping[int, Command]) -> bool:
        self._packet.clear()
        for index, command in setpoints.items():
            part = self._packet.create_view([index])
            part.position, part.velocity, part.effort = command.position, command.velocity, command.effort_field
        return bool(self.group.send_command(self._packet))

    def _switch_off(self) -> None:
        for _ in range(STOP_ATTEMPTS):
            self._fill_off(self._packet)
            if self.group.send_command_with_acknowledgement(self._packet, STOP_ACKNOWLEDGE_MS):
                self._possible = [{Strategy.OFF} for _ in self._possible]
                return
        raise ActuatorError(
            "stop_unacknowledged",
            f"HEBI modules did not all confirm that they are off, asked {STOP_ATTEMPTS} times; the command lifetime "
            "ends their torque. Press the motion stop",
        )

    @staticmethod
    def _fill_off(packet: Any) -> None:
        packet.clear()
        packet.control_strategy = int(Strategy.OFF)
        packet.position = packet.velocity = packet.effort = NO_SETPOINT

    def _check_info(self, info: Any, but: int | None = None) -> None:
        """Compare settings of all modules with the expected ones; joint ``but`` may have another strategy."""
        for index, record in enumerate(self._records):
            reads = tuple(str(getattr(info, name)[index]) for name in ("family", "name", "serial"))
            known = (record.family, record.name, record.serial)
            if reads != known:
                raise ActuatorError(
                    "module_lost",
                    f"{self.names[index]}: HEBI module reads as {'/'.join(reads[:2])} ({reads[2]}); expected "
                    f"{'/'.join(known[:2])} ({known[2]})",
                )
            number, wanted = int(info.control_strategy[index]), self._asked[index]
            if number in set(Strategy):
                self._possible[index] = {Strategy(number)}
            if index != but and number != int(wanted):
                raise ActuatorError(
                    "strategy",
                    f"{self.names[index]}: strategy reads back as {number}; expected {wanted.name} ({int(wanted)})",
                )


def _answered(info: Any) -> Any:
    if info is None:
        raise ActuatorError("module_lost", f"HEBI modules did not all answer within {ACKNOWLEDGE_MS} ms")
    return info


class _Row:
    """One module's part of a frame or of settings, as hebi-py's for a group of one."""

    def __init__(self, of_all: Any, index: int) -> None:
        self._of_all = of_all
        self._index = index

    def __getattr__(self, name: str) -> Any:
        return (getattr(self._of_all, name)[self._index],)


class _Part:
    """One module's part of a group ``packet``, as hebi-py's command for a group of one."""

    packet: Any
    strategy: Strategy | None
    _view: Any

    def __init__(self, packet: Any, index: int) -> None:
        self.__dict__.update(packet=packet, strategy=None, _view=packet.create_view([index]))

    def clear(self) -> None:
        self.packet.clear()
        self.__dict__["strategy"] = None

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "control_strategy":
            self.__dict__["strategy"] = Strategy(value)
        setattr(self._view, name, value)


class _Seat:
    """One module as hebi-py's group of one; commands of :class:`HebiBackend` are sent through the shared group."""

    size = 1

    def __init__(self, shared: HebiGroup, index: int) -> None:
        shared.join()
        self._shared = shared
        self._index = index

    @property
    def command_lifetime(self) -> float:
        return float(self._shared.group.command_lifetime)

    @command_lifetime.setter
    def command_lifetime(self, milliseconds: int) -> None:
        self._shared.group.command_lifetime = milliseconds

    @property
    def feedback_frequency(self) -> float:
        return float(self._shared.group.feedback_frequency)

    @feedback_frequency.setter
    def feedback_frequency(self, rate: float) -> None:
        self._shared.group.feedback_frequency = rate

    def send_command_with_acknowledgement(self, command: _Part, timeout_ms: float) -> bool:
        return self._shared.acknowledged(self._index, command.packet, command.strategy, timeout_ms)

    def request_info(self, timeout_ms: float) -> Any:
        info = self._shared.info(self._index, timeout_ms)
        return None if info is None else _Row(info, self._index)

    def get_next_feedback(self, timeout_ms: float, reuse_fbk: Any = None) -> Any:
        # The first joint receives a frame and the others read the same one; otherwise one state would mix two frames.
        frame = self._shared.receive(timeout_ms) if self._index == 0 else self._shared.frame
        return None if frame is None else _Row(frame, self._index)


class _GroupPort(HebiBackend):
    """Common part of both ports of a group."""

    def __init__(self, shared: HebiGroup, index: int, clock: Clock | None = None, **options: Any) -> None:
        super().__init__(clock=clock, make_group=lambda: _Seat(shared, index), **options)
        self.shared = shared
        self._index = index
        # A module without any record reads 0.
        self._last_receive_us = 0

    def read(self, timeout: float) -> Feedback | None:
        """Return this module's part of the newest frame if it is new; only the first joint waits for one."""
        return super().read(timeout if self._index == 0 else 0.0)

    def release(self) -> None:
        """Release the group without stopping."""
        if self._group is not None:
            self._group = self._command = self._feedback = None
            self.shared.leave()

    def _new_command(self) -> Any:
        return _Part(self._hebi.GroupCommand(len(self.shared.names)), self._index)


class GroupDrive(_GroupPort):
    """Actuator port of one driven joint; :meth:`flush` sends the setpoints of all joints."""

    def write(self, command: Command) -> Applied:
        """Store setpoints, checked and limited, for the next :meth:`flush`."""
        self._own()
        limited, changed = check_command(command, self._strategy, self._limits)
        self.shared.keep(self._index, limited)
        return Applied(limited, self._strategy, changed, self._clock.now_ns())

    def flush(self) -> None:
        """Send the stored setpoints of all ports of the group."""
        self._own()
        self.shared.send()

    def stop(self) -> None:
        """Remove torque, then set strategy off, on all modules of the group."""
        if self._group is None or threading.get_ident() != self._owner:
            return
        self._strategy = Strategy.OFF
        self.shared.stop(self._index)

    def close(self) -> None:
        """Stop and release."""
        try:
            self.stop()
        finally:
            self.release()


class GroupEncoder:
    """Port of a passive joint, without any way to command torque."""

    def __init__(self, shared: HebiGroup, index: int, clock: Clock | None = None) -> None:
        self._clock = clock or WallClock()
        self._port = _GroupPort(shared, index, self._clock)

    def connect(self) -> ActuatorInfo:
        """Find the module, once, and return its properties; its motor reads back as off."""
        return self._port.connect()

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self._clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the module's part of the newest frame if it is new."""
        return self._port.read(timeout)

    def set_feedback_rate(self, rate: float) -> float:
        """Set the request rate of the whole group [Hz]."""
        return self._port.set_feedback_rate(rate)

    def close(self) -> None:
        """Release the group."""
        self._port.release()
