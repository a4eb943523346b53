"""Actuator port of drives with a current loop of their own: they are off, or take a torque.

A subclass speaks a vendor's protocol. This class has what is common: order of calls, limits, pace of the records, and
the expiry of commands on this side, because the watchdog of most drives counts any request, not only commands.
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    Feedback,
    HardwareLimits,
    MStopAction,
    Strategy,
)
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_hw_bridge.port.command_check import check_command, check_lifetime
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError

__all__ = ["TORQUE_LOOP", "DriveModel", "Identity", "TorqueDrive"]

TORQUE_LOOP = Strategy.PARALLEL_PWM
"""Strategy in force while a drive takes torques."""
STOP_ATTEMPTS = 3
_SILENCE = 1.2
"""Time without requests after a stop that was not confirmed, in command lifetimes [-]."""


@dataclass(frozen=True)
class DriveModel:
    """Constants of a drive's model, at its output.

    Attributes:
        name: As sold.
        torque_per_ampere: [N m/A].
        gear_ratio: Motor turns per turn of the output [-].
        largest_current: Largest current that it can be set to [A].
    """

    name: str
    torque_per_ampere: float
    gear_ratio: float
    largest_current: float

    @property
    def peak(self) -> float:
        """Torque at the largest current [N m]."""
        return self.torque_per_ampere * self.largest_current


@dataclass(frozen=True)
class Identity:
    """What a drive reports about itself."""

    family: str
    model: DriveModel
    serial: str
    firmware: str


class Bus:
    """Drives on one bus, and the time until which nothing is asked on it, so that watchdogs can act [ns]."""

    def __init__(self) -> None:
        self.quiet_until_ns = 0
        self.drives: list[TorqueDrive] = []


class TorqueDrive(ABC):
    """One drive.

    Args:
        joint: Name of its joint, reported as its name.
        clock: Host clock.
    """

    name: str
    fastest: float
    """Largest feedback rate [Hz]."""

    def __init__(self, clock: Clock, joint: str = "") -> None:
        self.clock = clock
        self._joint = joint
        self._connected = False
        self._strategy = Strategy.OFF
        self._possibly_on = True
        self._limits = HardwareLimits(m_stop=MStopAction.DISABLED)
        self._gains: GainSet | None = None
        self._lifetime = 0.1
        self._period_ns = round(NANOSECONDS / 100.0)
        self._next_ns = 0
        self._bus = Bus()
        self._bus.drives.append(self)
        self._written_ns = self._sequence = 0

    @classmethod
    @abstractmethod
    def drive_of(cls, model: str) -> DriveModel:
        """Return a model by its name; ParameterError if it is unknown."""

    @classmethod
    @abstractmethod
    def scan(cls, values: Mapping[str, Any]) -> list[Identity]:
        """Return the drives that answer on the bus that the bridge's parameters name."""

    @abstractmethod
    def on_this_bus(self, values: Mapping[str, Any]) -> TorqueDrive:
        """Return the port of another drive on the same bus, which the bridge's parameters of its joint name."""

    # --- what a subclass does ---------------------------------------------------------------------------------

    @abstractmethod
    def _open(self) -> Identity:
        """Open the bus, once, and ask the drive who it is; change nothing."""

    @abstractmethod
    def _request(self, patience: float) -> Feedback | None:
        """Ask for one record and wait at most ``patience`` [s]; None without a reply to this very request."""

    @abstractmethod
    def _send(self, effort: float) -> float:
        """Send a torque [N m]; return the one that the drive gets, rounded to its steps."""

    @abstractmethod
    def _switch_on(self, effort: float) -> None:
        """Switch the torque loop on with a first torque [N m]; ActuatorError unless that reads back."""

    @abstractmethod
    def _switch_off(self) -> None:
        """Remove torque and switch off; ActuatorError unless that reads back."""

    @abstractmethod
    def _limit_effort(self, limit: float) -> float:
        """Limit the torque in the drive [N m] and check its other settings; return the limit read back."""

    @abstractmethod
    def _limit_lifetime(self, lifetime: float) -> float:
        """Set the drive's watchdog [s]; return the value read back."""

    @abstractmethod
    def _release(self) -> None:
        """Close the bus."""

    # --- the port ---------------------------------------------------------------------------------------------

    @property
    def strategy(self) -> Strategy:
        """Last confirmed strategy."""
        return self._strategy

    def connect(self) -> ActuatorInfo:
        """Find the drive and return its properties."""
        identity = self._open()
        self._connected = True
        return ActuatorInfo(
            backend=self.name,
            family=identity.family,
            name=self._joint or identity.model.name,
            serial=identity.serial,
            firmware=identity.firmware,
            strategy=self._strategy,
            feedback_rate=NANOSECONDS / self._period_ns,
            command_lifetime=self._lifetime,
            limits=self._limits,
            gains=self._gains,
            drivetrain={key: value for key, value in asdict(identity.model).items() if key != "name"},
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self.clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Ask for the next record when it is due; None if it is not due within ``timeout`` [s], or is not answered."""
        self._require_connection()
        deadline = self.now_ns() + round(timeout * NANOSECONDS)
        due = max(self._next_ns, self._bus.quiet_until_ns)
        if due > deadline:
            self.clock.wait_until(deadline)
            return None
        self.clock.wait_until(due)
        now = self.now_ns()
        # Late readers skip records; those in time do not drift.
        self._next_ns = max(due + self._period_ns, now + self._period_ns // 2)
        if self._strategy is TORQUE_LOOP and now - self._written_ns > round(self._lifetime * NANOSECONDS):
            # Requests keep the drive's own watchdog quiet.
            self._send(0.0)
        record = self._request(min(0.02, 0.8 * self._period_ns / NANOSECONDS))
        if record is None:
            return None
        self._sequence += 1
        return record._replace(sequence=self._sequence)

    def write(self, command: Command) -> Applied:
        """Send a torque; none for NaN."""
        self._require_connection()
        effort, changed = self._checked(command, self._strategy)
        now = self._written_ns = self.now_ns()
        if self._strategy is Strategy.OFF:
            return Applied(Command(), self._strategy, changed, now)
        return Applied(Command(effort=self._send(effort)), self._strategy, changed, now)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Switch on with a first torque, or off."""
        self._require_connection()
        if strategy not in {Strategy.OFF, TORQUE_LOOP}:
            raise ActuatorError(
                "strategy", f"strategy is {strategy.name}; expected OFF or {TORQUE_LOOP.name}: {self.name} takes torque"
            )
        effort, _ = self._checked(command or Command(), strategy)
        if strategy is Strategy.OFF:
            self._strategy = strategy
            self._switch_surely_off()
            return strategy
        self._possibly_on = True
        self._written_ns = self.now_ns()
        try:
            self._switch_on(effort)
        except ActuatorError:
            self.stop()
            raise
        self._strategy = strategy
        return strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Store gains; the current loop has none that the bridge sets."""
        self._require_connection()
        self._gains = gains
        return gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Limit the torque in the drive, which checks no other limit and has no motion stop."""
        self._require_connection()
        self._limits = replace(limits, effort=self._limit_effort(limits.effort), m_stop=MStopAction.DISABLED)
        return self._limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the drive's watchdog, and the expiry on this side [s]."""
        self._require_connection()
        self._lifetime = self._limit_lifetime(check_lifetime(lifetime))
        return self._lifetime

    def set_feedback_rate(self, rate: float) -> float:
        """Set the rate of requests [Hz]."""
        self._require_connection()
        if not (math.isfinite(rate) and 0.0 < rate <= self.fastest):
            raise ParameterError(f"feedback_rate is {rate} Hz; expected > 0 and <= {self.fastest:g} Hz for {self.name}")
        self._period_ns = round(NANOSECONDS / rate)
        return NANOSECONDS / self._period_ns

    def stop(self) -> None:
        """Remove torque and switch off, with retries because packets get lost."""
        self._strategy = Strategy.OFF
        if self._connected and self._possibly_on:
            self._switch_surely_off()

    def close(self) -> None:
        """Stop and release the bus."""
        try:
            self.stop()
        finally:
            if self._connected:
                self._connected = False
                self._release()

    def _switch_surely_off(self) -> None:
        problem: ActuatorError | None = None
        for _ in range(STOP_ATTEMPTS):
            try:
                self._switch_off()
            except ActuatorError as error:
                problem = error
                self._calm_others()
            else:
                self._possibly_on = False
                return
        # Whatever reaches the drive feeds its watchdog: only silence lets it act.
        self._bus.quiet_until_ns = self.now_ns() + round(_SILENCE * self._lifetime * NANOSECONDS)
        raise ActuatorError(
            "stop_unacknowledged",
            f"drive did not confirm that it is off, asked {STOP_ATTEMPTS} times ({problem}): unless its "
            "watchdog acts, it may have torque. Switch its supply off",
        )

    def _calm_others(self) -> None:
        """Send no torque to the other drives on the bus: theirs must not go on while this one is waited for."""
        for other in self._bus.drives:
            if other is not self and other._strategy is TORQUE_LOOP:
                with contextlib.suppress(ActuatorError):
                    other._send(0.0)

    def _share_bus(self, other: TorqueDrive) -> None:
        other._bus = self._bus
        self._bus.drives.append(other)

    def _checked(self, command: Command, strategy: Strategy) -> tuple[float, bool]:
        limited, changed = check_command(command, strategy, self._limits)
        if not (math.isnan(limited.position) and math.isnan(limited.velocity)):
            raise ActuatorError("strategy", "drive got a position or a velocity; expected a torque alone")
        return 0.0 if math.isnan(limited.effort) else limited.effort, changed

    def _require_connection(self) -> None:
        if not self._connected:
            raise ActuatorError("not_connected", f"{self.name} drive is not connected; call connect() first")
