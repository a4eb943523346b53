"""Primitives of compiled loops: time, waiting, messages. Imported by the compiler's process alone.

Functions of rcl are called as ``pendulum_rcl_...``; the loader passes their addresses in the library that rclpy has
loaded (:mod:`pendulum_msgs_py.ros.direct`).
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = [
    "FAILED",
    "NOTHING",
    "ORDINARY",
    "OTHER",
    "compiled",
    "copy",
    "entry",
    "has_listeners",
    "is_called",
    "publish",
    "sleep_until",
    "steady_ns",
    "take_one",
    "wait_for_any",
    "wall_ns",
]

# Installed by the packages that compile, simulator and control; not a dependency of this one.
numba = importlib.import_module("numba")
llvm = importlib.import_module("llvmlite.binding")
types = numba.types

_int, _address = types.int32, types.uintp
_take = types.ExternalFunction("pendulum_rcl_take", _int(_address, _address, _address, _address))
_publish = types.ExternalFunction("pendulum_rcl_publish", _int(_address, _address, _address))
_count = types.ExternalFunction("pendulum_rcl_count", _int(_address, _address))
_memcpy = types.ExternalFunction("memcpy", _address(_address, _address, _address))
_get_time = types.ExternalFunction("clock_gettime", _int(_int, _address))
_sleep = types.ExternalFunction("clock_nanosleep", _int(_int, _int, _address, _address))
_poll = types.ExternalFunction("ppoll", _int(_address, types.uint64, _address, _address))
_read = types.ExternalFunction("read", types.int64(_int, _address, _address))
# Called in another process: here the linker only needs some address.
for _symbol in ("pendulum_rcl_take", "pendulum_rcl_publish", "pendulum_rcl_count"):
    llvm.add_symbol(_symbol, 1)

_WALL, _STEADY, _ABSOLUTE, _READABLE = 0, 1, 1, 1
"""``CLOCK_REALTIME``, ``CLOCK_MONOTONIC``, ``TIMER_ABSTIME``, ``POLLIN``."""
_STAMP_AT, _HEADER = 4, 4
NOTHING, ORDINARY, OTHER, FAILED = range(4)
"""Results of :func:`take_one`: no message, an expected one, one for Python, or an error of rcl."""
_TAKE_FAILED = 401
"""``RCL_RET_SUBSCRIPTION_TAKE_FAILED``: no message."""


def compiled(function: Any) -> Any:
    """Compile a function for compiled callers, with Python's results: no operation fused or reordered."""
    return numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)


def entry(layout: np.dtype[Any]) -> Any:
    """Return a decorator that compiles a loop's function of one record."""
    signature = types.int64(numba.from_dtype(layout))
    return numba.njit(signature, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


@compiled
def copy(to: Any, at: Any, size: Any) -> None:
    """Copy bytes from one address to another."""
    _memcpy(to, at, size)


@compiled
def steady_ns(time: Any) -> Any:
    """Return the time of the monotonic clock [ns]."""
    _get_time(_STEADY, time.now.ctypes.data)
    return time.now[0] * NANOSECONDS + time.now[1]


@compiled
def wall_ns(time: Any) -> Any:
    """Return the system time [ns]."""
    _get_time(_WALL, time.now.ctypes.data)
    return time.now[0] * NANOSECONDS + time.now[1]


@compiled
def sleep_until(time: Any, steady: Any) -> None:
    """Sleep until a time of the monotonic clock [ns] or a signal."""
    time.until[0] = steady // NANOSECONDS
    time.until[1] = steady % NANOSECONDS
    _sleep(_STEADY, _ABSOLUTE, time.until.ctypes.data, 0)


@compiled
def is_called(time: Any, calls: Any) -> Any:
    """Return whether one of two event counters was incremented, without waiting or resetting."""
    time.poll[0], time.poll[2] = calls[0], calls[1]
    time.poll[1] = time.poll[3] = _READABLE
    time.until[0] = time.until[1] = 0
    return _poll(time.poll.ctypes.data, 2, time.until.ctypes.data, 0) > 0


@compiled
def wait_for_any(time: Any, counter: Any, calls: Any, longest: Any) -> None:
    """Wait at most a time [ns] for one of three event counters, and reset the first, which does not block."""
    time.poll[0], time.poll[2], time.poll[4] = counter, calls[0], calls[1]
    time.poll[1] = time.poll[3] = time.poll[5] = _READABLE
    time.until[0] = longest // NANOSECONDS
    time.until[1] = longest % NANOSECONDS
    if longest > 0 and _poll(time.poll.ctypes.data, 3, time.until.ctypes.data, 0) > 0:
        _read(counter, time.until.ctypes.data, 8)


@compiled
def matches(source: Any) -> Any:
    """Read stamp and numbers of the taken message if it has the expected layout; return whether it has."""
    size = source.size
    if size == 0 or source.message[1] != size:
        return False
    _memcpy(source.data.ctypes.data, source.message[0], size)
    different = np.uint8(0)
    for index in range(size):
        different |= (source.data[index] ^ source.template[index]) & source.mask[index]
    if different != 0:
        return False
    _memcpy(source.stamp.ctypes.data, source.data.ctypes.data + np.uintp(_STAMP_AT), 8)
    if source.stamp[1] >= NANOSECONDS:
        return False
    seconds = np.int64(source.stamp[0])
    if seconds >= 2**31:
        return False
    source.stamp_ns = seconds * NANOSECONDS + np.int64(source.stamp[1])
    values = source.value.ctypes.data
    for index in range(source.value.shape[0]):
        if source.value_at[index] > 0:
            at = source.data.ctypes.data + np.uintp(source.value_at[index])
            _memcpy(values + np.uintp(8 * index), at, 8)
    return True


@compiled
def take_one(source: Any) -> Any:
    """Take the oldest message of an input; return what it is."""
    message, info = source.message.ctypes.data, source.info.ctypes.data
    code = _take(source.subscription, message, info, 0)
    if code == _TAKE_FAILED:
        return NOTHING
    if code != 0:
        return FAILED
    return ORDINARY if matches(source) else OTHER


@compiled
def publish(output: Any, stamp_ns: Any) -> Any:
    """Publish an output's numbers under a stamp [ns]; return whether the middleware accepted them."""
    output.stamp[0] = np.uint32(stamp_ns // NANOSECONDS)
    output.stamp[1] = np.uint32(stamp_ns % NANOSECONDS)
    data = output.data.ctypes.data
    _memcpy(data + np.uintp(_STAMP_AT), output.stamp.ctypes.data, 8)
    for index in range(output.values):
        at = data + np.uintp(output.value_at[index])
        _memcpy(at, output.value.ctypes.data + np.uintp(8 * index), 8)
    return _publish(output.publisher, output.message.ctypes.data, 0) == 0


@compiled
def has_listeners(output: Any) -> Any:
    """Return whether an output has a matched subscriber."""
    return _count(output.publisher, output.matched.ctypes.data) == 0 and output.matched[0] > 0
