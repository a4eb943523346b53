"""Every fault that the bridge must survive, in every strategy and phase, judged by what the motor did.

A fault begins at a random instant: in regulation upright, on a ramp, or while its end is held. The duty of the motor is
compared with the limit, and with what was rightfully asked for: by a controller that sees the truth and was there
before the fault. What an intruder asks for afterwards excuses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.contract.values import JointCommand
from tests.tools.faults.bridge_rig import MILLISECOND, Rig
from tests.tools.faults.node_rig import NodeRig

__all__ = ["CASES", "LIMIT", "SCENARIOS", "Case", "Phase", "Reaction", "Scenario", "run_scenario"]

LIMIT = 3.0
"""Effort limit of the bridge [N m]: noise and controller together often ask for more."""
LONGEST_MS = 60.0
"""Time within which a fault must have ended all torque [ms]."""
_INTRUDER = 9.0
_BEFORE = 0.5
_WATCH = 0.4
_REMEMBERED_NS = 70 * MILLISECOND
"""A torque may act for its command's life, and a record more [ns]."""
_ROUNDING = 0.2
"""Difference of torques that is none: rounding of the duty, noise of sensors, the swing of a held setpoint [N m]."""
_SWING = 0.15
"""What a held setpoint swings more where it compensates the damping of a velocity that changes meanwhile: 0.30 N m in
the worst of 20 seeds, without any fault of the drive [N m]."""
_LOOP_ERROR = 2.0
"""The same under the firmware's torque loop, of its mean: it overshoots where the torque asked for steps [N m]."""
_LOOP_TIME_NS = 20 * MILLISECOND
_STEP = 0.01
"""Torque of a step of the duty [N m]."""
_NO_TORQUE = 1e-3
"""Torque below which a motor is not driven, whatever its duty: a broken phase carries no current [N m]."""
_UNSEEN_MOTION = 0.03
"""How far the link may turn behind a stuck encoder before torque ends [rad]: while it rests, nothing can tell."""


class Phase(str, Enum):
    """What goes on when the fault begins."""

    REGULATION = "regulation"
    RAMP = "ramp"
    HOLD = "hold"


_POSITION = (Phase.RAMP, Phase.HOLD)


@dataclass(frozen=True)
class Case:
    """A column of the table.

    Attributes:
        name: What stands above it.
        phase: What goes on.
        kinds: Ways to make a torque, tried in turn: under position control the firmware's loops do, in all of them.
    """

    name: str
    phase: Phase
    kinds: tuple[EffortStrategy, ...]


CASES: tuple[Case, ...] = (
    *(Case(f"regulation, {kind.value}", Phase.REGULATION, (kind,)) for kind in EffortStrategy),
    *(Case(f"{phase.value}, position control", phase, tuple(EffortStrategy)) for phase in _POSITION),
)


@dataclass(frozen=True)
class Scenario:
    """One fault.

    Attributes:
        name: Name of the fault.
        begin: Lets it begin.
        expected: Names of the bridge's faults, or other reactions, of which one must be seen: ``starved``,
            ``goes on``, ``lifetime``, ``closed``, a state.
        phases: Where it is tried.
        zero: Whether torque must go to zero; else the plant goes on as if nothing were.
        own_torque: The module itself makes torque that nobody asked for, until it is switched off.
        unseen: Time counts from the first torque that was not asked for: a duty that is stuck where it should be
            anyway shows nothing.
        by_motion: Torque need not end in time, but before the link has turned further than nobody can see.
    """

    name: str
    begin: Callable[[Rig], None]
    expected: tuple[str, ...]
    phases: tuple[Phase, ...] = tuple(Phase)
    zero: bool = True
    own_torque: bool = False
    unseen: bool = False
    by_motion: bool = False


