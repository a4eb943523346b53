"""Bags on disk: whole at every instant, for every reader, in both storages."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter, QosProfile, exchange, message_type, metadata_file
from pendulum_testing.bag_readers import JOINT_STATE, STRING, count_everywhere, count_in_order, state, text_message

JOINT_STATE_HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
"""As Jazzy's own discovery reports it."""


@pytest.mark.parametrize(("storage", "compression"), [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)])
def test_what_is_sealed_is_in_the_bag_for_every_reader(tmp_path: Path, storage: str, compression: str | None) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag, storage, compression)
    writer.add_topic("/a", JOINT_STATE)
    writer.add_topic("/b", JOINT_STATE)
    for index in range(300):
        writer.write("/ab"[:1] + "ab"[index % 2], index, state(index))
        if index in (0, 1, 50, 298):
            writer.seal()
            assert set(count_everywhere(bag)) == {index + 1}
    writer.close()
    assert set(count_everywhere(bag)) == {300}


def test_a_file_outgrows_its_room_and_its_summaries_many_times(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag)
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
        with BagWriter(bag, storage, **limits) as writer:
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
    with BagWriter(bag, metadata={"run": {"seed": 3}, "strange": strange}) as writer:
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
    with BagWriter(bag, compression="zstd") as writer:
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
        (channel,) = summary.channels.values()
        assert channel.metadata["topic_type_hash"] == message_type(JOINT_STATE).hash
        assert [metadata.name for metadata in reader.iter_metadata()] == ["rosbag2"]
    # Also of the file alone, without the metadata of its folder.
    assert read_bag(bag / "bag_0.mcap").topics["/a"].hash == JOINT_STATE_HASH


def test_sqlite_files_have_the_index_that_rosbag2_seeks_by(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, "sqlite3") as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(100):
            writer.write("/a", index, state(index))
    connection = sqlite3.connect(bag / "bag_0.db3")
    assert connection.execute("SELECT name FROM sqlite_master WHERE type = 'index'").fetchall() == [("timestamp_idx",)]
    assert connection.execute("SELECT schema_version, ros_distro FROM schema").fetchall() == [(4, "jazzy")]
    assert "bag_0.db3" in connection.execute("SELECT metadata FROM metadata").fetchone()[0]
    connection.close()


def test_a_database_names_the_distribution_that_its_metadata_name(tmp_path: Path) -> None:
    BagWriter(tmp_path / "bag", "sqlite3", ros_distro="humble").close()
    connection = sqlite3.connect(tmp_path / "bag" / "bag_0.db3")
    assert connection.execute("SELECT ros_distro FROM schema").fetchall() == [("humble",)]
    assert "ros_distro: humble" in (tmp_path / "bag" / "metadata.yaml").read_text()


