"""Messages of any type as objects, decoded by rosbags with the bag's own definitions."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.topic_info import TopicInfo
from pendulum_rosbag.storage.message_types import typestore

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


__all__ = ["decoder_for", "store_for"]

_MAX_DEFINITION = 1 << 18
_MAX_VALUES = 1 << 20
_MAX_DEPTH = 40


def store_for(info: TopicInfo) -> Typestore:
    """Return a type store with a topic's type as its bag defines it; a DataError if it cannot be read.

    Each definition has a store of its own: in a shared one a bag could change how the next is read. ROS 2 Jazzy's types
    complete what the bag does not define.
    """
    shared = typestore()
    try:
        store = _defined(info.type, info.definition) if info.definition else shared
    except Exception as error:  # rosbags raises its own and parser errors
        if info.type in shared.fielddefs:
            return shared  # in a language that rosbags does not read, such as IDL under another name
        reason = f": {error}" if isinstance(error, DataError) else ""
        raise DataError(
            f"topic {info.name}: the definition of {info.type} in the bag is not one of ROS 2 messages{reason}"
        ) from error
    if info.type not in store.fielddefs:
        held = f"has type {info.type}" if info.type else "has no type in the bag"
        raise DataError(f"topic {info.name} {held}; expected a type that the bag or ROS 2 defines")
    return store


@lru_cache(maxsize=64)
def _defined(name: str, definition: str) -> Typestore:
    """Return the store of one definition, cached by its text for equal topics of many bags."""
    from rosbags.typesys import get_types_from_msg
    from rosbags.typesys.store import Typestore

    if len(definition) > _MAX_DEFINITION:
        raise DataError(f"it has {len(definition)} letters; expected at most {_MAX_DEFINITION}")
    shared = typestore()
    types = get_types_from_msg(definition, name)
    if all(shared.fielddefs.get(kind) == fields for kind, fields in types.items()):
        return shared
    known: dict[str, Any] = {**shared.fielddefs, **types}
    for kind in types:
        if _values(kind, known, {}) > _MAX_VALUES:
            raise DataError(f"{kind} holds more than {_MAX_VALUES} values; expected no more")
    store = Typestore()
    store.register(types)
    for kind in shared.fielddefs.keys() - types.keys():
        store.fielddefs[kind], store.types[kind] = shared.fielddefs[kind], shared.types[kind]
    return store


def _values(kind: str, known: dict[str, Any], counted: dict[str, int], depth: int = 0) -> int:
    """Return the least number of values in a message; one line of text can define more than memory holds."""
    from rosbags.interfaces import Nodetype

    if depth > _MAX_DEPTH:
        raise DataError(f"{kind} is nested deeper than {_MAX_DEPTH} levels, or holds itself")
    if kind not in counted:
        if kind not in known:
            raise DataError(f"{kind} is not defined")
        total = 0
        for _, (node, detail) in known[kind][1]:
            is_list = node in {Nodetype.ARRAY, Nodetype.SEQUENCE}
            (inner, of), length = detail if is_list else ((node, detail), 1)
            values = _values(of, known, counted, depth + 1) if inner == Nodetype.NAME else 1
            # Numeric arrays are read as one value; everything else is written out.
            written_out = inner == Nodetype.NAME or of[0] in {"string", "wstring"}
            total += values * (length if node == Nodetype.ARRAY and written_out else 1)
        counted[kind] = total
    return counted[kind]


def decoder_for(info: TopicInfo) -> Callable[[bytes], Any]:
    """Return the decoder of a topic's CDR bytes; DataErrors for an unknown type or a damaged message."""
    store = store_for(info)
    kind = store.get_msgdef(info.type)

    def decode(data: bytes) -> Any:
        try:
            parse = kind.deserialize_cdr_le if data[1] & 1 else kind.deserialize_cdr_be
            # rclpy's serialiser leaves up to twelve meaningless bytes behind a message, which rosbags' own entry point
            # rejects: what counts is that all fields are there.
            message, end = parse(memoryview(data)[4:], 0, kind.cls, store)
            if end + 4 > len(data):
                raise ValueError("it is cut off")
        except Exception as error:  # a damaged message fails in many ways
            raise DataError(f"topic {info.name}: a message of {len(data)} bytes is no {info.type}: {error}") from error
        return message

    return decode
