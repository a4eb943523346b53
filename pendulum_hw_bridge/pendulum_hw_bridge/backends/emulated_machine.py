"""Ports of an emulated machine of several joints in this process: a drive or an encoder for each joint."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    Feedback,
    HardwareLimits,
    Strategy,
)
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_hw_bridge.port.command_check import check_command
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["DrivePort", "JointPort", "machine_ports"]

TORQUE_LOOP = Strategy.PARALLEL_PWM
"""Strategy of drives with a current loop, which take an effort; those of motors in volts take a duty."""


class JointPort:
    """Encoder of joint ``index``, without torque; the machine's clock must start at the present of ``clock``."""

    def __init__(self, machine: EmulatedMachine, index: int, clock: Clock) -> None:
        self.machine = machine
        self.clock = clock
        self._index = index
        self._connected = False

    def connect(self) -> ActuatorInfo:
        """Return the properties of the emulated module."""
        self._connected = True
        return ActuatorInfo(
            backend="emulator",
            family="emulated",
            name=self.machine.coordinates.joints[self._index].name,
            serial=f"QDD-E{self._index:04d}",
            firmware="emulated machine",
            strategy=Strategy.OFF,
            feedback_rate=self.machine.rate,
            command_lifetime=0.0,
            limits=HardwareLimits(joint=self.machine.coordinates.joints[self._index]),
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self.clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the newest feedback, waiting for one at most ``timeout`` [s]."""
        self._require_connection()
        deadline = self.now_ns() + round(timeout * NANOSECONDS)
        while True:
            now = self.now_ns()
            self.machine.advance_to(now)
            feedback = self.machine.feedback(self._index, now)
            if feedback is not None or now >= deadline:
                return feedback
            self.clock.wait_until(min(deadline, max(now + 1, self.machine.next_arrival_ns(self._index))))

    @property
    def stood_still(self) -> float:
        """Time for which the machine stood still because it was not read [s]."""
        return self.machine.stood_still

    def set_feedback_rate(self, rate: float) -> float:
        """Set the feedback rate of the whole machine [Hz]."""
        self._require_connection()
        self.machine.advance_to(self.now_ns())
        self.machine.set_rate(rate)
        return self.machine.rate

    def push(self, effort: float) -> None:
        """Hold an external effort on the joint [N m or N]."""
        self.machine.hold_push(self._index, effort, self.now_ns())

    def close(self) -> None:
        """Release the module."""
        self._connected = False

    def _require_connection(self) -> None:
        if not self._connected:
            raise ActuatorError("not_connected", "emulated module is not connected; call connect() first")


class DrivePort(JointPort):
    """Drive of joint ``index``, which has a motor."""

    def __init__(self, machine: EmulatedMachine, index: int, clock: Clock) -> None:
        super().__init__(machine, index, clock)
        self._motor = machine.coordinates.driven.index(index)
        self._limits = HardwareLimits(
            effort=machine.plant.effort_limits[self._motor], joint=machine.coordinates.joints[index]
        )
        self._gains = DEFAULT_GAINS[TORQUE_LOOP]
        self._volts = machine.coordinates.volts
        self._supply = machine.constants[self._motor].supply_voltage if self._volts else 1.0
        self._loop = Strategy.DIRECT_PWM if self._volts else TORQUE_LOOP
        self._strategy = Strategy.OFF

    @property
    def strategy(self) -> Strategy:
        """Strategy in force."""
        return self._strategy

    def connect(self) -> ActuatorInfo:
        """Return the properties of the emulated drive."""
        return replace(
            super().connect(),
            strategy=self._strategy,
            command_lifetime=self.machine.drives[self._motor].lifetime,
            limits=self._limits,
            gains=self._gains,
            drivetrain=asdict(self.machine.hardware),
        )

    def write(self, command: Command) -> Applied:
        """Send a torque or duty, which arrives after the transport delay."""
        self._require_connection()
        if ActuatorFault.SEND_FAILED in self._faults:
            raise ActuatorError("send_failed", "command could not be sent: the network refuses it")
        limited, changed = self._checked(command, self._strategy)
        now = self.now_ns()
        self.machine.deliver(self._motor, limited.pwm if self._volts else limited.effort, now)
        return Applied(limited, self._strategy, changed, now)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Switch on with a first torque, or off."""
        self._require_reach("strategy")
        if strategy not in {Strategy.OFF, self._loop}:
            takes = "duty" if self._volts else "the loop of torque"
            raise ActuatorError("strategy", f"strategy is {strategy.name}; expected OFF or {self._loop.name}, {takes}")
        limited = None if command is None else self._checked(command, strategy)[0]
        now = self.now_ns()
        self.machine.switch(self._motor, now, on=strategy is not Strategy.OFF)
        self._strategy = strategy
        if limited is not None and strategy is not Strategy.OFF:
            self.machine.deliver(self._motor, limited.pwm if self._volts else limited.effort, now)
        return self._strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Store gains; the current loop uses none."""
        self._require_reach("gains")
        self._gains = gains
        return self._gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Set the limits; the effort limit cannot exceed the drive's own."""
        self._require_reach("limits")
        self._limits = limits
        # A duty counts from zero, not from the dead band.
        wanted = limits.effort / (self.machine.plant.gains[self._motor] * self._supply)
        self.machine.drives[self._motor].limit = min(self.machine.largest[self._motor], wanted)
        return self._limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Set the command lifetime [s]."""
        self._require_reach("command_lifetime")
        self.machine.set_lifetime(self._motor, lifetime)
        return self.machine.drives[self._motor].lifetime

    def stop(self) -> None:
        """Switch off; if commands are lost, the command lifetime ends the torque."""
        if not self._connected:
            return
        self._strategy = Strategy.OFF
        if self._faults & {ActuatorFault.COMMANDS_LOST, ActuatorFault.SEND_FAILED}:
            raise ActuatorError(
                "stop_unacknowledged", "drive did not confirm that it is off; the command lifetime ends its torque"
            )
        self.machine.switch(self._motor, self.now_ns(), on=False)

    def close(self) -> None:
        """Stop and release."""
        try:
            self.stop()
        finally:
            super().close()

    @property
    def _faults(self) -> set[ActuatorFault]:
        return self.machine.faults[self._index]

    def _checked(self, command: Command, strategy: Strategy) -> tuple[Command, bool]:
        limited, changed = check_command(command, strategy, self._limits)
        if not (math.isnan(limited.position) and math.isnan(limited.velocity)):
            raise ActuatorError("strategy", "drive got a position or a velocity; expected effort alone")
        return limited, changed

    def _require_reach(self, what: str) -> None:
        self._require_connection()
        if self._faults & {ActuatorFault.COMMANDS_LOST, ActuatorFault.SEND_FAILED}:
            raise ActuatorError("no_acknowledgement", f"drive did not acknowledge {what}")


def machine_ports(machine: EmulatedMachine, clock: Clock) -> tuple[JointPort, ...]:
    """Return one port per joint, in the order of the model: a drive where there is a motor."""
    driven = machine.coordinates.driven
    return tuple(
        (DrivePort if index in driven else JointPort)(machine, index, clock)
        for index in range(len(machine.coordinates.joints))
    )
