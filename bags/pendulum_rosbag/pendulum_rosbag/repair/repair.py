"""Repairing bags that a recorder left broken: all whole messages go to a new, sound bag."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.storage.bag_writer import BagWriter
from pendulum_rosbag.storage.message_types import MessageType, message_type
from pendulum_rosbag.storage.qos import profiles_of

if TYPE_CHECKING:
    from pendulum_rosbag.reader.batches import Source, Stream

__all__ = ["RepairReport", "message_type_of", "repair_bag"]


@dataclass(slots=True)
class RepairReport:
    """What a repair found and did to the bag that is now at ``path``.

    ``damage`` and ``left_out`` are sentences, ``messages`` counts the saved ones by topic, ``kept`` names attachments
    and metadata of other writers; ``original`` is where the broken bag is now, None if nothing was repaired.
    """

    path: Path
    damage: list[str] = field(default_factory=list)
    messages: dict[str, int] = field(default_factory=dict)
    original: Path | None = None
    kept: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    @property
    def repaired(self) -> bool:
        """Whether a new bag was written."""
        return self.original is not None

    def sentence(self) -> str:
        """Return the report in one sentence."""
        if not self.repaired:
            return f"{self.path} is sound: nothing to repair"
        total = sum(self.messages.values())
        kept = f" and {len(self.kept)} attachments and metadata" if self.kept else ""
        left_out = f"; LEFT OUT: {'; '.join(self.left_out)}" if self.left_out else ""
        return (
            f"saved {total} messages of {len(self.messages)} topics{kept} to {self.path}; the original is "
            f"{self.original}{left_out}"
        )


def repair_bag(
    path: str | os.PathLike[str], output: str | os.PathLike[str] | None = None, *, force: bool = False
) -> RepairReport:
    """Write all whole messages of a broken bag to a new one; a sound bag is left alone unless ``force``.

    Without ``output`` (a folder that must not exist) the new bag takes the place of the broken one, which becomes
    ``NAME.broken``; a single storage file gets a folder ``NAME_repaired`` alongside it. A BagError if nothing can be
    read or the new bag cannot be written.
    """
    from pendulum_rosbag.reader.open_source import damage_of, open_folder, open_sources

    bag = Path(path)
    folder = open_folder(bag)
    sources = open_sources(folder, verify=True)
    damage = damage_of(folder, sources)
    damage += [f"{source.path.name}: its recorder did not close it" for source in sources if source.unclosed]
    report = RepairReport(bag, damage)
    if not damage and not force:
        _close(sources)
        return report
    in_place = output is None and bag.is_dir()
    target = Path(output) if output is not None else bag.with_name(f"{bag.name.split('.')[0]}_repaired")
    if in_place:
        target = bag.with_name(f"{bag.name}.repairing")
        if target.exists():
            raise BagError(f"{target} exists already; expected no unfinished repair (remove it to begin again)")
    try:
        compression = "zstd" if any(source.compressed for source in sources) and folder.storage == "mcap" else None
        name = bag.name if in_place else target.name
        with BagWriter(target, folder.storage, compression, folder.custom_data, file_stem=name) as writer:
            report.left_out = _copy(sources, folder.topic_hashes, writer)
            report.messages = writer.written
            report.kept = [extra.name for source in sources for extra in source.extras()]
    except BaseException:
        if in_place:
            shutil.rmtree(target, ignore_errors=True)
        raise
    finally:
        _close(sources)
    if in_place:
        report.original = _free_name(bag.with_name(f"{bag.name}.broken"))
        os.rename(bag, report.original)
        os.rename(target, bag)
    else:
        report.path, report.original = target, bag
    return report


def _copy(sources: list[Source], hashes: dict[str, str], writer: BagWriter) -> list[str]:
    left_out: list[str] = []
    for source in sources:
        streams: dict[int, Stream] = {}
        for stream in source.streams:
            kind = message_type_of(stream, hashes.get(stream.topic, ""))
            try:
                writer.add_topic(stream.topic, kind, profiles_of(stream.qos))
            except BagError as error:
                if stream.count:
                    left_out.append(f"{stream.count} messages ({error})")
                continue
            streams[stream.channel] = stream
        for batch in source.batches(set(streams), None, None):
            topic = streams[batch.channel].topic
            writer.write_many((topic, time, data) for time, data in batch.payloads())
        for extra in source.extras():
            writer.keep(extra)
    return left_out


def message_type_of(stream: Stream, type_hash: str) -> MessageType:
    """Return the type of a topic as its file describes it, completed by what is known of the type."""
    if stream.serialization != "cdr" or stream.type.count("/") != 2:
        return MessageType(stream.type, stream.definition, stream.hash, stream.encoding, stream.serialization)
    if stream.definition:
        known = stream.hash or type_hash or _known_hash(stream.type)
        return MessageType(stream.type, stream.definition, known, stream.encoding)
    return message_type(stream.type, stream.hash or type_hash)


def _known_hash(name: str) -> str:
    try:
        return message_type(name).hash
    except BagError:
        return ""


def _free_name(path: Path) -> Path:
    number = 1
    candidate = path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}{number}")
    return candidate


def _close(sources: list[Source]) -> None:
    for source in sources:
        source.close()
