"""Files made to harm whoever reads them: bombs, lies about sizes, ways out of the folder, code in disguise.

Each is a few kilobytes. None may cost more memory or time than its size deserves, nor run anything, nor reach a file
outside of its bag.
"""

from __future__ import annotations

import sqlite3
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.storage import mcap_records as rec
from tests.tools.faults.parsers import PARSERS, Parser, make_bag

__all__ = ["HOSTILE", "HostileFile", "outside_reads"]

_ZEROS = 64 << 20


@dataclass(frozen=True)
class HostileFile:
    """One hostile file.

    Attributes:
        name: What it tries.
        parser: Name of the parser that meets it.
        make: Writes it under a folder.
        refused: The parser must raise its error; else it may also read what is sound.
    """

    name: str
    parser: str
    make: Callable[[Path], Path]
    refused: bool = True

    def reader(self) -> Parser:
        """Return the parser that meets it."""
        return next(parser for parser in PARSERS if parser.name == self.parser)


def outside_reads(folder: Path) -> bool:
    """Tell whether a bag that names files outside of its folder got at one of them."""
    from pendulum_rosbag.reader import read_bag

    bag = _escaping_bag(folder, "../secret.mcap")
    with read_bag(bag.parent) as opened:
        return "/secret" in opened.topics


def _text(name: str, text: str | bytes | Callable[[], bytes]) -> Callable[[Path], Path]:
    """Return what writes a file; what takes time to build is built then, and not by everybody who imports this."""

    def make(folder: Path) -> Path:
        path = folder / name
        content = text() if callable(text) else text
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def _laughs(head: str, indent: str = "") -> str:
    lines = [f"{indent}a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"{indent}a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    return head + "\n".join(lines) + "\n"


def _metadata(change: Callable[[str], str]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = make_bag(folder) / "metadata.yaml"
        path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
        return path

    return make


def _escaping_bag(folder: Path, target: str) -> Path:
    (folder / "secret.mcap").write_bytes(_mcap(_described("/secret") + _message(b"\0\1\0\0" + bytes(8))))
    bag = make_bag(folder)
    (file,) = bag.glob("*.mcap")
    path = bag / "metadata.yaml"
    path.write_text(path.read_text(encoding="utf-8").replace(file.name, target), encoding="utf-8")
    return path


def _described(topic: str = "/t", kind: str = "sensor_msgs/msg/JointState", definition: str = "") -> bytes:
    return rec.schema_record(1, kind, "ros2msg", definition) + rec.channel_record(1, 1, topic, "cdr", {})


def _message(data: bytes, time: int = 5) -> bytes:
    return rec.MESSAGE_HEADER.pack(rec.MESSAGE, 22 + len(data), 1, 0, time, time) + data


def _mcap(content: bytes) -> bytes:
    end = rec.record(rec.DATA_END, bytes(4)) + rec.footer_record(0, 0)
    return rec.MAGIC + rec.header_record("hostile") + content + end + rec.MAGIC


def _long_name(number: int) -> bytes:
    name = "x" * (10_000 if number == 7 else 3)
    return _message(encode_joint_state(number, frame_id=name, effort=1.0), number)


def _chunk(packed: bytes, claimed: int, compression: bytes) -> bytes:
    head = struct.pack("<QQQII", 1, 9, claimed, 0, len(compression)) + compression
    return rec.record(rec.CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def _zstd(size: int, *, honest: bool = True) -> bytes:
    packer = zstandard.ZstdCompressor(write_content_size=honest)
    if honest:
        return packer.compress(bytes(size))
    stream = packer.compressobj()
    return b"".join(stream.compress(bytes(1 << 20)) for _ in range(size >> 20)) + stream.flush()


def _lz4(size: int) -> bytes:
    import lz4.frame

    return bytes(lz4.frame.compress(bytes(size), store_size=False))


def _indexed(entries: int, chunks: int) -> bytes:
    """Return a file whose index names one large message many times."""
    state = encode_joint_state(5, frame_id="x" * 60_000, position=1.0)
    records = _message(state)
    head = rec.MAGIC + rec.header_record("hostile") + _described()
    at = len(head)
    chunk = _chunk(records, len(records), b"")
    index_at = at + len(chunk)
    table = struct.pack("<qQ", 5, 0) * entries
    index = rec.record(rec.MESSAGE_INDEX, struct.pack("<HI", 1, len(table)) + table)
    summary_at = index_at + len(index)
    places = [(1, index_at)]
    entry = rec.chunk_index_record(5, 5, at, len(chunk), places, len(index), "", len(records), len(records))
    statistics = rec.statistics_record(
        message_count=entries,
        schema_count=1,
        attachment_count=0,
        metadata_count=0,
        chunk_count=chunks,
        start_ns=5,
        stop_ns=5,
        channel_counts={1: 2**60},
    )
    summary = _described() + entry * chunks + statistics
    return head + chunk + index + summary + rec.footer_record(summary_at, 0) + rec.MAGIC


def _database(statements: Sequence[str], spoil: Callable[[bytes], bytes] = bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / "hostile.db3"
        with sqlite3.connect(path) as connection:
            for statement in statements:
                connection.execute(statement)
        connection.close()
        path.write_bytes(spoil(path.read_bytes()))
        return path

    return make


_TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
    "offered_qos_profiles TEXT)"
)
_ONE_TOPIC = "INSERT INTO topics VALUES (1, '/t', 'sensor_msgs/msg/JointState', 'cdr', '')"
_MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"


def _zip_bomb(folder: Path) -> Path:
    path = folder / "bomb.npz"
    deflated = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with deflated as archive, archive.open("time.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (2**27,)})
        for _ in range(256):
            file.write(bytes(1 << 20))
    return path


_EIGHT = b"\0\1\0\0" + bytes(8)
_CODE_NAME = 'a/msg/B:\n    pass\nopen("owned","w").close()\nclass C'
_CODE_CONSTANT = "string X=\"');open('owned','w').close();('\"\nint32 x\n"

_NEXT = "\n" + "=" * 80 + "\nMSG: "
_DEFINITIONS = {
    "a thousand million texts": "string[900000000] x\n",
    "a thousand million things of no size": f"a/Z[900000000] x{_NEXT}a/Z\nuint8[0] x\n",
    "a type that holds itself": "a/B x\n",
    "a type that holds many of itself": "a/B[] x\n",
    "doubling at every level": "a/C0 x\n" + "".join(f"{_NEXT}a/C{i}\na/C{i + 1}[9] x\n" for i in range(12)),
    "2000 levels": "a/C0 x\n" + "".join(f"{_NEXT}a/C{i}\na/C{i + 1} x\n" for i in range(2000)),
    "50 000 fields": "".join(f"int32 x{i}\n" for i in range(50_000)),
    "a call for a name": 'int32 x\na/C(open("owned","w")) y\n',
}


def _defining(text: str) -> Callable[[Path], Path]:
    return _text("b.mcap", _mcap(_described(kind="a/msg/B", definition=text) + _message(_EIGHT)))


HOSTILE: Sequence[HostileFile] = (
    HostileFile("a billion laughs", "plant YAML", _text("p.yaml", _laughs("format: pendulum_plant/1\n"))),
    HostileFile("a tag that calls", "plant YAML", _text("p.yaml", "!!python/object/apply:os.system [touch owned]\n")),
    HostileFile("100 000 brackets", "plant YAML", _text("p.yaml", "[" * 100_000)),
    HostileFile(
        "a million million seeds", "study YAML",
        _text("s.yaml", "format: pendulum_study/1\nname: a\nplants: {a: {}}\ncontrollers: {lqr: {}}\n"
              "seeds: {first: 1, count: 1000000000000}\n"),
    ),
    HostileFile(
        "named runs without end", "study YAML",
        _text("s.yaml", "format: pendulum_study/1\nname: a\nexperiment: thesis\nrepeats: 1000000000000\n"),
    ),
    HostileFile(
        "a controller that is a number", "study YAML",
        _text("s.yaml", "format: pendulum_study/1\nname: a\nplants: {thesis: {}}\ncontrollers: {0: {}}\n"),
    ),
    HostileFile("100 000 brackets", "JSON log", _text("l.json", "[" * 100_000)),
    HostileFile("entries that are numbers", "JSON log", _text("l.json", '{"entries": [1, 2, 3]}')),
    HostileFile("100 000 brackets", "run metadata JSON", _text("m.json", '{"a":' * 100_000)),
    HostileFile("100 000 brackets", "identification JSON", _text("m.json", '{"a":' * 100_000)),
    HostileFile(
        "a billion laughs", "HEBI gains XML",
        _text("g.xml", '<!DOCTYPE g [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><group_gains>&b;</group_gains>'),
    ),
    HostileFile(
        "an entity from /etc/passwd", "HEBI gains XML",
        _text("g.xml", '<!DOCTYPE g [<!ENTITY a SYSTEM "file:///etc/passwd">]><group_gains>&a;</group_gains>'),
    ),
    HostileFile(
        "a strategy that is no number", "HEBI gains XML",
        _text("g.xml", "<group_gains><control_strategy>inf</control_strategy></group_gains>"),
    ),
    HostileFile(
        "an encoding of its own", "HEBI gains XML",
        _text("g.xml", '<?xml version="1.0" encoding="UTF-7"?>+ADw-group_gains/>'),
    ),
    HostileFile("a quarter of a gigabyte of zeros", "feedback NPZ", _zip_bomb),
    HostileFile(
        "a billion laughs in custom_data", "bag: metadata.yaml",
        _metadata(lambda text: text.replace("  ros_distro", _laughs("", "    ") + "  ros_distro")), refused=False,
    ),
    HostileFile("100 000 brackets", "bag: metadata.yaml", _metadata(lambda _: "[" * 100_000), refused=False),
    HostileFile(
        "a path out of the folder", "bag: metadata.yaml",
        lambda folder: _escaping_bag(folder, "../../../../../../etc/passwd"), refused=False,
    ),
    HostileFile(
        "an absolute path", "bag: metadata.yaml", lambda folder: _escaping_bag(folder, "/etc/passwd"), refused=False
    ),
    HostileFile(
        "a chunk that claims an exabyte", "bag: MCAP",
        _text("b.mcap", _mcap(_described() + _chunk(_zstd(1000), 2**60, b"zstd"))), refused=False,
    ),
    HostileFile(
        "a zstd frame that claims 1 GB", "bag: MCAP",
        _text("b.mcap", lambda: _mcap(_described() + _chunk(_zstd(1 << 30, honest=False), 1000, b"zstd"))),
        refused=False,
    ),
    HostileFile(
        "an lz4 frame larger than its chunk", "bag: MCAP",
        _text("b.mcap", lambda: _mcap(_described() + _chunk(_lz4(_ZEROS), 1000, b"lz4"))), refused=False,
    ),
    HostileFile(
        "one message named 100 000 times", "bag: MCAP", _text("b.mcap", lambda: _indexed(100_000, 1)), refused=False
    ),
    HostileFile("one chunk named 1000 times", "bag: MCAP", _text("b.mcap", _indexed(1000, 1000)), refused=False),
    HostileFile(
        "frame ids of 10 000 letters", "bag: MCAP",
        _text("b.mcap", _mcap(_described() + b"".join(map(_long_name, range(20_000))))), refused=False,
    ),
    HostileFile(
        "code in the name of a type", "bag: MCAP",
        _text("b.mcap", _mcap(_described(kind=_CODE_NAME, definition="int32 x\n") + _message(_EIGHT))),
    ),
    HostileFile(
        "code in a constant", "bag: MCAP",
        _text("b.mcap", _mcap(_described(kind="a/msg/Code", definition=_CODE_CONSTANT) + _message(_EIGHT))),
        refused=False,
    ),
    *(HostileFile(f"a definition with {what}", "bag: MCAP", _defining(text)) for what, text in _DEFINITIONS.items()),
    HostileFile(
        "a head that claims 2^31 pages", "bag: SQLite",
        _database([_TOPICS, _ONE_TOPIC, _MESSAGES], lambda data: data[:28] + b"\x7f\xff\xff\xff" + data[32:]),
        refused=False,
    ),
    HostileFile(
        "columns that compute gigabytes", "bag: SQLite",
        _database([
            _TOPICS, _ONE_TOPIC,
            _MESSAGES.replace("data BLOB", "data BLOB AS (zeroblob(900000000))"),
            "INSERT INTO messages(topic_id, timestamp) VALUES (1, 5), (1, 6), (1, 7)",
        ]),
        refused=False,
    ),
    HostileFile(
        "topics of the wrong type", "bag: SQLite",
        _database([_TOPICS, _MESSAGES, "INSERT INTO topics VALUES (1, NULL, x'ff', 3, 4.5)"]),
    ),
)  # fmt: skip
