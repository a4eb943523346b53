"""The interface of a storage format: one file of a bag that is being written."""

# ruff: noqa: D102 (the implementations document the methods)
from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol

from pendulum_rosbag.storage.mcap_records import Attachment, Metadata
from pendulum_rosbag.storage.message_types import MessageType

__all__ = ["StorageFile", "write_at"]


class StorageFile(Protocol):
    """Interface of a storage format; see :class:`~pendulum_rosbag.storage.sealed_mcap.SealedMcapFile`."""

    path: Path

    @property
    def count(self) -> int: ...
    @property
    def start_ns(self) -> int: ...
    @property
    def stop_ns(self) -> int: ...
    def size_with(self, size: int, *, empty: bool = False) -> int: ...
    def add_channel(self, channel_id: int, topic: str, type: MessageType, qos: str) -> None: ...
    def write_many(
        self, messages: Iterator[tuple[str, int, bytes]], channels: Mapping[str, int], counts: dict[str, int], most: int
    ) -> bool: ...
    def seal(self) -> None: ...
    def settle(self) -> None: ...
    def duplicate(self) -> int: ...
    def keep(self, record: Attachment | Metadata) -> None: ...
    def close(self, metadata: str = "") -> None: ...
    def abandon(self) -> None: ...


def write_at(descriptor: int, data: bytes | bytearray, offset: int) -> None:
    """Write all bytes at an offset of an open file; raises OSError if the disk is full or fails."""
    view = memoryview(data)
    while view:
        done = os.pwrite(descriptor, view, offset)
        view = view[done:]
        offset += done
