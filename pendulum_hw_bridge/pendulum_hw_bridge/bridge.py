"""The bridge between the rules of a plant and an actuator: one cycle at a time, without ROS.

A cycle is ``observe`` (feedback in, checks), then ``act`` (the supervisor's decision carried out). Every way out of
driving goes through ``release``: effort zero, then strategy off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pendulum_hw_bridge.actuator import (
    ActuatorError,
    ActuatorInfo,
    ActuatorPort,
    Applied,
    Command,
    Feedback,
    HardwareLimits,
    Strategy,
    check_lifetime,
)
from pendulum_hw_bridge.effort_mapping import EffortMapping
from pendulum_hw_bridge.gains import GainSet
from pendulum_hw_bridge.safety import SafetyMonitor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample

__all__ = ["TRAJECTORY_STRATEGY", "Bridge", "BridgeSettings", "Outcome"]

TRAJECTORY_STRATEGY = Strategy.PARALLEL_PWM
"""Strategy under which trajectories are followed (3, as in the thesis)."""
_PREPARED_NS = NANOSECONDS
_READBACK_TOLERANCE = 1e-3


@dataclass(frozen=True)
class BridgeSettings:
    """What the bridge sets in the actuator when it connects.

    Attributes:
        feedback_rate: [Hz].
        command_lifetime: [s]; a killed bridge drives for this long and no longer.
        limits: Limits of the firmware.
        gains: Gains of the loops; None keeps those of the module.
        joint_offset: Joint angle where the actuator reads zero [rad].
        joint_sign: 1, or -1 for an actuator mounted the other way round.
        effort_tare: Torque that the sensor shows at the joint when nothing pulls [N m].
    """

    feedback_rate: float = 100.0
    command_lifetime: float = 0.05
    limits: HardwareLimits = field(default_factory=HardwareLimits)
    gains: GainSet | None = None
    joint_offset: float = 0.0
    joint_sign: int = 1
    effort_tare: float = 0.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a cycle did.

    Attributes:
        drive: The supervisor's decision.
        effort: Torque that the setpoints stand for, after all limits [N m].
        applied: What was sent, or None where nothing was.
        fault: Name of the fault that ended driving in this cycle, or an empty string.
    """

    drive: Drive
    effort: float
    applied: Applied | None = None
    fault: str = ""


