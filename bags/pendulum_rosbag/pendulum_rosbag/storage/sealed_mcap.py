"""An MCAP file that is complete at every instant (layout: :mod:`~pendulum_rosbag.storage.mcap_layout`)."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag import __version__
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_rosbag.storage.mcap_layout import McapLayout
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata
from pendulum_rosbag.storage.mcap_summary import Chunk, Compressor, McapSummary, build_chunk
from pendulum_rosbag.storage.message_types import MessageType

__all__ = ["SealedMcapFile"]

_LARGEST_NUMBER = 256
"""Most staged chunks, so that rare messages do not make a long index either."""
_NO_SPAN = (2**63 - 1, 0)
_LEAST_SIZE = 576
"""Most bytes in a closed file besides messages, topics and metadata."""
_CHANNEL_SIZE = 35
"""Bytes that a topic adds to the index of a chunk and to the statistics."""


class SealedMcapFile:
    """Append messages to a new MCAP file; after ``seal`` every reader sees them. ``compression`` is None or "zstd".

    Each seal adds a small chunk; about each megabyte they are rewritten as one, so neither seals nor memory grow. A
    BagError if the file exists; an OSError, in all methods, if the disk fails: the flushed messages remain.
    """

    def __init__(self, path: Path, *, compression: str | None = None) -> None:
        if path.exists():
            raise BagError(f"{path} exists already; expected a new file")
        self.path = path
        self._compressor = ("zstd", _zstd_compressor()) if compression == "zstd" else None
        self._summary = McapSummary()
        self._schema_ids: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}
        # Unsealed messages: records, and channel -> [log time, offset, log time, offset, ...].
        self._pending: list[bytes] = []
        self._pending_size = 0
        self._pending_index: dict[int, list[int]] = {}
        self._pending_span = _NO_SPAN
        # The same for staged messages.
        self._group: list[bytes] = []
        self._group_size = 0
        self._group_count = 0
        self._group_index: dict[int, list[bytes]] = {}
        self._group_span = _NO_SPAN
        self._stale = False
        self._records: list[Attachment | Metadata] = []
        self._layout = McapLayout(path, rec.MAGIC + rec.header_record(f"pendulum_rosbag {__version__}"), self._summary)

    @property
    def count(self) -> int:
        """Number of sealed messages."""
        return self._summary.count

    @property
    def start_ns(self) -> int:
        """First log time of the sealed messages [ns]."""
        return self._summary.start_ns

    @property
    def stop_ns(self) -> int:
        """Last log time of the sealed messages [ns]."""
        return self._summary.stop_ns

    def size_with(self, size: int, *, empty: bool = False) -> int:
        """Return the closed file's size with one more message of ``size`` [bytes] (or only that one), less metadata."""
        summary = len(self._summary.description) + len(self._summary.settled) + _CHANNEL_SIZE * len(self._sequences)
        if empty:
            return _LEAST_SIZE + summary
        # Pending parts come in pairs: head and content of a message, schema and channel.
        entries = 16 * (self._group_count + len(self._pending) // 2)
        message = size + 47 if size else 0
        return (
            _LEAST_SIZE + summary + self._layout.settled_end + self._group_size + self._pending_size + entries + message
        )

    def add_channel(self, channel_id: int, topic: str, type: MessageType, qos: str) -> None:
        """Describe a topic before its first message (ids from 1; QoS profiles as YAML text)."""
        key = (type.name, type.definition)  # neither: messages that describe themselves, such as JSON
        schema_id = self._schema_ids.get(key, 0)
        schema = b""
        if not schema_id and any(key):
            schema_id = self._schema_ids[key] = self._summary.schemas + 1
            schema = rec.schema_record(schema_id, type.name, type.encoding, type.definition)
            self._summary.add_schema(schema)
        described = {"offered_qos_profiles": qos, "topic_type_hash": type.hash}  # the keys of rosbag2
        channel = rec.channel_record(channel_id, schema_id, topic, type.serialization, described)
        self._summary.add_channel(channel_id, channel)
        self._sequences[channel_id] = 0
        self._pending += [schema, channel]
        self._pending_size += len(schema) + len(channel)
        self._stale = True

    def write_many(
        self, messages: Iterator[tuple[str, int, bytes]], channels: Mapping[str, int], counts: dict[str, int], most: int
    ) -> bool:
        """Add messages (topic, log time [ns], CDR) until the chunk has ``most`` bytes; return whether it is full.

        Counts them in ``counts``; the rest stays in the iterator. Raises BagError at a topic without channel.
        """
        pending, index, sequences = self._pending, self._pending_index, self._sequences
        pack, size, (start, stop) = rec.MESSAGE_HEADER.pack, self._pending_size, self._pending_span
        try:
            for topic, log_time_ns, data in messages:
                channel, length = channels[topic], len(data)
                sequence = sequences[channel] + 1
                pending += (pack(rec.MESSAGE, length + 22, channel, sequence, log_time_ns, log_time_ns), data)
                sequences[channel] = sequence
                if channel not in index:
                    index[channel] = []
                index[channel] += (log_time_ns, size)
                size += length + 31
                if log_time_ns < start:  # noqa: PLR1730  # to call min takes longer
                    start = log_time_ns
                if log_time_ns > stop:  # noqa: PLR1730
                    stop = log_time_ns
                counts[topic] += 1
                if size >= most:
                    return True
            return False
        finally:
            self._pending_size, self._pending_span = size, (start, stop)

    def keep(self, record: Attachment | Metadata) -> None:
        """Store an attachment or a metadata record when the file is closed."""
        self._records.append(record)

    def seal(self) -> None:
        """Write everything so far to the file."""
        if self._pending_index:
            if self._stale and self._summary.count:
                self._publish()  # a seal before failed on its way: its chunks must be listed before more come
            self._seal_pending()
        if self._stale:
            self._publish()

    def settle(self) -> None:
        """Seal, and merge the staged chunks into one."""
        self.seal()
        if self._summary.staged_chunks:
            self._settle_group()
            self._publish()

    def duplicate(self) -> int:
        """Return a duplicate descriptor for waiting for the disk; the caller closes it."""
        return self._layout.duplicate()

    def close(self, metadata: str = "") -> None:
        """Seal, write summary, the text of ``metadata.yaml`` and footer, cut off the unused room and close."""
        if not self._layout.is_open:
            return
        try:
            try:
                self.settle()
            finally:
                # Also after a failed seal: a full disk needs the unused space.
                own = [Metadata("rosbag2", {"serialized_metadata": metadata})] if metadata else []
                self._layout.finish([*self._records, *own])
            self._layout.sync()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close without writing; the sealed content remains."""
        self._layout.abandon()

    def _seal_pending(self) -> None:
        layout = self._layout
        whole = self._group_size + self._pending_size
        if whole < layout.group_limit and self._summary.staged_chunks < _LARGEST_NUMBER:
            chunk = self._pending_chunk()
            if layout.can_stage(chunk.size):
                record = chunk.index_record(layout.stage(chunk))
                self._take_pending()
                self._summary.stage(record)
                return
        chunk = self._group_chunk(with_pending=True)
        if layout.can_settle(chunk.size):
            record = chunk.index_record(layout.settle(chunk))
            self._take_pending()
            self._finish_group(record)
            return
        # Too large for the space before the staged chunks: settle those first.
        self._settle_group()
        self._publish()
        chunk = self._group_chunk(with_pending=True)
        record = chunk.index_record(layout.settle(chunk))
        self._take_pending()
        self._finish_group(record)

    def _settle_group(self) -> None:
        chunk = self._group_chunk(with_pending=False)
        self._finish_group(chunk.index_record(self._layout.settle(chunk)))

    def _pending_chunk(self) -> Chunk:
        indexes = [
            (channel, struct.pack(f"<{len(entries)}Q", *entries)) for channel, entries in self._pending_index.items()
        ]
        return build_chunk(b"".join(self._pending), indexes, self._pending_span, self._compressor)

    def _group_chunk(self, *, with_pending: bool) -> Chunk:
        if not with_pending:
            parts, span, index = self._group, self._group_span, self._group_index
        else:
            parts = self._group + self._pending
            span = _union(self._group_span, self._pending_span)
            index = {channel: list(entries) for channel, entries in self._group_index.items()}
            self._add_entries(index)
        entries = [(channel, b"".join(items)) for channel, items in index.items()]
        return build_chunk(b"".join(parts), entries, span, self._compressor)

    def _add_entries(self, index: dict[int, list[bytes]]) -> None:
        for channel, entries in self._pending_index.items():
            table = np.array(entries, "<u8")
            table[1::2] += np.uint64(self._group_size)
            index.setdefault(channel, []).append(table.tobytes())

    def _take_pending(self) -> None:
        self._add_entries(self._group_index)
        self._group.append(b"".join(self._pending))
        self._group_size += self._pending_size
        self._group_span = _union(self._group_span, self._pending_span)
        counts = {channel: len(entries) // 2 for channel, entries in self._pending_index.items()}
        self._summary.add_messages(counts, self._pending_span)
        self._group_count += sum(counts.values())
        self._pending.clear()
        self._pending_size = 0
        self._pending_index.clear()
        self._pending_span = _NO_SPAN
        self._stale = True

    def _finish_group(self, record: bytes) -> None:
        self._summary.settle(record)
        self._group.clear()
        self._group_size = self._group_count = 0
        self._group_index.clear()
        self._group_span = _NO_SPAN
        self._stale = True

    def _publish(self) -> None:
        self._layout.publish()
        self._stale = False


def _union(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    return min(a[0], b[0]), max(a[1], b[1])


def _zstd_compressor() -> Compressor:
    import zstandard

    return zstandard.ZstdCompressor(level=1).compress
