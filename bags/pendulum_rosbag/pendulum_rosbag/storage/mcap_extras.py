"""What an MCAP file holds besides messages: attachments and named maps of strings."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["Attachment", "Metadata"]

_TIMES = struct.Struct("<QQ")


@dataclass(frozen=True)
class Attachment:
    """A file inside the file: its record's content as it stands there, checksum included.

    Args:
        content: Log time, creation time, name, media type, data and checksum, as the format lays them out.
        name: As in ``content``.
        media_type: As in ``content``.
        data_size: Bytes of data.
    """

    content: bytes
    name: str
    media_type: str
    data_size: int

    def record(self) -> bytes:
        """Return the whole record."""
        return rec.record(rec.ATTACHMENT, self.content)

    def index_record(self, offset: int) -> bytes:
        """Return the summary's record of it when it begins at byte ``offset`` of the file."""
        log_time_ns, create_time_ns = _TIMES.unpack_from(self.content)
        length = rec.RECORD_HEAD_SIZE + len(self.content)
        return rec.attachment_index_record(
            offset, length, log_time_ns, create_time_ns, self.data_size, self.name, self.media_type
        )


@dataclass(frozen=True)
class Metadata:
    """A named map of strings."""

    name: str
    items: Mapping[str, str]

    def record(self) -> bytes:
        """Return the whole record."""
        return rec.metadata_record(self.name, self.items)

    def index_record(self, offset: int) -> bytes:
        """Return the summary's record of it when it begins at byte ``offset`` of the file."""
        return rec.metadata_index_record(offset, len(self.record()), self.name)
