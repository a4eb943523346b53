"""Emulated X5-9 on its own clock, independent of hosts, sockets and wall time.

Only ``advance_to`` advances time, and emulators with the same seed and sequence of calls give identical feedback, bit
by bit.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pendulum_hw_bridge.emulation import kernel
from pendulum_hw_bridge.emulation.faults import ActuatorFault, distort
from pendulum_hw_bridge.emulation.firmware import gain_rows
from pendulum_hw_bridge.emulation.parameters import EmulatorParameters
from pendulum_hw_bridge.emulation.sensing import measure
from pendulum_hw_bridge.port.actuator import (
    NO_SETPOINT,
    Command,
    CommandLock,
    Feedback,
    HardwareLimits,
    MStopAction,
    Strategy,
)
from pendulum_hw_bridge.port.command_check import check_lifetime
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet, PidGains
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.dynamics.series_elastic import spring_deflection
from pendulum_msgs_py.errors import ParameterError

__all__ = ["EmulatedX5", "HandTorque", "LinkState"]

HandTorque = Callable[[float, float, float], float]
"""Torque of a hand on the link [N m] as a function of time [s], position [rad] and velocity [rad/s]."""

_HAND_STEPS = 4
_FAULT_VOLTAGE = {ActuatorFault.VOLTAGE_LOW: 18.0, ActuatorFault.VOLTAGE_HIGH: 52.0}
_STUCK = {ActuatorFault.PWM_STUCK, ActuatorFault.PWM_RUNAWAY}
_STUCK_PWM = 0.05
_NO_GAINS = GainSet(3, PidGains(), PidGains(), PidGains())
_SLOW_FEEDBACK = 10
_LATE_NS = 80_000_000
_OTHER_SENDER = -1
_OPEN_CIRCUIT = 1e9


class LinkState(NamedTuple):
    """True state of link and motor.

    Attributes:
        time_ns: Actuator time [ns].
        position: Link angle [rad].
        velocity: [rad/s].
        motor_position: Motor angle at the output side [rad].
        motor_velocity: [rad/s].
        spring_torque: Torque on the link [N m].
        motor_torque: Electromagnetic torque at the output side [N m].
        pwm: Duty on the motor [-].
        winding_temperature: [degC].
    """

    time_ns: int
    position: float
    velocity: float
    motor_position: float
    motor_velocity: float
    spring_torque: float
    motor_torque: float
    pwm: float
    winding_temperature: float


class EmulatedX5:
    """One emulated actuator with its link.

    Args:
        parameters: Constants.
        seed: Seed of sensor noise and timing jitter.
        position: Link angle at the start, at rest [rad].
        start_ns: Actuator time at power-up [ns].
    """

    def __init__(
        self, parameters: EmulatorParameters, *, seed: int = 0, position: float = 0.0, start_ns: int = 0
    ) -> None:
        self.parameters = parameters
        self.strategy = Strategy.OFF
        self.gains: GainSet = DEFAULT_GAINS[3]
        self.limits = HardwareLimits(effort=parameters.plant.effort_limit)
        self.command_lifetime = 0.25
        self.feedback_rate = parameters.timing.feedback_rate
        self.push = 0.0
        self.hand: HandTorque | None = None
        self.faults: set[ActuatorFault] = set()
        self.lifetime_expiries = 0
        self.last_command_ns: int | None = None
        self.trace: Callable[[LinkState], None] | None = None
        self._random = np.random.Generator(np.random.Philox(key=seed))
        self._start_ns = start_ns
        self._steps = 0
        self._actuator = actuator = kernel.Actuator()
        self._state, self._memory, self._setpoints = actuator.state, actuator.memory, actuator.setpoints
        actuator.gains[:] = gain_rows(self.gains)
        self._setpoints[:] = NO_SETPOINT
        self._expires_ns: int | None = None
        self._lock_holder: int | None = None
        self._inbox: list[tuple[int, int, int, Command]] = []
        self._deliveries = 0
        self._outbox: deque[tuple[int, Feedback]] = deque()
        self._sequence = 0
        self._fault_sequence = 0
        self._samples = 0
        self._clock_offset_ns = 0
        self._frozen: Feedback | None = None
        self._last: Feedback | None = None
        self._stuck_pwm = 0.0
        self._next_sample_ns = self._raster_ns = start_ns
        self.place(position)
        self._refresh()

    @property
    def now_ns(self) -> int:
        """Actuator time, in steps of 0.25 ms [ns]."""
        return self._start_ns + self._steps * kernel.STEP_NS

    @property
    def link(self) -> LinkState:
        """True state, not available from sensors."""
        state, drive = self._state.tolist(), self.parameters.drivetrain
        return LinkState(
            time_ns=self.now_ns,
            position=state[2],
            velocity=state[3],
            motor_position=state[0],
            motor_velocity=state[1],
            spring_torque=state[10],
            motor_torque=drive.torque_constant * drive.gear_ratio * state[9],
            pwm=state[8],
            winding_temperature=state[5],
        )

    def place(self, position: float, temperature: float | None = None) -> None:
        """Put the link at rest at a position [rad], its weight on the spring, all parts at a temperature [degC]."""
        if not math.isfinite(position):
            raise ParameterError(f"initial position is {position} rad; expected a finite number")
        drive = self.parameters.drivetrain
        weight = 0.0 if self.parameters.flat else self.parameters.plant.gravity * math.sin(position)
        start = drive.winding_temperature if temperature is None else temperature
        self._state[:] = 0.0
        self._state[0] = position + spring_deflection(weight, drive.stiffness, drive.stiffness_hardening)
        self._state[2] = position
        self._state[5] = self._state[6] = self._state[7] = start

    def configure(
        self,
        *,
        strategy: Strategy | None = None,
        gains: GainSet | None = None,
        limits: HardwareLimits | None = None,
        command_lifetime: float | None = None,
        feedback_rate: float | None = None,
    ) -> None:
        """Change settings of the firmware, as an acknowledged command does; a new strategy resets all loops."""
        if strategy is not None:
            self.strategy = Strategy(strategy)
            # Setpoints in transit were sent for the previous strategy.
            self._inbox.clear()
            self._end_command()
        if gains is not None:
            self.gains = gains
            self._actuator.gains[:] = gain_rows(gains)
        if limits is not None:
            self.limits = limits
        if command_lifetime is not None:
            self.command_lifetime = check_lifetime(command_lifetime)
        if feedback_rate is not None:
            if not (math.isfinite(feedback_rate) and 0.0 < feedback_rate <= 1000.0):
                raise ParameterError(f"feedback_rate is {feedback_rate} Hz; expected > 0 and <= 1000 Hz")
            if feedback_rate != self.feedback_rate:
                self._next_sample_ns = self.now_ns
                self._samples = 0
            self.feedback_rate = feedback_rate
        self._refresh()

    def inject(self, fault: ActuatorFault) -> None:
        """Start a fault now."""
        self.faults.add(ActuatorFault(fault))
        self._frozen = self._last
        self._fault_sequence = self._sequence
        if fault is ActuatorFault.MODULE_REBOOT:
            # Unsaved settings are lost: limits, gains, M-stop action. Lifetime and rate are stored in the host's
            # library, which sends them with each packet.
            self.configure(
                strategy=Strategy.OFF,
                gains=DEFAULT_GAINS[3],
                limits=HardwareLimits(effort=self.parameters.plant.effort_limit),
            )
            self._clock_offset_ns = -self.now_ns
            self._sequence = 0
        elif fault is ActuatorFault.STRATEGY_CHANGED:
            self.strategy = Strategy.PARALLEL_PWM if self.strategy is Strategy.DIRECT_PWM else Strategy.DIRECT_PWM
        elif fault is ActuatorFault.PWM_STUCK:
            self._stuck_pwm = float(self._state[8]) or _STUCK_PWM
        elif fault is ActuatorFault.PWM_RUNAWAY:
            self._stuck_pwm = math.copysign(1.0, float(self._state[8]))
        elif fault is ActuatorFault.GAINS_LOST:
            self._actuator.gains[:] = gain_rows(_NO_GAINS)
        self._refresh()

    def clear_faults(self) -> None:
        """End all faults; a module that rebooted or changed its strategy stays as it is."""
        self.faults.clear()
        self._frozen = None
        self._actuator.gains[:] = gain_rows(self.gains)
        self._refresh()

    def deliver(self, command: Command, arrival_ns: int, sender: int = 1) -> None:
        """Deliver a command at ``arrival_ns`` [ns], not before now; its lifetime locks other senders out."""
        self._deliveries += 1
        heapq.heappush(self._inbox, (max(arrival_ns, self.now_ns), self._deliveries, sender, command))

    @property
    def next_sample_ns(self) -> int:
        """Time of the next measurement [ns]."""
        return self._next_sample_ns

    def feedback(self, until_ns: int) -> Feedback | None:
        """Return the newest record that has arrived by a time [ns], and drop older ones."""
        newest = None
        while self._outbox and self._outbox[0][0] <= until_ns:
            newest = self._outbox.popleft()[1]
        return newest

    @property
    def next_delivery_ns(self) -> int | None:
        """Arrival of the next record in transit [ns], or None."""
        return self._outbox[0][0] if self._outbox else None

    def advance_to(self, time_ns: int) -> None:
        """Let time pass, with all events, up to ``time_ns`` rounded down to 0.25 ms [ns]."""
        while True:
            target = time_ns
            if self._inbox:
                target = min(target, self._inbox[0][0])
            target = min(target, self._next_sample_ns)
            if self._expires_ns is not None:
                target = min(target, self._expires_ns)
            self._integrate(target)
            if target >= time_ns and not self._due(time_ns):
                return
            self._events(target)

    def _due(self, time_ns: int) -> bool:
        return (
            (bool(self._inbox) and self._inbox[0][0] <= time_ns)
            or self._next_sample_ns <= time_ns
            or (self._expires_ns is not None and self._expires_ns <= time_ns)
        )

    def _integrate(self, time_ns: int) -> None:
        steps = (time_ns - self._start_ns) // kernel.STEP_NS - self._steps
        while steps > 0:
            now = min(steps, _HAND_STEPS) if self.hand is not None or self.trace is not None else steps
            torque = self.push
            if self.hand is not None:
                seconds = self._steps * kernel.STEP
                torque += self.hand(seconds, float(self._state[2]), float(self._state[3]))
            if self.faults & _STUCK and self.strategy is not Strategy.OFF:
                asked = self._setpoints.copy()
                self._setpoints[:] = (math.nan, math.nan, self._stuck_pwm)
                self._actuator.advance(int(Strategy.DIRECT_PWM), torque, self._steps, now)
                self._setpoints[:] = asked
            else:
                self._actuator.advance(int(self.strategy), torque, self._steps, now)
            self._steps += now
            steps -= now
            if self.trace is not None:
                self.trace(self.link)

    def _events(self, time_ns: int) -> None:
        while self._inbox and self._inbox[0][0] <= time_ns:
            arrival, _, sender, command = heapq.heappop(self._inbox)
            self._receive(command, arrival, sender)
        if self._expires_ns is not None and self._expires_ns <= time_ns:
            self.lifetime_expiries += 1
            self._end_command()
        if self._next_sample_ns <= time_ns:
            self._sample()
            self._samples += 1
            timing = self.parameters.timing
            period = 1.0 / self.feedback_rate
            jitter = min(timing.feedback_jitter, 0.1 * period) * float(self._random.standard_normal())
            jitter = min(max(jitter, -0.3 * period), 0.3 * period)
            nominal = round(NANOSECONDS * period)
            # Jitter around a regular raster: a late record does not delay later ones.
            self._raster_ns = (self._raster_ns if self._samples > 1 else time_ns) + nominal
            self._next_sample_ns = max(self._raster_ns + round(NANOSECONDS * jitter), time_ns + kernel.STEP_NS)

    def _receive(self, command: Command, time_ns: int, sender: int) -> None:
        if ActuatorFault.COMMANDS_LOST in self.faults:
            return
        if ActuatorFault.LOCKED_BY_OTHER in self.faults and sender != _OTHER_SENDER:
            return
        if self._expires_ns is not None and self._lock_holder not in {None, sender}:
            return
        # The strategy in force decides what the field means, whatever the sender meant.
        self._setpoints[:] = (command.position, command.velocity, command.effort_field)
        self.last_command_ns = time_ns
        self._expires_ns = time_ns + round(self.command_lifetime * NANOSECONDS)
        self._lock_holder = sender

    def _end_command(self) -> None:
        self._setpoints[:] = NO_SETPOINT
        self._expires_ns = None
        self._lock_holder = None
        self._memory[:] = 0.0

    @property
    def voltage(self) -> float:
        """Present supply voltage [V]."""
        for fault, voltage in _FAULT_VOLTAGE.items():
            if fault in self.faults:
                return voltage
        return self.parameters.drivetrain.supply_voltage

    def _refresh(self) -> None:
        fault = ActuatorFault
        stopped = fault.M_STOP in self.faults and self.limits.m_stop is not MStopAction.DISABLED
        hot = fault.OVER_TEMPERATURE_MOTOR in self.faults or fault.OVER_TEMPERATURE_BOARD in self.faults
        self._actuator.constants[:] = self.parameters.constants(self.limits, self.voltage, not (stopped or hot))
        if fault.WINDING_OPEN in self.faults:
            self._actuator.constants[kernel.CONSTANTS.index("winding_resistance")] = _OPEN_CIRCUIT

    def _sample(self) -> None:
        self._sequence += 1
        fault = ActuatorFault
        timing = self.parameters.timing
        delay = timing.feedback_delay + timing.delay_jitter * float(self._random.standard_normal())
        arrival = self.now_ns + max(0, round(NANOSECONDS * delay))
        record = measure(
            self._state, self._setpoints, self.parameters, self.limits, self.voltage, self._random
        )._replace(
            stamp_ns=arrival,
            hardware_ns=self.now_ns + self._clock_offset_ns,
            sequence=self._sequence,
            m_stop=fault.M_STOP in self.faults,
            lock=self._lock(),
        )
        if fault.FEEDBACK_LOST in self.faults:
            return
        if fault.FEEDBACK_SLOW in self.faults and (self._sequence - self._fault_sequence) % _SLOW_FEEDBACK:
            return
        if fault.FEEDBACK_FROZEN in self.faults and self._frozen is not None:
            record = self._frozen._replace(stamp_ns=arrival)
        elif fault.FEEDBACK_LATE in self.faults:
            record = record._replace(stamp_ns=arrival + _LATE_NS)
        else:
            record = distort(record, self.faults, self._frozen)
            self._last = record
        self._outbox.append((record.stamp_ns, record))

    def _lock(self) -> CommandLock:
        if ActuatorFault.LOCKED_BY_OTHER in self.faults or self._lock_holder == _OTHER_SENDER:
            return CommandLock.LOCKED_BY_OTHER
        return CommandLock.UNLOCKED if self._lock_holder is None else CommandLock.LOCKED_BY_SENDER