@dataclass(frozen=True)
class Reaction:
    """What a scenario came to.

    Attributes:
        reaction: The bridge's fault or other reaction, as it was.
        mode: State of the plant afterwards.
        time_to_zero_ms: From the beginning of the fault to the last instant with a duty on the motor [ms].
        after_excess_ms: The same from the first torque after it that was not asked for [ms].
        beyond_limit: Largest torque of the motor above the effort limit [N m].
        beyond_asked: Largest torque of the motor beyond what was rightfully asked for [N m].
        stays_zero: Whether the torque stayed zero to the end.
        turned: How far the link turned while there was torque [rad].
        beyond_stop: Largest torque of the motor after a stop beyond that before it [N m].
    """

    reaction: str
    mode: str
    time_to_zero_ms: float
    after_excess_ms: float
    beyond_limit: float
    beyond_asked: float
    stays_zero: bool
    turned: float
    beyond_stop: float

    def complaints(self, scenario: Scenario) -> list[str]:
        """Return a sentence for each thing that must hold and did not."""
        found = []
        if self.reaction not in scenario.expected:
            found.append(f"reaction is {self.reaction}; expected {' or '.join(scenario.expected)}")
        if scenario.by_motion and self.turned > _UNSEEN_MOTION:
            found.append(f"link turned by {self.turned:.3f} rad; expected at most {_UNSEEN_MOTION:g} rad")
        lasts = self.after_excess_ms if scenario.unseen else self.time_to_zero_ms
        if scenario.zero and not scenario.by_motion and not (self.stays_zero and lasts <= LONGEST_MS):
            found.append(f"torque for {lasts:.1f} ms; expected at most {LONGEST_MS:g} ms, and then none")
        # Behind a stuck encoder even the rightful controller does not see what to ask for.
        if not (scenario.own_torque or scenario.by_motion):
            for what, torque in (
                ("the limit", self.beyond_limit),
                ("what was asked for", self.beyond_asked),
                ("the torque before the stop", self.beyond_stop),
            ):
                if torque > 0.0:
                    found.append(f"{torque:.2f} N m beyond {what}")
        return found


# --- the faults ----------------------------------------------------------------------------------------------------


def _inject(fault: ActuatorFault) -> Callable[[Rig], None]:
    return lambda rig: rig.actuator.inject(fault)


def _lose_controller(rig: Rig) -> None:
    rig.controlling = False


def _lose_controller_and_disturbance(rig: Rig) -> None:
    rig.controlling = rig.disturbing = False


def _lose_disturbance(rig: Rig) -> None:
    rig.disturbing = False


def _kill(rig: Rig) -> None:
    rig.alive = False


def _close(rig: Rig) -> None:
    rig.close()


def _raise(rig: Rig) -> None:
    def fail() -> None:
        raise RuntimeError("a bug in a callback")

    rig.break_cycle = fail


def _stall(rig: Rig) -> None:
    rig.clock.wait_until(rig.clock.now_ns() + 100 * MILLISECOND)


def _freeze_stamps(rig: Rig) -> None:
    stamp = rig.bridge.sample.stamp_ns if rig.bridge.sample else 0
    offer = rig._send
    rig.send = lambda command: offer(JointCommand(stamp, command.effort, command.source))


def _not_a_number(rig: Rig) -> None:
    offer = rig._send
    rig.send = lambda command: offer(JointCommand.of_one(command.stamp_ns, math.nan, command.source))


def _second_commander(rig: Rig) -> None:
    """Let an intruder ask for more than the limit in each cycle, after the controller and where there is none."""
    offer, interrupt = rig._send, rig.break_cycle

    def intrude(stamp_ns: int) -> None:
        offer(JointCommand.of_one(stamp_ns, _INTRUDER, "intruder"))

    def both(command: JointCommand) -> None:
        offer(command)
        intrude(command.stamp_ns + 1)

    def alone() -> None:
        interrupt()
        if not rig.controlling and rig.bridge.sample is not None:
            intrude(rig.bridge.sample.stamp_ns)

    rig.send, rig.break_cycle = both, alone


def _twin_commanders(rig: Rig) -> None:
    """Let two nodes of one name answer each state in two ways."""
    assert isinstance(rig, NodeRig)
    rig.add_twin()
    offer = rig._send

    def twice(command: JointCommand) -> None:
        offer(command)
        offer(JointCommand.of_one(command.stamp_ns, -_INTRUDER, command.source))

    rig.send = twice


