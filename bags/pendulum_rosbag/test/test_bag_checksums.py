"""A byte that a disk changed in an MCAP file is told, wherever it lies; it is never handed over as if it were data."""

from __future__ import annotations

import json
import struct
import threading
from pathlib import Path

import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.convert.rewrite import rewrite
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.info_cli import main as info_main
from pendulum_rosbag.reader.mcap_source import McapSource
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_testing.bag_messages import JOINT_STATE, write_bag

TOPICS = ("/a", "/b", "/c")
COUNT = 30_000


@pytest.fixture(scope="module", params=[None, "zstd"], ids=["plain", "zstd"])
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed bag of several chunks."""
    return write(tmp_path_factory.mktemp("sound") / "bag", request.param)


def write(path: Path, compression: str | None, *, close: bool = True, count: int = COUNT) -> Path:
    states = (
        (TOPICS[index % 3], 1_000_000 * index, encode_joint_state(index, position=0.5 * index))
        for index in range(count)
    )
    return write_bag(path, states, compression=compression, seal_every=3000, close=close)


def with_flip(bag: Path, target: Path, at: int) -> Path:
    """Copy a bag with one bit of one byte of its file turned over."""
    target.mkdir()
    for file in bag.iterdir():
        content = bytearray(file.read_bytes())
        if file.suffix == ".mcap":
            content[at] ^= 0x10
        (target / file.name).write_bytes(content)
    return target


def inside(bag: Path) -> int:
    """Return a byte of the file in the second chunk: of a position where the chunk is plain."""
    source = source_of(bag)
    chunk = source.chunks[1]
    if chunk.compression:
        return chunk.data_start + chunk.data_size // 2
    start = read_bag(bag, start=chunk.start_ns)["/a"]["position"][100]
    return bytes(source.buffer).index(struct.pack("<d", start), chunk.data_start)


def source_of(bag: Path) -> McapSource:
    (file,) = bag.glob("*.mcap")
    return McapSource(file)


def test_a_changed_byte_of_a_message_is_refused_with_file_and_place(sound: Path, tmp_path: Path) -> None:
    chunk = source_of(sound).chunks[1]
    bag = with_flip(sound, tmp_path / "flipped", inside(sound))
    for read in (lambda b: b["/a"], lambda b: b.raw("/b"), lambda b: b.messages("/c"), lambda b: b.load()):
        with pytest.raises(BagError) as told:
            read(read_bag(bag))
        assert f"{bag.name}/bag_0.mcap" in str(told.value)
        assert "\n" not in str(told.value)
    if not chunk.compression:
        assert f"the chunk at byte {chunk.offset} is damaged (checksum " in str(told.value)
        unread = read_bag(bag, verify=False)
        assert [len(unread[topic]) for topic in TOPICS] == [COUNT // 3] * 3, "whoever wants the rest can have it"
    # What was read before the damage, and a span that does not touch it, are as they were.
    before = read_bag(bag, stop=chunk.start_ns)["/a"]
    assert len(before)
    assert before.tobytes() == read_bag(sound, stop=chunk.start_ns)["/a"].tobytes()


def test_info_convert_and_repair_leave_the_damaged_chunk_out_and_say_so(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chunk = source_of(sound).chunks[1]
    bag = with_flip(sound, tmp_path / "flipped", inside(sound))
    lost = sum(len(read_bag(sound, start=chunk.start_ns, stop=chunk.stop_ns + 1).raw(topic)) for topic in TOPICS)
    sentence = f"bag_0.mcap: the chunk at byte {chunk.offset} does not have its checksum; {lost} messages are left out"
    whole = read_bag(bag, verify=True)
    assert whole.damage == [sentence]
    assert sum(topic.count for topic in whole.topics.values()) == COUNT - lost
    assert sum(len(whole[topic]) for topic in TOPICS) == COUNT - lost
    assert info_main([str(bag)]) == 0
    assert sentence in capsys.readouterr().out
    converted = rewrite([bag], tmp_path / "converted")
    assert converted.damage == [f"{bag}: {sentence}"]
    repaired = repair_bag(bag, tmp_path / "repaired")
    assert repaired.damage == [sentence]
    for report in (converted, repaired):
        found = read_bag(report.path)
        assert not found.damage
        for topic in TOPICS:
            rows = read_bag(sound).raw(topic)
            assert found.raw(topic) == [row for row in rows if not chunk.start_ns <= row[0] <= chunk.stop_ns]


def test_a_changed_message_index_is_refused_and_repair_loses_nothing(sound: Path, tmp_path: Path) -> None:
    """No checksum covers an index; each entry (log time, offset) must name a message of that time."""
    chunk = source_of(sound).chunks[1]
    entry = next(iter(chunk.indexes.values())) + 15
    for number, place in enumerate((entry, entry + 8)):
        bag = with_flip(sound, tmp_path / f"flipped{number}", place)
        with pytest.raises(BagError, match="try to repair"):
            read_bag(bag).raw("/a")
        with pytest.raises(BagError, match="try to repair"):
            read_bag(bag).log_times("/a")
        repaired = repair_bag(bag, tmp_path / f"repaired{number}")
        assert "message index" in repaired.damage[0]
        assert {topic: read_bag(repaired.path).raw(topic) for topic in TOPICS} == {
            topic: read_bag(sound).raw(topic) for topic in TOPICS
        }


def test_a_changed_summary_is_reported_and_the_chunks_are_found_without_it(sound: Path, tmp_path: Path) -> None:
    (file,) = sound.glob("*.mcap")
    summary = int.from_bytes(file.read_bytes()[-28:-20], "little")
    content = file.read_bytes()
    topic = content.index(b"/b", summary)
    bag = with_flip(sound, tmp_path / "flipped", topic + 1)
    opened = read_bag(bag)
    assert opened.damage == [f"bag_0.mcap: the summary at byte {summary} does not have its checksum"]
    assert {name: len(opened[name]) for name in TOPICS} == dict.fromkeys(TOPICS, COUNT // 3)


def test_chunks_of_a_file_that_was_not_closed_are_compared_when_it_is_opened(tmp_path: Path) -> None:
    """Who lost power may have lost pages: what is whole is offered, the rest is named."""
    bag = write(tmp_path / "bag", None, close=False, count=6000)
    chunk = source_of(bag).chunks[0]
    flipped = with_flip(bag, tmp_path / "flipped", chunk.data_start + 1000)
    opened = read_bag(flipped)
    assert opened.damage[-1].startswith(f"bag_0.mcap: the chunk at byte {chunk.offset} does not have its checksum; ")
    assert 0 < sum(len(opened[topic]) for topic in TOPICS) < 6000
    assert read_bag(bag).load().damage == read_bag(bag, verify=False).damage, "a sound one has no more damage than that"


def test_a_changed_summary_of_a_file_that_was_not_closed_is_reported(tmp_path: Path) -> None:
    """Any byte of it: a name, a type, a count, a time."""
    states = ((TOPICS[index % 3], index, encode_joint_state(index)) for index in range(30))
    bag = write_bag(tmp_path / "bag", states, seal_every=10, close=False)
    (file,) = bag.glob("*.mcap")
    content = file.read_bytes()
    summary = int.from_bytes(content[-28:-20], "little")
    whole = {topic: read_bag(bag).raw(topic) for topic in TOPICS}
    end = summary
    while content[end] != rec.PADDING:
        end += 9 + int.from_bytes(content[end + 1 : end + 9], "little")
    assert 500 < end - summary < 10_000
    silent = []
    for at in range(summary, end, 17):
        flipped = bytearray(content)
        flipped[at] ^= 0x01
        file.write_bytes(flipped)
        opened = read_bag(bag)
        if not opened.damage:
            silent.append(at)
        assert {topic: opened.raw(topic) for topic in opened.topics} == whole, "the chunks still hold everything"
    assert silent == []


def test_a_summary_that_the_recorder_replaces_while_it_is_read_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic("/a", JOINT_STATE)
    total = 0

    def record() -> None:
        nonlocal total
        for _ in range(10):
            writer.write("/a", total, encode_joint_state(total))
            total += 1
        writer.seal()

    record()
    take = McapSource._take_summary_record
    going = True

    def slowly(source: McapSource, opcode: int, content: bytes) -> bool:
        nonlocal going
        if going and opcode == rec.CHUNK_INDEX:
            going = False
            for _ in range(2):  # (there are two places for it)
                record()
                writer.sync()
        return take(source, opcode, content)

    monkeypatch.setattr(McapSource, "_take_summary_record", slowly)
    with read_bag(tmp_path / "bag") as opened:
        assert opened.damage == []
        assert opened["/a"]["stamp_ns"].tolist() == list(range(len(opened["/a"])))
        assert len(opened["/a"]) == opened.topics["/a"].count > 10
    writer.close()


def test_damage_is_reported_each_time_that_it_is_read(sound: Path, tmp_path: Path) -> None:
    opened = read_bag(with_flip(sound, tmp_path / "flipped", inside(sound)))
    for _ in range(2):
        for topic in TOPICS:
            with pytest.raises(BagError):
                opened.raw(topic)


def test_two_passes_over_a_file_at_a_time_both_find_the_damage(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", None)
    source = source_of(with_flip(bag, tmp_path / "flipped", inside(bag)))
    first, second = (source.batches({stream.channel}, None, None) for stream in source.streams[:2])
    next(first)
    next(second)
    second.close()  # type: ignore[attr-defined]  # (a generator)
    with pytest.raises(BagError, match=r"the chunk at byte \d+ is damaged"):
        list(first)


def test_a_pass_that_is_held_open_ends_with_its_file_and_so_does_its_thread(tmp_path: Path) -> None:
    source = source_of(write(tmp_path / "bag", None))
    before = set(threading.enumerate())
    going = source.batches({source.streams[0].channel}, None, None)
    next(going)
    (thread,) = set(threading.enumerate()) - before
    source.close()
    assert not thread.is_alive()
    with pytest.raises(BagError, match=r"bag_0\.mcap was closed while it was being read"):
        list(going)


def test_an_index_that_names_what_is_not_there_is_reported_with_file_chunk_topic_and_time(
    sound: Path, tmp_path: Path
) -> None:
    chunk = source_of(sound).chunks[1]
    time = read_bag(sound, start=chunk.start_ns).log_times("/b")[0]
    bag = with_flip(sound, tmp_path / "flipped", chunk.indexes[source_of(sound).streams[1].channel] + 15 + 8)
    sentence = (
        f"{bag}/bag_0.mcap: the message index of the chunk at byte {chunk.offset}, topic /b, names a message at "
        f"{time * 1e-9:.3f} s where there is none; try to repair the bag"
    )
    for read in (lambda b: b["/b"], lambda b: b.raw("/b"), lambda b: b.log_times("/b")):
        for span in ({}, {"start": chunk.start_ns, "stop": chunk.stop_ns}):
            with pytest.raises(BagError) as told:
                read(read_bag(bag, **span))
            assert str(told.value) == sentence
    assert repair_bag(bag, tmp_path / "repaired").damage == [sentence.removeprefix(f"{bag}/")]


def test_info_notes_what_no_checksum_covers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def library_file(name: str, **how: bool) -> Path:
        with (tmp_path / name).open("wb") as stream:
            writer = McapLibraryWriter(stream, chunk_size=1000, compression=CompressionType.ZSTD, **how)
            writer.start("ros2", "test")
            channel = writer.register_channel("/a", "cdr", writer.register_schema(JOINT_STATE, "ros2msg", b""))
            for index in range(60):
                writer.add_message(channel, index, encode_joint_state(index), index)
            writer.finish()
        return tmp_path / name

    with BagWriter(tmp_path / "sqlite", "sqlite3") as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.write("/a", 1, encode_joint_state(1))
    end = ", so bytes that changed in messages cannot be told"
    bare = library_file("bare.mcap", enable_crcs=False)
    chunks = len(McapSource(bare).chunks)
    assert chunks > 3
    for bag, notes in (
        (bare, [f"bare.mcap: {chunks} of {chunks} chunks have no checksum{end}"]),
        (
            library_file("loose.mcap", use_chunking=False),
            [f"loose.mcap: messages outside of chunks have no checksum{end}"],
        ),
        (tmp_path / "sqlite", [f"sqlite_0.db3: a database has no checksums{end}"]),
        (library_file("sound.mcap"), []),
        (library_file("scanned.mcap", use_statistics=False), []),
        (write(tmp_path / "ours", None, close=False, count=3000), []),
    ):
        assert info_main([str(bag)]) == 0
        printed = capsys.readouterr().out.splitlines()
        assert [line for line in printed if line.startswith(("note", "damaged"))] == [f"note: {note}" for note in notes]
        assert info_main([str(bag), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["notes"] == notes
