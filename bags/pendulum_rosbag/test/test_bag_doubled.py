"""Files of a bag that are there twice, in another form, under another name or as a copy: each message once."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_rosbag.convert.rewrite import rewrite
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_readers import JOINT_STATE, state

COUNT = 200


def write(bag: Path, storage: str = "mcap", first: int = 0, shift: int = 0) -> Path:
    with BagWriter(bag, storage) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(first, first + COUNT):
            writer.write("/a", index, state(index + shift))
    (file,) = [*bag.glob("*.mcap"), *bag.glob("*.db3")]
    return file


def pack(file: Path) -> Path:
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstandard.compress(file.read_bytes()))
    return packed


def rename_listed(bag: Path, old: str, new: str) -> None:
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(f'"{old}"', new, 1))


def decompressed_besides(file: Path) -> None:
    rename_listed(file.parent, file.name, f'"{pack(file).name}"')


def both_listed(file: Path) -> None:
    rename_listed(file.parent, file.name, f'"{file.name}"\n    - "{pack(file).name}"')


def packed_besides(file: Path) -> None:
    pack(file)


def listed_without_its_ending(file: Path) -> None:
    pack(file)
    file.unlink()


def listed_twice(file: Path) -> None:
    rename_listed(file.parent, file.name, f'"{file.name}"\n    - "./{file.name}"')


def by_a_windows_path(file: Path) -> None:
    rename_listed(file.parent, file.name, f"'recordings\\monday\\{file.name}'")


def linked(file: Path) -> None:
    file.with_name(f"latest{file.suffix}").symlink_to(file.name)


def linked_hard(file: Path) -> None:
    os.link(file, file.with_name(f"kept{file.suffix}"))


def copied(file: Path) -> None:
    shutil.copyfile(file, file.with_name(f"{file.stem} (copy){file.suffix}"))


def repaired_into_the_folder(file: Path) -> None:
    report = repair_bag(file.parent, file.parent.parent / "mended", force=True)
    (mended,) = [*report.path.glob("*.mcap"), *report.path.glob("*.db3")]
    shutil.move(mended, file.with_name(f"{file.stem}_repaired{file.suffix}"))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize(
    "double",
    [
        decompressed_besides,
        both_listed,
        packed_besides,
        listed_without_its_ending,
        listed_twice,
        by_a_windows_path,
        linked,
        linked_hard,
        copied,
        repaired_into_the_folder,
    ],
)
def test_a_file_that_is_there_twice_is_read_once_and_nothing_is_called_missing(
    tmp_path: Path, double: Callable[[Path], None], storage: str
) -> None:
    bag = tmp_path / "bag"
    double(write(bag, storage))
    with read_bag(bag) as opened:
        assert opened.damage == []
        assert [time for time, _ in opened.raw("/a")] == list(range(COUNT))
    assert rewrite([bag], tmp_path / "converted").messages == {"/a": COUNT}


def test_a_copy_in_a_folder_without_metadata_is_read_once(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    copied(write(bag))
    (bag / "metadata.yaml").unlink()
    with read_bag(bag) as opened:
        assert opened.topics["/a"].count == COUNT
        assert any("left out: all its messages are in" in note for note in opened.notes)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_another_run_at_the_same_simulated_times_is_no_copy(tmp_path: Path, storage: str) -> None:
    bag = tmp_path / "bag"
    file = write(bag, storage)
    shutil.move(write(tmp_path / "more", storage, shift=1), bag / f"tuesday{file.suffix}")
    (bag / "metadata.yaml").unlink()
    with read_bag(bag) as opened:
        assert opened.topics["/a"].count == 2 * COUNT
    assert rewrite([bag], tmp_path / "converted").messages == {"/a": 2 * COUNT}


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_a_damaged_copy_does_not_keep_the_bag_from_being_opened(tmp_path: Path, compression: str | None) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, compression=compression) as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, JOINT_STATE)
            for index in range(COUNT):
                writer.write(topic, index, state(index))
    (file,) = bag.glob("*.mcap")
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 0xFF
    file.with_name("copy.mcap").write_bytes(content)
    with read_bag(bag) as opened:
        assert set(opened.topics) == {"/a", "/b"}
    with pytest.raises(BagError, match=r"copy\.mcap"), read_bag(bag) as opened:
        list(opened.raw("/a"))


def test_a_torn_file_is_replaced_by_its_sound_twin(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    file = write(bag)
    packed = pack(file)
    rename_listed(bag, file.name, f'"{packed.name}"')
    packed.write_bytes(packed.read_bytes()[:500])
    with read_bag(bag) as opened:
        assert opened.damage == []
        assert opened.topics["/a"].count == COUNT


def test_what_a_recorder_that_died_had_not_listed_yet_is_read(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    write(bag)
    shutil.move(write(tmp_path / "more", first=COUNT), bag / "bag_1.mcap")
    with read_bag(bag) as opened:
        assert [time for time, _ in opened.raw("/a")] == list(range(2 * COUNT))


def test_a_bag_that_is_named_twice_is_not_merged_with_itself(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    write(bag)
    (tmp_path / "link").symlink_to(bag)
    with pytest.raises(ParameterError, match="is named twice"):
        rewrite([bag, tmp_path / "link"], tmp_path / "merged")