_F = ActuatorFault
_REGULATION = (Phase.REGULATION,)
_STUCK = ("command_not_in_force", "output_disagreement", "motor_effort", "effort_measured")
SCENARIOS: tuple[Scenario, ...] = (
    Scenario("feedback lost", _inject(_F.FEEDBACK_LOST), ("feedback_lost",)),
    Scenario("feedback frozen", _inject(_F.FEEDBACK_FROZEN), ("feedback_frozen",)),
    Scenario("feedback at a tenth of its rate", _inject(_F.FEEDBACK_SLOW), ("feedback_lost",)),
    Scenario("feedback late by 80 ms", _inject(_F.FEEDBACK_LATE), ("feedback_late",)),
    Scenario("position not a number", _inject(_F.POSITION_NAN), ("feedback_not_finite",)),
    Scenario("velocity not a number", _inject(_F.VELOCITY_NAN), ("feedback_not_finite",)),
    Scenario("effort not a number", _inject(_F.EFFORT_NAN), ("feedback_not_finite",)),
    Scenario("output encoder frozen", _inject(_F.POSITION_FROZEN), ("motion_disagreement", "goes on"), by_motion=True),
    Scenario("output encoder slips", _inject(_F.POSITION_JUMP), ("position_jump",)),
    Scenario("velocity reads 5 rad/s", _inject(_F.VELOCITY_SPIKE), ("motion_disagreement",)),
    # The emulated link turns by its velocity alone, which its position may contradict before the limit is looked at.
    Scenario("link turns too fast", _inject(_F.OVERSPEED), ("supervisor", "motion_disagreement")),
    Scenario("position outside its window", _inject(_F.OUTSIDE_WINDOW), ("position_jump",)),
    Scenario("effort sensor slips", _inject(_F.EFFORT_OFFSET), ("effort_measured",)),
    Scenario("output stage stuck", _inject(_F.PWM_STUCK), _STUCK, own_torque=True, unseen=True),
    Scenario("output stage runs away", _inject(_F.PWM_RUNAWAY), (*_STUCK, "supervisor"), own_torque=True),
    Scenario("motor phase broken", _inject(_F.WINDING_OPEN), ("winding_current",)),
    Scenario("commands lost on the way", _inject(_F.COMMANDS_LOST), ("command_not_in_force", "output_disagreement")),
    Scenario("command cannot be sent", _inject(_F.SEND_FAILED), ("send_failed",)),
    Scenario("module held by another sender", _inject(_F.LOCKED_BY_OTHER), ("locked_by_other",)),
    Scenario("module changes its strategy", _inject(_F.STRATEGY_CHANGED), _STUCK, own_torque=True),
    Scenario("module forgets its gains", _inject(_F.GAINS_LOST), ("output_disagreement",), _POSITION),
    Scenario("module restarts", _inject(_F.MODULE_REBOOT), ("module_restarted",)),
    Scenario("motion stop pressed", _inject(_F.M_STOP), ("m_stop",)),
    Scenario("motor too hot for the firmware", _inject(_F.OVER_TEMPERATURE_MOTOR), ("over_temperature",)),
    Scenario("board too hot for the firmware", _inject(_F.OVER_TEMPERATURE_BOARD), ("over_temperature",)),
    Scenario("firmware limits by temperature", _inject(_F.TEMPERATURE_CRITICAL), ("over_temperature",)),
    Scenario("winding above its limit", _inject(_F.WINDING_HOT), ("over_temperature",)),
    Scenario("supply sags to 18 V", _inject(_F.VOLTAGE_LOW), ("voltage",)),
    Scenario("supply rises to 52 V", _inject(_F.VOLTAGE_HIGH), ("voltage",), own_torque=True),
    Scenario("firmware's position limit", _inject(_F.POSITION_LIMIT), ("firmware_limit",)),
    Scenario("firmware's velocity limit", _inject(_F.VELOCITY_LIMIT), ("firmware_limit",)),
    Scenario("firmware's effort limit", _inject(_F.EFFORT_LIMIT), ("firmware_limit",)),
    Scenario("this computer stands still for 100 ms", _stall, ("host_stalled",)),
    Scenario("exception in the cycle", _raise, ("exception",)),
    Scenario("e-stop", Rig.e_stop, ("e_stop",)),
    Scenario("disarmed while driving", Rig.disarm, ("disarmed",)),
    Scenario("bridge ends (SIGINT, SIGTERM)", _close, ("closed",)),
    Scenario("bridge killed (SIGKILL)", _kill, ("lifetime",)),
    Scenario("controller lost", _lose_controller, ("starved",), _REGULATION),
    Scenario("controller and disturbance lost", _lose_controller_and_disturbance, ("starved",), _REGULATION),
    Scenario("disturbance lost", _lose_disturbance, ("goes on",), _REGULATION, zero=False),
    Scenario("command not a number", _not_a_number, ("starved",), _REGULATION),
    Scenario("controller repeats an old answer", _freeze_stamps, ("starved",), _REGULATION),
    Scenario("two commanders of one name", _twin_commanders, ("starved",), _REGULATION),
    Scenario("second commander asks for 9 N m", _second_commander, ("goes on",), zero=False),
)
"""All faults, in the order of the table."""


