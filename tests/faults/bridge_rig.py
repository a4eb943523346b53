"""A bridge on the emulated actuator in simulated time, and every fault that it must survive.

Each scenario starts in regulation at the top (LQR under noise) or on a ramp under position control, lets one fault
begin at a random instant, and watches the duty at the motor itself, which no sensor of the bridge sees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pendulum_hw_bridge.actuator import HardwareLimits, Strategy
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.clocks import SteppedClock
from pendulum_hw_bridge.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5, LinkState
from pendulum_hw_bridge.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.settings import BridgeSettings
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.contract.values import JointCommand

__all__ = ["SCENARIOS", "Reaction", "Rig", "Scenario", "run_scenario"]

MILLISECOND = 1_000_000
SECOND = 1_000_000_000
_K = (33.345265, 0.158993)
_NOISE = 2.5
_WARM_UP = 0.4
_WATCH = 0.4
_ANSWER_DELAY_NS = MILLISECOND


class Rig:
    """Bridge, emulated actuator, controller and disturbance, in one loop of simulated time.

    Args:
        seed: Of sensors, timing and noise.
        moving: Start on a ramp under position control instead of in regulation.
        rate: Feedback rate [Hz].
        kind: How a torque is made.
        effort_limit: [N m].
        voltage: Supply of the emulated actuator; None for the plant file's, which the bridge assumes at first [V].
        start: Angle at the start [rad]; by default close to upright, or 0.5 on a ramp.
        goal: End of the ramp [rad]; by default 1.5 rad further.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        moving: bool = False,
        rate: float = 100.0,
        kind: EffortStrategy = EffortStrategy.DIRECT_PWM,
        effort_limit: float = 13.0,
        voltage: float | None = None,
        start: float | None = None,
        goal: float | None = None,
    ) -> None:
        parameters = load_emulator("thesis")
        drivetrain = parameters.drivetrain
        if voltage is not None:
            parameters = parameters.with_drivetrain(supply_voltage=voltage)
        self.clock = SteppedClock(SECOND)
        if start is None:
            start = 0.5 if moving else UPRIGHT + 0.05
        self.actuator = EmulatedX5(parameters, seed=seed, position=start, start_ns=self.clock.now_ns())
        self.port = EmulatorBackend(self.actuator, self.clock, seed=seed)
        self.period = 1.0 / rate
        limits = PlantLimits(
            effort=effort_limit,
            feedback_timeout=max(4.0 * self.period, 0.03),
            velocity=1.5,
            position_min=-4.0,
            position_max=4.0,
            slew=2000.0,
        )
        self.supervisor = PlantSupervisor(limits)
        self.bridge = Bridge(
            self.port,
            self.supervisor,
            EffortMapping(kind, drivetrain, effort_limit=effort_limit),
            SafetyMonitor(SafetyLimits(measured_effort=effort_limit + 1.0), self.period, drivetrain),
            BridgeSettings(feedback_rate=rate, limits=HardwareLimits(effort=effort_limit, pwm=0.6)),
        )
        self.random = np.random.Generator(np.random.Philox(key=[seed, 7]))
        self.controlling = self.disturbing = not moving
        self.alive = True
        self.closed = False
        self.break_cycle: Callable[[], None] = lambda: None
        self.send: Callable[[JointCommand], None] = self._send
        self.duties: list[tuple[int, float, float]] = []
        self.largest_commanded = 0.0
        self.outcomes: list[Outcome] = []
        self.actuator.trace = self._watch
        self.bridge.connect()
        while self.bridge.observe(0.5 * self.period) is None:
            pass
        assert not self.bridge.prepare()
        assert not self.supervisor.arm(self.port.now_ns(), self.bridge.sample)
        if moving:
            assert not self.follow(start + 1.5 if goal is None else goal)

    def follow(self, goal: float) -> str:
        """Ramp to an angle [rad]; return why not, or an empty string."""
        sample = self.bridge.sample
        assert sample is not None
        ramp = thesis_ramp(sample.position, goal)
        return self.supervisor.accept_trajectory(ramp, self.port.now_ns(), sample)

    def run(self, duration: float) -> None:
        """Let time pass [s]; a bridge that is not alive does nothing any more, the actuator goes on."""
        end = self.clock.now_ns() + round(duration * SECOND)
        while self.clock.now_ns() < end:
            if not self.alive:
                self.clock.wait_until(end)
                self.actuator.advance_to(end)
                return
            self._cycle()

    def _cycle(self) -> None:
        """One turn of the actuator's thread, with its guard around it."""
        try:
            feedback = self.bridge.observe(0.005)
            armed = self.supervisor.mode.armed
            if feedback is None:
                drive = self._decide()
                if drive.kind is DriveKind.OFF or drive.starved:
                    self.bridge.carry_out(drive, was_armed=armed)
                return
            self.break_cycle()
            self._answer()
            outcome = self.bridge.carry_out(self._decide(), was_armed=armed)
            self.largest_commanded = max(self.largest_commanded, abs(outcome.effort))
            self.outcomes.append(outcome)
            self.supervisor.report_applied(outcome.effort)
        except Exception as error:  # noqa: BLE001
            self.bridge.fail("exception", str(error))
            self.bridge.release()
            self.clock.wait_until(self.clock.now_ns() + round(self.period * SECOND))

    def _decide(self) -> Drive:
        return self.supervisor.decide(self.port.now_ns(), self.bridge.sample)

    def _answer(self) -> None:
        sample = self.bridge.sample
        assert sample is not None
        if self.controlling or self.disturbing:
            self.clock.wait_until(self.clock.now_ns() + min(_ANSWER_DELAY_NS, round(0.3e9 * self.period)))
        if self.controlling:
            effort = -_K[0] * from_upright(sample.position) - _K[1] * sample.velocity
            self.send(JointCommand(sample.stamp_ns, effort, "controller"))
        if self.disturbing:
            noise = float(self.random.uniform(-_NOISE, _NOISE))
            command = JointCommand(sample.stamp_ns, noise, "disturbance")
            self.supervisor.offer(Input.DISTURBANCE, command, self.port.now_ns())

    def _send(self, command: JointCommand) -> None:
        self.supervisor.offer(Input.EFFORT_COMMAND, command, self.port.now_ns())

    def _watch(self, link: LinkState) -> None:
        self.duties.append((link.time_ns, link.pwm, link.motor_torque))


