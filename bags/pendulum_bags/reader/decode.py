"""Messages of any type as objects, by rosbags, with the definitions that the bag itself carries."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pendulum_bags.storage.message_types import typestore
from pendulum_msgs_py.errors import DataError

if TYPE_CHECKING:
    from pendulum_bags.reader.bag import TopicInfo

__all__ = ["decoder_for"]


def decoder_for(info: TopicInfo) -> Callable[[bytes], Any]:
    """Return a function from CDR bytes to an object of a topic's type.

    The built-in types of ROS 2 Jazzy are used where the bag has no definition of its own.

    Raises:
        DataError: Nobody knows the type; or, when the function is called, a message is damaged.
    """
    store = typestore()
    if info.type not in store.fielddefs:
        from rosbags.typesys import get_types_from_msg

        try:
            types = get_types_from_msg(info.definition, info.type) if info.definition else {}
            store.register({name: value for name, value in types.items() if name not in store.fielddefs})
        except Exception as error:  # rosbags raises its own and parser errors
            raise DataError(
                f"topic {info.name}: the definition of {info.type} is not readable: {error}"
            ) from error
        if info.type not in store.fielddefs:
            raise DataError(
                f"topic {info.name} has type {info.type}; expected a type that the bag or ROS 2 defines"
            )

    kind = store.get_msgdef(info.type)

    def decode(data: bytes) -> Any:
        try:
            parse = kind.deserialize_cdr_le if data[1] & 1 else kind.deserialize_cdr_be
            # rclpy's serialiser leaves up to twelve meaningless bytes behind a message, which rosbags' own
            # entry point takes for an error: what counts is that all fields are there.
            message, end = parse(memoryview(data)[4:], 0, kind.cls, store)
            if end + 4 > len(data):
                raise ValueError("it is cut off")
        except Exception as error:  # a damaged message fails in many ways
            raise DataError(
                f"topic {info.name}: a message of {len(data)} bytes is no {info.type}: {error}"
            ) from error
        return message

    return decode
