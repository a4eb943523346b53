"""Requests taken and answered without Python's lock, and refused where they are too large to be read quickly.

rclpy takes a request, unpacks it and makes objects of it in one call that holds Python's lock: no other thread of the
process runs meanwhile, neither an actuator's nor an e-stop's. A request of 8 MB that sets 80 000 parameters took more
than 0.3 s so. Here rcl takes it while other threads run, and Python sees it only where it is small.

Memory that Python owns is lent to rcl for the time of a call and no longer; requests and answers themselves are made
and unmade by the generated code of their types.
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
"""Largest request that is read, as it came [bytes]: some 600 parameters, which take Python 5 ms."""
_OK, _TIMEOUT, _NOTHING_TAKEN = 0, 2, 601
"""Codes of rcl (``rcl/types.h``)."""


class TooLarge(NamedTuple):
    """In place of a request that is not read.

    Attributes:
        size: Its size [bytes].
    """

    size: int


class _RequestId(ctypes.Structure):
    """``rmw_request_id_t``, and room for one of another version."""

    _fields_ = [
        ("writer_guid", ctypes.c_uint8 * 16),
        ("sequence_number", ctypes.c_int64),
        ("_room", ctypes.c_uint8 * 64),
    ]


class RequestHeader(ctypes.Structure):
    """``rmw_service_info_t``: who asked, when; the attributes are those of rclpy's own."""

    _fields_ = [
        ("source_timestamp", ctypes.c_int64),
        ("received_timestamp", ctypes.c_int64),
        ("request_id", _RequestId),
    ]


def take_request(service: Service) -> tuple[Any, Any]:
    """Take the oldest request that waits, with its header; None twice where none does.

    Args:
        service: No executor attends to it.

    Returns:
        The request, or :class:`TooLarge` in its place, and the header to answer it by.
    """
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
    """Answer a request; return whether its client has gone, None where rclpy does not tell.

    Args:
        service: Whose answer it is.
        send: rclpy's own way, for the header of a request that rclpy has taken.
        response: The answer.
        header: Of the request.
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
    """How the generated code makes and unmakes messages of a type.

    Attributes:
        create: Returns the address of a new message.
        destroy: Unmakes it.
        support: Address of what tells the middleware of its fields.
    """

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
    """Return the very library that rclpy has loaded, or None where it has not all that is called here."""
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
