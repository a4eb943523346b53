"""Tests of files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pendulum_msgs_py.whole_file import write_whole


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
    with pytest.raises(ValueError, match="null"):
        write_whole(tmp_path / "a\0b", "")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OSError, match="file"):
        write_whole(tmp_path / "file" / "below", "")
