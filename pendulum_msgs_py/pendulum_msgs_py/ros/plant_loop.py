"""The two clocks of a plant: absolute deadlines of wall time, or in lockstep with those who answer its states."""

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
    """What a loop needs of a plant: go on for one period, until a given time, under a decision."""

    def __call__(self, drive: Drive, stamp_ns: int) -> tuple[JointSample | None, Vector]:
        """Return the state at the end of the period, so stamped, and the efforts that were applied on the way.

        None stands for a measurement that was lost: nothing is published, time goes on.
        """


class RealtimeLoop:
    """Steps the plant at absolute deadlines of wall time, without drift.

    Late by a period or more, the plant is stepped through the periods it missed and only the newest state is
    published: one overrun, however many periods were missed. Its runner calls :meth:`run_due`: a timer of rclpy's would
    cost two more threads' attention a period, and drop the periods it missed.

    Args:
        interface: The plant on the graph, its inputs polled.
        step: Steps the plant.
        statistics: Gets the loop's figures.
        clock: Wall time.

    Attributes:
        paused: Somebody wants the plant to wait.
        halted: The plant has no next state; it says so itself, in a step.
        compiled: Runs ordinary periods, or None.
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
        """Do what is due; return the time until the next deadline [s]."""
        now = self._clock()
        period = self._statistics.period_ns
        if self.compiled is not None and now >= self._deadline_ns and not (self.paused or self.halted):
            # Until the first deadline after it whatever else waits has its turn.
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
        # As of the deadline: a plant that catches up must not chase a setpoint of the time at which it was noticed.
        drive = interface.decide(self._deadline_ns)
        sample, applied = self._step(drive, self._deadline_ns)
        # The state first: somebody waits to answer it.
        if publish and sample is not None:
            interface.publish_state(sample)
        if before is not None:
            interface.publish_applied(before.stamp_ns, applied)


class LockstepLoop:
    """Publishes a state and steps only when every expected answer stamped with it has come; runs as fast as they do.

    The plant's time is simulated, goes out on ``/clock`` and depends on nothing but the number of steps, so that two
    runs with one seed publish the same messages.

    Args:
        interface: The plant on the graph.
        step: Steps the plant.
        period_ns: Time between two states [ns].
        inputs: Inputs that must answer.
        subscribers: Subscriptions to states that must be there before the first one.
        duration: Simulated time after which to stop [s]; 0 for never.
        publish_clock: Whether this plant owns ``/clock``.

    Attributes:
        paused: Somebody wants the plant to wait.
        halted: The plant has no next state; it says so itself, in a step.
        compiled: Runs ordinary steps, or None.
        clock_publisher: Publishes ``/clock``, or None.
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
        self._told_waiting = False
        self._told_finished = False
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
        """Return the simulated time [ns]: the loop is the plant's clock."""
        return self.now_ns

    def diagnostics(self) -> Mapping[str, object]:
        """Return what the loop waits for."""
        missing = sorted(kind.value for kind in self._inputs - self._answered)
        return {
            "lockstep_steps": self.steps,
            "lockstep_waits_for": ", ".join(missing) if self._must_wait() else "nothing",
        }

    def run_due(self) -> float:
        """Start, step where nobody has to answer, ask again where patience has ended; return when to look again [s].

        Its runner calls this after each event; answers alone make the pace where they are waited for.
        """
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
        """Take answers and step, for a time at most [s]; return whether any step was taken."""
        before, compiled = self.steps, self.compiled
        end = time.monotonic() + (longest if compiled is not None else INTERPRETED_SLICE)
        while (left := end - time.monotonic()) > 0.0 and self._must_wait() and not self.finished:
            if compiled is not None:
                steps = self.steps
                done = self._run_compiled(compiled, left)
                if done.ended:
                    # Somebody calls, and it may be some time before they have their turn: Python waits meanwhile.
                    compiled, end = None, min(end, time.monotonic() + WHILE_CALLED)
                    continue
                if self.steps > steps or done.message is not None:
                    continue
            self._interface.wait_for_inputs(min(left, INTERPRETED_SLICE))
        return self.steps > before

    def _run_compiled(self, compiled: CompiledPeriods, longest: float) -> Slice:
        """Take ordinary steps for a time at most [s], and let Python do what comes then."""
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
            # All have answered, and what they make of it is not ordinary.
            self.advance()
        return done

    def answered(self, kind: Input, command: JointCommand) -> None:
        """Take note of an accepted command; steps when it was the last one missing."""
        if self.started and command.stamp_ns == self.now_ns:
            self._answered.add(kind)
            if not self.paused and not self._must_wait():
                self.advance()

    def advance(self) -> None:
        """Take one step."""
        interface = self._interface
        sample = None
        # A measurement that was lost has nobody to answer it: the plant goes on under its last decision's rules.
        while sample is None and not self.finished and not self.halted:
            before_ns = self.now_ns
            drive = interface.decide()
            self.now_ns += self._period_ns
            sample, applied = self._step(drive, self.now_ns)
            self.steps += 1
            self.finished = self._last_ns is not None and self.now_ns >= self._last_ns
            # The state first: somebody waits to answer it.
            if sample is not None:
                self._publish(sample)
            interface.publish_applied(before_ns, applied)
        if self.finished and not self._told_finished:
            self._told_finished = True
            interface.publish_event(Event.LOCKSTEP_FINISHED, steps=self.steps)

    def step_once(self) -> None:
        """Take one step while paused."""
        if self.started:
            self.advance()

    def _note_publication(self) -> None:
        self._waiting_since = time.monotonic()
        self._told_waiting = False

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
        """Publish the state again: a match is known to one side before the other, so it may have been heard by nobody.

        Who has answered already answers the same, and the plant refuses the second copy.
        """
        sample = self._interface.sample
        assert sample is not None
        self._waiting_since = time.monotonic()
        if not self._told_waiting:
            self._told_waiting = True
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
"""Events that the executor may attend to after each slice: 80 a second at least, and a plant's timers make 51."""
_LOOK_FREE = 0.001
"""Wall time between two steps that nobody has to answer, and between two looks for those who will [s]."""
_LOOK_WAITING = 0.1
"""Wall time between two looks for answers that are overdue [s]."""
_PATIENCE = 1.0
"""Wall time without an answer after which a state is published again [s]."""
