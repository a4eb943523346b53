"""What a plant does at each instant: one state machine and one set of rules for simulator and hardware.

::

    DISARMED --arm--> EFFORT <--trajectory / first command after it--> POSITION
    any armed state --fault--> FAULT --disarm--> DISARMED
    any state --e-stop--> E_STOP --reset--> DISARMED        (a reset never re-arms)

Pure: time, measurements and messages are arguments, the decision is a value. The plants only carry it out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from pendulum_msgs_py.commands import CommandGate, Refusal
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.trajectory import Trajectory
from pendulum_msgs_py.values import NANOSECONDS, JointCommand, JointSample

__all__ = ["Drive", "DriveKind", "Input", "Mode", "PlantLimits", "PlantSupervisor"]


class Mode(str, Enum):
    """State of a plant; the value is shown in diagnostics."""

    DISARMED = "disarmed"
    POSITION = "armed_position"
    EFFORT = "armed_effort"
    FAULT = "fault"
    E_STOP = "e_stop"

    @property
    def armed(self) -> bool:
        """Whether torque may flow."""
        return self in {Mode.POSITION, Mode.EFFORT}


class Input(str, Enum):
    """The inputs that carry torque."""

    EFFORT_COMMAND = "effort_command"
    DISTURBANCE = "disturbance"
    PUSH = "push"


class DriveKind(str, Enum):
    """What the plant has to do until the next decision."""

    OFF = "off"
    EFFORT = "effort"
    POSITION = "position"


@dataclass(frozen=True, slots=True)
class Drive:
    """One decision.

    Attributes:
        kind: Off (zero torque, drive released), torque, or position control.
        effort: Torque to apply; under position control the feed-forward of the hand-over [N m].
        position: Position to hold or follow [rad], for ``POSITION``.
        velocity: Its velocity [rad/s].
        controller: The controller's share of the effort, before limits [N m].
        disturbance: The disturbance's share [N m].
        push: Torque on the link itself [N m]; applied whatever the kind, as a hand would.
        saturated: The sum was clamped.
        starved: Armed for effort, but without a fresh command: zero torque.
    """

    kind: DriveKind
    effort: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    controller: float = 0.0
    disturbance: float = 0.0
    push: float = 0.0
    saturated: bool = False
    starved: bool = False


@dataclass(frozen=True)
class PlantLimits:
    """Limits that a plant keeps.

    Attributes:
        effort: Largest torque, after the sum of controller and disturbance [N m].
        command_timeout: Age at which a command counts for nothing [s].
        feedback_timeout: Age of the measurement at which an armed plant faults [s].
        velocity: Speed at which an armed plant faults, and largest of a trajectory [rad/s].
        position_min: Lower end of the position window [rad].
        position_max: Upper end [rad].
        slew: Largest rate of change of the torque [N m/s].
        handover_time: Time over which torque passes from position to effort control and back [s].
        tracking_error: Distance from the trajectory at which the plant faults [rad].
        arm_effort: Largest command that may be waiting when the plant is armed [N m].
    """

    effort: float
    command_timeout: float = 0.05
    feedback_timeout: float = math.inf
    velocity: float = math.inf
    position_min: float = -math.inf
    position_max: float = math.inf
    slew: float = math.inf
    handover_time: float = 0.1
    tracking_error: float = 0.3
    arm_effort: float = 0.5

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing or everything."""
        if not (math.isfinite(self.effort) and self.effort > 0.0):
            raise ParameterError(f"effort_limit is {self.effort} N m; expected a finite number > 0")
        if not (math.isfinite(self.command_timeout) and self.command_timeout > 0.0):
            raise ParameterError(f"command_timeout is {self.command_timeout} s; expected a finite number > 0")
        for name, unit in (("feedback_timeout", "s"), ("velocity", "rad/s"), ("slew", "N m/s")):
            if not getattr(self, name) > 0.0:
                raise ParameterError(f"{name} is {getattr(self, name)} {unit}; expected > 0")
        if not self.position_min < self.position_max:
            raise ParameterError(
                f"position window is [{self.position_min}, {self.position_max}] rad; expected min < max"
            )


