"""Rerun's program, as tests ask it what it thinks of an MCAP file; ``make readers`` brings it."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

__all__ = ["RerunMcap", "find_rerun"]

_PROJECT = Path(__file__).resolve().parents[3]
_PROGRAM = _PROJECT / ".venv" / "readers" / "rerun_cli" / "rerun"
_LONGEST_FETCH = 120.0
"""Time to fetch 170 MB [s]; `.ci/run` fetches it before, without a limit."""
_LONGEST_CHECK = 20.0
_NO_WHEEL = "its wheel needs Python 3.11"
_CHECKED = re.compile(r"^(\w+) +(?:\d+|\?) +(\d+) +(/\S+) +(.+?)\s*$", re.MULTILINE)
_CHANNEL = re.compile(r"^ *\d+ +(/\S+) +(\d+) ", re.MULTILINE)


@dataclass(frozen=True)
class RerunMcap:
    """``rerun mcap``, with its tables as data."""

    program: Path

    def check(self, file: Path) -> dict[str, str]:
        """Return topic -> what is wrong with it, ``—`` where nothing is.

        Raises:
            AssertionError: The file does not open, or something is said that is neither.
        """
        said = self._run("check", "--full", str(file))
        found = {}
        for status, _, topic, issues in _CHECKED.findall(said):
            assert (status == "ok") == (issues == "—"), said
            found[topic] = issues
        return found

    def counts(self, file: Path) -> dict[str, int]:
        """Return topic -> number of messages by the file's own summary."""
        said = self._run("info", str(file))
        assert "embedded" in said, f"Rerun had to make the summary of {file} itself:\n{said}"
        return {topic: int(count) for topic, count in _CHANNEL.findall(said)}

    def convert(self, file: Path, recording: Path) -> str:
        """Make a recording of Rerun's own of the file, and return what Rerun says is in it."""
        self._run("convert", str(file), "-o", str(recording))
        return self._run("stats", str(recording), kind="rrd")

    def _run(self, *arguments: str, kind: str = "mcap") -> str:
        done = subprocess.run(
            [self.program, kind, *arguments],
            capture_output=True,
            text=True,
            timeout=_LONGEST_CHECK,
            check=False,
            env={**os.environ, "RERUN_ANALYTICS": "0", "NO_COLOR": "1"},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


def find_rerun() -> RerunMcap:
    """Return the reader, installed from its lock where it is not yet; skip the test where it cannot be had."""
    if not (_PROJECT / "requirements").is_dir():
        pytest.skip("Rerun is fetched by the repository's lock, which is not here")
    handle = os.open(_PROJECT / "requirements", os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        reason = _fetch()
    finally:
        os.close(handle)
    if not _PROGRAM.is_file():
        pytest.skip(f"Rerun cannot be had here: {reason}")
    return RerunMcap(_PROGRAM)


def _fetch() -> str:
    """Install the reader where it is not yet, and return why it may not be there."""
    command = ["make", "--silent", "readers"]
    with subprocess.Popen(
        command, cwd=_PROJECT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        try:
            said, _ = process.communicate(timeout=_LONGEST_FETCH)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGTERM)
            return f"it was not there after {_LONGEST_FETCH:.0f} s (make readers waits longer)"
    errors = [line for line in said.splitlines() if line.startswith("ERROR")]
    return f"make readers failed ({' '.join(errors[:1]) or process.returncode})" if process.returncode else _NO_WHEEL
