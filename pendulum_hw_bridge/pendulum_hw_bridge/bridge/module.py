"""One module of the bridge: feedback, settings and strategy.

A :class:`Module` is read-only, as the encoder of a passive joint. A :class:`DrivenModule` has a motor too; all torque
passes through its ``send``, which limits it.
"""

from __future__ import annotations

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping
from pendulum_hw_bridge.drive.fault_table import Fault
from pendulum_hw_bridge.drive.motor_state import MotorWatch
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.drive.safety import SafetyMonitor
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    ActuatorPort,
    Applied,
    Command,
    EncoderPort,
    Feedback,
    Strategy,
    no_torque,
)
from pendulum_hw_bridge.port.settings import BridgeSettings, write_rate, write_settings
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind

__all__ = ["DrivenModule", "Module"]


class Module:
    """A read-only module.

    Args:
        port: Source of its records.
        monitor: Checks of its feedback.
        settings: Its settings, and the conversion of its angle to that of the joint.
        joint: Name of its joint, for messages; empty for a single module.

    Attributes:
        info: Properties reported when it was connected.
        feedback: Newest record.
        fresh: Whether that record is in no state of the plant yet.
    """

    def __init__(self, port: EncoderPort, monitor: SafetyMonitor, settings: BridgeSettings, *, joint: str = "") -> None:
        self.port = port
        self.monitor = monitor
        self.settings = settings
        self.joint = joint
        self.info: ActuatorInfo | None = None
        self.feedback: Feedback | None = None
        self.fresh = False

    def connect(self) -> ActuatorInfo:
        """Connect and write all settings; ActuatorError if the module is missing or a setting does not read back."""
        self.port.connect()
        self.write_settings()
        self.info = self.port.connect()
        return self.info

    def write_settings(self) -> None:
        """Write all settings; ActuatorError unless each reads back."""
        write_rate(self.port, self.settings)

    def take(self, feedback: Feedback) -> Fault | None:
        """Store a new record; return its first fault, or None."""
        fault = self.monitor.check(feedback)
        self.feedback = feedback
        self.fresh = True
        return fault

    def state(self, feedback: Feedback) -> tuple[float, float, float]:
        """Return a record's position, velocity and effort in joint coordinates [rad, rad/s, N m; or m, m/s, N]."""
        sign = self.settings.joint_sign
        return (
            sign * feedback.position + self.settings.joint_offset,
            sign * feedback.velocity,
            sign * feedback.effort - self.settings.effort_tare,
        )

    def words(self, message: str) -> str:
        """Return a message with the joint's name, if there are several."""
        return f"{self.joint}: {message}" if self.joint else message