@dataclass(frozen=True)
class Scenario:
    """One fault.

    Attributes:
        name: Name of the fault.
        begin: Lets it begin.
        expected: Name of the bridge's fault, or of another reaction: ``starved``, ``refused``, ``off``, ``lifetime``.
        moving: Takes place on a ramp under position control.
        zero: Whether torque must go to zero; else regulation goes on.
        own_torque: The module itself makes torque that nobody asked for, until it is switched off.
    """

    name: str
    begin: Callable[[Rig], None]
    expected: str
    moving: bool = False
    zero: bool = True
    own_torque: bool = False


@dataclass(frozen=True)
class Reaction:
    """What a scenario came to.

    Attributes:
        name: Fault.
        reaction: The bridge's fault or other reaction, as it was.
        mode: State of the plant afterwards.
        time_to_zero_ms: From the beginning of the fault to the last instant with a duty on the motor [ms].
        uncommanded: Largest duty beyond what was commanded, in equivalent torque [N m].
        stays_zero: Whether the duty stayed zero to the end.
    """

    name: str
    reaction: str
    mode: str
    time_to_zero_ms: float
    uncommanded: float
    stays_zero: bool


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
    rig.bridge.close()
    rig.alive = False
    rig.closed = True


def _raise(rig: Rig) -> None:
    def fail() -> None:
        raise RuntimeError("a bug in a callback")

    rig.break_cycle = fail


def _freeze_stamps(rig: Rig) -> None:
    stamp = rig.bridge.sample.stamp_ns if rig.bridge.sample else 0
    offer = rig._send
    rig.send = lambda command: offer(JointCommand(stamp, command.effort, command.source))