class Bridge:
    """Carries out a supervisor's decisions on an actuator.

    Args:
        port: The actuator.
        supervisor: Rules and state of the plant.
        mapping: Torque to setpoint.
        monitor: Checks of the feedback.
        settings: What to set in the actuator.
    """

    def __init__(
        self,
        port: ActuatorPort,
        supervisor: PlantSupervisor,
        mapping: EffortMapping,
        monitor: SafetyMonitor,
        settings: BridgeSettings,
    ) -> None:
        self.port = port
        self.supervisor = supervisor
        self.mapping = mapping
        self.monitor = monitor
        self.settings = settings
        self.info: ActuatorInfo | None = None
        self.feedback: Feedback | None = None
        self.sample: JointSample | None = None
        self.faults: dict[str, int] = {}
        self.last_fault = ""
        self._strategy = Strategy.OFF
        self._prepared_until_ns = 0

    # --- life -----------------------------------------------------------------------------------------------

    def connect(self) -> ActuatorInfo:
        """Connect, set everything, and check that it reads back.

        Raises:
            ActuatorError: The actuator is not there, or does not take a setting.
        """
        settings = self.settings
        self.port.connect()
        lifetime = self.port.set_command_lifetime(check_lifetime(settings.command_lifetime))
        self._expect("command lifetime", lifetime, settings.command_lifetime, "s")
        rate = self.port.set_feedback_rate(settings.feedback_rate)
        self._expect("feedback rate", rate, settings.feedback_rate, "Hz")
        limits = self.port.set_limits(settings.limits)
        self._expect("effort limit", limits.effort, settings.limits.effort, "N m")
        self._expect("velocity limit", limits.velocity, settings.limits.velocity, "rad/s")
        if settings.gains is not None:
            gains = self.port.set_gains(settings.gains)
            self._expect("position kp", gains.position.kp, settings.gains.position.kp, "")
        self._confirm(self.port.set_strategy(Strategy.OFF), Strategy.OFF)
        self._strategy = Strategy.OFF
        self.info = self.port.connect()
        return self.info

    def prepare(self) -> str:
        """Set the strategy for effort at zero torque before arming; return why it failed, or an empty string.

        If nobody arms within a second, the strategy goes off again.
        """
        if self.feedback is None:
            return "no feedback yet"
        silence = self.monitor.silence(self.port.now_ns())
        if silence is not None:
            return silence.message
        try:
            self._switch(self.mapping.strategy, self.mapping.command(0.0, self._at_rest(self.feedback)))
        except ActuatorError as error:
            self.release()
            return str(error)
        self._prepared_until_ns = self.port.now_ns() + _PREPARED_NS
        return ""

    def release(self) -> None:
        """Effort zero, then strategy off; never raises."""
        try:
            self.port.stop()
        # Whatever happens here, the command lifetime still ends all torque.
        except Exception as error:  # noqa: BLE001
            self._note(getattr(error, "fault", "exception"))
        self._strategy = Strategy.OFF
        self.monitor.stopped()

    def close(self) -> None:
        """Release and let go of the actuator; never raises."""
        self.supervisor.disarm(self.port.now_ns(), "bridge closes")
        self.release()
        try:
            self.port.close()
        except Exception as error:  # noqa: BLE001
            self._note(getattr(error, "fault", "exception"))

    # --- cycle ----------------------------------------------------------------------------------------------

    def observe(self, timeout: float) -> Feedback | None:
        """Wait for the next new feedback and check it; on a fault the drive is released before this returns.

        Args:
            timeout: Longest time to wait [s].

        Returns:
            The new record, or None where none came.
        """
        try:
            feedback = self.port.read(timeout)
        except ActuatorError as error:
            self.fail(error.fault, str(error))
            return None
        now = self.port.now_ns()
        if feedback is None or not self.monitor.is_new(feedback):
            silence = self.monitor.silence(now)
            if silence is not None and (self._driving or self.supervisor.mode.armed):
                self.fail(silence.name, silence.message)
            return None
        fault = self.monitor.check(feedback)
        self.feedback = feedback
        self.sample = self._to_sample(feedback)
        if fault is not None and (self._driving or self.supervisor.mode.armed):
            self.fail(fault.name, fault.message)
        return feedback

    def act(self) -> Outcome:
        """Ask the supervisor and do what it says, now."""
        now = self.port.now_ns()
        was_armed = self.supervisor.mode.armed
        return self.carry_out(self.supervisor.decide(now, self.sample), was_armed=was_armed)

    def carry_out(self, drive: Drive, *, was_armed: bool = False) -> Outcome:
        """Do what a decision says.

        Args:
            drive: The supervisor's decision.
            was_armed: Whether the plant was armed before it, to count faults of the supervisor.
        """
        push = getattr(self.port, "push", None)
        if push is not None:
            push(drive.push)
        if drive.kind is DriveKind.OFF or self.feedback is None:
            fault = ""
            if was_armed and self.supervisor.mode.value == "fault":
                fault = self._note("supervisor")
            if self._driving and (self.port.now_ns() > self._prepared_until_ns or fault or was_armed):
                self.release()
            return Outcome(drive, 0.0, fault=fault)
        self._prepared_until_ns = 0
        feedback = self.feedback
        if drive.kind is DriveKind.EFFORT:
            strategy, command = self.mapping.strategy, self._to_actuator(drive, feedback)
        else:
            strategy, command = TRAJECTORY_STRATEGY, self._to_actuator(drive, feedback)
        try:
            applied = (
                self._switch(strategy, command) if strategy is not self._strategy else self._send(command)
            )
        except ActuatorError as error:
            self.fail(error.fault, str(error))
            return Outcome(Drive(DriveKind.OFF, push=drive.push), 0.0, fault=error.fault)
        effort = self.settings.joint_sign * self.mapping.effort_of(applied.command, feedback)
        return Outcome(drive, effort, applied)

    def fail(self, name: str, message: str) -> None:
        """Release the drive at once and put the plant into the fault state.

        Args:
            name: Fault, as in :data:`pendulum_hw_bridge.safety.FAULTS`.
            message: What was seen.
        """
        armed = self.supervisor.mode.armed
        if armed or self._driving:
            self._note(name)
            self.last_fault = name
            self.release()
        if armed:
            self.supervisor.fault(f"{name}: {message}", self.port.now_ns())

    # --- inside ---------------------------------------------------------------------------------------------

    @property
    def _driving(self) -> bool:
        return self._strategy is not Strategy.OFF

    def _to_sample(self, feedback: Feedback) -> JointSample:
        sign = self.settings.joint_sign
        return JointSample(
            feedback.stamp_ns,
            sign * feedback.position + self.settings.joint_offset,
            sign * feedback.velocity,
            sign * feedback.effort - self.settings.effort_tare,
        )

    def _to_actuator(self, drive: Drive, feedback: Feedback) -> Command:
        sign = self.settings.joint_sign
        if drive.kind is DriveKind.EFFORT:
            return self.mapping.command(sign * drive.effort, feedback)
        offset = self.mapping.handover_offset(sign * drive.effort)
        position = sign * (drive.position - self.settings.joint_offset) + offset
        return Command(position=position, velocity=sign * drive.velocity)

    def _at_rest(self, feedback: Feedback) -> Feedback:
        return feedback._replace(motor_velocity=0.0) if math.isnan(feedback.motor_velocity) else feedback

    def _switch(self, strategy: Strategy, command: Command) -> Applied:
        now = self.port.now_ns()
        self._strategy = strategy
        self._confirm(self.port.set_strategy(strategy, command), strategy)
        self.monitor.told(command, strategy, now)
        return Applied(command, strategy, limited=False, sent_ns=now)

    def _send(self, command: Command) -> Applied:
        applied = self.port.write(command)
        self.monitor.told(applied.command, applied.strategy, applied.sent_ns)
        return applied

    def _confirm(self, reads: Strategy, wanted: Strategy) -> None:
        if reads is not wanted:
            raise ActuatorError(
                "strategy",
                f"strategy reads back as {reads.name} ({int(reads)}); expected {wanted.name} ({int(wanted)})",
            )

    def _expect(self, what: str, reads: float, wanted: float, unit: str) -> None:
        if not abs(reads - wanted) <= _READBACK_TOLERANCE * max(1.0, abs(wanted)):
            raise ActuatorError(
                "no_acknowledgement",
                f"{what} reads back as {reads:g} {unit}; expected {wanted:g} {unit}".rstrip(),
            )

    def _note(self, fault: str) -> str:
        self.faults[fault] = self.faults.get(fault, 0) + 1
        return fault
