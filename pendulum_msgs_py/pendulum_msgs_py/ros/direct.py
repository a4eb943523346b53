"""rclpy's publishers and subscriptions in the records of compiled loops: the module that knows rcl's memory.

A compiled loop calls ``rcl_take_serialized_message`` and ``rcl_publish_serialized_message`` of the library that rclpy
has loaded, with rclpy's entities, whose handles are held meanwhile. rcl's own allocator owns the bytes that rcl writes.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import weakref
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from pendulum_msgs_py.loops.machine_code import NoMachineCodeError
from pendulum_msgs_py.loops.records import MOST_BYTES
from pendulum_msgs_py.ros.rcl_structures import SerializedMessage, default_allocator, loaded_rcl

__all__ = ["DirectTopics", "rcl_symbols"]

_SYMBOLS = {
    "pendulum_rcl_take": "rcl_take_serialized_message",
    "pendulum_rcl_publish": "rcl_publish_serialized_message",
    "pendulum_rcl_count": "rcl_publisher_get_subscription_count",
}
_LARGEST_KEPT = 65_536
"""Most memory that a long message leaves allocated for an input [bytes]."""
_MIDDLEWARES = ("rmw_fastrtps_cpp",)
"""Tested ones."""


@functools.cache
def rcl_symbols() -> dict[str, int]:
    """Return the addresses of the functions that loops call; raise a NoMachineCodeError if unavailable."""
    from rclpy.utilities import get_rmw_implementation_identifier

    middleware = get_rmw_implementation_identifier()
    if middleware not in _MIDDLEWARES:
        raise NoMachineCodeError(f"middleware is {middleware}; expected one of {', '.join(_MIDDLEWARES)}")
    rcl = loaded_rcl()
    if rcl is None:
        raise NoMachineCodeError("librcl.so is not loaded, or another version than is known")
    try:
        return {name: _address(getattr(rcl, function)) for name, function in _SYMBOLS.items()}
    except AttributeError as error:
        raise NoMachineCodeError(f"rcl has not all that is called: {error}") from error


class DirectTopics:
    """The inputs and outputs of one loop."""

    def __init__(self) -> None:
        self._handles: list[Any] = []

    def add_input(self, record: NDArray[Any], subscription: Subscription, most: int) -> None:
        """Write a subscription without executor into a record of ``INPUT``, which must outlive this.

        One poll takes ``most`` messages.
        """
        record["subscription"] = subscription.handle.pointer
        record["most"] = most
        _allocate(_message_in(record), MOST_BYTES)
        weakref.finalize(self, _free, _message_in(record), record)
        self._handles.append(subscription.handle)

    def add_output(self, record: NDArray[Any], publisher: Publisher) -> None:
        """Write a publisher into a record of ``OUTPUT``."""
        record["publisher"] = publisher.handle.pointer
        self._handles.append(publisher.handle)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold all entities; raise an ``InvalidHandle`` if one has been destroyed."""
        with contextlib.ExitStack() as stack:
            for handle in self._handles:
                stack.enter_context(handle)
            yield

    @staticmethod
    def message(record: NDArray[Any]) -> bytes:
        """Return the message that a loop left to Python, and shrink its memory."""
        message = _message_in(record)
        data = ctypes.string_at(message.buffer, message.length)
        if message.capacity > _LARGEST_KEPT:
            _free(message, record)
            _allocate(message, MOST_BYTES)
        return data


def _message_in(record: NDArray[Any]) -> SerializedMessage:
    return SerializedMessage.from_address(record["message"].ctypes.data)


def _allocate(message: SerializedMessage, size: int) -> None:
    rcl = loaded_rcl()
    message.buffer, message.length, message.capacity, message.allocator = None, 0, 0, default_allocator()
    if rcl is None or rcl.rcutils_uint8_array_init(ctypes.byref(message), size, ctypes.byref(message.allocator)):
        raise MemoryError(f"no memory for a message of {size} bytes")


def _free(message: SerializedMessage, _record: NDArray[Any]) -> None:
    rcl = loaded_rcl()
    if rcl is not None:
        rcl.rcutils_uint8_array_fini(ctypes.byref(message))


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0