@dataclass
class _Handover:
    """Fade from the torque before a change of control to the torque after it."""

    start_ns: int
    effort: float
    offset: float = 0.0

    def remaining(self, now_ns: int, duration: float) -> float:
        if duration <= 0.0:
            return 0.0
        return min(1.0, max(0.0, 1.0 - (now_ns - self.start_ns) / (duration * NANOSECONDS)))


@dataclass
class PlantSupervisor:
    """State machine, command gates, trajectory and hand-over of one plant.

    Args:
        limits: The limits to keep.
        preflight: Called on arming; returns why the plant is not ready, or an empty string.
    """

    limits: PlantLimits
    preflight: Callable[[], str] = lambda: ""
    mode: Mode = Mode.DISARMED
    reason: str = "not armed yet"
    starved_periods: int = 0
    saturated_periods: int = 0
    transitions: list[tuple[int, Mode, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Make one gate per input."""
        timeout = self.limits.command_timeout
        self.gates = {kind: CommandGate(timeout) for kind in Input}
        self.commander_conflict = ""
        self._trajectory: Trajectory | None = None
        self._trajectory_start_ns = 0
        self._handover: _Handover | None = None
        self._applied = 0.0
        self._last_effort = 0.0
        self._last_decision_ns: int | None = None
        self._hold_position: float | None = None

    # --- messages ------------------------------------------------------------------------------------------

    def offer(self, kind: Input, command: JointCommand | None, now_ns: int) -> Refusal | None:
        """Offer a message of an input; None stands for one that was no command of one joint."""
        gate = self.gates[kind]
        return gate.refuse_malformed() if command is None else gate.offer(command, now_ns)

    def set_commander_conflict(self, conflict: str) -> None:
        """Report that several publishers stand behind one name on ``effort_command``, or that they no longer do.

        Commanders with names of their own are told apart message by message; twins are not, and while there are
        twins nobody's torque is applied.
        """
        self.commander_conflict = conflict

    def accept_trajectory(self, trajectory: Trajectory, now_ns: int, sample: JointSample) -> str:
        """Start to follow a trajectory; return why it is refused, or an empty string."""
        limits = self.limits
        if not self.mode.armed:
            return f"plant is {self.mode.value}; expected it armed before a trajectory"
        if not sample.is_finite():
            return "measured position is not finite"
        gap = trajectory.start - sample.position
        if abs(gap) > limits.tracking_error:
            return (
                f"trajectory starts at {trajectory.start:.4f} rad, the pendulum is at {sample.position:.4f} rad; "
                f"expected at most {limits.tracking_error} rad between them"
            )
        speed = trajectory.max_speed()
        if speed > limits.velocity:
            return f"trajectory asks for {speed:.3f} rad/s; expected at most {limits.velocity} rad/s"
        positions = [point.position for point in trajectory.points]
        if min(positions) < limits.position_min or max(positions) > limits.position_max:
            return (
                f"trajectory covers {min(positions):.3f} to {max(positions):.3f} rad; expected it inside "
                f"{limits.position_min} to {limits.position_max} rad"
            )
        self._trajectory = trajectory
        self._trajectory_start_ns = now_ns
        self._handover = _Handover(now_ns, self._applied, offset=-gap)
        self._enter(Mode.POSITION, "following a trajectory", now_ns)
        return ""

    # --- transitions ---------------------------------------------------------------------------------------

    def arm(self, now_ns: int, sample: JointSample | None) -> str:
        """Arm for effort at zero torque; return why not, or an empty string. Arming twice changes nothing."""
        if self.mode.armed:
            return ""
        refusal = self._arm_refusal(now_ns, sample)
        if refusal:
            return refusal
        for gate in self.gates.values():
            gate.reset()
        self._handover = None
        self._trajectory = None
        self._applied = self._last_effort = 0.0
        self._enter(Mode.EFFORT, "armed", now_ns)
        return ""

    def disarm(self, now_ns: int, reason: str = "disarmed on request") -> None:
        """Release the drive; also acknowledges a fault, but never an e-stop."""
        if self.mode is not Mode.E_STOP:
            self._release(Mode.DISARMED, reason, now_ns)

    def e_stop(self, now_ns: int, reason: str = "e-stop pressed") -> None:
        """Latch the e-stop."""
        self._release(Mode.E_STOP, reason, now_ns)

    def e_stop_reset(self, now_ns: int) -> str:
        """Leave the e-stop for DISARMED; return why not, or an empty string."""
        if self.mode is not Mode.E_STOP:
            return f"plant is {self.mode.value}; expected e_stop"
        self._release(Mode.DISARMED, "e-stop reset; arm again to go on", now_ns)
        return ""

    def fault(self, reason: str, now_ns: int) -> None:
        """Release the drive and stay so until somebody disarms; an e-stop outranks a fault."""
        if self.mode not in {Mode.E_STOP, Mode.FAULT}:
            self._release(Mode.FAULT, reason, now_ns)

    # --- decision ------------------------------------------------------------------------------------------

    def decide(self, now_ns: int, sample: JointSample | None) -> Drive:
        """Return what the plant has to do now.

        Args:
            now_ns: The plant's clock [ns].
            sample: Newest measurement, or None before the first.
        """
        push_command = self.gates[Input.PUSH].fresh(now_ns)
        push = push_command.effort if push_command else 0.0
        if self.mode.armed:
            fault = self._measurement_fault(now_ns, sample)
            if fault:
                self.fault(fault, now_ns)
        if not self.mode.armed or sample is None:
            self._last_effort = 0.0
            return Drive(DriveKind.OFF, push=push)
        if self.mode is Mode.POSITION:
            drive = self._decide_position(now_ns, sample, push)
            if drive is not None:
                return drive
        return self._decide_effort(now_ns, push)

    def report_applied(self, effort: float) -> None:
        """Tell what torque the plant really applied, so that the next hand-over starts from there [N m]."""
        self._applied = effort

    @property
    def trajectory_finished(self) -> bool:
        """Whether position control holds the goal of a finished trajectory."""
        return self.mode is Mode.POSITION and self._hold_position is not None

    def has_fresh_command(self, now_ns: int) -> bool:
        """Whether a controller is answering."""
        return self.gates[Input.EFFORT_COMMAND].fresh(now_ns) is not None

    # --- inside --------------------------------------------------------------------------------------------

    def _decide_position(self, now_ns: int, sample: JointSample, push: float) -> Drive | None:
        trajectory = self._trajectory
        assert trajectory is not None
        elapsed = (now_ns - self._trajectory_start_ns) / NANOSECONDS
        position, velocity = trajectory.at(elapsed)
        handover = self._handover
        remaining = handover.remaining(now_ns, self.limits.handover_time) if handover else 0.0
        if handover:
            position += handover.offset * remaining
        if abs(sample.position - position) > self.limits.tracking_error:
            self.fault(
                f"pendulum is at {sample.position:.3f} rad, the trajectory at {position:.3f} rad; "
                f"expected at most {self.limits.tracking_error} rad between them",
                now_ns,
            )
            return Drive(DriveKind.OFF, push=push)
        if elapsed >= trajectory.duration:
            if self._hold_position is None:
                self._hold_position = trajectory.goal
                self.reason = "holding the end of a trajectory"
            command = self.gates[Input.EFFORT_COMMAND].fresh(now_ns)
            end_ns = self._trajectory_start_ns + round(trajectory.duration * NANOSECONDS)
            if command is not None and command.stamp_ns >= end_ns and not self.commander_conflict:
                self._trajectory = None
                self._handover = _Handover(now_ns, self._applied)
                self._last_effort = self._applied
                self._last_decision_ns = now_ns
                self._enter(Mode.EFFORT, f"commanded by {command.source or 'an unnamed node'}", now_ns)
                return None
        effort = handover.effort * remaining if handover else 0.0
        return Drive(
            DriveKind.POSITION, effort=self._clamp(effort), position=position, velocity=velocity, push=push
        )

    def _decide_effort(self, now_ns: int, push: float) -> Drive:
        command = None if self.commander_conflict else self.gates[Input.EFFORT_COMMAND].fresh(now_ns)
        if command is None:
            self.starved_periods += 1
            self._handover = None
            self._last_effort = 0.0
            self._last_decision_ns = now_ns
            self.reason = self.commander_conflict or "no fresh command: zero torque"
            return Drive(DriveKind.EFFORT, push=push, starved=True)
        disturbance_command = self.gates[Input.DISTURBANCE].fresh(now_ns)
        disturbance = disturbance_command.effort if disturbance_command else 0.0
        wanted = self._clamp(command.effort + disturbance)
        saturated = wanted != command.effort + disturbance
        effort = wanted
        if self._handover is not None:
            remaining = self._handover.remaining(now_ns, self.limits.handover_time)
            effort = self._clamp(remaining * self._handover.effort + (1.0 - remaining) * wanted)
            if remaining == 0.0:
                self._handover = None
        effort = self._limit_slew(effort, now_ns)
        self.saturated_periods += saturated
        self._last_effort = effort
        self._last_decision_ns = now_ns
        self.reason = f"commanded by {command.source or 'an unnamed node'}"
        return Drive(
            DriveKind.EFFORT,
            effort=effort,
            controller=command.effort,
            disturbance=disturbance,
            push=push,
            saturated=saturated,
        )

    def _limit_slew(self, effort: float, now_ns: int) -> float:
        if math.isinf(self.limits.slew) or self._last_decision_ns is None:
            return effort
        step = self.limits.slew * max(0, now_ns - self._last_decision_ns) / NANOSECONDS
        return min(self._last_effort + step, max(self._last_effort - step, effort))

    def _clamp(self, effort: float) -> float:
        return min(self.limits.effort, max(-self.limits.effort, effort))

    def _measurement_fault(self, now_ns: int, sample: JointSample | None) -> str:
        limits = self.limits
        if sample is None:
            return "no measurement"
        if not sample.is_finite():
            return f"measurement is not finite: {sample.position} rad, {sample.velocity} rad/s, {sample.effort} N m"
        age = (now_ns - sample.stamp_ns) / NANOSECONDS
        if age > limits.feedback_timeout:
            return f"measurement is {age * 1e3:.0f} ms old; expected at most {limits.feedback_timeout * 1e3:.0f} ms"
        if not limits.position_min <= sample.position <= limits.position_max:
            return (
                f"position is {sample.position:.3f} rad; expected inside {limits.position_min} to "
                f"{limits.position_max} rad"
            )
        if abs(sample.velocity) > limits.velocity:
            return f"velocity is {sample.velocity:.3f} rad/s; expected at most {limits.velocity} rad/s"
        return ""

    def _arm_refusal(self, now_ns: int, sample: JointSample | None) -> str:
        if self.mode is Mode.E_STOP:
            return "e-stop is latched; reset it first"
        if self.mode is Mode.FAULT:
            return f"fault not acknowledged: {self.reason}; disarm first"
        if self.commander_conflict:
            return self.commander_conflict
        fault = self._measurement_fault(now_ns, sample)
        if fault:
            return fault
        command = self.gates[Input.EFFORT_COMMAND].fresh(now_ns)
        if command is not None and abs(command.effort) > self.limits.arm_effort:
            return (
                f"{command.source or 'a controller'} already commands {command.effort:.3f} N m; "
                f"expected at most {self.limits.arm_effort} N m while arming"
            )
        return self.preflight()

    def _release(self, mode: Mode, reason: str, now_ns: int) -> None:
        self._trajectory = None
        self._handover = None
        self._applied = self._last_effort = 0.0
        self._enter(mode, reason, now_ns)

    def _enter(self, mode: Mode, reason: str, now_ns: int) -> None:
        self._hold_position = None
        if mode is not self.mode:
            self.transitions.append((now_ns, mode, reason))
            del self.transitions[:-_KEPT_TRANSITIONS]
        self.mode = mode
        self.reason = reason


_KEPT_TRANSITIONS = 50
