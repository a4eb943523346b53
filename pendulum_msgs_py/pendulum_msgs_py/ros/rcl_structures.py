"""C structures of rcl, and the library that rclpy has loaded."""

from __future__ import annotations

import ctypes
import functools
import os
from typing import Any

__all__ = ["Allocator", "SerializedMessage", "default_allocator", "loaded_rcl"]


class Allocator(ctypes.Structure):
    """``rcutils_allocator_t``."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")]


class SerializedMessage(ctypes.Structure):
    """``rcutils_uint8_array_t``."""

    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", Allocator),
    ]


@functools.cache
def loaded_rcl() -> Any:
    """Return the library with functions of serialised messages declared, or None if it differs."""
    try:
        # Its handle also finds symbols of the libraries it is linked to.
        rcl = ctypes.CDLL("librcl.so", mode=os.RTLD_NOW | os.RTLD_NOLOAD)
        pointer = ctypes.c_void_p
        rcl.rcutils_get_default_allocator.argtypes, rcl.rcutils_get_default_allocator.restype = [], Allocator
        rcl.rcutils_uint8_array_init.argtypes = [pointer, ctypes.c_size_t, pointer]
        rcl.rcutils_uint8_array_init.restype = ctypes.c_int
        rcl.rcutils_uint8_array_fini.argtypes = [pointer]
    except (AttributeError, OSError):
        return None
    return rcl


def default_allocator() -> Allocator:
    """Return rcl's default allocator."""
    allocator: Allocator = loaded_rcl().rcutils_get_default_allocator()
    return allocator
