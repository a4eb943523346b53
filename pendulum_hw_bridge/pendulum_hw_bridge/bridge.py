"""The bridge between the rules of a plant and an actuator: one cycle at a time, without ROS.

A cycle is ``observe`` (feedback in, checks), then ``act`` (the supervisor's decision carried out). Torque leaves in
one place, ``_send``, where it is bounded. Every way out of driving goes through ``release``: effort zero, then strategy
off.
"""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_hw_bridge.actuator import (
    ActuatorError,
    ActuatorInfo,
    ActuatorPort,
    Applied,
    Command,
    Feedback,
    Strategy,
)
from pendulum_hw_bridge.effort_mapping import EffortMapping
from pendulum_hw_bridge.fault_table import Fault
from pendulum_hw_bridge.motor_state import MotorWatch
from pendulum_hw_bridge.output_check import OutputCheck
from pendulum_hw_bridge.safety import SafetyMonitor
from pendulum_hw_bridge.settings import BridgeSettings, write_settings
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Mode, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.errors import PendulumError

__all__ = ["TRAJECTORY_STRATEGY", "Bridge", "Outcome"]

TRAJECTORY_STRATEGY = Strategy.PARALLEL_PWM
"""Strategy under which trajectories are followed (3, as in the thesis)."""
_PREPARED_NS = NANOSECONDS
_STOP_AGAIN_NS = NANOSECONDS // 10
"""Time between two requests to a module that did not confirm that it is off [ns]."""


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
        limits = monitor.limits
        self._motor = MotorWatch(mapping.drivetrain, limits.voltage_min, limits.voltage_max)
        self._output = monitor.output = OutputCheck(mapping, settings.limits.pwm)
        self._strategy = Strategy.OFF
        self._prepared_until_ns = 0
        self._turn_ns: int | None = None
        self._stop_again_ns: int | None = None
        self._handover = (0.0, 0.0)
        self._handover_left = 0.0
        self._effort = 0.0
        self._dither = mapping.dither

    # --- life -----------------------------------------------------------------------------------------------

    def connect(self) -> ActuatorInfo:
        """Connect, switch off, set everything, and check that it reads back.

        Raises:
            ActuatorError: The actuator is not there, or does not take a setting.
        """
        self.port.connect()
        self._confirm(self.port.set_strategy(Strategy.OFF), Strategy.OFF)
        self._strategy = Strategy.OFF
        self._write_settings()
        self.info = self.port.connect()
        return self.info

    def prepare(self) -> str:
        """Write all settings and the strategy for effort at zero torque before arming; return why not, or "".

        A module that was without power since the last time has lost its settings, and nobody would notice. If nobody
        arms within a second, the strategy goes off again.
        """
        # A drive that was disarmed in this very cycle is in force still: it ends before anything is written.
        if self._driving or self.stop_pending:
            self.release()
        if self.stop_pending:
            return "the module has not confirmed that it is off"
        refusal = self._present_fault()
        if refusal:
            return refusal
        try:
            self._write_settings()
            self._send(self.mapping.strategy, self.mapping.idle())
            # Writing takes its time on a network; what is seen afterwards decides.
            self._turn_ns = self.port.now_ns()
            if self.monitor.age(self._turn_ns) > self.monitor.period:
                self.observe(self.monitor.timeout)
        except PendulumError as error:
            if self._driving:
                self.release()
            return str(error)
        refusal = self._present_fault()
        if refusal or not self._driving:
            self.release()
            return refusal or f"released again: {self.last_fault}"
        self._prepared_until_ns = self.port.now_ns() + _PREPARED_NS
        return ""

    def release(self) -> None:
        """Effort zero, then strategy off; never raises. A module that does not confirm it is asked again."""
        self._strategy = Strategy.OFF
        # No torque is in force any more: the next hand-over must not begin with that of an earlier drive.
        self._effort = self._handover_left = 0.0
        self.monitor.stopped()
        try:
            self.port.stop()
        # Whatever happens here, the command lifetime still ends all torque.
        except Exception as error:  # noqa: BLE001
            self._stop_again_ns = self.port.now_ns() + _STOP_AGAIN_NS
            name = self._note(getattr(error, "fault", "exception"))
            self.last_fault = self.last_fault or name
            self.supervisor.fault(f"{name}: {error}", self.port.now_ns())
        else:
            self._stop_again_ns = None

    def insist(self) -> None:
        """Ask a module again that has not confirmed that it is off; never raises."""
        if self._stop_again_ns is not None and self.port.now_ns() >= self._stop_again_ns:
            self.release()

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
        if self._driving:
            self._turn()
        try:
            feedback = self.port.read(timeout)
        except ActuatorError as error:
            self.fail(error.fault, str(error))
            return None
        if self._driving:
            self._turn()
        if feedback is None or not self.monitor.is_new(feedback):
            silence = self.monitor.silence(self.port.now_ns())
            if silence is not None and self._awake:
                self.fail(silence.name, silence.message)
            return None
        fault = self.monitor.check(feedback)
        self._motor.update(feedback)
        self.feedback = feedback
        self.sample = self._to_sample(feedback)
        if fault is not None and self._awake:
            self.fail(fault.name, fault.message)
        elif fault is not None:
            self._understand(fault)
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
            push(drive.push[0])
        if self._driving and not self._turn():
            return Outcome(Drive(DriveKind.OFF, push=drive.push), 0.0, fault="host_stalled")
        if drive.kind is DriveKind.OFF or self.feedback is None:
            return self._rest(drive, was_armed)
        if not self._driving:
            # Released between preparing and arming: settings may be lost, and a fault passed unseen.
            why = f": {self.last_fault}" if self.last_fault else ""
            self.fail("not_prepared", f"drive was released before it was armed{why}; disarm, then arm again")
            return Outcome(Drive(DriveKind.OFF, push=drive.push), 0.0, fault="not_prepared")
        self._prepared_until_ns = 0
        try:
            applied = self._send(*self._setpoints(drive, self.feedback))
        except ActuatorError as error:
            self.fail(error.fault, str(error))
            return Outcome(Drive(DriveKind.OFF, push=drive.push), 0.0, fault=error.fault)
        motor, pwm = self._motor.state, self.feedback.pwm_command
        self._effort = self.mapping.effort_of(applied.command, motor, pwm)
        return Outcome(drive, self.settings.joint_sign * self._effort, applied)

    def fail(self, name: str, message: str) -> None:
        """Release the drive at once and put the plant into the fault state.

        Args:
            name: Fault, as in :data:`pendulum_hw_bridge.fault_table.FAULTS`.
            message: What was seen.
        """
        armed = self.supervisor.mode.armed
        if armed or self._driving:
            self._note(name)
            self.last_fault = name
            # Named first, so that a stop which fails on top of it does not hide it.
            if armed:
                self.supervisor.fault(f"{name}: {message}", self.port.now_ns())
            self.release()

    # --- inside ---------------------------------------------------------------------------------------------

    @property
    def stop_pending(self) -> bool:
        """Whether the module has not confirmed yet that it is off."""
        return self._stop_again_ns is not None

    @property
    def _driving(self) -> bool:
        return self._strategy is not Strategy.OFF

    @property
    def _awake(self) -> bool:
        return self._driving or self.supervisor.mode.armed

    def _understand(self, fault: Fault) -> None:
        """Take note of what a record shows of a module at rest, which may be why it went there."""
        if fault.name == "module_restarted":
            self._note(fault.name)
        elif fault.name == "feedback_late" and self.last_fault == "feedback_lost":
            # Until it came, nobody could tell late from lost.
            self.last_fault = self._note(fault.name)
            if self.supervisor.mode is Mode.FAULT and self.supervisor.reason.startswith("feedback_lost: "):
                self.supervisor.reason = f"{fault.name}: {fault.message}"

    def _turn(self) -> bool:
        """Take note that the bridge runs; while it drives, a pause as long as the watchdog's is a fault."""
        last, self._turn_ns = self._turn_ns, self.port.now_ns()
        pause = 0.0 if last is None else (self._turn_ns - last) / NANOSECONDS
        stalled = pause > self.monitor.timeout
        if stalled:
            self.fail(
                "host_stalled",
                f"bridge did not run for {pause * 1e3:.0f} ms; expected at most {self.monitor.timeout * 1e3:.0f} ms: "
                "is the machine too busy?",
            )
        return not stalled

    def _rest(self, drive: Drive, was_armed: bool) -> Outcome:
        fault = ""
        now = self.port.now_ns()
        if was_armed and self.supervisor.mode is Mode.FAULT:
            fault = self.last_fault = self._note("supervisor")
        # Prepared for arming it may wait, but not behind an e-stop.
        waits = now <= self._prepared_until_ns and self.supervisor.mode is Mode.DISARMED
        ends = self._driving and (was_armed or not waits)
        if ends:
            self.release()
        self.insist()
        return Outcome(drive, 0.0, fault=fault)

    def _present_fault(self) -> str:
        if self.feedback is None:
            return "no feedback yet"
        fault = self.monitor.silence(self.port.now_ns()) or self.monitor.present
        return f"{fault.name}: {fault.message}" if fault is not None else ""

    def _write_settings(self) -> None:
        self._output.gains = self.mapping.limited_gains(self._motor.state.voltage)
        write_settings(self.port, self.settings, self._output.gains)

    def _to_sample(self, feedback: Feedback) -> JointSample:
        sign = self.settings.joint_sign
        return JointSample.of_one(
            feedback.stamp_ns,
            sign * feedback.position + self.settings.joint_offset,
            sign * feedback.velocity,
            sign * feedback.effort - self.settings.effort_tare,
        )

    def _setpoints(self, drive: Drive, feedback: Feedback) -> tuple[Strategy, Command]:
        """Return strategy and setpoints of a decision, in the actuator's own angle and sign."""
        sign, mapping = self.settings.joint_sign, self.mapping
        if drive.kind is DriveKind.EFFORT:
            self._handover_left = 0.0
            if drive.starved:
                return mapping.strategy, mapping.idle()
            return mapping.strategy, mapping.command(sign * drive.effort[0], self._motor.state)
        if drive.handover > self._handover_left:
            # The torque in force passes on with the speed that the link has: neither the setpoints' nor zero.
            self._handover = mapping.handover(self._effort, feedback.pwm_command, feedback.velocity, self._motor.state)
        self._handover_left = drive.handover
        offset, speed = self._handover
        # A duty that stands still while a setpoint moves is stuck: even in hold the setpoint moves, by less than shows.
        self._dither = -self._dither
        velocity = sign * drive.velocity[0]
        return TRAJECTORY_STRATEGY, Command(
            position=sign * (drive.position[0] - self.settings.joint_offset) + drive.handover * offset + self._dither,
            velocity=velocity + drive.handover * (speed - velocity),
        )

    def _send(self, strategy: Strategy, command: Command) -> Applied:
        """Send setpoints, bounded, and change the strategy with them where another is in force."""
        command = self.mapping.bounded(command, self._motor.state)
        now = self.port.now_ns()
        if strategy is self._strategy:
            applied = self.port.write(command)
        else:
            self._strategy = strategy
            self._confirm(self.port.set_strategy(strategy, command), strategy)
            applied = Applied(command, strategy, limited=False, sent_ns=now)
        self.monitor.told(applied.command, strategy, applied.sent_ns)
        return applied

    def _confirm(self, reads: Strategy, wanted: Strategy) -> None:
        if reads is not wanted:
            raise ActuatorError(
                "strategy",
                f"strategy reads back as {reads.name} ({int(reads)}); expected {wanted.name} ({int(wanted)})",
            )

    def _note(self, fault: str) -> str:
        self.faults[fault] = self.faults.get(fault, 0) + 1
        return fault
