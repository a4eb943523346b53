"""The two clocks of a plant: absolute deadlines of wall time, and lockstep with the replies to its states."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Protocol

from rosgraph_msgs.msg import Clock as ClockMessage

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_clock
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.plant_specs import LOCKSTEP_EPOCH_NS
from pendulum_msgs_py.contract.supervisor import Drive, Input, Mode
from pendulum_msgs_py.contract.timing import LoopStatistics, SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.compiled_periods import CompiledPeriods, Slice
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.turns import INTERPRETED_SLICE, WHILE_CALLED, Turns

__all__ = ["LockstepLoop", "RealtimeLoop", "Stepper"]


class Stepper(Protocol):
    """Steps a plant."""

    def __call__(self, drive: Drive, stamp_ns: int) -> tuple[JointSample | None, Vector]:
        """Step one period until a stamp [ns]; return the state (None: lost measurement) and the applied efforts."""


class RealtimeLoop:
    """Steps the plant at absolute deadlines of wall time, without drift.

    A plant that is late by a period or more is stepped through the missed periods, and only the newest state is
    published: one overrun. The runner calls :meth:`run_due`: rclpy's timer would wake two more threads per period, and
    skip missed ones.

    Attributes:
        paused: Time stands still.
        halted: The plant, in a step, reported that it has no next state.
        compiled: Runs nominal periods, or None.
    """

    def __init__(
        self, interface: PlantInterface, step: Stepper, statistics: LoopStatistics, clock: SteadyWallClock
    ) -> None:
        self._interface = interface
        self._step = step
        self._statistics = statistics
        self._clock = clock
        self._deadline_ns = clock() + statistics.period_ns
        self.paused = False
        self.halted = False
        self.compiled: CompiledPeriods | None = None

    def run_due(self) -> float:
        """Run due periods; return the time until the next deadline [s]."""
        now = self._clock()
        period = self._statistics.period_ns
        if self.compiled is not None and now >= self._deadline_ns and not (self.paused or self.halted):
            done = self.compiled.run(self._deadline_ns - period)
            self._deadline_ns = done.now_ns + period
            if done.message is not None:
                self._interface.receive(*done.message)
            now = self._clock()
        if now >= self._deadline_ns:
            self._interface.take_inputs()
            if self.paused or self.halted:
                self._deadline_ns = now
            else:
                self._run(now, period)
            self._deadline_ns += period
            now = self._clock()
        return (self._deadline_ns - now) / NANOSECONDS

    def _run(self, now: int, period: int) -> None:
        self._statistics.cycle(now, self._deadline_ns)
        while now - self._deadline_ns >= period and not self.halted:
            self._advance(publish=False)
            self._deadline_ns += period
        self._advance()

    def step_once(self) -> None:
        """Take one step while paused."""
        self._interface.take_inputs()
        self._deadline_ns = self._clock()
        self._advance()

    def _advance(self, *, publish: bool = True) -> None:
        interface = self._interface
        before = interface.sample
        # As of the deadline: a plant that catches up must not follow a later set point.
        drive = interface.decide(self._deadline_ns)
        sample, applied = self._step(drive, self._deadline_ns)
        # The state first: a controller waits for it.
        if publish and sample is not None:
            interface.publish_state(sample)
        if before is not None:
            interface.publish_applied(before.stamp_ns, applied)


class LockstepLoop:
    """Publishes a state and steps once every expected reply to it has arrived, as fast as they come.

    The plant's time is simulated and depends on the number of steps alone: two runs with one seed publish the same
    messages.

    Args:
        interface: The plant on the graph.
        step: Steps the plant.
        period_ns: Time between two states [ns].
        inputs: Inputs that must reply.
        subscribers: Subscriptions to states required before the first one.
        duration: Simulated time after which to stop [s]; 0 for never.
        publish_clock: Whether this plant owns ``/clock``.
    """

    def __init__(
        self,
        interface: PlantInterface,
        step: Stepper,
        period_ns: int,
        inputs: Sequence[Input],
        *,
        subscribers: int = 1,
        duration: float = 0.0,
        publish_clock: bool = True,
    ) -> None:
        self._interface = interface
        self._step = step
        self._period_ns = period_ns
        self._inputs = frozenset(inputs)
        self._subscribers = subscribers
        self._last_ns = LOCKSTEP_EPOCH_NS + round(duration * NANOSECONDS) if duration else None
        self._answered: set[Input] = set()
        self._waiting_since = time.monotonic()
        self._reported_waiting = False
        self._reported_finished = False
        self.now_ns = LOCKSTEP_EPOCH_NS
        self.steps = 0
        self.started = False
        self.finished = False
        self.paused = False
        self.halted = False
        self.clock_publisher = (
            interface.node.create_publisher(ClockMessage, names.CLOCK, qos.CLOCK) if publish_clock else None
        )
        self._next_look = 0.0
        self._turns = Turns(self._wait_for_answers, _EVENTS_AFTER_SLICE)
        self.compiled: CompiledPeriods | None = None
        if interface.polled:
            interface.watch_inputs()

    def __call__(self) -> int:
        """Return the simulated time [ns]."""
        return self.now_ns

    def diagnostics(self) -> Mapping[str, object]:
        """Return what the loop waits for."""
        missing = sorted(kind.value for kind in self._inputs - self._answered)
        return {
            "lockstep_steps": self.steps,
            "lockstep_waits_for": ", ".join(missing) if self._must_wait() else "nothing",
        }

    def run_due(self) -> float:
        """Start, take steps that need no reply, or repeat an overdue state; return the time until the next call [s]."""
        interface, waits = self._interface, False
        if interface.polled:
            interface.take_inputs()
            waits = self.started and self._must_wait() and not (self.paused or self.halted or self.finished)
            if waits:
                self._turns.run_due()
        now = time.monotonic()
        if now >= self._next_look:
            self._look()
            self._next_look = now + (_LOOK_WAITING if self.started and self._must_wait() else _LOOK_FREE)
        return 0.0 if waits else self._next_look - now

    def _wait_for_answers(self, longest: float) -> bool:
        before, compiled = self.steps, self.compiled
        end = time.monotonic() + (longest if compiled is not None else INTERPRETED_SLICE)
        while (left := end - time.monotonic()) > 0.0 and self._must_wait() and not self.finished:
            if compiled is not None:
                steps = self.steps
                done = self._run_compiled(compiled, left)
                if done.ended:
                    # A pending call may have to wait for its turn: Python waits meanwhile.
                    compiled, end = None, min(end, time.monotonic() + WHILE_CALLED)
                    continue
                if self.steps > steps or done.message is not None:
                    continue
            self._interface.wait_for_inputs(min(left, INTERPRETED_SLICE))
        return self.steps > before

    def _run_compiled(self, compiled: CompiledPeriods, longest: float) -> Slice:
        done = compiled.run(
            self.now_ns, longest=longest, expected=self._inputs, answered=self._answered, last_ns=self._last_ns
        )
        self.now_ns, self._answered = done.now_ns, set(done.answered)
        self.steps += done.periods
        if done.periods:
            self._note_publication()
        if done.message is not None:
            self._interface.receive(*done.message)
        elif self._inputs <= self._answered:
            # All have answered, but the step is not nominal.
            self.advance()
        return done

    def answered(self, kind: Input, command: JointCommand) -> None:
        """Record an accepted command, and step if it was the last one missing."""
        if self.started and command.stamp_ns == self.now_ns:
            self._answered.add(kind)
            if not self.paused and not self._must_wait():
                self.advance()

    def advance(self) -> None:
        """Take one step."""
        interface = self._interface
        sample = None
        # A lost measurement gets no reply: the plant steps on.
        while sample is None and not self.finished and not self.halted:
            before_ns = self.now_ns
            drive = interface.decide()
            self.now_ns += self._period_ns
            sample, applied = self._step(drive, self.now_ns)
            self.steps += 1
            self.finished = self._last_ns is not None and self.now_ns >= self._last_ns
            # The state first: a controller waits for it.
            if sample is not None:
                self._publish(sample)
            interface.publish_applied(before_ns, applied)
        if self.finished and not self._reported_finished:
            self._reported_finished = True
            interface.publish_event(Event.LOCKSTEP_FINISHED, steps=self.steps)

    def step_once(self) -> None:
        """Take one step while paused."""
        if self.started:
            self.advance()

    def _note_publication(self) -> None:
        self._waiting_since = time.monotonic()
        self._reported_waiting = False

    def _publish(self, sample: JointSample) -> None:
        self._answered.clear()
        self._note_publication()
        self._interface.publish_state(sample)
        if self.clock_publisher is not None and self.clock_publisher.get_subscription_count():
            self.clock_publisher.publish(encode_clock(self.now_ns))

    def _must_wait(self) -> bool:
        return self._interface.supervisor.mode is Mode.EFFORT and not self._inputs <= self._answered

    def _look(self) -> None:
        if self.finished or self.paused or self.halted:
            return
        if not self.started:
            self._try_start()
        elif not self._must_wait():
            self.advance()
        elif time.monotonic() - self._waiting_since > _PATIENCE:
            self._repeat()

    def _repeat(self) -> None:
        """Publish the state again: DDS may have matched too late for the first copy.

        Repeated replies are equal, and refused as duplicates.
        """
        sample = self._interface.sample
        assert sample is not None
        self._waiting_since = time.monotonic()
        if not self._reported_waiting:
            self._reported_waiting = True
            self._interface.node.get_logger().warning(
                f"waiting for {self.diagnostics()['lockstep_waits_for']} in answer to the state at "
                f"{self.now_ns / NANOSECONDS:.3f} s; publishing it again"
            )
        self._interface.publish_state(sample)

    def _try_start(self) -> None:
        interface = self._interface
        ready = interface.state_subscribers >= self._subscribers and all(
            interface.commanders(kind) > 0 for kind in self._inputs
        )
        if ready and interface.sample is not None:
            self.started = True
            self._publish(interface.sample)


_EVENTS_AFTER_SLICE = 16
"""Executor events after each slice, at least 80 a second; a plant's timers make 51."""
_LOOK_FREE = 0.001
"""Wall time between two steps without reply, and between two checks for subscribers [s]."""
_LOOK_WAITING = 0.1
"""Wall time between two checks for overdue replies [s]."""
_PATIENCE = 1.0
"""Wall time without a reply after which a state is repeated [s]."""