class DrivenModule(Module):
    """A module with a motor; ``mapping`` converts torque to setpoints, ``check`` is the class of its output check."""

    port: ActuatorPort

    def __init__(
        self,
        port: ActuatorPort,
        mapping: EffortMapping,
        monitor: SafetyMonitor,
        settings: BridgeSettings,
        *,
        joint: str = "",
        check: type[OutputCheck] = OutputCheck,
    ) -> None:
        super().__init__(port, monitor, settings, joint=joint)
        self.mapping = mapping
        limits = monitor.limits
        self._motor = MotorWatch(mapping.drivetrain, limits.voltage_min, limits.voltage_max)
        self._output = monitor.output = check(mapping, settings.limits.pwm)
        self._strategy = Strategy.OFF
        self._handover = (0.0, 0.0)
        self._handover_left = 0.0
        self._effort = 0.0
        self._dither = mapping.dither

    @property
    def driving(self) -> bool:
        """Whether a strategy is in force."""
        return self._strategy is not Strategy.OFF

    @property
    def effort(self) -> float:
        """Joint torque of the setpoints in force, after all limits [N m]."""
        return self.settings.joint_sign * self._effort

    def connect(self) -> ActuatorInfo:
        """Connect, switch off, write all settings; ActuatorError if missing or a setting does not read back."""
        self.port.connect()
        self._confirm(self.port.set_strategy(Strategy.OFF), Strategy.OFF)
        self._strategy = Strategy.OFF
        self.write_settings()
        self.info = self.port.connect()
        return self.info

    def write_settings(self) -> None:
        """Write all settings, with limited gains; ActuatorError unless each reads back."""
        self._output.gains = self.mapping.limited_gains(self._motor.state.voltage)
        write_settings(self.port, self.settings, self._output.gains)

    def take(self, feedback: Feedback) -> Fault | None:
        """Store a new record; return its first fault, or None."""
        fault = super().take(feedback)
        self._motor.update(feedback)
        return fault

    def idle(self) -> None:
        """Set the effort strategy at zero torque; ActuatorError if that fails or does not read back."""
        self.send(self.mapping.strategy, no_torque(self.mapping.strategy))

    def carry_out(self, drive: Drive, index: int, feedback: Feedback) -> Applied:
        """Send a decision's setpoints for driven joint ``index``; ``feedback`` is the newest record.

        Raises:
            ActuatorError: Sending failed, or the strategy does not read back.
        """
        applied = self.send(*self._setpoints(drive, index, feedback))
        self._effort = self.mapping.effort_of(applied.command, self._motor.state, feedback.pwm_command)
        return applied

    def send(self, strategy: Strategy, command: Command) -> Applied:
        """Send limited setpoints, with a change of strategy if another is in force.

        Raises:
            ActuatorError: Sending failed, or the strategy does not read back.
        """
        command = self.mapping.bounded(command, self._motor.state)
        now = self.port.now_ns()
        if strategy is self._strategy:
            applied = self.port.write(command)
        else:
            self._strategy = strategy
            self._confirm(self.port.set_strategy(strategy, command), strategy)
            applied = Applied(command, strategy, limited=False, sent_ns=now)
        self.monitor.note_sent(applied.command, strategy, applied.sent_ns)
        return applied

    def stop(self) -> Exception | None:
        """Remove torque, then set strategy off; return why the module has not confirmed it, never raise."""
        self._strategy = Strategy.OFF
        # No torque is in force any more: the next handover must not start with that of an earlier drive.
        self._effort = self._handover_left = 0.0
        self.monitor.stopped()
        try:
            self.port.stop()
        # Whatever happens here, the command lifetime still ends all torque.
        except Exception as error:  # noqa: BLE001
            return error
        return None

    def _setpoints(self, drive: Drive, index: int, feedback: Feedback) -> tuple[Strategy, Command]:
        """Return strategy and setpoints of a decision, in the actuator's own angle and sign."""
        sign, mapping = self.settings.joint_sign, self.mapping
        if drive.kind is DriveKind.EFFORT:
            self._handover_left = 0.0
            if drive.starved:
                return mapping.strategy, no_torque(mapping.strategy)
            return mapping.strategy, mapping.command(sign * drive.effort[index], self._motor.state)
        if drive.handover > self._handover_left:
            # The handover takes over the torque in force at the link's present speed, not at the setpoint's or zero.
            self._handover = mapping.handover(self._effort, feedback.pwm_command, feedback.velocity, self._motor.state)
        self._handover_left = drive.handover
        offset, speed = self._handover
        # A constant duty under a moving setpoint is stuck: so the setpoint moves even in hold, invisibly little.
        self._dither = -self._dither
        velocity = sign * drive.velocity[index]
        place = sign * (drive.position[index] - self.settings.joint_offset)
        setpoints = Command(
            position=place + drive.handover * offset + self._dither,
            velocity=velocity + drive.handover * (speed - velocity),
        )
        return mapping.follow(setpoints, feedback)

    def _confirm(self, reads: Strategy, wanted: Strategy) -> None:
        if reads is not wanted:
            raise ActuatorError(
                "strategy",
                f"strategy reads back as {reads.name} ({int(reads)}); expected {wanted.name} ({int(wanted)})",
            )
