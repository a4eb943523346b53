"""Arrival signals for services and inputs that a node polls itself.

Polling takes the middleware 16 us a service in a process that has just woken up: with a plant's fourteen services at
100 Hz, 2.5 % of a core, a sixth of a plant at 1 kHz. An event counter of the kernel (eventfd(2)) shows at once that
nothing has come. rcl gets no memory of Python's: the middleware's thread calls ``eventfd_write`` of the C library with
a descriptor that stays open as long as the process, so a late call causes a needless poll only.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import time
import weakref
from collections.abc import Iterable

from rclpy.service import Service
from rclpy.subscription import Subscription

__all__ = ["ArrivalSignal"]

_LONGEST_TRUST = 1.0
"""Time after which inputs are polled without a signal [s]."""
_LOOK = 1e-4
"""Poll period without signals [s]."""
_LAST_DESCRIPTOR = 1023
"""Largest descriptor for select(2)."""

_free: list[int] = []
"""Counters for reuse: never closed, since the middleware may still write to them."""


class ArrivalSignal:
    """Reports whether services or subscriptions, which no executor serves, may have something new; waiting items count.

    Attributes:
        works: Whether the middleware signals. If not (no Linux, another build of ROS or middleware), every poll is due.
    """

    def __init__(self, entities: Iterable[Service | Subscription]) -> None:
        self._waiting = select.poll()
        self._look_anyway = 0.0
        self._counter = -1
        try:
            self._counter = _free.pop() if _free else os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        except (AttributeError, OSError):  # no Linux, or no descriptor left
            self.works = False
            return
        weakref.finalize(self, _free.append, self._counter)
        self._waiting.register(self._counter, select.POLLIN)
        self.counted()  # an earlier signal may have left something in it
        counted = [_count(entity, self._counter) for entity in entities]
        self.works = all(counted) and self._counter <= _LAST_DESCRIPTOR

    @property
    def descriptor(self) -> int:
        """The counter, for poll(2); -1, which poll(2) skips, if it does not work."""
        return self._counter if self.works else -1

    def wake(self) -> None:
        """Wake the waiting thread, from any thread."""
        if self.works:
            os.eventfd_write(self._counter, 1)

    def counted(self) -> bool:
        """Return whether the middleware has signalled since the last call, from any thread."""
        try:
            return self._counter >= 0 and os.eventfd_read(self._counter) > 0
        except BlockingIOError:
            return False

    def came(self) -> bool:
        """Return whether anything may have come since the last call."""
        if not self.works:
            return True
        # Polled first: reading a counter of zero raises, which takes three times as long.
        if self._waiting.poll(0):
            with contextlib.suppress(BlockingIOError):  # another thread was first
                os.eventfd_read(self._counter)
        elif time.monotonic() < self._look_anyway:
            return False
        self._look_anyway = time.monotonic() + _LONGEST_TRUST
        return True

    def wait(self, timeout: float) -> bool:
        """Wait at most a time [s] until something may have come; return whether it may have."""
        if timeout > 0.0 and self.works:
            # Not poll(2), whose timeout is in whole milliseconds.
            select.select([self._counter], [], [], timeout)
        elif timeout > 0.0:
            time.sleep(min(timeout, _LOOK))
        return self.came()


def _count(entity: Service | Subscription, counter: int) -> bool:
    name = "service_set_on_new_request" if isinstance(entity, Service) else "subscription_set_on_new_message"
    try:
        # The library that rclpy has loaded, or none.
        rcl = ctypes.CDLL("librcl.so", mode=os.RTLD_NOW | os.RTLD_NOLOAD)
        register = getattr(rcl, f"rcl_{name}_callback")
        call = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
    except (AttributeError, OSError):
        return False
    register.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    register.restype = ctypes.c_int
    with entity.handle:
        code: int = register(entity.handle.pointer, call, counter)
    return code == 0