def _not_a_number(rig: Rig) -> None:
    offer = rig._send
    rig.send = lambda command: offer(JointCommand(command.stamp_ns, math.nan, command.source))


def _second_commander(rig: Rig) -> None:
    offer = rig._send

    def both(command: JointCommand) -> None:
        offer(command)
        offer(JointCommand(command.stamp_ns + 1, 9.0, "intruder"))

    rig.send = both


def _twin_commanders(rig: Rig) -> None:
    rig.supervisor.set_commander_conflict("2 commanders named /controller; expected one: zero torque")


def _press_e_stop(rig: Rig) -> None:
    rig.supervisor.e_stop(rig.port.now_ns())


def _disarm(rig: Rig) -> None:
    rig.supervisor.disarm(rig.port.now_ns())


_F = ActuatorFault
SCENARIOS: tuple[Scenario, ...] = (
    Scenario("feedback lost", _inject(_F.FEEDBACK_LOST), "feedback_lost"),
    Scenario("feedback frozen", _inject(_F.FEEDBACK_FROZEN), "feedback_frozen"),
    Scenario("feedback at a tenth of its rate", _inject(_F.FEEDBACK_SLOW), "feedback_lost"),
    Scenario("feedback late by 80 ms", _inject(_F.FEEDBACK_LATE), "feedback_lost"),
    Scenario("position not a number", _inject(_F.POSITION_NAN), "feedback_not_finite"),
    Scenario("velocity not a number", _inject(_F.VELOCITY_NAN), "feedback_not_finite"),
    Scenario("effort not a number", _inject(_F.EFFORT_NAN), "feedback_not_finite"),
    Scenario("output encoder frozen", _inject(_F.POSITION_FROZEN), "motion_disagreement", moving=True),
    Scenario("output encoder slips", _inject(_F.POSITION_JUMP), "position_jump"),
    Scenario("velocity reads 5 rad/s", _inject(_F.VELOCITY_SPIKE), "motion_disagreement"),
    Scenario("link turns too fast", _inject(_F.OVERSPEED), "supervisor"),
    Scenario("position outside its window", _inject(_F.OUTSIDE_WINDOW), "position_jump"),
    Scenario("effort sensor slips", _inject(_F.EFFORT_OFFSET), "effort_measured"),
    Scenario("output stage stuck", _inject(_F.PWM_STUCK), "command_not_in_force"),
    Scenario("motor phase broken", _inject(_F.WINDING_OPEN), "winding_current", moving=True),
    Scenario("commands lost on the way", _inject(_F.COMMANDS_LOST), "command_not_in_force"),
    Scenario("command cannot be sent", _inject(_F.SEND_FAILED), "send_failed"),
    Scenario("module held by another sender", _inject(_F.LOCKED_BY_OTHER), "locked_by_other"),
    Scenario("module changes its strategy", _inject(_F.STRATEGY_CHANGED), "command_not_in_force", own_torque=True),
    Scenario("module restarts", _inject(_F.MODULE_REBOOT), "module_restarted"),
    Scenario("motion stop pressed", _inject(_F.M_STOP), "m_stop"),
    Scenario("motor too hot for the firmware", _inject(_F.OVER_TEMPERATURE_MOTOR), "over_temperature"),
    Scenario("board too hot for the firmware", _inject(_F.OVER_TEMPERATURE_BOARD), "over_temperature"),
    Scenario("firmware limits by temperature", _inject(_F.TEMPERATURE_CRITICAL), "over_temperature"),
    Scenario("winding above its limit", _inject(_F.WINDING_HOT), "over_temperature"),
    Scenario("supply sags to 18 V", _inject(_F.VOLTAGE_LOW), "voltage"),
    Scenario("supply rises to 52 V", _inject(_F.VOLTAGE_HIGH), "voltage"),
    Scenario("firmware's position limit", _inject(_F.POSITION_LIMIT), "firmware_limit"),
    Scenario("firmware's velocity limit", _inject(_F.VELOCITY_LIMIT), "firmware_limit"),
    Scenario("firmware's effort limit", _inject(_F.EFFORT_LIMIT), "firmware_limit"),
    Scenario("controller lost", _lose_controller, "starved"),
    Scenario("controller and disturbance lost", _lose_controller_and_disturbance, "starved"),
    Scenario("disturbance lost", _lose_disturbance, "goes on", zero=False),
    Scenario("command not a number", _not_a_number, "starved"),
    Scenario("controller repeats an old answer", _freeze_stamps, "starved"),
    Scenario("second commander", _second_commander, "goes on", zero=False),
    Scenario("two commanders of one name", _twin_commanders, "starved"),
    Scenario("e-stop", _press_e_stop, "e_stop"),
    Scenario("disarmed while driving", _disarm, "disarmed"),
    Scenario("exception in the cycle", _raise, "exception"),
    Scenario("bridge ends (SIGINT, SIGTERM)", _close, "closed"),
    Scenario("bridge killed (SIGKILL)", _kill, "lifetime"),
    Scenario("bridge killed on a ramp", _kill, "lifetime", moving=True),
    Scenario("feedback lost on a ramp", _inject(_F.FEEDBACK_LOST), "feedback_lost", moving=True),
    Scenario("motion stop pressed on a ramp", _inject(_F.M_STOP), "m_stop", moving=True),
)
"""All faults, in the order of the table."""


