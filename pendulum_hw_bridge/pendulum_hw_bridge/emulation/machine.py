"""Emulated machine of several joints on its own clock: a mechanism with drives and encoders.

It uses the simulator's equations and drives of its own. Only ``advance_to`` advances time, and machines with the same
seed and sequence of calls give the same feedback.
"""

from __future__ import annotations

import heapq
import math
from collections import deque

import numpy as np

from pendulum_hw_bridge.emulation.faults import ActuatorFault, distort
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import CommandLock, Feedback
from pendulum_hw_bridge.port.command_check import check_lifetime
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.dynamics.joint_steps import LAG, advance_joints, joint_functions
from pendulum_msgs_py.dynamics.series_elastic import winding_resistance_at
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay, pack_joints

__all__ = ["EmulatedMachine"]

_STEP_NS = 1_000_000
"""Longest integration step [ns]."""
_CATCH_UP_NS = NANOSECONDS
"""Longest time to catch up with at once [ns]: 1 s costs some 30 ms, a minute would block the actuator's thread for 2 s.
"""
_KEPT = 1000
"""Records of a joint that wait to be fetched; older ones are lost, as on a network."""


class _Drive:
    """State of one drive: off, or with a setpoint in force until its lifetime ends, a torque or of a motor a duty."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.on = False
        self.accepted = math.nan
        self.effort = math.nan
        self.lifetime = 0.1
        self.expires_ns: int | None = None
        self.expiries = 0
        self.temperature = 0.0

    def end(self) -> None:
        self.accepted = self.effort = math.nan
        self.expires_ns = None

    @property
    def commanded(self) -> float:
        return self.effort if self.on and math.isfinite(self.effort) else 0.0


class EmulatedMachine:
    """A mechanism with drives and encoders.

    Args:
        plant: Mechanism; joints with an actuator have a drive.
        hardware: Constants of drives and encoders.
        seed: Seed of sensor noise.
        position: n positions at the start, at rest; None for 0 [rad or m].
        start_ns: Time at the start [ns].
        rate: Feedback rate [Hz].

    Raises:
        ParameterError: The start does not fit the joints or their end stops, or the drives have different delays.
    """

    def __init__(
        self,
        plant: PlantParameters,
        hardware: QuasiDirectDrive | None = None,
        *,
        seed: int = 0,
        position: Vector | None = None,
        start_ns: int = 0,
        rate: float = 500.0,
    ) -> None:
        self.plant = plant
        self.hardware = own = hardware or QuasiDirectDrive()
        self.coordinates = plant.coordinates
        joints = self.coordinates.joints
        still = (0.0,) * len(joints)
        self.push = still
        self.faults: list[set[ActuatorFault]] = [set() for _ in joints]
        # The same delay for all drives: torques act in the order of arrival.
        self._delay = common_delay(plant)
        self.constants = tuple(
            own.constants(joints[index], actuator.effort_limit, actuator.motor)
            for index, actuator in zip(self.coordinates.driven, plant.actuators, strict=True)
        )
        self.largest = tuple(
            actuator.command_limit / (constants.supply_voltage if actuator.motor is not None else 1.0)
            for actuator, constants in zip(plant.actuators, self.constants, strict=True)
        )
        """Largest setpoint of each drive [N m or N, of a motor -]."""
        self.drives = tuple(map(_Drive, self.largest))
        for drive in self.drives:
            drive.temperature = own.ambient
        self._behind = plant.torque_plant
        self._position = self.plant.check_start(still if position is None else position)
        self._velocity = self._effort = still
        table = pack_joints(self._behind)
        loop = 0.0 if self.coordinates.volts else own.current_loop
        lags = (max(lag, loop if index in self.coordinates.driven else 0.0) for index, lag in enumerate(table[LAG]))
        self._table = (*table[:LAG], tuple(lags))
        self._along, self._put, self._lag = joint_functions(len(joints))
        self._steps = [own.step(joint, driven=index in self.coordinates.driven) for index, joint in enumerate(joints)]
        self._noise = [own.velocity_noise * own.scale(joint) for joint in joints]
        self._random = np.random.Generator(np.random.Philox(key=seed))
        self._now_ns = self._next_sample_ns = start_ns
        self._period_ns = round(NANOSECONDS / rate)
        self._inbox: list[tuple[int, int, int, float]] = []
        self._acts: deque[tuple[int, int, float]] = deque()
        self._deliveries = 0
        self._stood_still_ns = 0
        self._sequence = 0
        self._outboxes: tuple[deque[Feedback], ...] = tuple(deque(maxlen=_KEPT) for _ in joints)

    @property
    def state(self) -> tuple[Vector, Vector, Vector]:
        """True positions, velocities and drive efforts (0 at passive joints) at the last event."""
        return self._position, self._velocity, self.coordinates.spread(self._net())

    @property
    def rate(self) -> float:
        """Feedback rate [Hz]."""
        return NANOSECONDS / self._period_ns

    @property
    def stood_still(self) -> float:
        """Time for which it was not advanced, and stood still instead of catching up [s]."""
        return self._stood_still_ns / NANOSECONDS

    def set_rate(self, rate: float) -> None:
        """Set the feedback rate from now on [Hz]."""
        if not (math.isfinite(rate) and 0.0 < rate <= 1000.0):
            raise ParameterError(f"feedback_rate is {rate} Hz; expected > 0 and <= 1000 Hz")
        period_ns = round(NANOSECONDS / rate)
        if period_ns != self._period_ns:
            self._period_ns = period_ns
            self._next_sample_ns = self._now_ns

    def switch(self, index: int, now_ns: int, *, on: bool) -> None:
        """Switch driven joint ``index`` on, without torque, or off; commands in transit are lost."""
        self.advance_to(now_ns, wholly=True)
        self._inbox = [item for item in self._inbox if item[2] != index]
        heapq.heapify(self._inbox)
        self.drives[index].on = on
        self._end(index)

    def set_lifetime(self, index: int, lifetime: float) -> None:
        """Set a drive's command lifetime after arrival [s]."""
        self.drives[index].lifetime = check_lifetime(lifetime)

    def deliver(self, index: int, effort: float, sent_ns: int) -> None:
        """Send a torque [N m or N], to a motor a duty [-], NaN for none, at ``sent_ns`` [ns].

        It acts after command and transport delay.
        """
        self._deliveries += 1
        arrival_ns = sent_ns + round(self.hardware.command_delay * NANOSECONDS)
        heapq.heappush(self._inbox, (arrival_ns, self._deliveries, index, effort))

    def hold_push(self, index: int, effort: float, now_ns: int) -> None:
        """Hold an external effort on a joint [N m or N]; NaN is none."""
        effort = effort if math.isfinite(effort) else 0.0
        if effort != self.push[index]:
            self.advance_to(now_ns, wholly=True)
            self.push = (*self.push[:index], effort, *self.push[index + 1 :])

    def feedback(self, index: int, until_ns: int) -> Feedback | None:
        """Return the newest record of a joint that has arrived by a time [ns], and drop older ones."""
        newest = None
        outbox = self._outboxes[index]
        while outbox and outbox[0].stamp_ns <= until_ns:
            newest = outbox.popleft()
        return newest

    def next_arrival_ns(self, index: int) -> int:
        """Return the expected arrival of a joint's next record [ns]."""
        outbox = self._outboxes[index]
        if outbox:
            return outbox[0].stamp_ns
        return self._next_sample_ns + round(self.hardware.feedback_delay * NANOSECONDS)

    def advance_to(self, time_ns: int, *, wholly: bool = False) -> None:
        """Process everything due by a time [ns], of a long time only the last second.

        ``wholly`` integrates to that very time, not only to the last event before it.
        """
        self._skip(time_ns - self._next_sample_ns - _CATCH_UP_NS)
        while True:
            due = self._next_sample_ns
            if self._inbox:
                due = min(due, self._inbox[0][0])
            if self._acts:
                due = min(due, self._acts[0][0])
            for drive in self.drives:
                if drive.expires_ns is not None:
                    due = min(due, drive.expires_ns)
            if due > time_ns:
                break
            self._flow(due)
            self._happen(due)
        if wholly:
            self._flow(time_ns)

    def _skip(self, late_ns: int) -> None:
        """Let time pass while the mechanism stands still [ns]; command lifetimes still expire."""
        if late_ns > 0:
            late_ns -= late_ns % self._period_ns
            self._now_ns += late_ns
            self._next_sample_ns += late_ns
            self._stood_still_ns += late_ns

    def _flow(self, time_ns: int) -> None:
        """Integrate up to a time, between events."""
        plant = self._behind
        forward, p = plant.mechanism.forward, self._packed()
        command = self.coordinates.spread(self._stall())
        while self._now_ns < time_ns:
            step_ns = min(_STEP_NS, time_ns - self._now_ns)
            h = step_ns / NANOSECONDS
            self._position, self._velocity = advance_joints(
                forward, self._along, self._put, self._lag, self._position, self._velocity, self._effort, command,
                self.push, h, p, self._table,
            )  # fmt: skip
            self._effort = self._lag(self._effort, command, h, self._table[LAG])
            self._warm(h)
            self._now_ns += step_ns

    def _warm(self, h: float) -> None:
        own = self.hardware
        for index, drive in enumerate(self.drives):
            current, resistance = self._electric(index)
            settled = own.ambient + own.thermal_resistance * resistance * current * current
            drive.temperature += (settled - drive.temperature) * h / own.thermal_time

    def _electric(self, index: int) -> tuple[float, float]:
        """Return current [A] and resistance [ohm] of a winding."""
        constants = self.constants[index]
        current = self._net()[index] / (constants.gear_ratio * constants.torque_constant)
        return current, winding_resistance_at(
            self.drives[index].temperature, constants.winding_resistance, constants.resistance_temperature_coefficient
        )

    def _stall(self) -> Vector:
        """Return the efforts of the drives at standstill [N m or N]."""
        commands = tuple(drive.commanded for drive in self.drives)
        if not self.coordinates.volts:
            return commands
        volts = (duty * own.supply_voltage for duty, own in zip(commands, self.constants, strict=True))
        return self.plant.stall_efforts(tuple(volts))

    def _net(self) -> Vector:
        """Return the efforts of the drives, of motors less their back EMF [N m or N]."""
        driven = tuple(self._effort[index] for index in self.coordinates.driven)
        if not self.coordinates.volts:
            return driven
        # An amplifier that is off is open: no current flows, so that its motor does not brake either.
        net = zip(driven, self.plant.motor_efforts(driven, self._velocity), self.drives, strict=True)
        return tuple(braked if drive.on else effort for effort, braked, drive in net)

    def _packed(self) -> Vector:
        """Return the parameters of the equation, with the back EMF of motors that are on."""
        packed, off = self._behind.packed, [index for index, drive in enumerate(self.drives) if not drive.on]
        if not (off and self.coordinates.volts):
            return packed
        p, first = list(packed), len(self.plant.values)
        for joint in (self.coordinates.driven[index] for index in off):
            p[first + joint] = self.plant.joints[joint].damping
        return tuple(p)

    def _end(self, index: int) -> None:
        """End a drive's torque, including delayed ones."""
        self.drives[index].end()
        self._acts = deque(item for item in self._acts if item[1] != index)

    def _happen(self, time_ns: int) -> None:
        # Expiry comes before an arrival at the same instant.
        for index, drive in enumerate(self.drives):
            if drive.expires_ns is not None and drive.expires_ns <= time_ns:
                drive.expiries += 1
                self._end(index)
        while self._inbox and self._inbox[0][0] <= time_ns:
            self._accept(*heapq.heappop(self._inbox))
        while self._acts and self._acts[0][0] <= time_ns:
            _, index, effort = self._acts.popleft()
            self.drives[index].effort = effort
        if self._next_sample_ns <= time_ns:
            self._sample()
            self._next_sample_ns += self._period_ns

    def _accept(self, arrival_ns: int, _: int, index: int, effort: float) -> None:
        drive, joint = self.drives[index], self.coordinates.driven[index]
        if not drive.on or ActuatorFault.COMMANDS_LOST in self.faults[joint]:
            return
        limit = drive.limit
        # NaN is no torque: clamping would turn it into full torque.
        drive.accepted = min(limit, max(-limit, effort)) if math.isfinite(effort) else math.nan
        drive.expires_ns = arrival_ns + round(drive.lifetime * NANOSECONDS)
        delay_ns = round(self._delay * NANOSECONDS)
        self._acts.append((arrival_ns + delay_ns, index, drive.accepted))

    def _sample(self) -> None:
        self._sequence += 1
        for index, faults in enumerate(self.faults):
            # Draw noise before anything may be lost: a fault of one joint must not change the noise of others.
            noise = self._random.standard_normal(2)
            if ActuatorFault.FEEDBACK_LOST not in faults:
                record = self._measure(index, float(noise[0]), float(noise[1]))
                self._outboxes[index].append(distort(record, faults, None))

    def _measure(self, index: int, of_velocity: float, of_effort: float) -> Feedback:
        own, step = self.hardware, self._steps[index]
        position = step * round(self._position[index] / step)
        velocity = self._velocity[index] + self._noise[index] * of_velocity
        record = Feedback(
            stamp_ns=self._now_ns + round(own.feedback_delay * NANOSECONDS),
            hardware_ns=self._now_ns,
            sequence=self._sequence,
            position=position,
            velocity=velocity,
            effort=0.0,
            position_command=math.nan,
            velocity_command=math.nan,
            effort_command=math.nan,
            pwm_command=math.nan,
            motor_current=0.0,
            winding_current=0.0,
            motor_position=position,
            motor_velocity=velocity,
            deflection=0.0,
            deflection_velocity=0.0,
            voltage=own.supply_voltage,
            winding_temperature=own.ambient,
            housing_temperature=own.ambient,
            motor_sensor_temperature=own.ambient,
            board_temperature=own.ambient,
            processor_temperature=own.ambient,
            m_stop=ActuatorFault.M_STOP in self.faults[index],
        )
        if index not in self.coordinates.driven:
            return record
        motor = self.coordinates.driven.index(index)
        drive, constants = self.drives[motor], self.constants[motor]
        current, resistance = self._electric(motor)
        back_emf = constants.back_emf_constant * constants.gear_ratio * velocity
        # When off, the motor's bridge is open: no duty, and no current at any speed.
        supply, setpoint, scale = own.supply_voltage, drive.accepted, drive.limit
        duty = (resistance * current + back_emf) / supply
        if self.coordinates.volts:
            supply, setpoint, scale = constants.supply_voltage, math.nan, self.plant.effort_limits[motor]
            duty = 0.0 if math.isnan(drive.accepted) else drive.accepted
        duty = duty if drive.on else math.nan
        return record._replace(
            effort=self._net()[motor] + own.effort_noise * scale * of_effort,
            effort_command=setpoint,
            voltage=supply,
            pwm_command=duty,
            motor_current=duty * current if drive.on else 0.0,
            winding_current=current,
            motor_position=position * constants.gear_ratio,
            motor_velocity=velocity * constants.gear_ratio,
            winding_temperature=drive.temperature,
            lock=CommandLock.UNLOCKED if drive.expires_ns is None else CommandLock.LOCKED_BY_SENDER,
        )