def test_large_messages_continue_on_overflow_pages(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    sizes = [0, 1, 4000, 4030, 4031, 4032, 4040, 4044, 4061, 4100, 8000, 8150, 12_345, 70_000, 300_000]
    with BagWriter(bag, "sqlite3") as writer:
        writer.add_topic("/s", STRING)
        for number, size in enumerate(sizes):
            writer.write("/s", number, text_message("z" * size))
    assert set(count_everywhere(bag)) == {len(sizes)}
    assert [len(stored.message.data) for stored in read_bag(bag)["/s"]] == sizes


def _write_sealed(writer: BagWriter, index: int) -> None:
    writer.write("/a", index, state(index))
    writer.seal()


def _open_in(folder: Path) -> list[str]:
    """Return what this process has open below a folder, removed files too; what others left open does not count."""
    found = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found.append(str(descriptor.readlink()))
    return [name for name in found if name.startswith(f"{folder}/")]


def _told(bag: Path) -> dict[str, Any]:
    told: dict[str, Any] = yaml.safe_load((bag / "metadata.yaml").read_bytes())["rosbag2_bagfile_information"]
    return told


def test_two_files_of_metadata_take_turns_and_leave_nothing_behind(tmp_path: Path) -> None:
    """To make a new one at each seal would cost more than all else."""
    bag, places = tmp_path / "bag", []
    with BagWriter(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(12):
            writer.write("/a", 10**index, state(index))
            note = "x" * (index % 8 < 4) * 600
            if index % 4 == 0:
                writer.update_metadata({"pendulum.note": note})
            writer.seal()
            told = _told(bag)
            assert told["message_count"] == told["topics_with_message_count"][0]["message_count"] == index + 1
            assert told["custom_data"]["pendulum.note"] == note
            places.append((bag / "metadata.yaml").stat().st_ino)
        assert len(set(places)) == 2
    assert sorted(path.name for path in bag.iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert _open_in(tmp_path) == []


@pytest.mark.parametrize("how", ["close", "abandon", "replaced", "renamed"])
def test_no_file_of_metadata_stays_open(tmp_path: Path, how: str) -> None:
    for number in range(3):
        bag = tmp_path / str(number)
        writer = BagWriter(bag)
        writer.add_topic("/a", JOINT_STATE)
        for index in range(4):
            _write_sealed(writer, index)
            if how == "replaced":
                (bag / "own").write_text("mine")
                (bag / "own").replace(bag / "metadata.yaml")
        if how == "renamed":
            bag.rename(tmp_path / f"{number}_elsewhere")
            with pytest.raises(FileNotFoundError):
                writer.close()
        elif how == "abandon":
            writer.abandon()
            assert sorted(path.name for path in bag.iterdir()) == [f"{number}_0.mcap", "metadata.yaml"]
        else:
            writer.close()
    assert _open_in(tmp_path) == []


@pytest.mark.parametrize("written", [0, 900])
def test_a_kill_in_the_middle_of_new_metadata_leaves_the_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(4):
            _write_sealed(writer, index)
        old, write = (bag / "metadata.yaml").read_bytes(), os.pwrite

        def killed(descriptor: int, data: bytes, at: int) -> int:
            if data[:7] != b"rosbag2":
                return write(descriptor, data, at)
            write(descriptor, data[:written], at)
            raise KeyboardInterrupt

        monkeypatch.setattr(metadata_file.os, "pwrite", killed)
        writer.write("/a", 4, state(4))
        with pytest.raises(KeyboardInterrupt):
            writer.seal()
        assert (bag / "metadata.yaml").read_bytes() == old


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOSYS, None])
def test_where_files_cannot_exchange_their_names_metadata_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int | None
) -> None:
    def refuse(*_: object) -> int:
        ctypes.set_errno(code or 0)
        return -1

    monkeypatch.setattr(exchange, "_renameat2", lambda: refuse if code else None)
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(4):
            _write_sealed(writer, index)
            assert _told(bag)["message_count"] == index + 1
            assert sorted(path.name for path in bag.iterdir()) == ["bag_0.mcap", "metadata.yaml"]