# --- trying one ----------------------------------------------------------------------------------------------------


def run_scenario(scenario: Scenario, case: Case, repetition: int) -> Reaction:
    """Run one scenario once and return what happened; needs :func:`tests.tools.faults.node_rig.ros_of_its_own`.

    Args:
        scenario: Which.
        case: In what strategy and phase.
        repetition: Seeds noise, timing and the instant of the fault.
    """
    rig = _begin(case, repetition)
    try:
        # Feedback and physics stand at the last event; the fault begins between two cycles, wherever that is.
        rig.actuator.advance_to(rig.clock.now_ns())
        begin_ns = rig.actuator.now_ns
        expiries = rig.actuator.lifetime_expiries
        scenario.begin(rig)
        rig.run(_WATCH)
        rig.actuator.advance_to(rig.clock.now_ns())
        after = [
            (time, position)
            for (time, duty, torque), position in zip(rig.duties, rig.positions, strict=True)
            if time > begin_ns and duty != 0.0 and abs(torque) > _NO_TORQUE
        ]
        driven = [time for time, _ in after]
        torques = _torques(rig)
        excesses = _excesses(rig, torques, begin_ns)
        first = min((time for time, excess in excesses if time > begin_ns and excess > 0.0), default=math.inf)
        return Reaction(
            _reaction(rig, expiries),
            rig.supervisor.mode.value,
            (max(driven) - begin_ns) / MILLISECOND if driven else 0.0,
            max(0.0, (max(driven) - first) / MILLISECOND) if driven else 0.0,
            max(0.0, max(abs(torque) for _, torque in torques) - LIMIT - _ROUNDING),
            max([0.0, *(excess for _, excess in excesses)]),
            not any(time > begin_ns + 200 * MILLISECOND for time in driven),
            max((abs(position - after[0][1]) for _, position in after), default=0.0),
            _beyond_stop(torques, [stop_ns for stop_ns in rig.stops if stop_ns > begin_ns]),
        )
    finally:
        rig.end()


def _begin(case: Case, repetition: int) -> NodeRig:
    """Return a rig in a phase, its motor watched for half a second."""
    kind = case.kinds[repetition % len(case.kinds)]
    seed = 1000 + repetition
    if case.phase is Phase.REGULATION:
        rig = NodeRig(seed, kind=kind, effort_limit=LIMIT)
    else:
        rig = NodeRig(seed, kind=kind, effort_limit=LIMIT, moving=True, goal=0.65 if case.phase is Phase.HOLD else None)
    rig.actuator.trace = None
    rig.run(1.5 if case.phase is Phase.HOLD else 0.3)
    rig.actuator.trace = rig._watch
    rig.run(_BEFORE + float(rig.random.uniform(0.0, 0.05)))
    expected = Mode.EFFORT if case.phase is Phase.REGULATION else Mode.POSITION
    assert rig.supervisor.mode is expected, f"{case.name}: {rig.supervisor.reason}"
    assert rig.supervisor.trajectory_finished is (case.phase is Phase.HOLD)
    return rig


