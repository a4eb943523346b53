"""The plant supervisor: one state machine and one set of rules for simulator and hardware.

::

    DISARMED --arm--> EFFORT <--trajectory / first command after it--> POSITION
    any armed state --fault--> FAULT --disarm--> DISARMED
    any state --e-stop--> E_STOP --reset--> DISARMED        (a reset never re-arms)

It is pure: time, measurements and messages are arguments, the decision is a value that the plant carries out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import add, sub

from pendulum_msgs_py.contract.commands import CommandGate, Refusal
from pendulum_msgs_py.contract.drive import Drive, DriveKind, Input, Mode, PlantLimits
from pendulum_msgs_py.contract.handover import Handover
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates, Joint
from pendulum_msgs_py.contract.rules import age_of, has_lapsed, is_inside, rise_within, within
from pendulum_msgs_py.contract.trajectory import MAX_RAMP_VELOCITY, Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector, written

__all__ = ["PUSH_LIMIT_FACTOR", "Drive", "DriveKind", "Input", "Mode", "PlantLimits", "PlantSupervisor"]

PUSH_LIMIT_FACTOR = 10.0
"""A push is clamped to this multiple of the actuator's effort: 1e308 N m is finite too."""

_KEPT_TRANSITIONS = 50
_LONGEST_STEP_NS = NANOSECONDS // 10
"""Longest step of a trajectory or a fade in one decision [ns]."""


