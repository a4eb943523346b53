"""Message definitions and type hashes, stored in a bag so that any machine can read it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from pendulum_msgs_py.errors import BagError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = ["MessageType", "message_type", "typestore"]


@dataclass(frozen=True, slots=True)
class MessageType:
    """One message type as a bag describes it.

    Args:
        name: Such as ``sensor_msgs/msg/JointState``.
        definition: Concatenated ``.msg`` text with all types that it uses; empty when unknown.
        hash: ``RIHS01_...`` type description hash; empty when unknown.
        encoding: Format of the definition: ``ros2msg``, ``ros2idl``, or empty.
        serialization: Encoding of the messages: ``cdr`` in ROS 2, or another writer's (``json``).
    """

    name: str
    definition: str = ""
    hash: str = ""
    encoding: str = "ros2msg"
    serialization: str = "cdr"


@cache
def typestore() -> Typestore:
    """Return the type store of ROS 2 Jazzy, shared by the process."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=256)
def message_type(name: str, type_hash: str = "") -> MessageType:
    """Return definition and hash of a type ``package/msg/Name``; a BagError for other names.

    Types outside the ROS distribution are read from ``AMENT_PREFIX_PATH``; an unknown one has no definition.
    ``type_hash`` from discovery overrides the computed hash.
    """
    if len(name.split("/")) != 3:
        raise BagError(f"message type is {name!r}; expected package/msg/Name")
    store = typestore()
    if name not in store.fielddefs and not _register_from_ament(name):
        return MessageType(name, "", type_hash, "")
    definition, _ = store.generate_msgdef(name, ros_version=2)
    return MessageType(name, definition, type_hash or store.hash_rihs01(name))


def _register_from_ament(name: str) -> bool:
    from rosbags.typesys import get_types_from_msg

    store = typestore()
    found: dict[str, object] = {}
    todo = [name]
    while todo:
        current = todo.pop()
        if current in found or current in store.fielddefs:
            continue
        text = _definition_file(current)
        if text is None:
            return False
        for key, value in get_types_from_msg(text, current).items():
            found[key] = value
            todo.extend(_used_types(value))
    store.register(found)  # type: ignore[arg-type]
    return True


def _used_types(definition: object) -> list[str]:
    names: list[str] = []
    if isinstance(definition, str):
        if definition.count("/") == 2:
            names.append(definition)
    elif isinstance(definition, (list, tuple)):
        for part in definition:
            names.extend(_used_types(part))
    return names


def _definition_file(name: str) -> str | None:
    package, kind, short = name.split("/")
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "share", package, kind, f"{short}.msg")
        if prefix and path.is_file():
            return path.read_text(encoding="utf-8")
    return None
