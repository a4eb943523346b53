"""Finding the storage files of a bag, with or without its ``metadata.yaml``."""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Any

import yaml

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Source
from pendulum_rosbag.reader.decompression import UnpackedSource, decompress_bounded, holds_packed_messages
from pendulum_rosbag.reader.mcap_source import McapSource
from pendulum_rosbag.reader.sqlite_source import SqliteSource
from pendulum_rosbag.storage.metadata_file import METADATA_NAME, METADATA_VERSION

__all__ = [
    "BagFolder",
    "damage_of",
    "is_bag_folder",
    "is_ros1",
    "is_storage_file",
    "open_folder",
    "open_source",
    "open_sources",
    "parsed",
]

_ENDINGS = {".mcap": "mcap", ".db3": "sqlite3"}
_LEAST_ROOM = 1 << 28
_MAX_RATIO = 100
"""Largest ratio of content to size in a file compressed as a whole: states reach 5, bombs far more."""
_MAX_METADATA = 16 << 20
_MAX_DEPTH = 40
_NO_METADATA = (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError, RecursionError, OverflowError)
"""Errors of reading YAML that is not a bag's."""


@dataclass(slots=True)
class BagFolder:
    """What is known of a bag before its storage files are opened."""

    path: Path
    files: list[Path]
    storage: str = ""
    custom_data: dict[str, str] = field(default_factory=dict)
    topic_hashes: dict[str, str] = field(default_factory=dict)
    message_compression: bool | None = None
    """Whether messages are compressed one by one; ``None`` if unknown."""
    topic_counts: dict[str, int] = field(default_factory=dict)
    """Messages by topic in the metadata; empty if unknown."""
    damage: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Files left out as duplicates, or read without being listed."""
    unlisted: list[Path] = field(default_factory=list)
    """Files that no metadata lists."""
    twins: dict[Path, Path] = field(default_factory=dict)
    """File -> the same file in its other form (compressed or not), which is not read."""

    @property
    def metadata(self) -> dict[str, Any]:
        """Run metadata (``custom_data``), JSON values parsed."""
        return {key: parsed(value) for key, value in self.custom_data.items()}


def is_storage_file(path: Path) -> bool:
    """Return whether a file's name is that of a storage file, compressed as a whole or not."""
    return _ending(path) in _ENDINGS and not path.name.startswith(".") and path.is_file()


def is_ros1(path: Path) -> bool:
    """Return whether a file's name is that of a ROS 1 bag; ``.active`` is one whose recorder was killed."""
    return path.name.removesuffix(".active").endswith(".bag") and path.is_file()


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a bag: it has storage files, or metadata of lost ones."""
    if any(is_storage_file(file) for file in path.iterdir()):
        return True
    try:
        return "rosbag2_bagfile_information" in _read_metadata(path / METADATA_NAME)
    except (OSError, UnicodeDecodeError):
        return False


def open_folder(path: Path) -> BagFolder:
    """Read a bag's metadata and list its storage files; a BagError if there are none."""
    if not path.exists():
        raise BagError(f"bag {path} does not exist")
    if path.is_file():
        return BagFolder(path, [path], _ENDINGS.get(_ending(path), ""))
    folder = BagFolder(path, [])
    try:
        text = _read_metadata(path / METADATA_NAME)
    except FileNotFoundError:
        folder.damage.append(f"{METADATA_NAME} is missing")
    except (OSError, UnicodeDecodeError) as error:
        folder.damage.append(f"{METADATA_NAME} is not readable: {error}")
    else:
        _take_metadata(folder, text)
    try:
        inside = [file for file in path.iterdir() if is_storage_file(file)]
    except OSError as error:
        raise BagError(f"{path} cannot be read as a bag: {error.strerror or error}") from error
    present = sorted(inside, key=_file_order)
    listed, missing = _listed(folder.files, present)
    if missing:
        folder.damage.append(f"listed but missing: {', '.join(missing)}")
    _choose_files(folder, listed, present)
    if not folder.files:
        raise BagError(f"{path} is no bag: it has neither {METADATA_NAME} with its files nor any .mcap or .db3 file")
    folder.storage = folder.storage or _ENDINGS[_ending(folder.files[0])]
    return folder


