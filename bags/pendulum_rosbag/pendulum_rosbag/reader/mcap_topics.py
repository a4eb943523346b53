"""Topic descriptions of an MCAP file: schemas, channels, metadata."""

from __future__ import annotations

import struct

from pendulum_rosbag.reader.batches import Stream
from pendulum_rosbag.reader.mcap_chunks import read_metadata, read_text, read_text_map
from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["McapTopics"]


class McapTopics:
    """Descriptions found in a summary, or between the messages.

    Attributes:
        schemas: Name, encoding and definition of each schema, by its number.
        channels: Schema, topic, encoding and metadata of each channel, by its number.
        metadata: Metadata records by name.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def clear(self) -> None:
        """Remove all descriptions."""
        for known in (self.schemas, self.channels, self.metadata):
            known.clear()

    def take(self, opcode: int, content: bytes) -> None:
        """Store a schema, channel or metadata record; raises struct.error or UnicodeDecodeError if it is not whole."""
        if opcode == rec.SCHEMA:
            (key,) = struct.unpack_from("<H", content)
            name, at = read_text(content, 2)
            encoding, at = read_text(content, at)
            definition, at = read_text(content, at, "surrogateescape")  # some encodings are not text
            self.schemas[key] = (name, encoding, definition)
        elif opcode == rec.CHANNEL:
            key, schema = struct.unpack_from("<HH", content)
            topic, at = read_text(content, 4)
            encoding, at = read_text(content, at)
            self.channels[key] = (schema, topic, encoding, read_text_map(content, at))
        elif opcode == rec.METADATA:
            found = read_metadata(content)
            self.metadata[found.name] = dict(found.items)

    def describe_all(self, named: set[int]) -> bool:
        """Return whether every channel of a set is described, and every schema of the channels."""
        return (
            named <= self.channels.keys()
            and {schema for schema, *_ in self.channels.values()} - {0} <= self.schemas.keys()
        )

    def stream(self, channel: int, count: int) -> Stream:
        """Return the description of a channel, with the number of its messages."""
        schema, topic, encoding, metadata = self.channels[channel]
        name, schema_encoding, definition = self.schemas.get(schema, ("", "", ""))
        type_hash, qos = metadata.get("topic_type_hash", ""), metadata.get("offered_qos_profiles", "")
        return Stream(channel, topic, name, count, definition, schema_encoding, type_hash, qos, encoding)