@dataclass
class PlantSupervisor:
    """State machine, command gates, trajectory and handover of one plant.

    ``preflight`` is called on arming and returns why the plant is not ready, or an empty string. ``follows`` says
    whether the plant can follow trajectories; with several joints it cannot. Limits for another number of joints are a
    ParameterError.
    """

    limits: PlantLimits
    preflight: Callable[[], str] = lambda: ""
    coordinates: Coordinates = ONE_JOINT
    follows: bool = True
    mode: Mode = Mode.DISARMED
    reason: str = "not armed yet"
    starved_periods: int = 0
    saturated_periods: int = 0
    transitions: list[tuple[int, Mode, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        joints, driven, unit = self.coordinates.names, self.coordinates.driven_names, self.coordinates.drive_unit
        self.limits = self.limits.for_joints(len(joints), len(driven))
        self.follows = self.follows and len(joints) == 1
        timeout = self.limits.command_timeout
        self.gates = {
            Input.EFFORT_COMMAND: CommandGate(timeout, joints=driven, unit=unit),
            Input.DISTURBANCE: CommandGate(timeout, joints=driven, partial=True, unit=unit),
            Input.PUSH: CommandGate(timeout, joints=joints, partial=True, unit=self.coordinates.units[2]),
        }
        self._joints = len(joints)
        self._nothing = (0.0,) * len(driven)
        self._no_push = (0.0,) * len(joints)
        # A passive joint has the push limit of the strongest motor.
        efforts = self.limits.push or self.limits.effort
        largest = max(efforts, default=1.0)
        own = dict(zip(driven, efforts, strict=True))
        self._push_limits = tuple(PUSH_LIMIT_FACTOR * own.get(name, largest) for name in joints)
        # Attributes, because enum hashes its members in Python: slow in each decision.
        self._commands = self.gates[Input.EFFORT_COMMAND]
        self._disturbances = self.gates[Input.DISTURBANCE]
        self._pushes = self.gates[Input.PUSH]
        self.commander_conflict = ""
        self._trajectory: Trajectory | None = None
        self._trajectory_start_ns = 0
        self._handover: Handover | None = None
        self._applied = self._nothing
        self._last_effort = self._nothing
        self._last_decision_ns: int | None = None
        self._last_time_ns: int | None = None
        self._hold_position: float | None = None
        self._commanding: str | None = None
        self._commanded_ns = 0
        self._gap_from: Vector | None = None
        self._stop: Handover | None = None
        self._held_ns: int | None = None

    # --- messages ------------------------------------------------------------------------------------------

    def offer(self, kind: Input, command: JointCommand | None, now_ns: int, problem: str = "") -> Refusal | None:
        """Offer a message of an input; None for a message that is no command, with its problem."""
        gate = self.gates[kind]
        return gate.refuse_malformed(problem) if command is None else gate.offer(command, now_ns)

    def set_commander_conflict(self, conflict: str) -> None:
        """Set or clear a conflict: publishers of one name cannot be distinguished, so no torque is applied."""
        self.commander_conflict = conflict

    def receive_enable(self, now_ns: int, *, held: bool) -> None:
        """Record a message of the hold-to-run switch; its release disarms at once."""
        self._held_ns = now_ns if held else None
        self._keep_enabled(now_ns)

    def accept_trajectory(self, trajectory: Trajectory, now_ns: int, sample: JointSample) -> str:
        """Follow a trajectory; return why it is refused, or an empty string."""
        limits = self.limits
        if not self.follows:
            return f"{self.no_trajectories}; expected {self.coordinates.topics.command}"
        if not self.mode.armed:
            return f"plant is {self.mode.value}; expected it armed before a trajectory"
        fault = self._measurement_fault(now_ns, sample)
        if fault:
            return fault
        (place,) = sample.position
        trajectory = trajectory.from_position(place)
        gap = trajectory.start - place
        if abs(gap) > limits.tracking_error:
            return (
                f"trajectory starts at {trajectory.start:.4f} rad, the pendulum is at {place:.4f} rad; "
                f"expected at most {limits.tracking_error} rad between them"
            )
        # The gap closes while the trajectory runs, no faster than a ramp.
        offset_time = max(limits.handover_time, abs(gap) / MAX_RAMP_VELOCITY)
        speed = trajectory.max_speed
        if offset_time > 0.0:
            speed += abs(gap) / offset_time
        if speed > limits.velocity:
            return f"trajectory asks for {speed:.3f} rad/s; expected at most {limits.velocity} rad/s"
        low, high = limits.position_min[0], limits.position_max[0]
        if trajectory.lowest < low or trajectory.highest > high:
            return (
                f"trajectory covers {trajectory.lowest:.3f} to {trajectory.highest:.3f} rad; expected it inside "
                f"{low} to {high} rad"
            )
        self._keep_pace(now_ns)
        self._trajectory = trajectory
        self._trajectory_start_ns = now_ns
        self._handover = Handover(now_ns, self._applied, offset=-gap, offset_time=offset_time)
        self._commanding = None
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
        self._applied = self._last_effort = self._nothing
        self._last_decision_ns = self._commanded_ns = now_ns
        self._commanding = None
        self._enter(Mode.EFFORT, "armed", now_ns)
        return ""

    def disarm(self, now_ns: int, reason: str = "disarmed on request") -> None:
        """Stop the drive; also acknowledges a fault, never an e-stop."""
        if self.mode is not Mode.E_STOP:
            self._stop_drive(Mode.DISARMED, reason, now_ns)

    def e_stop(self, now_ns: int, reason: str = "e-stop pressed") -> None:
        """Latch the e-stop."""
        self._stop_drive(Mode.E_STOP, reason, now_ns)

    def e_stop_reset(self, now_ns: int) -> str:
        """Leave the e-stop for DISARMED; return why not, or an empty string."""
        if self.mode is not Mode.E_STOP:
            return f"plant is {self.mode.value}; expected e_stop"
        self._stop_drive(Mode.DISARMED, "e-stop reset; arm again to go on", now_ns)
        return ""

    def fault(self, reason: str, now_ns: int) -> None:
        """Release the drive until a disarm; an e-stop outranks a fault."""
        self._stop = None
        if self.mode not in {Mode.E_STOP, Mode.FAULT}:
            self._release(Mode.FAULT, reason, now_ns)

    def end_stop(self) -> None:
        """End the fade of a stop: a drive prepared for arming must not continue it."""
        self._stop = None

    # --- decision ------------------------------------------------------------------------------------------

    def decide(self, now_ns: int, sample: JointSample | None) -> Drive:
        """Return the drive for a time of the plant's clock [ns] and the newest measurement, None before the first."""
        self._keep_pace(now_ns)
        self._keep_enabled(now_ns)
        push_command = self._pushes.fresh(now_ns)
        push = _clamp(push_command.effort, self._push_limits) if push_command else self._no_push
        if self.mode.armed:
            fault = self._measurement_fault(now_ns, sample)
            if fault:
                self.fault(fault, now_ns)
        if not self.mode.armed or sample is None:
            self._last_effort = self._nothing
            self._last_decision_ns = now_ns
            return self._decide_stop(now_ns, sample, push)
        if self.mode is Mode.POSITION:
            drive = self._decide_position(now_ns, sample, push)
            if drive is not None:
                return drive
        return self._decide_effort(now_ns, push)

    def report_applied(self, effort: Vector) -> None:
        """Record the applied efforts [N m or N], from which the next handover starts."""
        self._applied = _clamp(effort, self.limits.effort)

    @property
    def trajectory_finished(self) -> bool:
        """Whether position control holds the goal of a finished trajectory."""
        return self.mode is Mode.POSITION and self._hold_position is not None

    @property
    def no_trajectories(self) -> str:
        """Why the plant follows no trajectory, or an empty string."""
        if self.follows:
            return ""
        names = self.coordinates.names
        return f"plant has {', '.join(names)} and follows no trajectory; one that does has one joint alone"

    @staticmethod
    def commanded_by(source: str) -> str:
        """Return the reason of a commanded plant."""
        return f"commanded by {source or 'an unnamed node'}"

    # --- inside --------------------------------------------------------------------------------------------

    def _keep_enabled(self, now_ns: int) -> None:
        if self.mode.armed and (refusal := self._enable_refusal(now_ns)):
            self.disarm(now_ns, f"disarmed: {refusal}")

    def _enable_refusal(self, now_ns: int) -> str:
        timeout = self.limits.enable_timeout
        if math.isinf(timeout):
            return ""
        if self._held_ns is None:
            return "enable switch is not held; expected true on enable_input, all the time"
        # abs: a clock that steps back must not keep a switch held.
        silence = abs(now_ns - self._held_ns) / NANOSECONDS
        if silence > timeout:
            return f"enable switch is silent for {1e3 * silence:.0f} ms; expected a message within {timeout:g} s"
        return ""

    def _keep_pace(self, now_ns: int) -> None:
        """Shift trajectory and fades by a stop of the process or a step of the clock: the set point must not jump."""
        last_ns, self._last_time_ns = self._last_time_ns, now_ns
        if last_ns is None:
            return
        elapsed = now_ns - last_ns
        lost = elapsed - min(_LONGEST_STEP_NS, max(0, elapsed))
        if lost:
            self._trajectory_start_ns += lost
            if self._handover is not None:
                self._handover.start_ns += lost
            if self._stop is not None and elapsed < 0:
                # A stop never waits, but a clock that steps back must not restore its torque.
                self._stop.start_ns += elapsed

    def _decide_position(self, now_ns: int, sample: JointSample, push: Vector) -> Drive | None:
        trajectory = self._trajectory
        assert trajectory is not None
        elapsed = (now_ns - self._trajectory_start_ns) / NANOSECONDS
        position, velocity = trajectory.at(elapsed)
        handover = self._handover
        remaining = handover.remaining(now_ns, self.limits.handover_time) if handover else 0.0
        offset = handover.remaining_offset(now_ns) if handover else 0.0
        position += offset
        # Negated, so that NaN is a fault too.
        if not abs(sample.position[0] - position) <= self.limits.tracking_error:
            self.fault(
                f"pendulum is at {sample.position[0]:.3f} rad, the trajectory at {position:.3f} rad; "
                f"expected at most {self.limits.tracking_error} rad between them",
                now_ns,
            )
            return self._off(push)
        if elapsed >= trajectory.duration and offset == 0.0:
            if self._hold_position is None:
                self._hold_position = trajectory.goal
                self.reason = "holding the end of a trajectory"
            command = self._commands.fresh(now_ns)
            end_ns = self._trajectory_start_ns + round(trajectory.duration * NANOSECONDS)
            if command is not None and command.stamp_ns >= end_ns and not self.commander_conflict:
                refusal = self._take_over_refusal(command, now_ns)
                if refusal:
                    self.reason = f"holding: {refusal}"
                    return self._hold(handover, remaining, position, velocity, push)
                self._trajectory = None
                self._handover = Handover(now_ns, self._applied)
                self._last_effort = self._applied
                self._last_decision_ns = self._commanded_ns = now_ns
                self._commanding, self._gap_from = command.source, None
                self._enter(Mode.EFFORT, self.commanded_by(command.source), now_ns)
                return None
        return self._hold(handover, remaining, position, velocity, push)

    def _take_over_refusal(self, command: JointCommand, now_ns: int) -> str:
        # Before the limit: with a low limit every command would look near.
        unit = self.coordinates.drive_unit
        largest, asked = self.limits.handover_effort, f"{command.effort[0]:.2f} {unit}"
        jump = abs(command.effort[0] - self._applied[0])
        waiting = self._disturbances.fresh(now_ns)
        if jump <= largest and waiting is not None:
            largest, asked = self.limits.handover_sum, f"{asked} and the disturbance for {waiting.effort[0]:.2f} {unit}"
            jump = abs(command.effort[0] + waiting.effort[0] - self._applied[0])
        if jump <= largest:
            return ""
        return (
            f"{command.source or 'a controller'} asks for {asked}, {jump:.2f} {unit} from what holds; "
            f"expected at most {largest} {unit}"
        )

    def _hold(
        self, handover: Handover | None, remaining: float, position: float, velocity: float, push: Vector
    ) -> Drive:
        effort = (handover.effort[0] * remaining,) if handover else self._nothing
        effort = _clamp(effort, self.limits.effort)
        return Drive(DriveKind.POSITION, effort, (position,), (velocity,), push=push, handover=remaining)

    def _off(self, push: Vector) -> Drive:
        return Drive(DriveKind.OFF, self._nothing, self._nothing, self._nothing, self._nothing, self._nothing, push)

    def _stop_drive(self, mode: Mode, reason: str, now_ns: int) -> None:
        """Release the drive; with stop category 1 the acting torque fades first."""
        stop, applied = self._stop, self._applied
        if self.mode.armed:
            # Without torque nothing fades: a zero torque would wake the torque loop of a module.
            starved = self.mode is Mode.EFFORT and self._gap_from is not None
            stop = None if starved else Handover(now_ns, ())
        self._release(mode, reason, now_ns)
        self._stop, self._applied = stop, applied

    def _decide_stop(self, now_ns: int, sample: JointSample | None, push: Vector) -> Drive:
        """Return the drive of a plant that is not armed: off, or the rest of a category 1 stop."""
        stop = self._stop
        if stop is None:
            return self._off(push)
        # Read here: at the request, the torque decided before it may not have been reported yet.
        stop.effort = stop.effort or self._applied
        # A plant that catches up, or whose clock stepped back, decides as of before the request.
        stop.start_ns = min(stop.start_ns, now_ns)
        remaining = stop.remaining(now_ns, self.limits.stop_time)
        if remaining == 0.0 or not any(stop.effort) or self._measurement_fault(now_ns, sample):
            self._stop = None
            return self._off(push)
        effort = tuple(remaining * held for held in stop.effort)
        return self._off(push)._replace(kind=DriveKind.EFFORT, effort=effort)

    def _decide_effort(self, now_ns: int, push: Vector) -> Drive:
        command = None if self.commander_conflict else self._commands.fresh(now_ns)
        refusal = self.commander_conflict or "no fresh command: zero torque"
        if command is not None:
            refusal = self._begin_refusal(command, now_ns)
        if command is None or refusal:
            return self._starve(refusal, now_ns, push)
        self._commanding, self._commanded_ns, self._gap_from = command.source, now_ns, None
        disturbance_command = self._disturbances.fresh(now_ns)
        limits = self.limits.effort
        disturbance = disturbance_command.effort if disturbance_command else self._nothing
        total = tuple(map(add, command.effort, disturbance))
        wanted = _clamp(total, limits)
        saturated = wanted is not total
        effort = wanted
        if self._handover is not None:
            remaining = self._handover.remaining(now_ns, self.limits.handover_time)
            faded = (remaining * h + (1.0 - remaining) * w for h, w in zip(self._handover.effort, wanted, strict=True))
            effort = _clamp(tuple(faded), limits)
            if remaining == 0.0:
                self._handover = None
        effort = self._limit_slew(effort, now_ns)
        self.saturated_periods += saturated
        self._last_effort = effort
        self._last_decision_ns = now_ns
        self.reason = self.commanded_by(command.source)
        return Drive(
            DriveKind.EFFORT, effort, self._nothing, self._nothing, command.effort, disturbance, push, saturated
        )

    def _begin_refusal(self, command: JointCommand, now_ns: int) -> str:
        """Return why a commander may not begin, or an empty string; an active commander may ask for anything.

        After a gap it goes on near its last effort; one that was deactivated ended with zero torque.
        """
        largest, who, unit = self.limits.start_effort, command.source or "a controller", self.coordinates.drive_unit
        if self._commanding == command.source and not has_lapsed(self._commanded_ns, now_ns):
            if self._gap_from is None:
                return ""
            limits = self.limits.effort
            if _largest(tuple(map(sub, _clamp(command.effort, limits), _clamp(self._gap_from, limits)))) <= largest:
                return ""
        if not _largest(command.effort) <= largest:
            return (
                f"zero torque: {who} asks for {written(command.effort, '.2f')} {unit}; "
                f"expected at most {largest} {unit} to begin: bring the plant to where it asks for less, "
                "or let its torque rise (a controller's start_time)"
            )
        # The first command would let a waiting disturbance act at once, however large.
        largest = self.limits.start_sum
        waiting = self._disturbances.fresh(now_ns)
        if waiting is not None and not _largest(tuple(map(add, command.effort, waiting.effort))) <= largest:
            return (
                f"zero torque: {who} asks for {written(command.effort, '.2f')} {unit} and the disturbance for "
                f"{written(waiting.effort, '.2f')} {unit}; expected a sum of at most {largest} {unit} to begin"
            )
        return ""

    def _starve(self, reason: str, now_ns: int, push: Vector) -> Drive:
        silence = (now_ns - self._commanded_ns) / NANOSECONDS
        if silence > self.limits.starvation:
            self.disarm(now_ns, f"disarmed: no command for {silence:.1f} s ({reason})")
            return self._off(push)
        self.starved_periods += 1
        if self._gap_from is None:
            newest = self._commands.newest
            self._gap_from = self._nothing if newest is None else newest.effort
        self._handover = None
        self._last_effort = self._nothing
        self._last_decision_ns = now_ns
        self.reason = reason
        return self._off(push)._replace(kind=DriveKind.EFFORT, starved=True)

    def _limit_slew(self, effort: Vector, now_ns: int) -> Vector:
        if math.isinf(self.limits.slew) or self._last_decision_ns is None:
            return effort
        step = self.limits.slew * max(0, now_ns - self._last_decision_ns) / NANOSECONDS
        return tuple(rise_within(last, wanted, step) for last, wanted in zip(self._last_effort, effort, strict=True))

    def _measurement_fault(self, now_ns: int, sample: JointSample | None) -> str:
        limits = self.limits
        if sample is None:
            return "no measurement"
        if not len(sample.position) == len(sample.velocity) == len(sample.effort) == self._joints:
            return f"measurement has {len(sample.position)} joints; expected {self._joints}"
        if not sample.is_finite():
            of_position, of_velocity, of_effort = self.coordinates.units
            return (
                f"measurement is not finite: {written(sample.position)} {of_position}, "
                f"{written(sample.velocity)} {of_velocity}, {written(sample.effort)} {of_effort}"
            )
        age = age_of(sample.stamp_ns, now_ns)
        if age < -limits.feedback_timeout:
            # It would look fresh too long if no other followed.
            return f"measurement is stamped {-age * 1e3:.0f} ms ahead of the plant's clock"
        if age > limits.feedback_timeout:
            return (
                f"measurement is {age * 1e3:.0f} ms old; expected at most {limits.feedback_timeout * 1e3:.0f} ms: "
                "is the machine too busy, or the link to the actuator lost?"
            )
        _, positions, velocities, _ = sample
        fastest = limits.velocity
        # Lengths were checked above: strict would cost time.
        for low, position, high, velocity in zip(  # noqa: B905
            limits.position_min, positions, limits.position_max, velocities
        ):
            if not is_inside(low, position, high, velocity, fastest):
                return self._outside(sample) or self._too_fast(sample)
        return ""

    def _outside(self, sample: JointSample) -> str:
        limits = self.limits
        joints = zip(self.coordinates.joints, limits.position_min, sample.position, limits.position_max, strict=True)
        for joint, low, position, high in joints:
            if not low <= position <= high:
                of, unit = self._of(joint), joint.unit
                return f"position{of} is {position:.3f} {unit}; expected inside {low} to {high} {unit}"
        return ""

    def _too_fast(self, sample: JointSample) -> str:
        limit = self.limits.velocity
        joint, velocity = next(
            each for each in zip(self.coordinates.joints, sample.velocity, strict=True) if abs(each[1]) > limit
        )
        unit = joint.velocity_unit
        return f"velocity{self._of(joint)} is {velocity:.3f} {unit}; expected at most {limit} {unit}"

    def _of(self, joint: Joint) -> str:
        return f" of {joint.name}" if len(self.coordinates.joints) > 1 else ""

    def _arm_refusal(self, now_ns: int, sample: JointSample | None) -> str:
        if self.mode is Mode.E_STOP:
            return "e-stop is latched; reset it first"
        if self.mode is Mode.FAULT:
            return f"fault not acknowledged: {self.reason}; disarm first"
        if self.commander_conflict:
            return self.commander_conflict
        if refusal := self._enable_refusal(now_ns):
            return refusal
        fault = self._measurement_fault(now_ns, sample)
        if fault:
            return fault
        command = self._commands.fresh(now_ns)
        if command is not None and _largest(command.effort) > self.limits.arm_effort:
            unit = self.coordinates.drive_unit
            return (
                f"{command.source or 'a controller'} already commands {written(command.effort, '.3f')} {unit}; "
                f"expected at most {self.limits.arm_effort} {unit} while arming: deactivate the controller, arm, "
                + (
                    "bring the pendulum with a joint_trajectory to where the controller balances, then activate it"
                    if self.follows
                    else "bring the plant to where the controller balances, then activate it"
                )
            )
        return self.preflight()

    def _release(self, mode: Mode, reason: str, now_ns: int) -> None:
        self._trajectory = None
        self._handover = None
        self._applied = self._last_effort = self._nothing
        self._enter(mode, reason, now_ns)

    def _enter(self, mode: Mode, reason: str, now_ns: int) -> None:
        self._hold_position = None
        if mode is not self.mode:
            self.transitions.append((now_ns, mode, reason))
            del self.transitions[:-_KEPT_TRANSITIONS]
        self.mode = mode
        self.reason = reason


def _largest(values: Vector) -> float:
    return max(map(abs, values), default=0.0)


def _clamp(values: Vector, limits: Vector) -> Vector:
    """Return values within +-limits, 0 for NaN; the same tuple if all are inside."""
    for value, limit in zip(values, limits):  # noqa: B905  # a third faster, and the rare case below compares lengths
        if not -limit <= value <= limit:
            break
    else:
        return values
    return tuple(within(value, limit) for value, limit in zip(values, limits, strict=True))
