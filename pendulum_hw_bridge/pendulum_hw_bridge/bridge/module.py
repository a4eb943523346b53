"""One module under the bridge: what it measures, what is set in it, and which strategy is in force.

A :class:`Module` is only read, as the encoder of a passive joint: it has no way to give torque. A
:class:`DrivenModule` has a motor too. Torque leaves it in one place, ``send``, where it is bounded.
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

__all__ = ["TRAJECTORY_STRATEGY", "DrivenModule", "Module"]

TRAJECTORY_STRATEGY = Strategy.PARALLEL_PWM
"""Strategy under which trajectories are followed (3, as in the thesis)."""


class Module:
    """A module that is only read.

    Args:
        port: Where its records come from.
        monitor: Checks of them.
        settings: What to set in it, and how its angle becomes that of the joint.
        joint: Name of its joint, for messages; empty where it is the only one.

    Attributes:
        info: What it said of itself when it was connected.
        feedback: Its newest record.
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
        """Connect, set everything, and check that it reads back.

        Raises:
            ActuatorError: The module is not there, or does not take a setting.
        """
        self.port.connect()
        self.write_settings()
        self.info = self.port.connect()
        return self.info

    def write_settings(self) -> None:
        """Write all settings, and refuse a module that does not keep each of them.

        Raises:
            ActuatorError: It does not.
        """
        write_rate(self.port, self.settings)

    def take(self, feedback: Feedback) -> Fault | None:
        """Keep a new record; return the first fault that it shows, or None."""
        fault = self.monitor.check(feedback)
        self.feedback = feedback
        self.fresh = True
        return fault

    def state(self, feedback: Feedback) -> tuple[float, float, float]:
        """Return a record's position, velocity and effort as those of the joint [rad, rad/s, N m, or of a slide]."""
        sign = self.settings.joint_sign
        return (
            sign * feedback.position + self.settings.joint_offset,
            sign * feedback.velocity,
            sign * feedback.effort - self.settings.effort_tare,
        )

    def words(self, message: str) -> str:
        """Return a message with the joint that it is about, where there are several."""
        return f"{self.joint}: {message}" if self.joint else message


class DrivenModule(Module):
    """A module with a motor.

    Args:
        port: The actuator.
        mapping: Torque to setpoint.
        monitor: Checks of the feedback.
        settings: What to set in the actuator.
        joint: Name of its joint, for messages; empty where it is the only one.
        check: Kind of the check that the output is what was asked for.
    """

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
        """Torque at the joint that the setpoints in force stand for, after all limits [N m]."""
        return self.settings.joint_sign * self._effort

    def connect(self) -> ActuatorInfo:
        """Connect, switch off, set everything, and check that it reads back.

        Raises:
            ActuatorError: The actuator is not there, or does not take a setting.
        """
        self.port.connect()
        self._confirm(self.port.set_strategy(Strategy.OFF), Strategy.OFF)
        self._strategy = Strategy.OFF
        self.write_settings()
        self.info = self.port.connect()
        return self.info

    def write_settings(self) -> None:
        """Write all settings, the gains limited, and refuse a module that does not keep each of them.

        Raises:
            ActuatorError: It does not.
        """
        self._output.gains = self.mapping.limited_gains(self._motor.state.voltage)
        write_settings(self.port, self.settings, self._output.gains)

    def take(self, feedback: Feedback) -> Fault | None:
        """Keep a new record; return the first fault that it shows, or None."""
        fault = super().take(feedback)
        self._motor.update(feedback)
        return fault

    def idle(self) -> None:
        """Put the strategy for effort in force, at zero torque.

        Raises:
            ActuatorError: It cannot be sent, or does not read back.
        """
        self.send(self.mapping.strategy, no_torque(self.mapping.strategy))

    def carry_out(self, drive: Drive, index: int, feedback: Feedback) -> Applied:
        """Send what a decision says for one of the driven joints.

        Args:
            drive: The supervisor's decision.
            index: Which of the driven joints this one is.
            feedback: The newest record.

        Raises:
            ActuatorError: It cannot be sent, or the strategy does not read back.
        """
        applied = self.send(*self._setpoints(drive, index, feedback))
        self._effort = self.mapping.effort_of(applied.command, self._motor.state, feedback.pwm_command)
        return applied

    def send(self, strategy: Strategy, command: Command) -> Applied:
        """Send setpoints, bounded, and change the strategy with them where another is in force.

        Raises:
            ActuatorError: They cannot be sent, or the strategy does not read back.
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
        """No torque, then strategy off; return why the module has not confirmed it, never raise."""
        self._strategy = Strategy.OFF
        # No torque is in force any more: the next hand-over must not begin with that of an earlier drive.
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
            # The torque in force passes on with the speed that the link has: neither the setpoints' nor zero.
            self._handover = mapping.handover(self._effort, feedback.pwm_command, feedback.velocity, self._motor.state)
        self._handover_left = drive.handover
        offset, speed = self._handover
        # A duty that stands still while a setpoint moves is stuck: even in hold the setpoint moves, by less than shows.
        self._dither = -self._dither
        velocity = sign * drive.velocity[index]
        place = sign * (drive.position[index] - self.settings.joint_offset)
        return TRAJECTORY_STRATEGY, Command(
            position=place + drive.handover * offset + self._dither,
            velocity=velocity + drive.handover * (speed - velocity),
        )

    def _confirm(self, reads: Strategy, wanted: Strategy) -> None:
        if reads is not wanted:
            raise ActuatorError(
                "strategy",
                f"strategy reads back as {reads.name} ({int(reads)}); expected {wanted.name} ({int(wanted)})",
            )
