"""A bridge on the emulated actuator in simulated time: the bridge's own loop, turned by hand.

A controller regulates at the top (LQR under noise), or the bridge follows a ramp. What the motor does is watched at the
motor itself, which no sensor of the bridge sees.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.bridge.actuator_loop import ActuatorLoop
from pendulum_hw_bridge.bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5, LinkState
from pendulum_hw_bridge.port.actuator import HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.supervisor import Input, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.timing import LoopStatistics
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.contract.values import JointCommand

__all__ = ["MILLISECOND", "SECOND", "Rig", "SteppedLoop"]

MILLISECOND = 1_000_000
SECOND = 1_000_000_000
_K = (33.345265, 0.158993)
_NOISE = 2.5
_ANSWER_DELAY_NS = MILLISECOND
_COMMAND_LIFE_NS = 50 * MILLISECOND
_OFF_LATE_NS = (MILLISECOND, 15 * MILLISECOND)
"""Time from the setpoints of a stop to its change of strategy: a round trip, or one attempt that is lost [ns]."""
_PARAMETERS = load_emulator("thesis")


class SteppedLoop(ActuatorLoop):
    """The bridge's loop without a thread of its own, in simulated time: ``turn`` is what the thread does over and over.

    Attributes:
        answer: Called where the thread waits for answers to a state.
        outcomes: What was done, cycle by cycle.
    """

    def __init__(self, bridge: Bridge, *arguments: Any, **options: Any) -> None:
        self.answer: Callable[[], None] = lambda: None
        self.outcomes: list[Outcome] = []
        super().__init__(bridge, *arguments, **{**options, "answer_window": 0.0})

    def turn(self) -> None:
        """Run the jobs that wait, then one cycle."""
        self._run_jobs()
        self._guarded_cycle()

    def close(self) -> None:
        """Release the actuator and let it go, as the thread does on its way out."""
        self.bridge.close()

    def _start(self) -> threading.Thread:
        return threading.current_thread()

    def _pause(self) -> None:
        self._wait(round(self._period * SECOND))

    def _wait(self, duration_ns: int) -> None:
        clock = self.bridge.modules[0].port.clock  # type: ignore[attr-defined]  # the emulator's port has one
        clock.wait_until(clock.now_ns() + duration_ns)

    def _wait_for_answers(self, awaited: set[Input]) -> None:
        self.answer()
        super()._wait_for_answers(awaited)

    def _decide_and_act(self) -> Outcome:
        outcome = super()._decide_and_act()
        self.outcomes.append(outcome)
        return outcome


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

    Attributes:
        stops: When the setpoints of each stop arrived [ns].
    """

    loop: SteppedLoop
    bridge: Bridge
    supervisor: PlantSupervisor
    port: EmulatorBackend
    actuator: EmulatedX5

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
        self.clock = SteppedClock(SECOND)
        self.period = 1.0 / rate
        self.effort_limit = effort_limit
        if start is None:
            start = 0.5 if moving else UPRIGHT + 0.05
        self.random = np.random.Generator(np.random.Philox(key=[seed, 7]))
        self.controlling = self.disturbing = not moving
        self.alive = True
        self.closed = False
        self.break_cycle: Callable[[], None] = lambda: None
        self.send: Callable[[JointCommand], None] = self._send
        self.duties: list[tuple[int, float, float]] = []
        self.positions: list[float] = []
        self.asked: list[tuple[int, float]] = []
        self._last_asked = (-SECOND, 0.0)
        self._build(kind, seed, start, voltage)
        self.actuator.trace = self._watch
        self.stops: list[int] = []
        self._slow_down_stops(np.random.Generator(np.random.Philox(key=[seed, 8])))
        while self.module.feedback is None:
            self.loop.turn()
        refusal = self.arm()
        assert not refusal, refusal
        self.loop.answer = self._answer
        if moving:
            refusal = self.follow(start + 1.5 if goal is None else goal)
            assert not refusal, refusal

    def _build(self, kind: EffortStrategy, seed: int, start: float, voltage: float | None) -> None:
        """Make actuator, supervisor, bridge and loop."""
        parameters = _PARAMETERS
        drivetrain = parameters.drivetrain
        if voltage is not None:
            parameters = parameters.with_drivetrain(supply_voltage=voltage)
        effort_limit = self.effort_limit
        self.actuator = EmulatedX5(parameters, seed=seed, position=start, start_ns=self.clock.now_ns())
        self.port = EmulatorBackend(self.actuator, self.clock, seed=seed)
        limits = PlantLimits(
            effort=(effort_limit,),
            feedback_timeout=max(4.0 * self.period, 0.03),
            velocity=1.5,
            position_min=(-4.0,),
            position_max=(4.0,),
            slew=2000.0,
        )
        self.supervisor = PlantSupervisor(limits)
        self.module = DrivenModule(
            self.port,
            EffortMapping(kind, drivetrain, effort_limit=effort_limit),
            SafetyMonitor(SafetyLimits(measured_effort=effort_limit + 1.0), self.period, drivetrain),
            BridgeSettings(feedback_rate=1.0 / self.period, limits=HardwareLimits(effort=effort_limit, pwm=0.6)),
        )
        self.bridge = Bridge([self.module], self.supervisor)
        self.bridge.connect()
        self.loop = SteppedLoop(
            self.bridge,
            LoopStatistics(round(self.period * SECOND)),
            on_state=lambda sample: None,
            decide=lambda: self.supervisor.decide(self.port.now_ns(), self.bridge.sample),
            on_outcome=lambda stamp_ns, outcome: self.supervisor.report_applied(outcome.effort),
            # Commands come from `answer`: there is nothing to sleep for.
            take_inputs=lambda timeout: None,
        )

    def _slow_down_stops(self, random: np.random.Generator) -> None:
        """Let time pass between the setpoints of a stop and its change of strategy, as a network does."""
        configure = self.actuator.configure

        def later(**changes: Any) -> None:
            if changes.get("strategy") is Strategy.OFF and self.actuator.strategy is not Strategy.OFF:
                self.stops.append(self.actuator.now_ns)
                self.clock.wait_until(self.clock.now_ns() + round(random.uniform(*_OFF_LATE_NS)))
                self.actuator.advance_to(self.clock.now_ns())
            configure(**changes)

        self.actuator.configure = later  # type: ignore[method-assign]

    @property
    def outcomes(self) -> list[Outcome]:
        """What the bridge did, cycle by cycle."""
        return self.loop.outcomes

    # --- what a person does ---------------------------------------------------------------------------------

    def arm(self) -> str:
        """Arm; return why not, or an empty string."""
        return self.bridge.prepare() or self.supervisor.arm(self.port.now_ns(), self.bridge.sample)

    def disarm(self) -> None:
        """Disarm."""
        self.supervisor.disarm(self.port.now_ns())

    def e_stop(self) -> None:
        """Press the e-stop."""
        self.supervisor.e_stop(self.port.now_ns())

    def close(self) -> None:
        """End the bridge as a signal does."""
        self.bridge.close()
        self.alive, self.closed = False, True

    def follow(self, goal: float) -> str:
        """Ramp to an angle [rad]; return why not, or an empty string."""
        sample = self.bridge.sample
        assert sample is not None
        ramp = thesis_ramp(sample.position[0], goal)
        return self.supervisor.accept_trajectory(ramp, self.port.now_ns(), sample)

    # --- time -----------------------------------------------------------------------------------------------

    def run(self, duration: float) -> None:
        """Let time pass [s]; a bridge that is not alive does nothing any more, the actuator goes on."""
        end = self.clock.now_ns() + round(duration * SECOND)
        while self.clock.now_ns() < end:
            if not self.alive:
                self.clock.wait_until(end)
                self.actuator.advance_to(end)
                return
            self.loop.turn()

    def _answer(self) -> None:
        self.break_cycle()
        sample = self.bridge.sample
        assert sample is not None
        if self.controlling or self.disturbing:
            self.clock.wait_until(self.clock.now_ns() + min(_ANSWER_DELAY_NS, round(0.3e9 * self.period)))
        if self.controlling:
            effort = -_K[0] * from_upright(sample.position[0]) - _K[1] * sample.velocity[0]
            self.send(JointCommand.of_one(sample.stamp_ns, effort, "controller"))
        noise = 0.0
        if self.disturbing:
            noise = float(self.random.uniform(-_NOISE, _NOISE))
            self.disturb(JointCommand.of_one(sample.stamp_ns, noise, "disturbance"))
        now = self.port.now_ns()
        if self.controlling:
            # What a controller asks for that sees the truth, whatever the bridge tells it.
            link = self.actuator.link
            self._last_asked = now, -_K[0] * from_upright(link.position) - _K[1] * link.velocity
        if now - self._last_asked[0] <= _COMMAND_LIFE_NS:
            self.asked.append((now, self._last_asked[1] + noise))

    def _send(self, command: JointCommand) -> None:
        """Let a commander's torque reach the bridge."""
        self.supervisor.offer(Input.EFFORT_COMMAND, command, self.port.now_ns())

    def disturb(self, command: JointCommand) -> None:
        """Let a disturbance reach the bridge."""
        self.supervisor.offer(Input.DISTURBANCE, command, self.port.now_ns())

    def _watch(self, link: LinkState) -> None:
        self.duties.append((link.time_ns, link.pwm, link.motor_torque))
        self.positions.append(link.position)