def _torques(rig: Rig) -> list[tuple[int, float]]:
    """Return time and torque with which the motor drove, at its speed and at standstill alike [ns, N m].

    A motor that is turned brakes, whatever its duty: that torque is the turner's.
    """
    drive = rig.actuator.parameters.drivetrain
    per_duty = rig.actuator.voltage * drive.gear_ratio * drive.torque_constant / drive.winding_resistance
    return [
        (time, math.copysign(min(abs(duty) * per_duty, abs(torque)), duty) if duty * torque > 0.0 else 0.0)
        for time, duty, torque in rig.duties
    ]


def _beyond_stop(torques: Sequence[tuple[int, float]], stops: Sequence[int]) -> float:
    """Return by how much the torque after the first stop exceeds that in the cycle before it [N m]."""
    if not stops:
        return 0.0
    # The firmware's cycle in which the setpoints arrive is still one of before.
    end_ns = stops[0] + MILLISECOND
    before = [abs(torque) for time, torque in torques if end_ns - 11 * MILLISECOND < time <= end_ns]
    after = [abs(torque) for time, torque in torques if time > end_ns]
    excess = max(after, default=0.0) - max(before, default=0.0)
    return excess if excess > _STEP else 0.0


def _excesses(rig: Rig, torques: Sequence[tuple[int, float]], begin_ns: int) -> list[tuple[int, float]]:
    """Return by how much the motor's torque was outside of what was rightfully asked for just before [ns, N m].

    Under position control nobody asks for a torque: there the largest one before the fault counts, and what gravity
    adds on the way.
    """
    if not rig.asked:
        before = max(abs(torque) for time, torque in torques if time <= begin_ns)
        allowed = before + rig.actuator.parameters.plant.gravity * 0.5 * _WATCH + _ROUNDING
        return [(time, abs(torque) - allowed) for time, torque in torques]
    tolerance = _ROUNDING
    if rig.module.mapping.kind is EffortStrategy.EFFORT_LOOP:
        torques, tolerance = _means(torques), _LOOP_ERROR
    elif rig.module.mapping.kind is EffortStrategy.DIRECT_PWM_COMPENSATED:
        tolerance += _SWING
    excesses, first = [], 0
    for time, torque in torques:
        while first < len(rig.asked) and rig.asked[first][0] < time - _REMEMBERED_NS:
            first += 1
        recent = [0.0]
        for when, asked in rig.asked[first:]:
            if when > time:
                break
            recent.append(min(LIMIT, max(-LIMIT, asked)))
        excesses.append((time, max(torque - max(recent), min(recent) - torque) - tolerance))
    return excesses


def _means(torques: Sequence[tuple[int, float]]) -> list[tuple[int, float]]:
    """Return the mean of each torque and those shortly before [ns, N m]."""
    means: list[tuple[int, float]] = []
    first, total = 0, 0.0
    for time, torque in torques:
        total += torque
        while torques[first][0] < time - _LOOP_TIME_NS:
            total -= torques[first][1]
            first += 1
        means.append((time, total / (len(means) + 1 - first)))
    return means


def _reaction(rig: Rig, expiries: int) -> str:
    mode = rig.supervisor.mode
    if not rig.alive:
        if rig.closed:
            assert rig.actuator.strategy is Strategy.OFF
            return "closed"
        return "lifetime" if rig.actuator.lifetime_expiries > expiries else "none"
    if mode is Mode.FAULT:
        return rig.bridge.last_fault or "none"
    if mode is Mode.POSITION:
        return "goes on"
    if mode is Mode.EFFORT:
        starved = rig.supervisor.decide(rig.port.now_ns(), rig.bridge.sample).starved
        return "starved" if starved else "goes on"
    assert rig.actuator.strategy is Strategy.OFF
    return mode.value
