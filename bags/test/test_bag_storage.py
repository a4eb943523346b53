"""Bags on disk: whole at every instant, for every reader, in both storages."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from mcap.reader import McapReader, NonSeekingReader, SeekingReader, make_reader
from rosbags.highlevel import AnyReader

from pendulum_bags.reader import read_bag
from pendulum_bags.storage import (
    QosProfile,
    mcap_layout,
    message_type,
    open_writer,
    sealed_mcap,
    sealed_sqlite,
)
from pendulum_msgs_py.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError, ParameterError

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"


def text_message(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def state(index: int) -> bytes:
    return encode_joint_state(index * 1000, position=0.1 * index, velocity=1.0, effort=-2.0)


def count_everywhere(bag: Path) -> tuple[int, ...]:
    """Count the messages with each reader there is; each fails on a file that is not whole."""
    with AnyReader([bag]) as reader:
        counts = [sum(1 for _ in reader.messages())]
    ours = read_bag(bag)
    assert not ours.damage, ours.damage
    counts.append(sum(len(ours.raw(topic)) for topic in ours.topics))
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            counts.append(sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()))
    for file in sorted(bag.glob("*.db3")):
        connection = sqlite3.connect(f"file:{file}?immutable=1", uri=True)
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        counts.append(connection.execute("SELECT count(*) FROM messages").fetchone()[0])
        connection.close()
    return tuple(counts)


def count_in_order(bag: Path) -> int:
    """Count the messages of an MCAP file as a reader does that goes through it from the start."""
    with next(bag.glob("*.mcap")).open("rb") as stream:
        return sum(
            1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        )


@pytest.mark.parametrize(("storage", "compression"), [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)])
def test_what_is_sealed_is_in_the_bag_for_every_reader(
    tmp_path: Path, storage: str, compression: str | None
) -> None:
    bag = tmp_path / "bag"
    writer = open_writer(bag, storage, compression)
    writer.add_topic("/a", JOINT_STATE)
    writer.add_topic("/b", JOINT_STATE)
    for index in range(300):
        writer.write("/ab"[:1] + "ab"[index % 2], index, state(index))
        if index in (0, 1, 50, 298):
            writer.seal()
            assert set(count_everywhere(bag)) == {index + 1}
    writer.close()
    assert set(count_everywhere(bag)) == {300}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_no_write_of_a_commit_ever_leaves_a_broken_bag(
    tmp_path: Path, storage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stop after every single write, and between any two pages of it, and read the bag as it is then."""
    bag = tmp_path / "bag"
    page = 4096
    rng = random.Random(3)
    sealed = total = 0
    moments = 0
    real_write = os.pwrite

    def watched(fd: int, data: bytes, offset: int) -> int:
        # The kernel copies page by page and may be killed between two of them. All cuts of small writes are tried,
        # some of the large ones.
        nonlocal moments
        view = memoryview(data)
        first = page - offset % page
        cuts = list(range(first, len(view), page))
        chosen = set(cuts if len(cuts) < 3 else rng.sample(cuts, 2)) | {len(view)}
        at = 0
        for cut in [*cuts, len(view)]:
            real_write(fd, view[at:cut], offset + at)
            at = cut
            if bag.exists() and cut in chosen:
                moments += 1
                # Readers by index and readers in order may see the last chunk one write apart.
                counts = count_everywhere(bag)
                assert sealed <= min(counts)
                assert max(counts) <= total
        return len(view)

    writer = open_writer(bag, storage)
    monkeypatch.setattr(mcap_layout if storage == "mcap" else sealed_sqlite, "os", _WatchedOs(watched))
    writer.add_topic("/a", STRING)
    for round_number in range(14):
        for _ in range(rng.randrange(1, 5)):
            writer.write("/a", total, text_message("x" * rng.choice([0, 3, 300, 4000, 9000])))
            total += 1
        if round_number == 6:
            writer.add_topic("/late", STRING)
        writer.seal()
        sealed = total
        assert set(count_everywhere(bag)) == {total}
        if storage == "mcap":
            assert count_in_order(bag) == total
    writer.close()
    assert set(count_everywhere(bag)) == {total}
    assert moments > 60


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_small_chunks_become_large_ones_unseen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str | None
) -> None:
    """Stop after every single write while chunks are staged and settled, areas used again and summaries outgrown."""
    monkeypatch.setattr(mcap_layout, "_FIRST_ROOM", 1 << 16)
    monkeypatch.setattr(mcap_layout, "_LARGEST_ROOM", 1 << 16)
    monkeypatch.setattr(mcap_layout, "_FIRST_SLOT", 2 * 4096)
    monkeypatch.setattr(sealed_mcap, "_LARGEST_NUMBER", 8)
    bag = tmp_path / "bag"
    rng = random.Random(8)
    sealed = total = moments = 0

    def numbers(reader: McapReader) -> list[int]:
        messages = reader.iter_messages(log_time_order=False)
        return [int.from_bytes(message.data[4:12], "little") for _, _, message in messages]

    def check() -> None:
        with (bag / "bag_0.mcap").open("rb") as stream:
            by_index = numbers(SeekingReader(stream, validate_crcs=True))
            stream.seek(0)
            in_order = numbers(NonSeekingReader(stream, validate_crcs=True))
        for found in (by_index, in_order):
            assert found == list(range(len(found)))
            assert sealed <= len(found) <= total

    def watched(fd: int, data: bytes, offset: int) -> int:
        nonlocal moments
        done = os.pwrite(fd, data, offset)
        moments += 1
        check()
        return done

    writer = open_writer(bag, compression=compression)
    monkeypatch.setattr(mcap_layout, "os", _WatchedOs(watched))
    ends = []
    for round_number in range(25 if compression else 60):
        if round_number % 20 == 0:
            for number in range(12):
                writer.add_topic(f"/t{round_number}_{number}", STRING)
        for _ in range(rng.randrange(1, 5)):
            size = rng.choice([0, 3, 300, 2000, 2000, 50_000 if round_number % 15 == 7 else 3000])
            topic = f"/t{rng.randrange(0, round_number + 1, 20)}_0"
            writer.write(
                topic,
                total,
                b"\0\1\0\0"
                + total.to_bytes(8, "little")
                + (rng.randbytes(size // 2) + bytes(size - size // 2)),
            )
            total += 1
        if round_number % 13 == 12:
            writer.sync()
        else:
            writer.seal()
        sealed = total
        check()
        ends.append(writer._file._layout._size)  # type: ignore[attr-defined]
    writer.close()
    check()
    assert len(set(ends)) > (
        1 if compression else 2
    )  # the end of the file moved, also while chunks were staged
    assert moments > (80 if compression else 200)
    with (bag / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert 2 < len(summary.chunk_indexes) < 30
    assert not read_bag(bag).damage
    assert sum(len(read_bag(bag).raw(topic)) for topic in read_bag(bag).topics) == total


class _WatchedOs:
    """The os module with one function exchanged."""

    def __init__(self, pwrite: object) -> None:
        self.pwrite = pwrite

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)


def test_a_commit_head_never_straddles_two_pages(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    writer = open_writer(bag)
    writer.add_topic("/a", STRING)
    heads = []
    rng = random.Random(1)
    for index in range(600):
        writer.write("/a", index, text_message("y" * rng.randrange(0, 5000)))
        writer.seal()
        layout = writer._file._layout  # type: ignore[attr-defined]
        heads += [layout.settled_end % 4096, layout._chain_end % 4096]
    assert max(heads) <= 4096 - 9
    assert set(count_everywhere(bag)) == {600}
    assert count_in_order(bag) == 600
    writer.close()
    assert set(count_everywhere(bag)) == {600}


def test_a_file_outgrows_its_room_and_its_summaries_many_times(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    writer = open_writer(bag)
    for number in range(10):
        writer.add_topic(f"/t{number}", JOINT_STATE)
    total = 0
    for round_number in range(600):
        for number in range(10):
            writer.write(f"/t{number}", total, state(total))
            total += 1
        writer.seal()
        if round_number % 200 == 0:
            assert set(count_everywhere(bag)) == {total}
            assert count_in_order(bag) == total
    size_open = next(bag.glob("*.mcap")).stat().st_size
    writer.close()
    assert set(count_everywhere(bag)) == {total}
    assert next(bag.glob("*.mcap")).stat().st_size < size_open


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_splits_by_size_and_by_time(tmp_path: Path, storage: str) -> None:
    for name, limits in (("size", {"max_size": 60_000}), ("time", {"max_duration": 0.5})):
        bag = tmp_path / name
        with open_writer(bag, storage, **limits) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(1000):
                writer.write("/a", index * 2_000_000, state(index))
                if index % 50 == 49:
                    writer.seal()
        assert len(writer.files) > 2
        with AnyReader([bag]) as reader:
            assert sum(1 for _ in reader.messages()) == 1000
        assert read_bag(bag)["/a"]["stamp_ns"].tolist() == [index * 1000 for index in range(1000)]
        info = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        assert sum(file["message_count"] for file in info["files"]) == info["message_count"] == 1000


def test_metadata_is_what_rosbag2_writes(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    strange = 'quotes " and \\ and \x7f and \u2028 and : # {"a": [1]}\n'
    qos = QosProfile(reliability="best_effort", durability="transient_local", deadline_ns=1_500_000_000)
    with open_writer(bag, metadata={"run": {"seed": 3}, "strange": strange}) as writer:
        writer.add_topic("/a", JOINT_STATE, qos)
        writer.write("/a", 5_000, state(1))
        writer.write("/a", 9_000, state(2))
        writer.update_metadata({"more": [1, 2]})
    info = yaml.safe_load((bag / "metadata.yaml").read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    assert info["version"] == 9
    assert info["storage_identifier"] == "mcap"
    assert info["relative_file_paths"] == ["bag_0.mcap"]
    assert info["starting_time"] == {"nanoseconds_since_epoch": 5_000}
    assert info["duration"] == {"nanoseconds": 4_000}
    topic = info["topics_with_message_count"][0]
    assert topic["message_count"] == 2
    assert topic["topic_metadata"]["type_description_hash"] == message_type(JOINT_STATE).hash
    offered = topic["topic_metadata"]["offered_qos_profiles"][0]
    assert (offered["reliability"], offered["durability"]) == ("best_effort", "transient_local")
    assert offered["deadline"] == {"sec": 1, "nsec": 500_000_000}
    assert info["custom_data"]["strange"] == strange
    assert read_bag(bag).metadata == {"run": {"seed": 3}, "strange": strange, "more": [1, 2]}
    with AnyReader([bag]) as reader:
        assert reader.topics["/a"].msgcount == 2
    # A file that lost its folder still knows the run.
    alone = tmp_path / "alone.mcap"
    alone.write_bytes((bag / "bag_0.mcap").read_bytes())
    assert read_bag(alone).metadata["run"] == {"seed": 3}


def test_mcap_files_carry_profile_schema_and_checksums(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with open_writer(bag, compression="zstd") as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.write("/a", 1, state(1))
    with (bag / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 1
        (schema,) = summary.schemas.values()
        assert (schema.name, schema.encoding) == (JOINT_STATE, "ros2msg")
        assert b"MSG: std_msgs/Header" in schema.data
        assert [metadata.name for metadata in reader.iter_metadata()] == ["rosbag2"]


def test_sqlite_files_have_the_index_that_rosbag2_seeks_by(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with open_writer(bag, "sqlite3") as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(100):
            writer.write("/a", index, state(index))
    connection = sqlite3.connect(bag / "bag_0.db3")
    assert connection.execute("SELECT name FROM sqlite_master WHERE type = 'index'").fetchall() == [
        ("timestamp_idx",)
    ]
    assert connection.execute("SELECT schema_version, ros_distro FROM schema").fetchall() == [(4, "jazzy")]
    assert "bag_0.db3" in connection.execute("SELECT metadata FROM metadata").fetchone()[0]
    connection.close()


def test_large_messages_continue_on_overflow_pages(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    sizes = [0, 1, 4000, 4030, 4031, 4032, 4040, 4044, 4061, 4100, 8000, 8150, 12_345, 70_000, 300_000]
    with open_writer(bag, "sqlite3") as writer:
        writer.add_topic("/s", STRING)
        for number, size in enumerate(sizes):
            writer.write("/s", number, text_message("z" * size))
    assert set(count_everywhere(bag)) == {len(sizes)}
    assert [len(stored.message.data) for stored in read_bag(bag)["/s"]] == sizes


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    open_writer(bag).close()
    with pytest.raises(BagError, match="exists already; expected a new folder"):
        open_writer(bag)


def test_wrong_use_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="storage is 'rosbag'; expected one of mcap, sqlite3"):
        open_writer(tmp_path / "a", "rosbag")
    with pytest.raises(ParameterError, match="expected storage mcap"):
        open_writer(tmp_path / "a", "sqlite3", "zstd")
    writer = open_writer(tmp_path / "b")
    with pytest.raises(BagError, match="/x was not added"):
        writer.write("/x", 0, b"")
    writer.add_topic("/x", JOINT_STATE)
    with pytest.raises(BagError, match="the bag holds it as sensor_msgs/msg/JointState"):
        writer.add_topic("/x", STRING)
    with pytest.raises(BagError, match="expected package/msg/Name"):
        writer.add_topic("/y", "JointState")
    writer.close()
    with pytest.raises(BagError, match="is closed"):
        writer.write("/x", 0, state(0))


def test_a_type_that_nobody_knows_is_kept_as_bytes(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with open_writer(bag) as writer:
        writer.add_topic("/own", "my_msgs/msg/Thing")
        writer.write("/own", 7, b"\0\1\0\0\1\2\3\4")
    opened = read_bag(bag)
    assert opened.raw("/own") == [(7, b"\0\1\0\0\1\2\3\4")]


def test_types_of_a_workspace_are_found_and_carried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "install" / "share" / "own_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Inner.msg").write_text("float64 value\n")
    (folder / "Outer.msg").write_text("std_msgs/Header header\nInner[] parts\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    kind = message_type("own_msgs/msg/Outer")
    assert kind.hash.startswith("RIHS01_")
    assert "MSG: own_msgs/Inner" in kind.definition


CHILD = """
import os, sys
from pendulum_bags.storage import open_writer
from pendulum_msgs_py.cdr import encode_joint_state
writer = open_writer(sys.argv[1], sys.argv[2])
for number in range(5):
    writer.add_topic(f"/t{number}", "sensor_msgs/msg/JointState")
data = encode_joint_state(5, position=1.0, velocity=1.0, effort=2.0)
print("go", flush=True)
total = 0
while True:
    for number in range(5):
        writer.write(f"/t{number}", total, data)
        total += 1
    if total % 25 == 0:
        writer.seal()
        os.write(1, b"%d\\n" % total)
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_kill_9_at_random_moments_costs_nothing_that_was_sealed(tmp_path: Path, storage: str) -> None:
    """A writer that does nothing but commit is killed: nearly every kill hits the middle of a commit."""
    rng = random.Random(11)
    for number in range(4):
        bag = tmp_path / f"bag{number}"
        child = subprocess.Popen([sys.executable, "-c", CHILD, str(bag), storage], stdout=subprocess.PIPE)
        assert child.stdout is not None
        assert child.stdout.readline() == b"go\n"
        time.sleep(rng.uniform(0.0, 0.2))
        child.send_signal(signal.SIGKILL)
        output = child.stdout.read().split()
        child.wait()
        sealed = int(output[-1]) if output else 0
        counts = set(count_everywhere(bag))
        assert len(counts) == 1
        assert counts.pop() >= sealed


FULL = """
import resource, sys
from pendulum_bags.storage import open_writer
from pendulum_msgs_py.cdr import encode_joint_state
writer = open_writer(sys.argv[1], sys.argv[2])
writer.add_topic("/a", "sensor_msgs/msg/JointState")
resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
total = 0
try:
    while True:
        for _ in range(100):
            writer.write("/a", total, encode_joint_state(total, position=1.0))
            total += 1
        writer.seal()
        sealed = total
except OSError as error:
    print(sealed, error.strerror)
try:
    writer.close()
except OSError:
    writer.abandon()
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_keeps_what_was_sealed(tmp_path: Path, storage: str) -> None:
    """The limit of the file size makes writes fail as a full disk does, without being root."""
    bag = tmp_path / "bag"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(bag), storage],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    sealed, reason = done.stdout.split(maxsplit=1)
    assert reason.strip() == "File too large"
    counts = set(count_everywhere(bag))
    assert len(counts) == 1
    assert counts.pop() >= int(sealed) > 5000


def test_a_message_index_names_every_message(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with open_writer(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(10):
            writer.write("/a", 100 - index, state(index))  # log times may go backwards
    content = (bag / "bag_0.mcap").read_bytes()
    with (bag / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (chunk,) = summary.chunk_indexes
    (at,) = chunk.message_index_offsets.values()
    opcode, _, channel, size = struct.unpack_from("<BQHI", content, at)
    assert (opcode, channel, size) == (0x07, 1, 160)
    assert read_bag(bag)["/a"]["log_time_ns"].tolist() == list(range(91, 101))