def run_scenario(scenario: Scenario, repetition: int) -> Reaction:
    """Run one scenario once and return what happened.

    Args:
        scenario: Which.
        repetition: Seeds noise, timing and the instant of the fault.
    """
    rig = Rig(seed=1000 + repetition, moving=scenario.moving)
    if scenario.moving:
        rig.run(2.0)
    rig.run(_WARM_UP + float(rig.random.uniform(0.0, 0.05)))
    # Feedback and physics stand at the last event; the fault begins between two cycles, wherever that is.
    begin_ns = rig.actuator.now_ns
    commanded = rig.largest_commanded * rig.bridge.mapping.pwm_per_torque()
    before = max((abs(duty) for _, duty, _ in rig.duties), default=0.0)
    expiries = rig.actuator.lifetime_expiries
    scenario.begin(rig)
    rig.run(_WATCH)
    rig.actuator.advance_to(rig.clock.now_ns())
    after = [(time, duty) for time, duty, _ in rig.duties if time > begin_ns]
    driven = [time for time, duty in after if duty != 0.0]
    tail = [duty for time, duty in after if time > begin_ns + 200 * MILLISECOND]
    # On a ramp the firmware's own position loop makes the duty: what it does to hold the ramp was commanded.
    ceiling = (
        1.0 if scenario.moving else max(before, rig.largest_commanded * rig.bridge.mapping.pwm_per_torque(), commanded)
    )
    excess = max((abs(duty) for _, duty in after), default=0.0) - ceiling - 3e-4
    return Reaction(
        scenario.name,
        _reaction(rig, expiries),
        rig.supervisor.mode.value,
        (max(driven) - begin_ns) / MILLISECOND if driven else 0.0,
        max(0.0, excess) / rig.bridge.mapping.pwm_per_torque(),
        not any(tail),
    )


def _reaction(rig: Rig, expiries: int) -> str:
    mode = rig.supervisor.mode
    if not rig.alive:
        if rig.closed:
            assert rig.actuator.strategy is Strategy.OFF
            return "closed"
        return "lifetime" if rig.actuator.lifetime_expiries > expiries else "none"
    if mode is Mode.FAULT:
        return next(iter(rig.bridge.faults), "none")
    if mode is Mode.EFFORT:
        starved = rig.supervisor.decide(rig.port.now_ns(), rig.bridge.sample).starved
        return "starved" if starved else "goes on"
    assert rig.actuator.strategy is Strategy.OFF
    return mode.value
