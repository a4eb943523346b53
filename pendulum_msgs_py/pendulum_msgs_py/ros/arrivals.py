"""Word that something has come for services and inputs that a node looks at itself.

To look for requests takes the middleware 16 us a service in a process that has just woken up: with the fourteen
services of a plant, at 100 Hz, a fortieth of a processor, which is a sixth of what a plant costs at 1 kHz. An event
counter of the kernel (eventfd(2)) tells at once that there is nothing to look for.

It calls rcl itself, and hands rcl no memory of Python's: what the middleware's thread
calls is ``eventfd_write`` of the C library, and what it gives that is the number of a counter, which stays open as long
as the process. A call that comes after its node has gone makes somebody look in vain, and nothing else.
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
"""Time after which somebody looks though no word of anything has come [s]."""
_LOOK = 1e-4
"""Time between two looks of who waits without being told [s]."""
_LAST_DESCRIPTOR = 1023
"""The largest that select(2) takes."""

_free: list[int] = []
"""Counters of signals that nobody has any more, for the next: never closed, since their numbers may still be used."""


class ArrivalSignal:
    """Tells whether anything may have come since somebody asked.

    Args:
        entities: Services and subscriptions that no executor attends to. What waits there already counts too.

    Attributes:
        works: Whether the middleware tells. Where it does not, on other systems than Linux, with another build of ROS
            or another middleware, something may have come each time, and whoever asks looks each time.
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
        """The counter, for who waits for it by other means; -1, which poll(2) passes over, where this does not work."""
        return self._counter if self.works else -1

    def wake(self) -> None:
        """Have whoever waits look, though nothing has come; from any thread."""
        if self.works:
            os.eventfd_write(self._counter, 1)

    def counted(self) -> bool:
        """Return whether the middleware has reported an arrival since this was asked last; from any thread."""
        try:
            return self._counter >= 0 and os.eventfd_read(self._counter) > 0
        except BlockingIOError:
            return False

    def came(self) -> bool:
        """Return whether anything may have come since this was asked last."""
        if not self.works:
            return True
        # Asked before it is read: to read a counter of zero is an exception, which takes three times as long.
        if self._waiting.poll(0):
            with contextlib.suppress(BlockingIOError):  # another thread was first
                os.eventfd_read(self._counter)
        elif time.monotonic() < self._look_anyway:
            return False
        self._look_anyway = time.monotonic() + _LONGEST_TRUST
        return True

    def wait(self, timeout: float) -> bool:
        """Wait until something may have come, for a time at most [s], and return whether it may have."""
        if timeout > 0.0 and self.works:
            # Not by poll(2), which counts whole milliseconds.
            select.select([self._counter], [], [], timeout)
        elif timeout > 0.0:
            time.sleep(min(timeout, _LOOK))
        return self.came()


def _count(entity: Service | Subscription, counter: int) -> bool:
    """Have the middleware add to a counter whenever something comes; return whether it will."""
    name = "service_set_on_new_request" if isinstance(entity, Service) else "subscription_set_on_new_message"
    try:
        # The very library that rclpy has loaded, or none.
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
