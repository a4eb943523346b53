"""Storage files hold to their largest size and duration, to one message, however rarely they are sealed."""

from __future__ import annotations

import itertools
import random
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pendulum_rosbag.convert.convert_cli import convert_main, merge_main
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_readers import STRING, count_everywhere, text_message

KINDS = [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)]
LEAST = {"mcap": 12_000, "sqlite3": 200_000}
SLACK = {"mcap": 3_000, "sqlite3": 24 * 4096}
"""What a closed file may be smaller than its limit, but for a message: a chunk's head; pages of a database."""


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("limits")


def files_of(bag: Path) -> list[Path]:
    return sorted([*bag.glob("*.mcap"), *bag.glob("*.db3")], key=lambda file: int(file.stem.rpartition("_")[2]))


@pytest.mark.parametrize(("storage", "compression"), KINDS)
@settings(
    max_examples=12, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture], deadline=None
)
@given(st.integers(0, 2**32))
def test_no_file_is_larger_than_its_limit_nor_smaller_by_more_than_a_message(
    scratch: Path, storage: str, compression: str | None, seed: int
) -> None:
    rng = random.Random(seed)
    limit = round(LEAST[storage] * rng.uniform(1.0, 6.0))
    largest = rng.choice([10, 200, 3000])
    bag = scratch / "bag"
    shutil.rmtree(bag, ignore_errors=True)
    messages = []
    total = 0
    while total < 3 * limit:
        size = rng.randrange(largest)
        text = "".join(rng.choice("ab") for _ in range(size)) if compression else "x" * size
        messages.append((rng.choice(["/a", "/b"]), len(messages) * 1000, text_message(text)))
        total += len(text) // (6 if compression else 1) + 40
    with BagWriter(bag, storage, compression, max_size=limit) as writer:
        writer.add_topic("/a", STRING)
        writer.add_topic("/b", STRING)
        if rng.random() < 0.5:
            writer.write_many(iter(messages))
        else:
            for number, message in enumerate(messages):
                writer.write(*message)
                if number % 97 == 0:
                    writer.seal()
    sizes = [file.stat().st_size for file in files_of(bag)]
    assert len(sizes) >= 2
    assert max(sizes) <= limit
    assert min(sizes[:-1]) >= 0.97 * limit - largest - 200 - SLACK[storage]
    assert set(count_everywhere(bag)) >= {len(messages)}
    with read_bag(bag) as opened:
        found = sorted(row for topic in opened.topics for row in opened.raw(topic))
    assert found == sorted((time, data) for _, time, data in messages)


@pytest.mark.parametrize(("storage", "compression"), KINDS)
def test_no_file_is_longer_than_its_limit_across_pauses_too(
    tmp_path: Path, storage: str, compression: str | None
) -> None:
    rng = random.Random(4)
    times = [0]
    while len(times) < 3000:
        times.append(times[-1] + rng.choice([1, 2, 5, 3000 if rng.random() < 0.002 else 3]) * 1_000_000)
    bag = tmp_path / "bag"
    with BagWriter(bag, storage, compression, max_duration=0.5) as writer:
        writer.add_topic("/a", STRING)
        writer.write_many(("/a", time, text_message("x")) for time in times)
    spans = []
    for file in files_of(bag):
        with read_bag(file) as part:
            spans.append((part.start_ns, part.stop_ns))
    assert all(stop - start <= 500_000_000 for start, stop in spans)
    assert all(after[0] - before[0] > 500_000_000 for before, after in itertools.pairwise(spans))
    assert sum(len(read_bag(bag).raw(topic)) for topic in ("/a",)) == len(times)


def test_convert_and_merge_hold_to_the_limits_though_they_write_all_at_once(tmp_path: Path) -> None:
    bags = []
    for name in ("one", "two"):
        bags.append(str(tmp_path / name))
        with BagWriter(bags[-1]) as writer:
            writer.add_topic("/a", STRING)
            writer.write_many(("/a", i * 1_000_000, text_message("x" * 90)) for i in range(4000))
    for main, inputs, out in ((convert_main, bags[:1], "converted"), (merge_main, bags, "merged")):
        assert main([*inputs, "-o", str(tmp_path / out), "--max-size", "0.1"]) == 0
        sizes = [file.stat().st_size for file in files_of(tmp_path / out)]
        assert max(sizes) <= 100_000
        assert min(sizes[:-1]) >= 99_000
        assert main([*inputs, "-o", str(tmp_path / f"{out}_s"), "--max-duration", "0.7"]) == 0
        assert len(files_of(tmp_path / f"{out}_s")) == 6
        assert main([*inputs, "-o", str(tmp_path / f"{out}_n"), "--max-size", "nan"]) == 2
