"""Write rosbag2 folders that are complete and readable at every instant."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata
from pendulum_rosbag.storage.message_types import MessageType, message_type
from pendulum_rosbag.storage.metadata_file import FileEntry, MetadataFile, TopicEntry, encode_custom_data, qos_yaml
from pendulum_rosbag.storage.qos import QosProfile
from pendulum_rosbag.storage.storage_file import StorageFile

__all__ = ["STORAGES", "BagWriter"]

STORAGES = ("mcap", "sqlite3")
_COMPRESSIONS = (None, "zstd")
_SPARE = 256
"""How many bytes longer the numbers in a file's metadata may get until it is closed."""


class _Channels(dict[str, int]):
    def __init__(self, bag: Path) -> None:
        super().__init__()
        self._bag = bag

    def __missing__(self, topic: str) -> int:
        raise BagError(f"topic {topic} was not added to bag {self._bag} before its first message")


class BagWriter:
    """One rosbag2 folder that is being written; all methods are thread-safe.

    Messages wait in memory until ``seal``, which is called at ``chunk_size`` bytes. Flushed messages survive the death
    of the process; any rosbag2 reader reads them without repair.

    Args:
        path: Folder to create; it must not exist.
        storage: ``"mcap"`` or ``"sqlite3"``.
        compression: ``None`` or ``"zstd"`` (MCAP only, chunk by chunk).
        metadata: Run metadata; values that are not strings are stored as JSON text.
        max_size: Largest closed storage file [bytes], 0 for no limit; at least twice that of an empty file.
        max_duration: Longest time span of a storage file [s], 0 for no limit.
        ros_distro: Distribution named in ``metadata.yaml`` and in a database.
        file_stem: Beginning of the names of storage files; by default the name of the folder.

    Raises:
        BagError: The folder exists or cannot be created; in methods, the writer is closed.
        ParameterError: Unknown storage or compression.
        OSError: In methods that write: the disk is full or fails. Flushed messages remain readable.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        storage: str = "mcap",
        compression: str | None = None,
        metadata: Mapping[str, Any] | None = None,
        *,
        chunk_size: int = 1 << 20,
        max_size: int = 0,
        max_duration: float = 0.0,
        ros_distro: str = "jazzy",
        file_stem: str = "",
    ) -> None:
        if storage not in STORAGES:
            raise ParameterError(f"storage is {storage!r}; expected one of {', '.join(STORAGES)}")
        if compression not in _COMPRESSIONS:
            raise ParameterError(f"compression is {compression!r}; expected 'zstd' or none")
        if compression and storage != "mcap":
            raise ParameterError(f"compression is {compression!r} with storage {storage}; expected storage mcap")
        self.path = path = Path(path).absolute()
        if path.exists():
            raise BagError(f"bag {path} exists already; expected a new folder (bags are never overwritten)")
        self._file_stem = file_stem or path.name
        self.storage = storage
        self._compression = compression
        self._chunk_size = chunk_size
        self._max_size = max_size
        self._max_duration_ns = round(max_duration * 1e9)
        self._most = 0
        self._closing = 0
        self._span: tuple[int, int] | None = None
        self._ros_distro = ros_distro
        self._custom = encode_custom_data(metadata)
        self._topics: dict[str, TopicEntry] = {}
        self._ids = _Channels(path)
        self._written: dict[str, int] = {}
        self._files: list[FileEntry] = []
        self._lock = threading.RLock()
        self._open = True
        self._folder = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        self._metadata = MetadataFile(self._folder, storage, ros_distro)
        try:
            self._folder.mkdir(parents=True)
            self._file = self._open_file()
            self._update_metadata()
            self._metadata.abandon()
            os.rename(self._folder, path)
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise BagError(f"bag {path} cannot be created: {error.strerror or error}") from error
        self._folder = path
        self._metadata = MetadataFile(path, storage, ros_distro)
        self._file.path = path / self._file.path.name

    @property
    def written(self) -> dict[str, int]:
        """Topic name -> messages given to the writer so far."""
        return dict(self._written)

    @property
    def sealed(self) -> dict[str, int]:
        """Topic name -> messages that are safe in the file."""
        return {name: topic.count for name, topic in self._topics.items()}

    @property
    def files(self) -> list[Path]:
        """Storage files, in order of time."""
        return [self.path / entry.name for entry in self._files]

    def add_topic(
        self, name: str, type: str | MessageType, qos: QosProfile | Sequence[QosProfile] | None = None
    ) -> None:
        """Announce a topic before its first message; a BagError if the bag has it with another type.

        ``qos`` is what its publishers offer, by default reliable, keep last 10. Repeated calls do nothing.
        """
        described = message_type(type) if isinstance(type, str) else type
        profiles = (qos,) if isinstance(qos, QosProfile) else tuple(qos) if qos is not None else (QosProfile(),)
        with self._lock:
            self._require_open()
            known = self._topics.get(name)
            if known is not None:
                if known.type.name != described.name:
                    raise BagError(f"topic {name} has type {described.name}; the bag holds it as {known.type.name}")
                if known.type.serialization != described.serialization:
                    raise BagError(
                        f"topic {name} is encoded as {described.serialization!r}; the bag holds it as "
                        f"{known.type.serialization!r}"
                    )
                return
            self._topics[name] = TopicEntry(name, described, profiles)
            self._ids[name] = len(self._ids) + 1
            self._written[name] = 0
            self._add_channel(name)
            # Readers refuse a listed topic without a definition, so the file is sealed before the topic is listed;
            # they skip messages of unlisted topics, so both come before the first message.
            self._file.seal()
            self._note_sealed()
            self._update_metadata()

    def write(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Add a message: log time [ns since the epoch or of the simulation], CDR bytes with their encapsulation."""
        self.write_many([(topic, log_time_ns, data)])

    def write_many(self, items: Iterable[tuple[str, int, bytes]]) -> None:
        """Add many messages ``(topic, log_time_ns, data)`` under one lock; a BagError if a topic was not added."""
        messages = iter(items)
        with self._lock:
            self._require_open()
            if self._max_size or self._max_duration_ns:
                for topic, log_time_ns, data in messages:
                    self._write_within_limits(topic, log_time_ns, data)
                return
            while self._file.write_many(messages, self._ids, self._written, self._chunk_size):
                self.seal()

    def _write_within_limits(self, topic: str, log_time_ns: int, data: bytes) -> None:
        first, last = self._span or (log_time_ns, log_time_ns)
        span = min(first, log_time_ns), max(last, log_time_ns)
        if self._span and self._ids[topic]:
            too_long = 0 < self._max_duration_ns < span[1] - span[0]
            if too_long or (self._max_size and self._is_full(len(data))):
                self._split()
                span = log_time_ns, log_time_ns
        if self._file.write_many(iter(((topic, log_time_ns, data),)), self._ids, self._written, self._chunk_size):
            self.seal()
        self._span = span

    def _is_full(self, size: int) -> bool:
        if not self._closing:
            self._closing = len(self._metadata.render(*self._described)) + _SPARE
            self._most = max(self._max_size, self._file.size_with(0, empty=True) + self._closing + self._max_size // 2)
        if self._file.size_with(size) + self._closing <= self._most:
            return False
        if not self._compression:
            return True
        self._file.settle()  # compressed, it takes less
        return self._file.size_with(size) + self._closing > self._most

    def keep(self, record: Attachment | Metadata) -> None:
        """Add a copied attachment or metadata record to the current file; a BagError if the storage is not MCAP."""
        with self._lock:
            self._require_open()
            self._file.keep(record)

    def seal(self) -> None:
        """Write all messages so far to the file."""
        with self._lock:
            self._require_open()
            self._seal(self._file.seal)

    def _seal(self, work: Callable[[], None]) -> None:
        before = self._file.count
        work()
        if self._file.count != before:
            self._note_sealed()
            self._update_metadata()

    def sync(self) -> None:
        """Seal, and wait until the disk has it (survives a power failure); other threads may write meanwhile."""
        with self._lock:
            self._require_open()
            self._seal(self._file.settle)
            descriptor = self._file.duplicate()
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)

    def split(self) -> None:
        """Continue in a new storage file of the same bag."""
        with self._lock:
            self._require_open()
            self.seal()
            if self._file.count:
                self._split()

    def update_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Add or replace entries of the run metadata (``custom_data``)."""
        with self._lock:
            self._custom.update(encode_custom_data(metadata))
            if self._open:
                self._update_metadata()

    def close(self) -> None:
        """Seal, release unused space and close; repeated calls do nothing."""
        with self._lock:
            if not self._open:
                return
            self._open = False
            try:
                self._close_file()
            finally:
                self._metadata.finish(*self._described)

    def abandon(self) -> None:
        """Close without writing anything more, as if the process had died."""
        with self._lock:
            self._open = False
            self._file.abandon()
            self._metadata.abandon()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _require_open(self) -> None:
        if not self._open:
            raise BagError(f"bag {self.path} is closed; nothing can be written to it any more")

    def _open_file(self) -> StorageFile:
        name = f"{self._file_stem}_{len(self._files)}"
        if self.storage == "mcap":
            from pendulum_rosbag.storage.sealed_mcap import SealedMcapFile

            file: StorageFile = SealedMcapFile(self._folder / f"{name}.mcap", compression=self._compression)
        else:
            from pendulum_rosbag.storage.sealed_sqlite import SealedSqliteFile

            file = SealedSqliteFile(self._folder / f"{name}.db3", ros_distro=self._ros_distro)
        self._files.append(FileEntry(file.path.name))
        self._closing, self._span = 0, None
        return file

    def _add_channel(self, name: str) -> None:
        topic = self._topics[name]
        self._closing = 0  # (what is written when the file is closed gets longer)
        self._file.add_channel(self._ids[name], name, topic.type, qos_yaml(topic.qos).strip())

    def _note_sealed(self) -> None:
        entry = self._files[-1]
        entry.count, entry.start_ns, entry.stop_ns = self._file.count, self._file.start_ns, self._file.stop_ns
        for name, topic in self._topics.items():
            topic.count = self._written[name]

    @property
    def _described(self) -> tuple[list[TopicEntry], list[FileEntry], dict[str, str]]:
        return list(self._topics.values()), self._files, self._custom

    def _update_metadata(self) -> None:
        self._metadata.update(*self._described)

    def _split(self) -> None:
        self._close_file()
        self._file = self._open_file()
        for name in self._topics:
            self._add_channel(name)
        self._file.seal()
        self._update_metadata()

    def _close_file(self) -> None:
        text = ""
        try:
            self._file.seal()
            self._note_sealed()
            text = self._metadata.render(*self._described)
        finally:
            # rosbag2 stores the content of "rosbag2_bagfile_information" without that key.
            self._file.close(_without_root(text))


def _without_root(text: str) -> str:
    return "".join(line[2:] + "\n" for line in text.splitlines()[1:])
