"""Tests of files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.whole_file import write_whole, writing


@pytest.mark.parametrize("content", ["ä = 1\n", "ä = 1\n".encode()], ids=["text", "bytes"])
def test_a_file_is_written_with_the_folders_above_it(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "new" / "folder" / "plant.yaml"
    write_whole(path, content)
    assert path.read_bytes() == "ä = 1\n".encode()
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("cause", [KeyboardInterrupt(), OSError(28, "No space left on device")], ids=["Ctrl-C", "full"])
@pytest.mark.parametrize("moment", ["write_bytes", "replace"])
def test_what_ends_the_writing_leaves_the_old_file_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: BaseException, moment: str
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("old", encoding="utf-8")
    real = getattr(Path, moment)

    def end(self: Path, *told: object) -> None:
        if moment == "write_bytes":
            real(self, b"ha")  # half of it
        raise cause

    monkeypatch.setattr(Path, moment, end)
    with pytest.raises(type(cause)):
        write_whole(path, "half and half")
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_path_that_is_none_is_refused_and_hides_no_reason(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="null"):
        write_whole(tmp_path / "a\0b", "")
    with pytest.raises(OSError, match="surrogates"):
        write_whole(tmp_path / "text", "\udc80")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OSError, match="file"):
        write_whole(tmp_path / "file" / "below", "")
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    with pytest.raises(OSError, match="circle"):
        write_whole(circle, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["circle", "file"]


def test_a_link_stays_one_and_what_it_stands_for_is_written(tmp_path: Path) -> None:
    shared, link, new = tmp_path / "shared" / "plant.yaml", tmp_path / "plant.yaml", tmp_path / "new.yaml"
    shared.parent.mkdir()
    shared.write_text("old", encoding="utf-8")
    link.symlink_to(shared)
    write_whole(link, "new")
    assert link.is_symlink()
    assert shared.read_text(encoding="utf-8") == "new"
    new.symlink_to(shared.with_name("none_yet.yaml"))
    write_whole(new, "first")
    assert new.is_symlink()
    assert new.read_text(encoding="utf-8") == "first"
    assert len(list(shared.parent.iterdir())) == 2


def test_what_is_no_file_is_written_to_and_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, "through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    with pytest.raises(OSError, match="No space left"):
        write_whole(Path("/dev/full"), "lost")
    assert Path("/dev/full").is_char_device()
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path, "")


def test_a_file_that_is_protected_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("mine", encoding="utf-8")
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write to all
    with pytest.raises(PermissionError, match="Permission denied"):
        write_whole(path, "yours")
    assert path.read_text(encoding="utf-8") == "mine"
    write_whole(tmp_path / "other.yaml", "new")


def test_what_cannot_be_written_is_told_in_a_sentence_with_the_thing_and_the_reason(tmp_path: Path) -> None:
    told = r"^plant file x cannot be written: No space left on device$"
    with pytest.raises(ParameterError, match=told), writing("plant file x", ParameterError):
        write_whole(Path("/dev/full"), "lost")
    # Libraries raise errors without a number.
    with pytest.raises(BagError, match=r"^picture x cannot be written: no mode P$"), writing("picture x", BagError):
        raise OSError("no mode P")
    # A BagError is an OSError, and has its sentence.
    for error in (BagError("told"), ParameterError("told"), ZeroDivisionError("told")):
        with pytest.raises(type(error), match=r"^told$"), writing("x", DataError):
            raise error
