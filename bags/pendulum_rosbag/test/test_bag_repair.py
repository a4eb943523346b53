"""Mending what other writers, and broken disks, leave behind."""

from __future__ import annotations

import json
import random
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError, DataError, PendulumError
from pendulum_rosbag.reader import read_bag, same_messages
from pendulum_rosbag.reader.statistics import bag_statistics
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.repair.repair_cli import main as repair_main
from pendulum_rosbag.storage import BagWriter, typestore
from pendulum_testing.bag_messages import JOINT_STATE, write_bag
from pendulum_testing.mcap_js_reader import McapJs

TOPICS = ("/a", "/b", "/c")


def state(index: int) -> bytes:
    return encode_joint_state(index, position=0.5 * index, velocity=1.0, effort=-1.0)


def our_bag(path: Path, storage: str, *, close: bool = True) -> Path:
    states = ((TOPICS[index % 3], index, state(index)) for index in range(3000))
    return write_bag(path, states, storage, metadata={"seed": 5}, seal_every=100, close=close)


def rosbags_bag(path: Path, storage: str) -> Path:
    writer = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    with writer:
        connections: list[Any] = [writer.add_connection(t, JOINT_STATE, typestore=typestore()) for t in TOPICS]
        for index in range(30_000 if storage == "mcap" else 3000):
            writer.write(connections[index % 3], index, state(index))
    return path


def storage_file(bag: Path) -> Path:
    (file,) = [*bag.glob("*.mcap"), *bag.glob("*.db3")]
    return file


def whole_messages(file: Path, size: int) -> int:
    """Count the messages of a sound MCAP file of plain chunks whose records end before some byte."""
    content = file.read_bytes()
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
    found = 0
    for chunk in summary.chunk_indexes:
        end = chunk.chunk_start_offset + chunk.chunk_length
        at = end - chunk.compressed_size
        while at < min(end, size):
            opcode, length = struct.unpack_from("<BQ", content, at)
            at += 9 + length
            found += opcode == 5 and at <= size
    return found


