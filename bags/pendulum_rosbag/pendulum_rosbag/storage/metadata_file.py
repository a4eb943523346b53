"""``metadata.yaml`` of a rosbag2 folder (version 9), complete at every instant."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pendulum_rosbag.storage.exchange import exchange
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

_PLAIN = re.compile("cdr|[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)+")
"""CDR, or the name of a ROS type: YAML reads these as text without quotes."""
_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")
"""YAML requires escapes for these, JSON does not write them."""


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
    """Return a double-quoted YAML scalar that every YAML parser reads back unchanged."""
    quoted = json.dumps(text, ensure_ascii=False)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def encode_custom_data(metadata: Mapping[str, Any] | None) -> dict[str, str]:
    """Return run metadata as rosbag2 stores it: strings; other values become JSON text."""
    return {
        str(key): value if isinstance(value, str) else json.dumps(value, default=str, sort_keys=True)
        for key, value in (metadata or {}).items()
    }


def qos_yaml(profiles: Sequence[QosProfile], indent: str = "") -> str:
    """Return offered QoS profiles as a block-style YAML list (``[]`` if empty)."""
    if not profiles:
        return f"{indent}[]\n"
    return "".join(profile.to_yaml(indent) for profile in profiles)


class MetadataFile:
    """Renders and replaces ``metadata.yaml`` of one bag, many times a second.

    Its text is cached, and two files exchange names: creating and renaming one costs ext4 thirty times as much.
    """

    def __init__(self, folder: Path, storage: str, ros_distro: str) -> None:
        self.path = folder / METADATA_NAME
        # Created once: pathlib interns the parts of each new path, which at 20 Hz cost a megabyte in ten minutes.
        self._temporary = folder / f".{METADATA_NAME}.tmp"
        self._storage = storage
        self._ros_distro = ros_distro
        self._key: tuple[Any, ...] | None = None
        self._topic_texts: list[str] = []
        self._custom_text = ""
        # Descriptors of the visible file and of the one before it.
        self._seen = self._spare = -1

    def render(self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str]) -> str:
        """Return the text for topics, storage files (in time order) and run metadata."""
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
            f"  duration:\n    nanoseconds: {stop - start}\n"
            f"  starting_time:\n    nanoseconds_since_epoch: {start}\n"
            f"  message_count: {sum(topic.count for topic in topics)}\n"
            f"  topics_with_message_count:{'' if topics else ' []'}\n"
        )
        body = "".join(
            f"{text}      message_count: {topic.count}\n" for text, topic in zip(self._topic_texts, topics, strict=True)
        )
        paths = "".join(f"    - {yaml_string(file.name)}\n" for file in files)
        entries = "".join(
            f"    - path: {yaml_string(file.name)}\n"
            f"      starting_time:\n        nanoseconds_since_epoch: {file.start_ns}\n"
            f"      duration:\n        nanoseconds: {file.stop_ns - file.start_ns}\n"
            f"      message_count: {file.count}\n"
            for file in files
        )
        return (
            f"{head}{body}"
            '  compression_format: ""\n  compression_mode: ""\n'
            f"  relative_file_paths:\n{paths}  files:\n{entries}"
            f"{self._custom_text}  ros_distro: {self._ros_distro}\n"
        )

    def update(self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str]) -> None:
        """Write the file during the recording; a reader, or a kill at any moment, sees the old text or the new.

        A reader at the update after next may see both. Raises OSError if the disk fails or the folder was moved.
        """
        data = self.render(topics, files, custom_data).encode()
        if not self._take_turns(data):
            self._replace(data)
            self._seen = os.open(self.path, os.O_WRONLY)

    def finish(self, topics: Sequence[TopicEntry], files: Sequence[FileEntry], custom_data: Mapping[str, str]) -> None:
        """Write the file for the last time; raises as :meth:`update`."""
        self._replace(self.render(topics, files, custom_data).encode())

    def abandon(self) -> None:
        """Leave the file as it is."""
        if self._spare >= 0 and _is_at(self._spare, self._temporary):
            with contextlib.suppress(OSError):
                self._temporary.unlink()
        for descriptor in (self._seen, self._spare):
            if descriptor >= 0:
                os.close(descriptor)
        self._seen = self._spare = -1

    def _take_turns(self, data: bytes) -> bool:
        # If another program replaced the visible file, an exchange would bring its file back the next time.
        if not _is_at(self._seen, self.path):
            return False
        if not _is_at(self._spare, self._temporary):
            if self._spare >= 0:
                return False
            self._spare = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        if os.pwrite(self._spare, data, 0) < len(data):
            return False
        if os.fstat(self._spare).st_size != len(data):
            os.ftruncate(self._spare, len(data))
        if not exchange(self._temporary, self.path):
            return False
        self._seen, self._spare = self._spare, self._seen
        return True

    def _replace(self, data: bytes) -> None:
        self.abandon()
        try:
            self._temporary.write_bytes(data)
            os.replace(self._temporary, self.path)
        except OSError:
            self._temporary.unlink(missing_ok=True)
            raise


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return descriptor >= 0 and os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


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
