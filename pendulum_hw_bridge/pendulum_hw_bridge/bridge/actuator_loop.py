"""The thread that owns the actuator: one cycle per feedback record, and jobs for it from elsewhere in between.

HEBI's library wants all calls of a group from one thread, and no slow callback of ROS may stand between feedback
and the reaction to it. What reaches the outside (publish, decide) are functions given by the node.
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
"""Longest wait for feedback before commands and silence are looked at again [s]."""
_IDLE = 0.1
_JOIN = 5.0


class ActuatorLoop:
    """Runs a bridge's cycles in a thread of its own.

    Args:
        bridge: Bridge and actuator; only this thread touches the actuator.
        statistics: Gets the figures of the loop.
        on_state: Called with each new sample.
        decide: Returns the decision for now.
        on_outcome: Called with the stamp of the state answered [ns] and what was done.
        on_records: Called with the feedback record of each module when its cycle has ended, in an error too, when the
            drive is off already: whoever reads these has time, and who answers the state has not.
        take_inputs: Takes the torques that have come, each into :meth:`answered`; where none has, it waits for one, for
            as long as it is told at most [s]. By default none ever comes.
        answer_window: Share of the period in which to wait for answers to a state before acting [-].
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

    # --- from other threads ---------------------------------------------------------------------------------

    def call(self, job: Callable[[], _T], timeout: float = 5.0) -> _T:
        """Run a job in the actuator's thread and return what it returns.

        Args:
            job: What to run.
            timeout: Longest time to wait for it [s].

        Raises:
            ActuatorError: The thread does not answer in time, or has ended.
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
        """Take note of an accepted command; the cycle goes on when all who answer have answered."""
        if command.stamp_ns == self._state_ns:
            self._answered.add(kind)
        if kind is Input.EFFORT_COMMAND:
            self.statistics.act_on_age(self.bridge.now_ns() - command.stamp_ns)

    def close(self) -> None:
        """End the thread; the actuator is released and let go on the way out."""
        self._closing.set()
        self._job_waiting.set()
        self._thread.join(_JOIN)

    # --- in the thread --------------------------------------------------------------------------------------

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
            # Whatever broke, the drive goes off first; a second break in the next cycle finds it off already.
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
        """Between two records only what ends torque is carried out: a command that went stale need not wait."""
        was_armed = self.bridge.supervisor.mode.armed
        drive = self._decide()
        if drive.kind is DriveKind.OFF or drive.starved:
            self.bridge.carry_out(drive, was_armed=was_armed)

    def _decide_and_act(self) -> Outcome:
        was_armed = self.bridge.supervisor.mode.armed
        return self.bridge.carry_out(self._decide(), was_armed=was_armed)

    def _awaited(self, now_ns: int) -> set[Input]:
        """Return who answered lately: whoever is late or has never answered is not waited for."""
        supervisor = self.bridge.supervisor
        if not supervisor.mode.armed:
            return set()
        answering = (Input.EFFORT_COMMAND, Input.DISTURBANCE)
        return {kind for kind in answering if supervisor.gates[kind].fresh(now_ns) is not None}

    def _wait_for_answers(self, awaited: set[Input]) -> None:
        """Take what has come, and wait in the window for answers to the newest state."""
        left = self._window if awaited else 0.0
        deadline = time.monotonic() + left
        while True:
            # Asleep at once: on a busy machine, who answers may wait for this processor.
            self._take_inputs(left)
            left = deadline - time.monotonic()
            if awaited <= self._answered or left <= 0.0 or self._closing.is_set():
                return
