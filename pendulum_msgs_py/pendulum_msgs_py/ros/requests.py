"""Requests taken and answered without the GIL, and refused if too large.

rclpy takes and unpacks a request in one call that holds the GIL and so blocks the threads of actuator and e-stop, for
more than 0.3 s with a request of 8 MB that sets 80 000 parameters. Here rcl takes it while other threads run, and
Python sees small ones only. rcl uses Python's memory during a call only; the types' generated code creates and destroys
messages.
"""

from __future__ import annotations

import ctypes
import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message, serialize_message
from rclpy.service import Service

from pendulum_msgs_py.ros.rcl_structures import SerializedMessage, default_allocator, loaded_rcl

__all__ = ["MOST_BYTES", "RequestHeader", "TooLarge", "send_response", "take_request"]

MOST_BYTES = 64_000
"""Largest request that is read [bytes]: some 600 parameters, which take Python 5 ms."""
_OK, _TIMEOUT, _NOTHING_TAKEN = 0, 2, 601  # rcl/types.h


class TooLarge(NamedTuple):
    """Stands for an unread request of this size [bytes]."""

    size: int


class _RequestId(ctypes.Structure):
    """``rmw_request_id_t``, with space for another version's."""

    _fields_ = [
        ("writer_guid", ctypes.c_uint8 * 16),
        ("sequence_number", ctypes.c_int64),
        ("_room", ctypes.c_uint8 * 64),
    ]


class RequestHeader(ctypes.Structure):
    """``rmw_service_info_t``, with the attributes of rclpy's own."""

    _fields_ = [
        ("source_timestamp", ctypes.c_int64),
        ("received_timestamp", ctypes.c_int64),
        ("request_id", _RequestId),
    ]


def take_request(service: Service) -> tuple[Any, Any]:
    """Take a service's oldest request, or :class:`TooLarge`, and its header; None twice if none waits."""
    rcl = _rcl()
    if rcl is None:
        with service.handle:
            taken: tuple[Any, Any] = service.handle.service_take_request(service.srv_type.Request)
        return taken
    kind = _kind(service.srv_type.Request)
    header = RequestHeader()
    with service.handle:
        message = kind.create()
        try:
            code = rcl.rcl_take_request_with_info(service.handle.pointer, ctypes.byref(header), message)
            if code == _NOTHING_TAKEN:
                return None, None
            _expect(rcl, code, f"request to {service.srv_name} was not taken")
            data = _serialized(rcl, kind, message)
        finally:
            kind.destroy(message)
    return data if isinstance(data, TooLarge) else deserialize_message(data, service.srv_type.Request), header


def send_response(service: Service, send: Callable[[Any, Any], None], response: Any, header: Any) -> bool | None:
    """Send a response; return whether the client has gone, None if rclpy hides it.

    ``send`` is rclpy's own function, for the header of a request that rclpy has taken.
    """
    rcl = _rcl()
    if rcl is None or not isinstance(header, RequestHeader):
        send(response, header)
        return None
    kind = _kind(service.srv_type.Response)
    data = serialize_message(response)
    held = ctypes.create_string_buffer(data, len(data))
    lent = SerializedMessage(ctypes.addressof(held), len(data), len(data), default_allocator())
    with service.handle:
        message = kind.create()
        try:
            _expect(rcl, rcl.rmw_deserialize(ctypes.byref(lent), kind.support, message), "answer was not understood")
            code = rcl.rcl_send_response(service.handle.pointer, ctypes.byref(header.request_id), message)
        finally:
            kind.destroy(message)
    if code == _TIMEOUT:
        rcl.rcutils_reset_error()
        text = f"failed to send response to {service.srv_name} (timeout): client will not receive response"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
        return True
    _expect(rcl, code, f"answer of {service.srv_name} was not sent")
    return False


class _Kind(NamedTuple):
    """Generated code of a message type: address of a new message, its destructor, and the type support."""

    create: Callable[[], int]
    destroy: Callable[[int], None]
    support: ctypes.c_void_p


@functools.cache
def _kind(message_type: Any) -> _Kind:
    meta = type(message_type)
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()
    return _Kind(
        ctypes.CFUNCTYPE(ctypes.c_void_p)(_address(meta._CREATE_ROS_MESSAGE)),
        ctypes.CFUNCTYPE(None, ctypes.c_void_p)(_address(meta._DESTROY_ROS_MESSAGE)),
        ctypes.c_void_p(_address(meta._TYPE_SUPPORT)),
    )


def _address(capsule: Any) -> int:
    api = ctypes.pythonapi
    api.PyCapsule_GetName.argtypes, api.PyCapsule_GetName.restype = [ctypes.py_object], ctypes.c_char_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    address: int = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    return address


@functools.cache
def _rcl() -> Any:
    rcl = loaded_rcl()
    try:
        for name in ("rcl_take_request_with_info", "rcl_send_response", "rmw_serialize", "rmw_deserialize"):
            getattr(rcl, name).argtypes = [ctypes.c_void_p] * 3
            getattr(rcl, name).restype = ctypes.c_int
        rcl.rcutils_reset_error.argtypes, rcl.rcutils_reset_error.restype = [], None
    except AttributeError:
        return None
    return rcl


def _serialized(rcl: Any, kind: _Kind, message: int) -> bytes | TooLarge:
    made = SerializedMessage(None, 0, 0, default_allocator())
    try:
        _expect(rcl, rcl.rmw_serialize(message, kind.support, ctypes.byref(made)), "request was not understood")
        if made.length > MOST_BYTES:
            return TooLarge(made.length)
        return ctypes.string_at(made.buffer, made.length)
    finally:
        rcl.rcutils_uint8_array_fini(ctypes.byref(made))


def _expect(rcl: Any, code: int, what: str) -> None:
    if code != _OK:
        rcl.rcutils_reset_error()
        raise RuntimeError(f"{what}: rcl's code is {code}; expected {_OK}")
