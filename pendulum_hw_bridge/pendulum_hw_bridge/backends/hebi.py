"""Backend for a real HEBI module, through hebi-py.

hebi-py checks nothing that it sends, returns views of changing buffers and needs a single thread. So commands are
checked, feedback is copied, and calls from another thread are refused. The library is imported only when a module is
connected, because of its licence and its few wheels.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pendulum_hw_bridge.backends.hebi_discovery import LOOK_TIME, ModuleSelection, discover, select_module
from pendulum_hw_bridge.backends.hebi_emulated import EmulatedLookup
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES, import_hebi, start_log, stop_log
from pendulum_hw_bridge.backends.hebi_settings import fill_gains, fill_limits, gains_of, limits_of
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    CommandLock,
    Feedback,
    HardwareLimits,
    LimitState,
    Strategy,
    TemperatureState,
    no_torque,
)
from pendulum_hw_bridge.port.clocks import Clock, WallClock
from pendulum_hw_bridge.port.command_check import check_command, check_lifetime
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.lab_file import EMULATED_NETWORK
from pendulum_msgs_py.programs.hang_guard import hang_guard

__all__ = [
    "ACKNOWLEDGE_MS",
    "LOOKUP_TIMEOUT",
    "STOP_ACKNOWLEDGE_MS",
    "STOP_ATTEMPTS",
    "HebiBackend",
    "connect_group",
    "new_command",
    "open_lookup",
]

LOOKUP_TIMEOUT = 5.0
ACKNOWLEDGE_MS = 200
STOP_ATTEMPTS = 3
STOP_ACKNOWLEDGE_MS = 15
"""Ten round trips; all attempts together take less than the command lifetime [ms]."""


def connect_group(wanted: ModuleSelection, interface: str = "", look_time: float = LOOK_TIME) -> Any:
    """Return hebi-py's group of the selected module, after a search of at least ``look_time`` [s].

    Raises:
        ActuatorError: hebi-py is not installed, or the module is missing, ambiguous or of another type.
    """
    lookup = open_lookup(interface)
    patience = max(look_time, min(LOOKUP_TIMEOUT, 3.0 * look_time))
    module = select_module(discover(lookup, look_time=look_time, patience=patience), wanted, seconds=patience)
    # By address, never by name: a second module of that name may appear after the search.
    group = lookup.get_group_from_macs([module.mac_address], round(1000 * LOOKUP_TIMEOUT))
    if group is None:
        raise ActuatorError("module_lost", f"HEBI module {module} was seen but does not connect")
    return group


def open_lookup(interface: str = "") -> Any:
    """Return hebi-py's ``Lookup`` on one network address or on all, or on emulators for ``emulator:HOST:PORT``.

    Raises:
        ActuatorError: hebi-py is not installed.
        ParameterError: The address of an emulator is not understood.
    """
    hebi = import_hebi()
    if interface.startswith(EMULATED_NETWORK):
        return EmulatedLookup(interface, hebi)
    return hebi.Lookup([interface]) if interface else hebi.Lookup()


def new_command() -> Any:
    """Return an empty hebi-py command for one module."""
    return import_hebi().GroupCommand(1)


class HebiBackend:
    """Actuator port of one HEBI module.

    Args:
        wanted: Module.
        clock: Host clock, which stamps feedback on receipt.
        interface: Network address to search; empty for all.
        drivetrain: Constants to report with a run.
        make_group: Returns hebi-py's group; by default the module is looked up on the network.
        imitation: The group is hebi-py's imitation, which returns neither settings nor times.
        log: File to which the library logs all feedback while connected, or None.
    """

    name = "hebi"

    def __init__(
        self,
        wanted: ModuleSelection = ModuleSelection(),  # noqa: B008  (immutable)
        *,
        clock: Clock | None = None,
        interface: str = "",
        drivetrain: Mapping[str, float] | None = None,
        make_group: Callable[[], Any] | None = None,
        imitation: bool = False,
        log: Path | None = None,
    ) -> None:
        self._clock = clock or WallClock()
        self._make_group = make_group or (lambda: connect_group(wanted, interface))
        self._imitation = imitation
        self._log = log
        self._drivetrain = dict(drivetrain or {})
        self._wanted = wanted
        self._group: Any = None
        self._hebi: Any = None
        self._command: Any = None
        self._feedback: Any = None
        self._owner: int | None = None
        self._strategy = Strategy.OFF
        self._possible = {Strategy.OFF}
        self._limits = HardwareLimits()
        self._gains: GainSet | None = None
        self._counter = 0
        self._last_receive_us = -1
        self._next_ns = 0

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], clock: Clock, **_: Any) -> HebiBackend:
        """Return the port of the module named by the bridge's parameters, with its plant's constants."""
        return cls(
            ModuleSelection.of(values),
            clock=clock,
            interface=values["interface"],
            log=Path(values["hebi_log"]) if values["hebi_log"] else None,
            drivetrain=asdict(load_emulator(values["plant"]).drivetrain),
        )

    @property
    def strategy(self) -> Strategy:
        """Last confirmed strategy."""
        return self._strategy

    def connect(self) -> ActuatorInfo:
        """Find the module, once, and return its properties."""
        if self._group is None:
            self._hebi = import_hebi()
            self._owner = threading.get_ident()
            group = self._make_group()
            if group.size != 1:
                raise ActuatorError("module_lost", f"HEBI group has {group.size} modules; expected 1")
            self._command = self._new_command()
            self._feedback = self._hebi.GroupFeedback(1)
            if self._log is not None:
                start_log(group, self._log)
            # Only now: a refused group must not count as connected on the next call.
            self._group = group
        self._own()
        info = self._read_info()
        family, name, serial, firmware = self._wanted.family, self._wanted.name, "", ""
        if info is not None:
            # An unknown strategy is not ours; the bridge switches it off first.
            number = int(info.control_strategy[0])
            self._strategy = Strategy(number) if number in set(Strategy) else Strategy.OFF
            self._possible = {self._strategy}
            family, name = str(info.family[0]), str(info.name[0])
            serial, firmware = str(info.serial[0]), str(info.firmware_revision[0])
        return ActuatorInfo(
            backend=self.name,
            family=family,
            name=name,
            serial=serial,
            firmware=firmware,
            strategy=self._strategy,
            feedback_rate=float(self._group.feedback_frequency),
            command_lifetime=float(self._group.command_lifetime) * 1e-3,
            limits=self._limits,
            gains=self._gains,
            drivetrain=self._drivetrain,
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self._clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the next feedback, copied from the library's buffers."""
        self._own()
        deadline = self._clock.now_ns() + round(timeout * NANOSECONDS)
        if self._imitation:
            # The imitation replies at once: without pacing the loop would spin.
            self._clock.wait_until(min(self._next_ns, deadline))
            if self._next_ns > deadline:
                return None
            self._next_ns = self._clock.now_ns() + round(NANOSECONDS / self._group.feedback_frequency)
        record = self._group.get_next_feedback(max(1.0, 1000.0 * timeout), self._feedback)
        if record is None:
            self._clock.wait_until(deadline)
            return None
        now = self._clock.now_ns()
        receive_us = int(record.receive_time_us[0])
        if not self._imitation:
            if receive_us == self._last_receive_us:
                self._clock.wait_until(deadline)
                return None
            self._last_receive_us = receive_us
        self._counter += 1
        return self._copy(record, now)

    def write(self, command: Command) -> Applied:
        """Send setpoints, checked and limited first."""
        self._own()
        limited, changed = check_command(command, self._strategy, self._limits)
        now = self._clock.now_ns()
        self._command.clear()
        self._set_setpoints(limited)
        self._send()
        return Applied(limited, self._strategy, changed, now)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Set the strategy, with first setpoints in the same packet."""
        self._own()
        limited, _ = check_command(command or no_torque(strategy), strategy, self._limits)
        # A requested strategy may be in force until confirmed: the acknowledgement can get lost.
        self._possible.add(strategy)
        self._command.clear()
        self._command.control_strategy = int(strategy)
        self._set_setpoints(limited)
        self._acknowledged("strategy")
        info = self._read_info()
        number = int(strategy) if info is None else int(info.control_strategy[0])
        if number not in set(Strategy):
            raise ActuatorError(
                "strategy", f"strategy reads back as {number}; expected {strategy.name} ({int(strategy)})"
            )
        self._strategy = Strategy(number)
        self._possible = {self._strategy}
        return self._strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Set the gains of all loops and read them back."""
        self._own()
        self._command.clear()
        fill_gains(self._command, gains)
        self._acknowledged("gains")
        info = self._read_info()
        self._gains = gains if info is None else gains_of(info, gains)
        return self._gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the module's safety parameters and read them back."""
        self._own()
        self._command.clear()
        fill_limits(self._command, limits)
        self._acknowledged("limits")
        info = self._read_info()
        self._limits = limits if info is None else limits_of(info, limits)
        return self._limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s]; 0, which means infinite, is refused."""
        self._own()
        milliseconds = max(1, round(1000.0 * check_lifetime(lifetime)))
        self._group.command_lifetime = milliseconds
        return float(self._group.command_lifetime) * 1e-3

    def set_feedback_rate(self, rate: float) -> float:
        """Set the rate of the library's background requests [Hz]."""
        self._own()
        if not (math.isfinite(rate) and 0.0 < rate <= 1000.0):
            raise ParameterError(f"feedback_rate is {rate} Hz; expected > 0 and <= 1000 Hz")
        self._group.feedback_frequency = float(rate)
        return float(self._group.feedback_frequency)

    def stop(self) -> None:
        """Remove torque, then set strategy off with acknowledgement, with retries because packets can get lost."""
        if self._group is None or threading.get_ident() != self._owner:
            return
        driving = self._possible - {Strategy.OFF}
        self._strategy = Strategy.OFF
        if driving:
            self._command.clear()
            self._set_setpoints(no_torque(*driving))
            self._group.send_command(self._command)
        for _ in range(STOP_ATTEMPTS):
            self._command.clear()
            self._command.control_strategy = int(Strategy.OFF)
            self._set_setpoints(no_torque(Strategy.OFF))
            if self._group.send_command_with_acknowledgement(self._command, STOP_ACKNOWLEDGE_MS):
                self._possible = {Strategy.OFF}
                return
        raise ActuatorError(
            "stop_unacknowledged",
            f"HEBI module did not confirm that it is off, asked {STOP_ATTEMPTS} times; the command lifetime ends its "
            "torque. Press the motion stop",
        )

    def close(self) -> None:
        """Stop, and release the group and its thread."""
        try:
            self.stop()
        finally:
            if self._log is not None and self._group is not None:
                stop_log(self._group)
            # Of thousands of groups one is never released: the library waits for a thread that never ends.
            with hang_guard():
                self._group = self._command = self._feedback = None

    def _own(self) -> None:
        if self._group is None:
            raise ActuatorError("not_connected", "HEBI module is not connected; call connect() first")
        if threading.get_ident() != self._owner:
            raise ActuatorError(
                "exception", "HEBI group was called from a second thread; expected only the one that connected"
            )

    def _new_command(self) -> Any:
        return self._hebi.GroupCommand(1)

    def _set_setpoints(self, command: Command) -> None:
        self._command.position = command.position
        self._command.velocity = command.velocity
        self._command.effort = command.effort_field

    def _send(self) -> None:
        if not self._group.send_command(self._command):
            raise ActuatorError("send_failed", "command could not be sent to the HEBI module: network down?")

    def _acknowledged(self, what: str) -> None:
        if not self._group.send_command_with_acknowledgement(self._command, ACKNOWLEDGE_MS):
            raise ActuatorError(
                "no_acknowledgement", f"HEBI module did not acknowledge its {what} within {ACKNOWLEDGE_MS} ms"
            )

    def _read_info(self) -> Any:
        if self._imitation:
            return None
        info = self._group.request_info(ACKNOWLEDGE_MS)
        if info is None:
            raise ActuatorError("module_lost", f"HEBI module did not answer within {ACKNOWLEDGE_MS} ms")
        return info

    def _copy(self, record: Any, now_ns: int) -> Feedback:
        values = {ours: float(getattr(record, theirs)[0]) for ours, theirs in ATTRIBUTES.items()}
        hardware_us = int(record.hardware_transmit_time_us[0])
        return Feedback(
            stamp_ns=now_ns,
            hardware_ns=1000 * hardware_us if hardware_us else now_ns,
            sequence=self._counter,
            m_stop=int(record.mstop_state[0]) == 0 and not self._imitation,
            temperature_state=_known(TemperatureState, record.temperature_state[0]),
            lock=_known(CommandLock, record.command_lifetime_state[0]),
            position_limit=self._limit(record.position_limit_state[0]),
            velocity_limit=self._limit(record.velocity_limit_state[0]),
            effort_limit=self._limit(record.effort_limit_state[0]),
            **values,
        )

    def _limit(self, number: Any) -> int:
        return LimitState.INSIDE if self._imitation else _known(LimitState, number)


def _known(kind: Any, number: Any) -> int:
    """Return a firmware state as our enum's value; unknown numbers of newer firmware pass unchanged."""
    try:
        return int(kind(int(number)))
    except ValueError:
        return int(number)
