"""Backend for an emulated X5-9 in this process, on wall-clock or simulated time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import TimingParameters, load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
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

__all__ = ["EmulatorBackend"]

_CUT_OFF = {ActuatorFault.COMMANDS_LOST, ActuatorFault.SEND_FAILED, ActuatorFault.LOCKED_BY_OTHER}
"""Faults that also keep settings from reaching the actuator."""
_LOCKSTEP_LEAD_NS = 500_000
"""In lockstep, time from measurement of the feedback to the state that shows it [ns]."""
_FIRST_STEP_NS = 1_000_000


class EmulatorBackend:
    """Actuator port of an :class:`EmulatedX5` whose clock must start at the present of ``clock``."""

    name = "emulator"

    def __init__(self, actuator: EmulatedX5, clock: Clock | None = None, *, seed: int = 0) -> None:
        self.actuator = actuator
        self.clock = clock or WallClock()
        self._random = np.random.Generator(np.random.Philox(key=[seed, 1]))
        # On the wall clock, time passes by itself; simulated time waits for computations.
        self._computes_ahead = isinstance(self.clock, WallClock)
        self._feedback_delay_ns = round(actuator.parameters.timing.feedback_delay * NANOSECONDS)
        self._connected = False
        self._strategy = Strategy.OFF

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], clock: Clock, *, lockstep: bool = False) -> EmulatorBackend:
        """Return the emulator that the bridge's parameters describe; without jitter in lockstep."""
        parameters = replace(load_emulator(values["plant"]), flat=values["flat"])
        # The first step compiles code, for tens of seconds on a busy machine: do it before the control loop starts.
        EmulatedX5(parameters).advance_to(_FIRST_STEP_NS)
        start_ns = clock.now_ns()
        if lockstep:
            # Set this rate from the start: a later change would restart the raster without the lead.
            quiet = replace(
                TimingParameters(), feedback_rate=values["feedback_rate"], feedback_jitter=0.0, delay_jitter=0.0
            )
            parameters = replace(parameters, timing=quiet)
            period_ns = round(NANOSECONDS / values["feedback_rate"])
            start_ns -= period_ns + min(_LOCKSTEP_LEAD_NS, period_ns // 2)
        actuator = EmulatedX5(parameters, seed=values["seed"], position=values["initial_position"], start_ns=start_ns)
        return cls(actuator, clock, seed=values["seed"])

    @property
    def strategy(self) -> Strategy:
        """Last confirmed strategy; the actuator may have changed it since."""
        return self._strategy

    def connect(self) -> ActuatorInfo:
        """Return the properties of the emulated actuator."""
        self._connected = True
        self._catch_up()
        actuator = self.actuator
        self._strategy = actuator.strategy
        return ActuatorInfo(
            backend=self.name,
            family="emulated",
            name=actuator.parameters.plant.name,
            serial="X5-9-E0001",
            firmware="emulated X5-9",
            strategy=actuator.strategy,
            feedback_rate=actuator.feedback_rate,
            command_lifetime=actuator.command_lifetime,
            limits=actuator.limits,
            gains=actuator.gains,
            drivetrain=asdict(actuator.parameters.drivetrain),
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self.clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the newest feedback, waiting for one at most ``timeout`` [s]."""
        self._require_connection()
        deadline = self.clock.now_ns() + round(timeout * NANOSECONDS)
        self._catch_up()
        while True:
            feedback = self.actuator.feedback(self.clock.now_ns())
            if feedback is not None:
                return feedback
            delivery = self.actuator.next_delivery_ns
            sample = self.actuator.next_sample_ns + self._feedback_delay_ns
            # A record in transit comes before the next one, unless it is delayed.
            target = sample if delivery is None else min(delivery, sample)
            if delivery is None and self._computes_ahead:
                # Measure while the record is in transit, because that takes 0.1 ms of computing.
                target = self.actuator.next_sample_ns
            if target > deadline or self.clock.now_ns() > deadline:
                self.clock.wait_until(deadline)
                self._catch_up()
                return self.actuator.feedback(deadline)
            self.clock.wait_until(target)
            self._catch_up()

    def write(self, command: Command) -> Applied:
        """Send setpoints, which arrive after the transport delay."""
        self._require_connection()
        limited, changed = check_command(command, self._strategy, self.actuator.limits)
        if ActuatorFault.SEND_FAILED in self.actuator.faults:
            raise ActuatorError("send_failed", "command could not be sent: the network refuses it")
        now = self.clock.now_ns()
        self._catch_up()
        timing = self.actuator.parameters.timing
        delay = timing.command_delay + timing.delay_jitter * float(self._random.standard_normal())
        self.actuator.deliver(limited, now + max(0, round(delay * NANOSECONDS)))
        return Applied(limited, self._strategy, changed, now)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Set the strategy, with first setpoints at the same instant."""
        limited = None if command is None else check_command(command, strategy, self.actuator.limits)[0]
        self._configure(strategy=strategy)
        self._strategy = self.actuator.strategy
        if limited is not None and self._strategy is strategy:
            self.actuator.deliver(limited, self.clock.now_ns())
        return self._strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Set the gains of all loops."""
        self._configure(gains=gains)
        return self.actuator.gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the firmware's limits."""
        self._configure(limits=limits)
        return self.actuator.limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s]."""
        self._configure(command_lifetime=check_lifetime(lifetime))
        return self.actuator.command_lifetime

    def set_feedback_rate(self, rate: float) -> float:
        """Set the feedback rate [Hz]."""
        self._configure(feedback_rate=rate)
        return self.actuator.feedback_rate

    def push(self, torque: float) -> None:
        """Hold an external torque on the link [N m]."""
        self._catch_up()
        self.actuator.push = torque if math.isfinite(torque) else 0.0

    def stop(self) -> None:
        """Remove torque, then set strategy off; both are lost if the connection is cut."""
        if not self._connected:
            return
        self._catch_up()
        if self._strategy is not Strategy.OFF and ActuatorFault.SEND_FAILED not in self.actuator.faults:
            self.actuator.deliver(no_torque(self._strategy), self.clock.now_ns())
            self._catch_up()
        self._strategy = Strategy.OFF
        if self.actuator.faults & _CUT_OFF:
            raise ActuatorError(
                "stop_unacknowledged", "actuator did not confirm that it is off; the command lifetime ends its torque"
            )
        self.actuator.configure(strategy=Strategy.OFF)

    def close(self) -> None:
        """Stop and release."""
        try:
            self.stop()
        finally:
            self._connected = False

    def _configure(self, **changes: object) -> None:
        self._require_connection()
        self._catch_up()
        if self.actuator.faults & _CUT_OFF:
            raise ActuatorError("no_acknowledgement", f"actuator did not acknowledge {', '.join(changes)}")
        self.actuator.configure(**changes)  # type: ignore[arg-type]  # one of its keywords each

    def _catch_up(self) -> None:
        self.actuator.advance_to(self.clock.now_ns())

    def _require_connection(self) -> None:
        if not self._connected:
            raise ActuatorError("not_connected", "emulated actuator is not connected; call connect() first")