def _listed(named: Iterable[Path], present: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the files named in the metadata in their present form, and the names of the missing ones."""
    found, missing = [], []
    for path in named:
        names = (path.name, _other_form(path).name)
        file = next((file for name in names for file in present if file.name == name), path)
        if file.is_file():
            found.append(file)
        else:
            missing.append(path.name)
    return found, missing


def _choose_files(folder: BagFolder, listed: Sequence[Path], present: Sequence[Path]) -> None:
    """Take each file once: under one of its names, and in one form, compressed or not."""
    folder.files = []
    taken: dict[tuple[int, int], Path] = {}
    for file in dict.fromkeys([*listed, *present]):
        status, other = file.stat(), _other_form(file)
        same = taken.setdefault((status.st_dev, status.st_ino), file)
        if same is not file:
            folder.notes.append(f"{file.name} is left out: it is {same.name} under another name")
        elif other in folder.files:
            folder.twins[other] = file
            folder.notes.append(f"{file.name} is left out: it is {other.name} in its other form")
        else:
            folder.files.append(file)
            # Begun by a recorder that died before listing it.
            if file not in listed:
                folder.unlisted.append(file)


def _other_form(file: Path) -> Path:
    return file.with_suffix("") if file.suffix == ".zstd" else file.with_name(f"{file.name}.zstd")


def _read_metadata(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise OSError("it is no file")  # reading a pipe would block for ever
    if path.stat().st_size > _MAX_METADATA:
        raise OSError(f"it has more than {_MAX_METADATA} bytes")
    return path.read_text(encoding="utf-8")


def _load_yaml(text: str) -> Any:
    """Parse YAML without aliases (a line could make gigabytes) and deep nesting (libyaml's stack overflows)."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    for event in yaml.parse(text, loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _MAX_DEPTH:
                raise ValueError(f"nested deeper than {_MAX_DEPTH} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.AliasEvent):
            raise ValueError("aliases are not allowed")
    return yaml.load(text, Loader=loader)


def _take_metadata(folder: BagFolder, text: str) -> None:
    try:
        document = _load_yaml(text)
        info: dict[str, Any] = document["rosbag2_bagfile_information"]
        version = int(info["version"])
        if version > METADATA_VERSION:
            folder.damage.append(f"metadata version is {version}; expected at most {METADATA_VERSION}")
        # rosbag2 on Windows separates folders by backslashes.
        folder.files = [folder.path / PureWindowsPath(name).name for name in info["relative_file_paths"]]
        folder.storage = str(info["storage_identifier"])
        custom = info.get("custom_data") or {}
        folder.custom_data = {str(key): str(value) for key, value in custom.items()}
        for item in info.get("topics_with_message_count", []):
            topic: Mapping[str, Any] = item["topic_metadata"]
            folder.topic_hashes[str(topic["name"])] = str(topic.get("type_description_hash", ""))
        folder.topic_counts = _counts_by_topic(info)
        folder.message_compression = _is_message_compression(info)
    except _NO_METADATA as error:
        sentence = " ".join(str(error).split())
        folder.damage.append(f"{METADATA_NAME} is not what a bag has: {sentence or type(error).__name__}")


def _counts_by_topic(info: Mapping[str, Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for item in info.get("topics_with_message_count") or []:
        name = str(item["topic_metadata"]["name"])
        counts[name] = counts.get(name, 0) + int(item.get("message_count", 0))
    return counts


def _missing_messages(folder: BagFolder, sources: Sequence[Source]) -> list[str]:
    """Return a sentence for each topic with fewer messages than the metadata names.

    More may be there: the metadata of a running or killed recorder is older than its files. Damaged or missing files
    are reported already.
    """
    if folder.damage or any(source.damage for source in sources):
        return []
    found: dict[str, int] = {}
    for source in sources:
        for stream in source.streams:
            found[stream.topic] = found.get(stream.topic, 0) + stream.count
    return [
        f"{METADATA_NAME if folder.path.is_dir() else 'its metadata'} names {count} messages on {topic}; "
        f"{found.get(topic, 0)} are there"
        for topic, count in folder.topic_counts.items()
        if found.get(topic, 0) < count
    ]


def _is_message_compression(info: Mapping[str, Any]) -> bool:
    if str(info.get("compression_mode") or "").lower() != "message":
        return False
    name = str(info.get("compression_format") or "")
    if name != "zstd":
        raise BagError(f"messages are compressed by {name!r}; expected zstd, the one format of rosbag2")
    return True


def _ending(file: Path) -> str:
    return file.with_suffix("").suffix if file.suffix == ".zstd" else file.suffix


def _file_order(file: Path) -> tuple[int, str]:
    """Order ``name_10`` behind ``name_9``."""
    number = file.name.split(".")[0].rpartition("_")[2]
    return (int(number) if number.isdigit() else 0, file.name)


def open_sources(folder: BagFolder, *, verify: bool | None = None) -> list[Source]:
    """Open the readable storage files and name the others in ``damage``; a BagError if none can be read."""
    sources: list[Source] = []
    errors: list[BagError] = []
    for file in folder.files:
        try:
            sources.append(_open_one_form(file, folder.twins.get(file), verify))
        except BagError as error:
            errors.append(error)
            folder.damage.append(str(error))
    if not sources:
        raise errors[0]
    _leave_out_copies(folder, sources)
    if not folder.custom_data or folder.message_compression is None:
        _metadata_from_storage(folder, sources[-1])
    folder.damage += _missing_messages(folder, sources)
    if folder.message_compression is None:
        folder.message_compression = holds_packed_messages(sources[0])
    return [UnpackedSource(source) for source in sources] if folder.message_compression else sources


def _open_one_form(file: Path, twin: Path | None, verify: bool | None) -> Source:
    """Open a file, or its other form if only that is sound."""
    if twin is None:
        return open_source(file, verify=verify)
    try:
        source = open_source(file, verify=verify)
        if not source.damage:
            return source
    except BagError:
        return open_source(twin, verify=verify)
    try:
        other = open_source(twin, verify=verify)
    except BagError:
        return source
    sound, torn = (source, other) if other.damage else (other, source)
    torn.close()
    return sound


def _leave_out_copies(folder: BagFolder, sources: list[Source]) -> None:
    """Close unlisted files whose messages are all in another file: copies, or leftovers of a repair."""
    for source in [one for one in sources if one.path in folder.unlisted and one.stop_ns]:
        for other in sources:
            if _is_copy(source, other):
                folder.notes.append(f"{source.path.name} is left out: all its messages are in {other.path.name}")
                sources.remove(source)
                source.close()
                break


def _is_copy(source: Source, other: Source) -> bool:
    inside = other is not source and other.start_ns <= source.start_ns and source.stop_ns <= other.stop_ns
    try:
        # Simulation runs begin at the same time, so times alone prove nothing.
        return inside and _messages(source) <= _messages(other)
    except BagError:
        return False


def _messages(source: Source) -> Counter[tuple[str, int, int]]:
    topics = {stream.channel: stream.topic for stream in source.streams}
    counts: Counter[tuple[str, int, int]] = Counter()
    for batch in source.batches(set(topics), None, None):
        topic = topics[batch.channel]
        counts.update((topic, time, hash(data)) for time, data in batch.payloads())
    return counts


def damage_of(folder: BagFolder, sources: Iterable[Source]) -> list[str]:
    """Return what is wrong with a bag and its storage files, one sentence each; empty for a healthy one."""
    return [*folder.damage, *(f"{source.path.name}: {source.damage}" for source in sources if source.damage)]


def open_source(file: Path, *, verify: bool | None = None) -> Source:
    """Open one storage file by its name; files compressed as a whole (``.zstd``) are decompressed first."""
    if is_ros1(file):
        raise BagError(f"{file} is a bag of ROS 1; `pendulum convert {file} -o FOLDER` makes one that can be read")
    if _ending(file) not in (".mcap", ".db3"):
        raise BagError(f"{file} is no storage file of a bag; expected .mcap or .db3, or either with .zstd behind")
    if file.suffix == ".mcap":
        return McapSource(file, verify=verify)
    if file.suffix == ".db3":
        return SqliteSource(file, verify=verify is True)
    try:
        with file.open("rb") as packed:
            data = decompress_bounded(packed, str(file), max(_LEAST_ROOM, _MAX_RATIO * file.stat().st_size))
    except OSError as error:
        if isinstance(error, BagError):
            raise
        raise BagError(f"{file} cannot be read: {error.strerror or error}") from error
    if _ending(file) == ".mcap":
        return McapSource(file, data, verify=verify)
    folder = tempfile.TemporaryDirectory(prefix="pendulum_rosbag_")
    copy = Path(folder.name, file.with_suffix("").name)
    copy.write_bytes(data)
    source = SqliteSource(copy, verify=verify is True)
    source.keep(folder)
    return source


def _metadata_from_storage(folder: BagFolder, source: Source) -> None:
    """Take run metadata from the storage file, for files that were separated from their folder."""
    if isinstance(source, McapSource):
        text = source.metadata.get("rosbag2", {}).get("serialized_metadata", "")
    else:
        text = source.custom_metadata() if isinstance(source, SqliteSource) else ""
    if not text:
        return
    try:
        info = _load_yaml(text)
        info = info.get("rosbag2_bagfile_information", info)
        custom = {str(key): str(value) for key, value in (info.get("custom_data") or {}).items()}
        folder.custom_data = folder.custom_data or custom
        if folder.message_compression is None and "compression_mode" in info:
            folder.message_compression = _is_message_compression(info)
        if folder.path.is_file() and len(info.get("relative_file_paths") or []) == 1:
            folder.topic_counts = _counts_by_topic(info)
    except _NO_METADATA:
        return


def parsed(text: Any) -> Any:
    """Return the value of JSON text; any other text unchanged."""
    if not isinstance(text, str) or text[:1] not in '{["-0123456789tfn':
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text
