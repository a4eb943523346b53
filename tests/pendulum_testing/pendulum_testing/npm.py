"""Packages of Node.js that tests need: installed from a lock, beside it."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

__all__ = ["install_packages", "node_process"]


def _skip(what: str, reason: str) -> None:
    pytest.skip(f"{what} cannot be had here: {reason}")


def install_packages(folder: Path, what: str) -> None:
    """Install the packages of a folder's lock, once for all test runs on this checkout; skip where they cannot be had.

    Args:
        folder: With ``package.json`` and ``package-lock.json``.
        what: What they are, for the reason of a skip.
    """
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            _skip(what, f"{program} is not installed")
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        mark = folder / "node_modules" / ".of_lock"
        lock = (folder / "package-lock.json").read_text(encoding="utf-8")
        if mark.is_file() and mark.read_text(encoding="utf-8") == lock:
            return
        command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
        except subprocess.TimeoutExpired:
            _skip(what, "npm found no registry within 60 s")
        if done.returncode:
            reason = (done.stderr or done.stdout).strip().splitlines()
            _skip(what, f"npm ci failed ({reason[0] if reason else done.returncode})")
        mark.write_text(lock, encoding="utf-8")
    finally:
        os.close(handle)


@contextmanager
def node_process(script: Path, *arguments: str, what: str) -> Iterator[subprocess.Popen[str]]:
    """Run a script that reads lines until its input ends; skip the test where it cannot be run.

    Args:
        script: Beside the lock of the packages that it needs.
        arguments: Its own.
        what: What it is, for the reason of a skip.
    """
    install_packages(script.parent, what)
    command = ["node", str(script), *arguments]
    # Its input is closed on the way out, which ends it; then it is waited for.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process
