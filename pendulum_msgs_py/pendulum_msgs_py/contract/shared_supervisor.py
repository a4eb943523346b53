"""The supervisor behind a lock: messages, e-stop and the actuator's cycle run in different threads."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections import deque
from collections.abc import Callable, Iterator

from pendulum_msgs_py.contract.commands import Refusal
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.supervisor import Drive, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import JointCommand, JointSample, Vector

__all__ = ["SharedSupervisor"]

_LONGEST_YIELD = 0.005
"""Longest yield of :meth:`alone` to waiting threads [s]."""


class SharedSupervisor(PlantSupervisor):
    """A plant supervisor that takes each step under one lock, and prepares the drive before arming.

    Args:
        limits: The limits.
        prepare: Prepares the drive (strategy set and confirmed); returns why it could not, or an empty string. Called
            outside the lock, because it may wait for another thread.
        withdraw: Called if the plant was prepared but not armed.
        measure: Returns time [ns] and newest measurement after the preparation, which may take long; None if it does
            not.
        coordinates: As for :class:`PlantSupervisor`.
        follows: Likewise.
    """

    def __init__(
        self,
        limits: PlantLimits,
        prepare: Callable[[], str] = lambda: "",
        withdraw: Callable[[], None] = lambda: None,
        measure: Callable[[], tuple[int, JointSample | None]] | None = None,
        *,
        coordinates: Coordinates = ONE_JOINT,
        follows: bool = True,
    ) -> None:
        self._lock = threading.RLock()
        self._counting = threading.Condition()
        self._waiting = ctypes.c_int64(0)
        self._presses: deque[tuple[int, str]] = deque()
        self._poll_press: Callable[[], tuple[int, str] | None] = lambda: None
        self._newest_press: tuple[int, str] | None = None
        self._prepare = prepare
        self._withdraw = withdraw
        self._measure = measure
        self._not_prepared = ""
        super().__init__(limits, preflight=lambda: self._not_prepared, coordinates=coordinates, follows=follows)

    @property
    def waiting_at(self) -> int:
        """Address of an ``int64`` that counts the threads waiting for :meth:`alone`; compiled code polls it."""
        return ctypes.addressof(self._waiting)

    def watch_for_presses(self, look: Callable[[], tuple[int, str] | None]) -> None:
        """Poll before each step for an e-stop that did not call :meth:`e_stop`: its time [ns] and reason, or None."""
        self._poll_press = look

    def _poll_then_latch(self) -> bool:
        press = self._poll_press()
        if press is not None:
            self._presses.append(press)
        return self._latch_presses()

    def _latch_presses(self) -> bool:
        """Latch pending e-stops, whose own threads may not have run yet; return whether there were any."""
        pressed = bool(self._presses)
        while self._presses:
            super().e_stop(*self._presses[0])
            # Only now: an exception in between must not lose it.
            self._presses.popleft()
        return pressed

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the supervisor exclusively; waiting threads run next."""
        with self._lock:
            self._poll_then_latch()
            yield
        # Python locks are unfair: without this yield a waiting disarm loses a period.
        if self._waiting.value:
            with self._counting:
                self._counting.wait_for(lambda: not self._waiting.value, _LONGEST_YIELD)

    @contextlib.contextmanager
    def _in_turn(self) -> Iterator[bool]:
        """Take the lock, and signal the wait to compiled code that holds it; yield whether e-stops were pending."""
        with self._counting:
            self._waiting.value += 1
        try:
            with self._lock:
                yield self._poll_then_latch()
        finally:
            with self._counting:
                self._waiting.value -= 1
                self._counting.notify_all()

    def offer(self, kind: Input, command: JointCommand | None, now_ns: int, problem: str = "") -> Refusal | None:
        """Offer a message of an input."""
        with self._lock:
            self._latch_presses()
            return super().offer(kind, command, now_ns, problem)

    def set_commander_conflict(self, conflict: str) -> None:
        """Set or clear a conflict between publishers."""
        with self._in_turn():
            super().set_commander_conflict(conflict)

    def receive_enable(self, now_ns: int, *, held: bool) -> None:
        """Record a message of the hold-to-run switch."""
        with self._in_turn():
            super().receive_enable(now_ns, held=held)

    def accept_trajectory(self, trajectory: Trajectory, now_ns: int, sample: JointSample) -> str:
        """Start to follow a trajectory."""
        # Points are computed before the lock is taken: under it they would delay actuator and e-stop.
        trajectory = trajectory.from_position(sample.position[0])
        with self._in_turn():
            return super().accept_trajectory(trajectory, now_ns, sample)

    def arm(self, now_ns: int, sample: JointSample | None) -> str:
        """Prepare the drive, then arm."""
        if self.mode is not Mode.DISARMED:
            with self._in_turn():
                return super().arm(now_ns, sample)
        self._not_prepared = self._prepare()
        if self._not_prepared:
            return self._not_prepared
        if self._measure is not None:
            now_ns, sample = self._measure()
        with self._in_turn():
            refusal = super().arm(now_ns, sample)
        if refusal:
            self._withdraw()
        return refusal

    def disarm(self, now_ns: int, reason: str = "disarmed on request") -> None:
        """Release the drive."""
        with self._in_turn():
            super().disarm(now_ns, reason)

    def e_stop(self, now_ns: int, reason: str = "e-stop pressed") -> None:
        """Latch the e-stop; every decision respects it from here on, even before this thread has the lock."""
        self._newest_press = press = (now_ns, reason)
        self._presses.append(press)
        with self._in_turn():
            pass  # it is carried out on the way in, unless another thread did so first

    def e_stop_reset(self, now_ns: int) -> str:
        """Leave the e-stop for disarmed, unless it was requested again meanwhile."""
        known = self._newest_press
        with self._in_turn() as pressed:
            if pressed or self._newest_press is not known:
                return "the e-stop has just been pressed; reset it once more"
            return super().e_stop_reset(now_ns)

    def fault(self, reason: str, now_ns: int) -> None:
        """Go to the fault state."""
        with self._in_turn():
            super().fault(reason, now_ns)

    def end_stop(self) -> None:
        """End the fade of a stop."""
        with self._in_turn():
            super().end_stop()

    def decide(self, now_ns: int, sample: JointSample | None) -> Drive:
        """Return the drive until the next decision."""
        with self._lock:
            self._poll_then_latch()
            return super().decide(now_ns, sample)

    def report_applied(self, effort: Vector) -> None:
        """Record the applied efforts."""
        with self._lock:
            self._latch_presses()
            super().report_applied(effort)
