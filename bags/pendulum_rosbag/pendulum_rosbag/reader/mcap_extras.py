"""Attachments and metadata of an MCAP file, found without its index: also in a file that was cut off."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING

from pendulum_rosbag.reader.mcap_chunks import read_text, read_text_map
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_rosbag.storage.mcap_extras import Attachment, Metadata

if TYPE_CHECKING:
    from pendulum_rosbag.reader.batches import Bytes

__all__ = ["find_extras"]

_HEAD = rec.RECORD_HEAD_SIZE
OURS = "rosbag2"
"""Name of the metadata that every writer of rosbag2 files makes anew."""


def find_extras(buffer: Bytes) -> Iterator[Attachment | Metadata]:
    """Yield what a file holds besides messages, the copy of its ``metadata.yaml`` left out; broken records too.

    Args:
        buffer: The whole file, shape (n,).
    """
    view, size, at = buffer.data, len(buffer), len(rec.MAGIC)
    while at + _HEAD <= size:
        opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
        body = at + _HEAD
        at = body + length
        if opcode in (0, rec.DATA_END, rec.FOOTER) or at > size:
            return
        if opcode not in (rec.ATTACHMENT, rec.METADATA):
            continue
        content = bytes(view[body:at])
        try:
            extra = _attachment(content) if opcode == rec.ATTACHMENT else _metadata(content)
        except (struct.error, UnicodeDecodeError):
            continue
        if not isinstance(extra, Metadata) or extra.name != OURS:
            yield extra


def _attachment(content: bytes) -> Attachment:
    name, at = read_text(content, 16)
    media_type, at = read_text(content, at)
    (size,) = struct.unpack_from("<Q", content, at)
    if at + 8 + size + 4 != len(content):
        raise struct.error("attachment does not fill its record")
    return Attachment(content, name, media_type, size)


def _metadata(content: bytes) -> Metadata:
    name, at = read_text(content, 0)
    return Metadata(name, read_text_map(content, at))
