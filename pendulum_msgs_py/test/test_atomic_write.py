"""Tests of files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import resource
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import BagError, DataError, ParameterError


@pytest.mark.parametrize("content", ["ä = 1\n", "ä = 1\n".encode()], ids=["text", "bytes"])
def test_a_file_is_written_with_the_folders_above_it(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "new" / "folder" / "plant.yaml"
    write_atomically(path, content)
    assert path.read_bytes() == "ä = 1\n".encode()
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("moment", ["chmod", "replace"])
def test_what_ends_the_writing_leaves_the_old_file_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("old", encoding="utf-8")

    def end(self: Path, *told: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, moment, end)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "half and half")
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("before", ["old", None])
def test_what_does_not_fit_leaves_the_old_file_and_nothing_beside_it(tmp_path: Path, before: str | None) -> None:
    path = tmp_path / "plant.yaml"
    if before is not None:
        path.write_text(before, encoding="utf-8")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match=r"File too large: '.*plant.yaml'"):
            write_atomically(path, 2000 * "x")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == ([] if before is None else [path])
    assert before is None or path.read_text(encoding="utf-8") == before


def test_threads_that_write_one_file_leave_it_whole_and_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    texts = [letter * 10_000 for letter in "abcd"]

    def write_often(text: str) -> None:
        for _ in range(30):
            write_atomically(path, text)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write_often, texts))
    assert path.read_text(encoding="utf-8") in texts
    assert list(tmp_path.iterdir()) == [path]


def test_a_path_that_is_none_is_refused_and_hides_no_reason(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="null"):
        write_atomically(tmp_path / "a\0b", "")
    with pytest.raises(OSError, match="surrogates"):
        write_atomically(tmp_path / "text", "\udc80")
    with pytest.raises(OSError, match="surrogates"):
        write_atomically(tmp_path / "\ud800", "")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OSError, match="file"):
        write_atomically(tmp_path / "file" / "below", "")
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    with pytest.raises(OSError, match=r"Too many levels of symbolic links: '.*circle'"):
        write_atomically(circle, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["circle", "file"]


def test_a_link_stays_one_and_what_it_stands_for_is_written(tmp_path: Path) -> None:
    shared, link, new = tmp_path / "shared" / "plant.yaml", tmp_path / "plant.yaml", tmp_path / "new.yaml"
    shared.parent.mkdir()
    shared.write_text("old", encoding="utf-8")
    link.symlink_to(shared)
    write_atomically(link, "new")
    assert link.is_symlink()
    assert shared.read_text(encoding="utf-8") == "new"
    new.symlink_to(shared.with_name("none_yet.yaml"))
    write_atomically(new, "first")
    assert new.is_symlink()
    assert new.read_text(encoding="utf-8") == "first"
    assert len(list(shared.parent.iterdir())) == 2


def test_what_is_no_file_is_written_to_and_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_atomically(pipe, "through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    with pytest.raises(OSError, match="No space left"):
        write_atomically(Path("/dev/full"), "lost")
    assert Path("/dev/full").is_char_device()
    with pytest.raises(IsADirectoryError):
        write_atomically(tmp_path, "")


def test_a_file_keeps_mode_and_owner_and_a_new_one_has_the_usual_ones(tmp_path: Path) -> None:
    path, plain = tmp_path / "plant.yaml", tmp_path / "plain.yaml"
    path.write_text("old", encoding="utf-8")
    path.chmod(0o640)
    if os.geteuid() == 0:
        os.chown(path, 65534, 65533)
    before = path.stat()
    write_atomically(path, "new")
    after = path.stat()
    assert (after.st_mode, after.st_uid, after.st_gid) == (before.st_mode, before.st_uid, before.st_gid)
    assert after.st_ino != before.st_ino
    plain.write_text("", encoding="utf-8")
    write_atomically(tmp_path / "new.yaml", "")
    assert (tmp_path / "new.yaml").stat().st_mode == plain.stat().st_mode


def test_what_a_file_keeps_from_others_is_in_no_other_file_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("old", encoding="utf-8")
    path.chmod(0o600)
    modes: list[int] = []
    chown = os.chown

    def look(beside: Path, *owner: int) -> None:
        modes.append(beside.stat().st_mode & 0o777)
        chown(beside, *owner)

    monkeypatch.setattr(os, "chown", look)
    write_atomically(path, "new")
    assert modes == [0o600]


def test_a_file_with_attributes_of_its_own_keeps_them(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("old", encoding="utf-8")
    try:
        os.setxattr(path, "user.made_by", b"me")
    except OSError:
        pytest.skip("this file system has no attributes")
    write_atomically(path, "new")
    assert path.read_text(encoding="utf-8") == "new"
    assert os.getxattr(path, "user.made_by") == b"me"


def test_a_file_of_two_names_keeps_both(tmp_path: Path) -> None:
    one, other = tmp_path / "one.yaml", tmp_path / "other.yaml"
    one.write_text("old", encoding="utf-8")
    os.link(one, other)
    write_atomically(one, "new")
    assert other.read_text(encoding="utf-8") == "new"


def test_a_name_as_long_as_there_may_be_is_written(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 255)
    write_atomically(path, "new")
    assert path.read_text(encoding="utf-8") == "new"


def test_what_a_shell_redirected_to_a_file_goes_on_there(tmp_path: Path) -> None:
    log = tmp_path / "log"
    code = "import sys; from pathlib import Path; from pendulum_msgs_py.atomic_write import write_atomically as w; "
    code += "w(Path(sys.argv[1]), 'from us\\n')"
    (tmp_path / "link").symlink_to("/dev/stdout")
    for device in ("/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", str(log), str(tmp_path / "link")):
        command = f"({shlex.join([sys.executable, '-c', code, device])}; echo tail) >> {log}"
        subprocess.run(["sh", "-c", command], check=True)
        assert log.read_text(encoding="utf-8").endswith("from us\ntail\n")


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM, errno.EBUSY, errno.EROFS, errno.EINVAL, errno.ENOSPC])
def test_what_may_be_written_to_but_not_replaced_is_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path = tmp_path / "plant.yaml"

    def refuse(self: Path, target: Path) -> None:
        raise OSError(number, "no", str(self))

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(OSError, match=r"no: '.*/plant.yaml'"):
        write_atomically(path, "new")
    assert not list(tmp_path.iterdir())
    path.write_text("an old text", encoding="utf-8")
    if number == errno.ENOSPC:
        with pytest.raises(OSError, match=r"no: '.*/plant.yaml'"):
            write_atomically(path, "new")
    else:
        write_atomically(path, "new")
    assert path.read_text(encoding="utf-8") == ("an old text" if number == errno.ENOSPC else "new")
    assert list(tmp_path.iterdir()) == [path]


def test_who_may_not_write_to_a_file_does_not_replace_it_either(tmp_path: Path) -> None:
    theirs, open_to_all = tmp_path / "theirs.yaml", tmp_path / "open.yaml"
    for path in (theirs, open_to_all):
        path.write_text("mine", encoding="utf-8")
    theirs.chmod(0o444)
    open_to_all.chmod(0o666)
    program = (
        "import os, sys; from pathlib import Path; from pendulum_msgs_py.atomic_write import write_atomically\n"
        "os.chdir(sys.argv[1])\n"
        "if os.geteuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "for name in ('theirs.yaml', 'open.yaml'):\n"
        "    try: write_atomically(Path(name), 'yours')\n"
        "    except PermissionError as error: print(error.filename)\n"
    )

    def run() -> str:
        command = [sys.executable, "-c", program, str(tmp_path)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    for mode in (0o777, 0o555):
        tmp_path.chmod(mode)
        assert run() == "theirs.yaml\n"
        assert theirs.read_text(encoding="utf-8") == "mine"
        assert open_to_all.read_text(encoding="utf-8") == "yours"
    tmp_path.chmod(0o755)


def test_what_cannot_be_written_is_reported_in_a_sentence_with_the_thing_and_the_reason(tmp_path: Path) -> None:
    told = r"^plant file x cannot be written: No space left on device$"
    with pytest.raises(ParameterError, match=told), writing("plant file x", ParameterError):
        write_atomically(Path("/dev/full"), "lost")
    # Libraries raise errors without a number.
    with pytest.raises(BagError, match=r"^picture x cannot be written: no mode P$"), writing("picture x", BagError):
        raise OSError("no mode P")
    # A BagError is an OSError, and has its sentence.
    for error in (BagError("told"), ParameterError("told"), ZeroDivisionError("told")):
        with pytest.raises(type(error), match=r"^told$"), writing("x", DataError):
            raise error