@pytest.mark.parametrize("writer", ["ours", "ours_unclosed", "rosbags"])
def test_a_truncated_mcap_file_gives_back_all_whole_messages(tmp_path: Path, writer: str) -> None:
    if writer == "rosbags":
        bag = rosbags_bag(tmp_path / "bag", "mcap")
    else:
        bag = our_bag(tmp_path / "bag", "mcap", close=writer == "ours")
    file = storage_file(bag)
    sound = file.read_bytes()
    whole = tmp_path / "whole.mcap"
    whole.write_bytes(sound)
    rng = random.Random(7)
    end = len(sound) if writer != "ours_unclosed" else 600_000  # beyond lies room that was never used
    for number in range(8):
        size = rng.randrange(200, end)
        file.write_bytes(sound[:size])
        expected = whole_messages(whole, size)
        output = tmp_path / f"mended{number}"
        report = repair_bag(bag, output)
        assert report.repaired
        assert sum(report.messages.values()) == expected
        mended = read_bag(output)
        assert not mended.damage
        assert sum(len(mended[topic]) for topic in mended.topics if mended.topics[topic].count) == expected
        if expected:
            with AnyReader([output]) as reader:
                assert sum(1 for _ in reader.messages()) == expected


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_compressed_chunk_that_is_cut_off_gives_back_what_its_compression_does(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "whole.mcap"
    rng = random.Random(4)
    with path.open("wb") as stream:
        writer = McapLibraryWriter(stream, chunk_size=1 << 24, compression=compression)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        for index in range(3000):
            text = rng.randbytes(200).hex().encode() + b"\0"
            writer.add_message(channel, index, b"\0\1\0\0" + len(text).to_bytes(4, "little") + text, index)
        writer.finish()
    sound = read_bag(path).raw("/a")
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    found = read_bag(torn)
    assert found.damage
    rows = found.raw("/a")
    assert rows == sound[: len(rows)]
    assert len(rows) > 1000


def foreign_file(path: Path, *, close: bool = True) -> Path:
    """Write what other programs put into MCAP files beside CDR: JSON, Protobuf, attachments, metadata."""
    with path.open("wb") as stream:
        writer = McapLibraryWriter(stream, chunk_size=5000, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        state_type = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        proto = writer.register_schema("foxglove.Log", "protobuf", bytes(range(256)))
        channels = [
            writer.register_channel("/a", "cdr", state_type),
            writer.register_channel("/log", "protobuf", proto),
            writer.register_channel("/plain", "json", 0),
        ]
        writer.add_attachment(7, 6, "calibration.yaml", "text/yaml", b"gain: 2\n")
        writer.add_metadata("operator", {"name": "A. Nother"})
        for index in range(300):
            writer.add_message(channels[0], index, state(index), index)
            writer.add_message(channels[1], index, bytes((index % 256, 255)), index)
            writer.add_message(channels[2], index, b'{"n": %d}' % index, index)
        writer.add_attachment(8, 8, "late.bin", "application/octet-stream", bytes(5000))
        if close:
            writer.finish()
    return path


@pytest.mark.parametrize("how", ["sound", "unclosed"])
def test_what_others_put_into_a_file_is_kept(tmp_path: Path, how: str, request: pytest.FixtureRequest) -> None:
    path = foreign_file(tmp_path / "foreign.mcap", close=how == "sound")
    original = read_bag(path)
    assert bool(original.damage) == (how == "unclosed")
    report = repair_bag(path, tmp_path / "mended", force=True)
    assert sorted(report.kept) == ["calibration.yaml", "late.bin", "operator"]
    assert not report.left_out
    mended = read_bag(report.path)
    assert not mended.damage
    for topic in ("/a", "/log", "/plain"):
        assert mended.raw(topic) == original.raw(topic)
        assert len(mended.raw(topic)) >= 250
    assert bag_statistics(mended).topics["/plain"].count == mended.topics["/plain"].count
    with pytest.raises(DataError, match="is encoded as 'json'; expected CDR"):
        mended.messages("/plain")
    file = storage_file(report.path)
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        attachments = {item.name: item.data for item in reader.iter_attachments()}
        assert attachments == {"calibration.yaml": b"gain: 2\n", "late.bin": bytes(5000)}
        assert {item.name: item.metadata for item in reader.iter_metadata()}["operator"] == {"name": "A. Nother"}
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert (summary.statistics.attachment_count, summary.statistics.metadata_count) == (2, 2)
        encodings = {channel.topic: channel.message_encoding for channel in summary.channels.values()}
        assert encodings == {"/a": "cdr", "/log": "protobuf", "/plain": "json"}
        (proto,) = [schema for schema in summary.schemas.values() if schema.name == "foxglove.Log"]
        assert proto.data == bytes(range(256))
    listed = yaml.safe_load((report.path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    formats = {
        item["topic_metadata"]["name"]: item["topic_metadata"]["serialization_format"]
        for item in listed["topics_with_message_count"]
    }
    assert formats == encodings
    readers: McapJs = request.getfixturevalue("mcap_js")  # last: it skips where there is no Node.js
    found = readers.read(file)
    assert sorted(found["byIndex"]["attachments"]) == ["calibration.yaml", "late.bin"]
    assert found["byIndex"]["count"] == found["inOrder"]["count"] == sum(report.messages.values())


def test_a_topic_of_two_types_keeps_the_bag_readable_and_repair_says_what_it_left_out(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = McapLibraryWriter(stream, compression=CompressionType.NONE)
        writer.start("ros2", "test")
        kinds = [writer.register_schema(name, "ros2msg", b"") for name in (JOINT_STATE, "std_msgs/msg/String")]
        channels = [writer.register_channel("/a", "cdr", kind) for kind in kinds]
        other = writer.register_channel("/b", "cdr", kinds[0])
        for index in range(10):
            writer.add_message(channels[index == 3], index, state(index), index)
            writer.add_message(other, index, state(index), index)
        writer.finish()
    bag = read_bag(path)
    assert "topic /a has the types sensor_msgs/msg/JointState, std_msgs/msg/String; expected one" in bag.damage[0]
    assert len(bag["/b"]) == 10
    assert len(bag["/a"]) == 9
    assert len(bag.raw("/a (std_msgs/msg/String)")) == 1
    report = repair_bag(path, tmp_path / "mended", force=True)
    assert "LEFT OUT: 1 messages (topic /a has type std_msgs/msg/String" in report.sentence()


@pytest.mark.parametrize("writer", ["ours", "rosbags"])
def test_a_truncated_sqlite_file_gives_back_the_rows_on_its_pages(tmp_path: Path, writer: str) -> None:
    bag = our_bag(tmp_path / "bag", "sqlite3") if writer == "ours" else rosbags_bag(tmp_path / "bag", "sqlite3")
    file = storage_file(bag)
    sound = file.read_bytes()
    rng = random.Random(9)
    saved = []
    for number in range(8):
        size = rng.randrange(0, len(sound))
        file.write_bytes(sound[:size])
        try:
            report = repair_bag(bag, tmp_path / f"mended{number}")
        except PendulumError as error:
            if size >= 120_000:
                raise AssertionError(f"{size} bytes should be enough to tell the topics") from error
            continue
        count = sum(report.messages.values())
        saved.append(count)
        # The index over time stands at the end; before it, pages hold about 25 messages each.
        assert count >= min(3000, (size - 120_000) // 4096 * 20)
        mended = read_bag(tmp_path / f"mended{number}")
        assert not mended.damage
        for topic in mended.topics:
            assert set(mended[topic]["position"] - 0.5 * mended[topic]["stamp_ns"]) <= {0.0}
    assert len(saved) >= 3


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_random_damage_is_refused_or_reported_and_what_is_read_was_written(tmp_path: Path, storage: str) -> None:
    rng = random.Random(13)
    bag = our_bag(tmp_path / storage, storage)
    file = storage_file(bag)
    whole = file.read_bytes()
    written = {topic: set(read_bag(bag).raw(topic)) for topic in TOPICS}
    assert sum(len(rows) for rows in written.values()) == 3000
    outcomes = set()
    for _ in range(25):
        damaged = bytearray(whole)
        changes = rng.randrange(1, 30)
        for _ in range(changes):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        file.write_bytes(damaged)
        sentence, rows, told = "", {}, False
        try:
            opened = read_bag(bag)
            rows = {topic: set(opened.raw(topic)) for topic in opened.topics if topic in written}
            opened.load()
            told = bool(opened.damage)
        except PendulumError as error:
            sentence = str(error)
        outcomes.add(bool(sentence))
        assert "\n" not in sentence
        if sentence or told:
            continue
        # Silent, a database may hand over a message with a byte changed in it (it has no checksums), but loses none and
        # makes none up; an MCAP file hands over what was written.
        assert {topic: len(found) for topic, found in rows.items()} == dict.fromkeys(TOPICS, 1000)
        assert sum(len(rows[topic] - written[topic]) for topic in TOPICS) <= (changes if storage == "sqlite3" else 0)
    assert outcomes == {True, False}


def test_a_bag_without_footer_and_metadata_is_put_in_place(tmp_path: Path) -> None:
    """What the MCAP writer of rosbags leaves after a kill: no footer, no metadata.yaml."""
    bag = rosbags_bag(tmp_path / "bag", "mcap")
    file = storage_file(bag)
    expected = whole_messages(file, file.stat().st_size - 200_000)
    file.write_bytes(file.read_bytes()[:-200_000])
    (bag / "metadata.yaml").unlink()
    report = repair_bag(bag)
    assert report.path == bag
    assert report.original == tmp_path / "bag.broken"
    assert (tmp_path / "bag.broken" / "bag.mcap").exists()
    assert "metadata.yaml is missing" in report.damage
    with AnyReader([bag]) as reader:
        assert sum(1 for _ in reader.messages()) == expected
    again = repair_bag(bag)
    assert not again.repaired
    assert again.sentence() == f"{bag} is sound: nothing to repair"


def test_a_hot_journal_is_rolled_back_and_the_bag_stays_untouched(tmp_path: Path) -> None:
    """A writer that dies in an SQLite transaction leaves a journal beside a torn file."""
    bag = our_bag(tmp_path / "bag", "sqlite3")
    file = storage_file(bag)
    script = (
        "import os, sqlite3, sys\n"
        "c = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "c.execute('PRAGMA cache_size = 2')\n"
        "c.execute('BEGIN')\n"
        "c.execute('UPDATE messages SET timestamp = 7, data = zeroblob(200)')\n"
        "print('go', flush=True)\n"
        "sys.stdin.read()\n"
    )
    child = subprocess.Popen([sys.executable, "-c", script, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"go\n"
    child.send_signal(signal.SIGKILL)
    child.wait()
    journal = file.with_name(file.name + "-journal")
    assert journal.stat().st_size
    before = file.read_bytes()
    opened = read_bag(bag)
    assert "bag_0.db3-journal" in opened.damage[0]
    assert opened["/a"]["stamp_ns"].tolist() == list(range(0, 3000, 3))
    opened.close()
    assert file.read_bytes() == before
    report = repair_bag(bag)
    assert sum(report.messages.values()) == 3000
    assert not read_bag(bag).damage


def test_a_killed_recording_of_ours_needs_no_repair_but_gets_smaller_by_one(tmp_path: Path) -> None:
    bag = our_bag(tmp_path / "bag", "mcap", close=False)
    copy = tmp_path / "copy"
    shutil.copytree(bag, copy)
    opened = read_bag(bag)
    assert not opened.damage
    assert sum(len(opened[topic]) for topic in opened.topics) == 3000
    report = repair_bag(copy)
    assert report.damage == ["bag_0.mcap: its recorder did not close it"]
    assert same_messages(opened, read_bag(copy))
    assert storage_file(copy).stat().st_size < storage_file(bag).stat().st_size
    assert read_bag(copy).metadata == {"seed": 5}


def test_a_single_file_gets_a_folder(tmp_path: Path) -> None:
    bag = our_bag(tmp_path / "bag", "mcap")
    alone = tmp_path / "alone.mcap"
    alone.write_bytes(storage_file(bag).read_bytes()[:-5000])
    report = repair_bag(alone)
    assert report.path == tmp_path / "alone_repaired"
    assert read_bag(report.path).topics["/a"].count == 1000


def test_the_command_says_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = our_bag(tmp_path / "bag", "mcap")
    file = storage_file(bag)
    file.write_bytes(file.read_bytes()[:100_000])
    assert repair_main([str(bag), "--json", "-o", str(tmp_path / "out")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert "no footer" in report["damage"][0]
    assert repair_main([str(bag)]) == 0
    assert "saved" in capsys.readouterr().out
    assert repair_main([str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err
    with pytest.raises(BagError, match="exists already"):
        repair_bag(bag, tmp_path / "out", force=True)


def test_a_bag_can_be_read_while_it_is_being_recorded(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag)
    writer.add_topic("/a", JOINT_STATE)
    seen = 0
    start = time.monotonic()
    for index in range(400):
        writer.write("/a", index, state(index))
        if index % 20 == 19:
            writer.seal()
            count = len(read_bag(bag)["/a"])
            assert count == index + 1 > seen
            seen = count
    writer.close()
    assert time.monotonic() - start < 20
