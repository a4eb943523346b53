"""Bags whose writer may stop at any instant: killed, out of room, or between two pages of a write."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import McapReader, NonSeekingReader, SeekingReader, make_reader

from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter, mcap_layout, sealed_mcap, storage_file
from pendulum_testing.bag_readers import (
    ENDLESS_WRITER,
    JOINT_STATE,
    STRING,
    count_everywhere,
    count_in_order,
    state,
    text_message,
)
from pendulum_testing.mcap_js_reader import McapJs


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

    writer = BagWriter(bag, storage)
    monkeypatch.setattr(storage_file, "os", _WatchedOs(watched))
    writer.add_topic("/a", STRING)
    for round_number in range(10):
        for _ in range(rng.randrange(1, 5)):
            writer.write("/a", total, text_message("x" * rng.choice([0, 3, 300, 4000, 9000])))
            total += 1
        if round_number == 5:
            writer.add_topic("/late", STRING)
        writer.seal()
        sealed = total
        assert set(count_everywhere(bag)) == {total}
        if storage == "mcap":
            assert count_in_order(bag) == total
    writer.close()
    assert set(count_everywhere(bag)) == {total}
    assert moments > 40


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_a_reader_keeps_what_it_was_shown_while_the_recorder_goes_on_and_ends(
    tmp_path: Path, compression: str | None
) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(bag, compression=compression)
    writer.add_topic("/a", JOINT_STATE)

    def record(first: int, last: int) -> None:
        for index in range(first, last):
            writer.write("/a", index, state(index))
            if index % 50 == 49:
                writer.seal()

    readers = []
    for first, last in ((0, 100), (100, 2000), (2000, 40_000)):
        record(first, last)
        readers.append((last, read_bag(bag)))
    record(40_000, 60_000)
    writer.close()
    for count, opened in readers:
        np.testing.assert_array_equal(opened["/a"]["stamp_ns"], 1000 * np.arange(count))


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
            reader = SeekingReader(stream, validate_crcs=True)
            by_index = numbers(reader)
            summary = reader.get_summary()
            if summary is not None and summary.statistics is not None:
                assert summary.statistics.chunk_count == len(summary.chunk_indexes)
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

    writer = BagWriter(bag, compression=compression)
    monkeypatch.setattr(storage_file, "os", _WatchedOs(watched))
    ends = []
    for round_number in range(25 if compression else 45):
        if round_number % 20 == 0:
            for number in range(12):
                writer.add_topic(f"/t{round_number}_{number}", STRING)
        for _ in range(rng.randrange(1, 5)):
            size = rng.choice([0, 3, 300, 2000, 2000, 50_000 if round_number % 15 == 7 else 3000])
            topic = f"/t{rng.randrange(0, round_number + 1, 20)}_0"
            writer.write(
                topic,
                total,
                b"\0\1\0\0" + total.to_bytes(8, "little") + (rng.randbytes(size // 2) + bytes(size - size // 2)),
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
    assert len(set(ends)) > (1 if compression else 2)  # the end of the file moved, also while chunks were staged
    assert moments > (80 if compression else 150)
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
    writer = BagWriter(bag)
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


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_foxgloves_readers_open_a_growing_file_at_every_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mcap_js: McapJs, compression: str | None
) -> None:
    """Stop after every single write while the file is made, grows, outgrows its summaries, and is closed."""
    monkeypatch.setattr(mcap_layout, "_FIRST_ROOM", 1 << 16)
    monkeypatch.setattr(mcap_layout, "_LARGEST_ROOM", 1 << 16)
    monkeypatch.setattr(mcap_layout, "_FIRST_SLOT", 2 * 4096)
    monkeypatch.setattr(sealed_mcap, "_LARGEST_NUMBER", 8)
    bag = tmp_path / "bag"
    rng = random.Random(5)
    sealed = total = moments = 0

    def watched(fd: int, data: bytes, offset: int) -> int:
        nonlocal moments
        done = os.pwrite(fd, data, offset)
        if bag.exists():
            moments += 1
            found = mcap_js.read(bag / "bag_0.mcap")
            for answer in found.values():
                # The end of the file and what leads there cannot move in one write: for as long as one call takes,
                # this reader in order finds bytes behind the last record, and says so.
                if answer is found["inOrder"] and "remaining after MCAP footer" in answer.get("error", ""):
                    continue
                assert sealed <= answer.get("count", -1) <= total, answer
        return done

    writer = BagWriter(bag, compression=compression)
    monkeypatch.setattr(storage_file, "os", _WatchedOs(watched))
    assert mcap_js.counts(bag / "bag_0.mcap") == (0, 0)
    sizes = set()
    for round_number in range(24):
        if round_number % 8 == 0:
            for number in range(12):
                writer.add_topic(f"/t{round_number}_{number}", STRING)
        for _ in range(rng.randrange(1, 4)):
            writer.write("/t0_0", total, text_message("x") + rng.randbytes(rng.choice([0, 300, 9000])))
            total += 1
        writer.seal()
        sealed = total
        assert mcap_js.counts(bag / "bag_0.mcap") == (total, total)
        sizes.add((bag / "bag_0.mcap").stat().st_size)
    writer.close()
    assert mcap_js.counts(bag / "bag_0.mcap") == (total, total)
    assert moments > 60
    assert len(sizes) > 1  # the end of the file moved


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_kill_9_at_random_moments_costs_nothing_that_was_sealed(tmp_path: Path, storage: str) -> None:
    """A writer that does nothing but commit is killed: nearly every kill hits the middle of a commit."""
    rng = random.Random(11)
    for number in range(4):
        bag = tmp_path / f"bag{number}"
        child = subprocess.Popen([sys.executable, "-c", ENDLESS_WRITER, str(bag), storage], stdout=subprocess.PIPE)
        assert child.stdout is not None
        assert child.stdout.readline() == b"go\n"
        time.sleep(rng.uniform(0.0, 0.1))
        child.send_signal(signal.SIGKILL)
        output = child.stdout.read().split()
        child.wait()
        sealed = int(output[-1]) if output else 0
        counts = set(count_everywhere(bag))
        assert len(counts) == 1
        assert counts.pop() >= sealed


FULL = """
import resource, sys
from pendulum_rosbag.storage import BagWriter
from pendulum_msgs_py.contract.cdr import encode_joint_state
writer = BagWriter(sys.argv[1], sys.argv[2])
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
        [sys.executable, "-c", FULL, str(bag), storage], capture_output=True, text=True, timeout=60, check=True
    )
    sealed, reason = done.stdout.split(maxsplit=1)
    assert reason.strip() == "File too large"
    counts = set(count_everywhere(bag))
    assert len(counts) == 1
    assert counts.pop() >= int(sealed) > 5000