def test_an_exchange_that_is_refused_says_of_what(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("a")
    with pytest.raises(FileNotFoundError, match=r"a.*->.*b"):
        exchange.exchange(tmp_path / "a", tmp_path / "b")
    (tmp_path / "b").write_text("b")
    assert exchange.exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a").read_text() == "b"


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_that_is_taken_away_while_it_is_written_is_noticed_at_the_next_seal(tmp_path: Path, storage: str) -> None:
    writer = BagWriter(tmp_path / "bag", storage)
    writer.add_topic("/a", JOINT_STATE)
    writer.write("/a", 0, state(0))
    writer.seal()
    (tmp_path / "bag").rename(tmp_path / "elsewhere")
    writer.write("/a", 1, state(1))
    with pytest.raises(FileNotFoundError, match="metadata"):
        writer.seal()
    writer.abandon()
    assert set(count_everywhere(tmp_path / "elsewhere")) == {2}


def test_metadata_that_somebody_replaced_is_replaced_again_and_does_not_come_back(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(6):
            if index % 3 == 0:
                (bag / "own").write_text("mine")
                (bag / "own").replace(bag / ("metadata.yaml" if index else ".metadata.yaml.tmp"))
            _write_sealed(writer, index)
            assert set(count_everywhere(bag)) == {index + 1}


def test_counts_that_a_full_disk_cuts_short_are_written_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/a", JOINT_STATE)
        _write_sealed(writer, 0)
        write = os.pwrite
        monkeypatch.setattr(
            metadata_file.os, "pwrite", lambda fd, data, at: write(fd, data[: 9 if data[:4] == b"rosb" else None], at)
        )
        _write_sealed(writer, 1)
        assert _told(bag)["message_count"] == 2


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    BagWriter(bag).close()
    with pytest.raises(BagError, match="exists already; expected a new folder"):
        BagWriter(bag)


def test_wrong_use_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="storage is 'rosbag'; expected one of mcap, sqlite3"):
        BagWriter(tmp_path / "a", "rosbag")
    with pytest.raises(ParameterError, match="expected storage mcap"):
        BagWriter(tmp_path / "a", "sqlite3", "zstd")
    writer = BagWriter(tmp_path / "b")
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


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_many_messages_at_once_are_those_written_one_by_one_across_files_and_chunks(
    tmp_path: Path, storage: str
) -> None:
    # Times go back and forth, and most chunks and files end in the middle of what is written at once.
    items = [("/ab"[:1] + "ab"[i % 3 == 0], 10**9 + (i * 37) % 500, state(i)) for i in range(500)]
    for name in ("one_by_one", "at_once"):
        with BagWriter(tmp_path / name, storage, chunk_size=3000, max_size=30_000, file_stem="bag") as writer:
            writer.add_topic("/a", JOINT_STATE)
            writer.add_topic("/b", JOINT_STATE)
            if name == "at_once":
                writer.write_many(iter(items))
            else:
                for item in items:
                    writer.write(*item)
            assert writer.written == {"/a": 333, "/b": 167}
    first, second = (sorted((tmp_path / name).iterdir()) for name in ("one_by_one", "at_once"))
    assert len(first) > 3
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]
    told = yaml.safe_load((tmp_path / "at_once" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert told["starting_time"]["nanoseconds_since_epoch"] == 10**9
    assert told["duration"]["nanoseconds"] == 499
    read = read_bag(tmp_path / "at_once")
    assert (len(read["/a"]), len(read["/b"])) == (333, 167)
    for path in (tmp_path / "at_once").glob("*.mcap"):
        with path.open("rb") as stream:
            found = [m.sequence for _, _, m in make_reader(stream).iter_messages(["/a"], log_time_order=False)]
        assert found == list(range(1, len(found) + 1))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("problem", ["unknown topic", "no bytes", "no time", "broken source"])
def test_what_comes_before_a_message_that_cannot_be_written_is_kept(tmp_path: Path, storage: str, problem: str) -> None:
    def source() -> Iterator[tuple[str, int, bytes]]:
        for i in range(7):
            yield "/a", i, state(i)
        bad: dict[str, Any] = {
            "unknown topic": ("/x", 7, state(7)),
            "no bytes": ("/a", 7, None),
            "no time": ("/a", "noon", state(7)),
        }
        if problem not in bad:
            raise KeyError("/a")
        yield bad[problem]

    with BagWriter(tmp_path / "bag", storage) as writer:
        writer.add_topic("/a", JOINT_STATE)
        expected = {"unknown topic": BagError, "broken source": KeyError}.get(problem, Exception)
        with pytest.raises(expected):
            writer.write_many(source())
        writer.write("/a", 8, state(8))
        assert writer.written == {"/a": 8}
    assert set(count_everywhere(tmp_path / "bag")) == {8}
    assert list(read_bag(tmp_path / "bag")["/a"]["position"]) == [0.1 * i for i in (*range(7), 8)]


def test_a_type_that_nobody_knows_is_kept_as_bytes(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
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


def test_a_message_index_names_every_message(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
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
