"""Thread that owns the actuator: one cycle per feedback record, with jobs from other threads in between.

HEBI's library needs all calls of a group in one thread, and slow ROS callbacks must not delay reactions to feedback.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any, TypeVar

from pendulum_hw_bridge.bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.port.actuator import ActuatorError, Feedback
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input
from pendulum_msgs_py.contract.timing import LoopStatistics
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample

__all__ = ["ActuatorLoop"]

_T = TypeVar("_T")
_PATIENCE = 0.005
"""Longest wait for feedback before commands and silence are checked again [s]."""
_IDLE = 0.1
_JOIN = 5.0


class ActuatorLoop:
    """Runs a bridge's cycles in a thread of its own.

    Args:
        bridge: Bridge and actuator; only this thread uses the actuator.
        statistics: Receives the loop's timing.
        on_state: Called with each new sample.
        decide: Returns the decision for now.
        on_outcome: Called with the stamp of the state [ns] and the outcome.
        on_records: Called with the feedback record of each module after its cycle, off the critical path; after an
            error, when the drive is off already.
        take_inputs: Passes received torques to :meth:`answered`, waiting at most the given time [s] for one.
        answer_window: Share of the period to wait for commands for a state before acting [-].
        report: Called with the text of an error that ended a cycle.
    """

    def __init__(
        self,
        bridge: Bridge,
        statistics: LoopStatistics,
        *,
        on_state: Callable[[JointSample], None],
        decide: Callable[[], Drive],
        on_outcome: Callable[[int, Outcome], None],
        on_records: Callable[[tuple[Feedback, ...]], None] = lambda records: None,
        take_inputs: Callable[[float], None] = time.sleep,
        answer_window: float = 0.3,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.bridge = bridge
        self.statistics = statistics
        self.active = False
        self._on_state = on_state
        self._decide = decide
        self._on_outcome = on_outcome
        self._on_records = on_records
        self._period = statistics.period_ns / NANOSECONDS
        self._take_inputs = take_inputs
        self._window = answer_window * self._period
        self._report = report
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._answered: set[Input] = set()
        self._state_ns = 0
        self._unpublished: tuple[Feedback, ...] = ()
        self._closing = threading.Event()
        self._job_waiting = threading.Event()
        self._last_state_ns: int | None = None
        self._thread = self._start()

    def call(self, job: Callable[[], _T], timeout: float = 5.0) -> _T:
        """Run a job in the actuator's thread and return its result, waiting at most ``timeout`` [s].

        Raises:
            ActuatorError: The job did not end in time, or the thread has ended.
        """
        if threading.current_thread() is self._thread:
            return job()
        future: Future[_T] = Future()
        self._jobs.put((job, future))
        self._job_waiting.set()
        if not self._thread.is_alive():
            raise ActuatorError("exception", "actuator thread has ended; restart the bridge")
        try:
            return future.result(timeout)
        except FutureTimeoutError:
            future.cancel()
            raise ActuatorError("exception", f"actuator thread did not answer within {timeout:g} s") from None

    def answered(self, kind: Input, command: JointCommand) -> None:
        """Register an accepted command; the cycle continues when all expected ones have come."""
        if command.stamp_ns == self._state_ns:
            self._answered.add(kind)
        if kind is Input.EFFORT_COMMAND:
            self.statistics.act_on_age(self.bridge.now_ns() - command.stamp_ns)

    def close(self) -> None:
        """End the thread, which releases the actuator."""
        self._closing.set()
        self._job_waiting.set()
        self._thread.join(_JOIN)

    def _start(self) -> threading.Thread:
        thread = threading.Thread(target=self._run, name="actuator", daemon=True)
        thread.start()
        return thread

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                self._run_jobs()
                if self.active:
                    self._guarded_cycle()
                else:
                    self.bridge.insist()
                    self._job_waiting.wait(_IDLE)
        finally:
            self.bridge.close()

    def _run_jobs(self) -> None:
        self._job_waiting.clear()
        while True:
            try:
                job, future = self._jobs.get_nowait()
            except queue.Empty:
                return
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(job())
            except BaseException as error:  # noqa: BLE001  (the caller gets it, whatever it is)
                future.set_exception(error)

    def _guarded_cycle(self) -> None:
        self._guarded(self._cycle)
        records, self._unpublished = self._unpublished, ()
        if records:
            self._guarded(lambda: self._on_records(records))

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except Exception as error:  # noqa: BLE001
            # After any error the drive goes off first; an error in the next cycle finds it off already.
            self.bridge.fail("exception", f"{type(error).__name__}: {error}")
            self.bridge.release()
            self._report(f"cycle of the actuator failed: {type(error).__name__}: {error}")
            self._pause()

    def _pause(self) -> None:
        self._closing.wait(self._period)

    def _cycle(self) -> None:
        bridge = self.bridge
        sample = bridge.observe(_PATIENCE)
        if sample is None:
            self._take_inputs(0.0)
            self._act_between()
            return
        now = bridge.now_ns()
        expected = now if self._last_state_ns is None else self._last_state_ns + self.statistics.period_ns
        self.statistics.cycle(now, expected)
        self._last_state_ns = now
        self._state_ns = sample.stamp_ns
        self._answered.clear()
        self._unpublished = bridge.records
        awaited = self._awaited(now)
        self._on_state(sample)
        self._wait_for_answers(awaited)
        self._on_outcome(sample.stamp_ns, self._decide_and_act())

    def _act_between(self) -> None:
        """Between two records carry out only what ends torque, because a stale command must not wait."""
        was_armed = self.bridge.supervisor.mode.armed
        drive = self._decide()
        if drive.kind is DriveKind.OFF or drive.starved:
            self.bridge.carry_out(drive, was_armed=was_armed)

    def _decide_and_act(self) -> Outcome:
        was_armed = self.bridge.supervisor.mode.armed
        return self.bridge.carry_out(self._decide(), was_armed=was_armed)

    def _awaited(self, now_ns: int) -> set[Input]:
        """Return the inputs to wait for: those with a fresh command."""
        supervisor = self.bridge.supervisor
        if not supervisor.mode.armed:
            return set()
        answering = (Input.EFFORT_COMMAND, Input.DISTURBANCE)
        return {kind for kind in answering if supervisor.gates[kind].fresh(now_ns) is not None}

    def _wait_for_answers(self, awaited: set[Input]) -> None:
        """Receive commands, and wait in the window for those for the newest state."""
        left = self._window if awaited else 0.0
        deadline = time.monotonic() + left
        while True:
            # Sleep at once: on a busy machine the commander may be waiting for this processor.
            self._take_inputs(left)
            left = deadline - time.monotonic()
            if awaited <= self._answered or left <= 0.0 or self._closing.is_set():
                return
