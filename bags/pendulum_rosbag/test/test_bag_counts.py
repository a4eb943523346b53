"""Messages that a damaged bag hides are told: an index, a page or a file that names fewer than were counted."""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.convert.rewrite import rewrite
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.mcap_source import McapSource
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, write_bag

TOPICS = ("/a", "/b")
COUNT = 60
"""Messages of each topic."""


def write(path: Path, storage: str = "mcap", compression: str | None = None, *, close: bool = True) -> Path:
    states = (
        (TOPICS[index % 2], 10**9 + 1000 * index, encode_joint_state(index, position=0.5 * index))
        for index in range(2 * COUNT)
    )
    return write_bag(path, states, storage, compression, seal_every=40, close=close)


def rows(bag: Path, **how: bool) -> dict[str, list[tuple[int, bytes]]]:
    with read_bag(bag, **how) as opened:
        return {topic: opened.raw(topic) for topic in opened.topics}


def file_of(bag: Path) -> Path:
    (file,) = [*bag.glob("*.mcap"), *bag.glob("*.db3")]
    return file


def change_index(bag: Path, change: Callable[[bytearray, int], None]) -> None:
    """Change the message index of ``/a`` in the first chunk, whose record begins at some byte."""
    file = file_of(bag)
    source = McapSource(file)
    at = source.chunks[0].indexes[source.streams[0].channel]
    source.close()
    content = bytearray(file.read_bytes())
    change(content, at)
    file.write_bytes(content)


def leave_out_ten(content: bytearray, at: int) -> None:
    opcode, length, channel, size = struct.unpack_from("<BQHI", content, at)
    struct.pack_into("<BQHI", content, at, opcode, length - 160, channel, size - 160)


def name_one_twice(content: bytearray, at: int) -> None:
    content[at + 31 : at + 47] = content[at + 15 : at + 31]


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_messages_that_an_index_leaves_out_are_found_in_their_chunk(tmp_path: Path, compression: str | None) -> None:
    bag = write(tmp_path / "bag", compression=compression)
    written = rows(bag)
    change_index(bag, leave_out_ten)
    sentence = f"bag_0.mcap: the message indexes name {COUNT - 10} messages on /a; the summary says {COUNT}"
    for verify in (None, True, False):
        opened = read_bag(bag, verify=verify)
        assert opened.damage == [sentence]
        assert {topic: opened.raw(topic) for topic in TOPICS} == written
        assert len(opened["/a"]) == opened.topics["/a"].count == COUNT
    repaired = repair_bag(bag, tmp_path / "repaired")
    assert repaired.damage == [sentence]
    converted = rewrite([bag], tmp_path / "converted")
    assert converted.damage == [f"{bag}: {sentence}"]
    for report in (repaired, converted):
        assert not read_bag(report.path).damage
        assert rows(report.path) == written


def test_an_index_that_names_a_message_twice_is_refused_and_repair_loses_nothing(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    written = rows(bag)
    change_index(bag, name_one_twice)
    for read in (lambda b: b["/a"], lambda b: b.raw("/a"), lambda b: b.log_times("/a")):
        with pytest.raises(BagError, match=r"bag_0\.mcap: a message index names a message twice; try to repair"):
            read(read_bag(bag))
    repaired = repair_bag(bag, tmp_path / "repaired")
    assert repaired.damage == ["bag_0.mcap: a message index names a message twice; try to repair the bag"]
    assert rows(repaired.path) == written


@pytest.mark.parametrize("alone", [False, True], ids=["folder", "file"])
def test_a_row_that_is_no_message_any_more_is_reported(tmp_path: Path, alone: bool) -> None:
    """A database has no checksums; one byte in the head of a row hides it from every reader."""
    bag = write(tmp_path / "bag", "sqlite3")
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    at = content.index((10**9 + 2000 * 20).to_bytes(8, "big")) - 8  # the serial type of topic_id stands there
    assert content[at : at + 2] == b"\x04\x06"
    content[at] ^= 0x08
    file.write_bytes(content)
    told = read_bag(file if alone else bag)
    assert told.damage == ["bag_0.db3: 1 rows of the table of messages are damaged and left out"]
    assert len(told["/a"]) + len(told["/b"]) == 2 * COUNT - 1
    assert repair_bag(file if alone else bag, tmp_path / "repaired").damage == told.damage


@pytest.mark.parametrize("alone", [False, True], ids=["folder", "file"])
@pytest.mark.parametrize(
    "change", ["DELETE FROM messages WHERE id = 5", "UPDATE messages SET topic_id = 2 WHERE id = 5"]
)
def test_fewer_messages_than_the_metadata_names_are_reported(tmp_path: Path, change: str, alone: bool) -> None:
    bag = write(tmp_path / "bag", "sqlite3")
    connection = sqlite3.connect(file_of(bag))
    connection.execute(change)
    connection.commit()
    connection.close()
    whose = "its metadata" if alone else "metadata.yaml"
    sentence = f"{whose} names {COUNT} messages on /a; {COUNT - 1} are there"
    bag = file_of(bag) if alone else bag
    assert read_bag(bag).damage == [sentence]
    assert repair_bag(bag, tmp_path / "repaired").damage == [sentence]
    assert rewrite([bag], tmp_path / "converted").damage == [f"{bag}: {sentence}"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_metadata_that_is_older_than_its_files_raises_no_alarm(tmp_path: Path, storage: str) -> None:
    """A recorder that was killed between two writes, one that still runs, and one file of several."""
    bag = write(tmp_path / "killed", storage, close=False)
    shutil.copy(bag / "metadata.yaml", tmp_path)
    early = re.sub(f"message_count: {COUNT}\\b", "message_count: 40", (tmp_path / "metadata.yaml").read_text())
    assert early != (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(early)
    assert read_bag(bag).damage == []
    assert {topic: len(found) for topic, found in rows(bag).items()} == dict.fromkeys(TOPICS, COUNT)
    split = tmp_path / "split"
    with BagWriter(split, storage, max_duration=30e-6) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(100):
            writer.write("/a", 1000 * index, encode_joint_state(index))
            writer.seal()
            assert read_bag(split).damage == []
    files = sorted([*split.glob("*.mcap"), *split.glob("*.db3")])
    assert len(files) > 2
    for file in files:
        assert read_bag(file).damage == []
