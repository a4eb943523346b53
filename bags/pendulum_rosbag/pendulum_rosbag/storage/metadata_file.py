"""``metadata.yaml`` of a rosbag2 folder (version 9), written so that it is whole at every instant."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pendulum_rosbag.storage.message_types import MessageType
from pendulum_rosbag.storage.qos import QosProfile

__all__ = [
    "METADATA_NAME",
    "METADATA_VERSION",
    "FileEntry",
    "MetadataFile",
    "TopicEntry",
    "encode_custom_data",
    "qos_yaml",
    "yaml_string",
]

METADATA_NAME = "metadata.yaml"
METADATA_VERSION = 9
_WIDTH = 19
"""Digits of the largest 64-bit integer."""

# YAML allows these only escaped, JSON leaves them as they are.
_PLAIN = re.compile("cdr|[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)+")
"""CDR, or a name of a ROS type, which YAML takes for text without quotes."""
_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")


@dataclass(slots=True)
class TopicEntry:
    """A topic of the bag, with the number of its messages."""

    name: str
    type: MessageType
    qos: tuple[QosProfile, ...] = ()
    count: int = 0


@dataclass(slots=True)
class FileEntry:
    """A storage file of the bag; times in ns since the epoch, ``stop_ns`` of the last message."""

    name: str
    count: int = 0
    start_ns: int = 0
    stop_ns: int = 0


def yaml_string(text: str) -> str:
    """Return a string as a double-quoted YAML scalar that every YAML parser reads back unchanged."""
    quoted = json.dumps(text, ensure_ascii=False)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def encode_custom_data(metadata: Mapping[str, Any] | None) -> dict[str, str]:
    """Return run metadata as rosbag2 can hold it: strings; anything else becomes JSON text."""
    return {
        str(key): value if isinstance(value, str) else json.dumps(value, default=str, sort_keys=True)
        for key, value in (metadata or {}).items()
    }


def qos_yaml(profiles: Sequence[QosProfile], indent: str = "") -> str:
    """Return offered QoS profiles as a block-style YAML list (an empty list as ``[]``)."""
    if not profiles:
        return f"{indent}[]\n"
    return "".join(profile.to_yaml(indent) for profile in profiles)


class MetadataFile:
    """Renders and replaces ``metadata.yaml`` of one bag.

    A recorder rewrites the file many times a second, so the text of topics and run metadata is kept and only the
    numbers are rendered anew. They keep their places while the file is written, so that new ones are written over the
    old ones: to replace a file costs ext4 300 times as much, since it allocates the new one's place at once.

    Args:
        folder: Folder of the bag.
        storage: ``mcap`` or ``sqlite3``.
        ros_distro: Such as ``jazzy``.
    """

    def __init__(self, folder: Path, storage: str, ros_distro: str) -> None:
        self.path = folder / METADATA_NAME
        # Made once: pathlib interns the parts of each new path, and twenty a second fill the interpreter's table of
        # strings, which after ten minutes takes a megabyte more.
        self._temporary = folder / f".{METADATA_NAME}.tmp"
        self._storage = storage
        self._ros_distro = ros_distro
        self._key: tuple[Any, ...] | None = None
        self._topic_texts: list[str] = []
        self._custom_text = ""
        self._fd = -1
        self._size = 0

    def render(
        self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str], width: int = 0
    ) -> str:
        """Return the text for these topics, storage files (in order of time) and run metadata.

        Args:
            topics: With the numbers of their messages.
            files: Storage files, in order of time.
            custom_data: Run metadata.
            width: Characters that each number takes at least, with blanks behind it.
        """
        filled = [file for file in files if file.count]
        start = min((file.start_ns for file in filled), default=0)
        stop = max((file.stop_ns for file in filled), default=0)
        key = (tuple((t.name, t.type.name, t.qos) for t in topics), tuple(custom_data.items()))
        if self._key != key:
            self._key = key
            self._topic_texts = [_topic_head(topic) for topic in topics]
            self._custom_text = _custom_text(custom_data)
        head = (
            "rosbag2_bagfile_information:\n"
            f"  version: {METADATA_VERSION}\n"
            f"  storage_identifier: {self._storage}\n"
            f"  duration:\n    nanoseconds: {stop - start:<{width}}\n"
            f"  starting_time:\n    nanoseconds_since_epoch: {start:<{width}}\n"
            f"  message_count: {sum(topic.count for topic in topics):<{width}}\n"
            f"  topics_with_message_count:{'' if topics else ' []'}\n"
        )
        body = "".join(
            f"{text}      message_count: {topic.count:<{width}}\n"
            for text, topic in zip(self._topic_texts, topics, strict=True)
        )
        paths = "".join(f"    - {yaml_string(file.name)}\n" for file in files)
        entries = "".join(
            f"    - path: {yaml_string(file.name)}\n"
            f"      starting_time:\n        nanoseconds_since_epoch: {file.start_ns:<{width}}\n"
            f"      duration:\n        nanoseconds: {file.stop_ns - file.start_ns:<{width}}\n"
            f"      message_count: {file.count:<{width}}\n"
            for file in files
        )
        return (
            f"{head}{body}"
            '  compression_format: ""\n  compression_mode: ""\n'
            f"  relative_file_paths:\n{paths}  files:\n{entries}"
            f"{self._custom_text}  ros_distro: {self._ros_distro}\n"
        )

    def update(self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str]) -> None:
        """Write the file while the bag is written; after a kill it holds the old numbers or the new ones.

        Who reads it in the very microsecond in which numbers are written may see digits of both.

        Raises:
            OSError: The disk is full or fails; the file is as it was.
        """
        data = self.render(topics, files, custom_data, _WIDTH).encode()
        if not (self._is_in_place() and len(data) == self._size and os.pwrite(self._fd, data, 0) == len(data)):
            self._replace(data)
            self._fd, self._size = os.open(self.path, os.O_WRONLY), len(data)

    def finish(self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str]) -> None:
        """Write the file for the last time, without the blanks; raises as :meth:`update`."""
        try:
            self._replace(self.render(topics, files, custom_data).encode())
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Leave the file as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _is_in_place(self) -> bool:
        """Tell whether the open file is the bag's; somebody may have moved or removed it."""
        try:
            return self._fd >= 0 and os.path.samestat(os.fstat(self._fd), self.path.stat())
        except FileNotFoundError:
            return False

    def _replace(self, data: bytes) -> None:
        """Put a new file in the old one's place: a reader, and a kill at any moment, sees one of them."""
        self.abandon()
        try:
            self._temporary.write_bytes(data)
            os.replace(self._temporary, self.path)
        except OSError:
            self._temporary.unlink(missing_ok=True)
            raise


def _topic_head(topic: TopicEntry) -> str:
    qos = f"\n{qos_yaml(topic.qos, ' ' * 10)}" if topic.qos else " []\n"
    kind, serialization = (
        text if _PLAIN.fullmatch(text) else yaml_string(text) for text in (topic.type.name, topic.type.serialization)
    )
    return (
        "    - topic_metadata:\n"
        f"        name: {yaml_string(topic.name)}\n"
        f"        type: {kind}\n"
        f"        serialization_format: {serialization}\n"
        f"        offered_qos_profiles:{qos}"
        f"        type_description_hash: {yaml_string(topic.type.hash)}\n"
    )


def _custom_text(custom_data: Mapping[str, str]) -> str:
    if not custom_data:
        return "  custom_data: ~\n"
    lines = "".join(f"    {yaml_string(key)}: {yaml_string(value)}\n" for key, value in custom_data.items())
    return f"  custom_data:\n{lines}"
