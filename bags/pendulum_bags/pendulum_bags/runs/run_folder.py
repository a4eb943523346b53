"""The folder of a run: where it is, what it may not overwrite, and what is known about the run."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from pendulum_msgs_py.atomic_write import write_atomically
from pendulum_msgs_py.errors import BagError
from pendulum_msgs_py.json_values import json_text

__all__ = [
    "REPEATS",
    "create_run_folder",
    "discard_if_empty",
    "git_revision",
    "is_repeat",
    "pair_folders",
    "provenance",
    "read_looks",
    "read_stalls",
    "versions",
    "write_json",
    "write_looks",
    "write_stall",
]

REPEATS = "repeats"
"""Folder within a run folder for repeats of the run with new noise, each with the bags ``sim`` and ``hw``."""
_LOOKS = "looks.json"
_STALLS = "stalls.json"

_PACKAGES = (
    "pendulum_msgs_py",
    "pendulum_sim",
    "pendulum_lqr",
    "pendulum_hw_bridge",
    "pendulum_bags",
    "numpy",
    "scipy",
    "control",
    "rosbags",
    "dynamixel-sdk",
    "hebi-py",
    "ros-jazzy-rclpy",
)


def create_run_folder(out: Path | None, experiment: str) -> Path:
    """Create and return the folder of a run, by default ``bags/runs/<UTC>_<experiment>``, or raise a BagError."""
    if out is None:
        stamp = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%SZ")
        out = Path("bags", "runs", f"{stamp}_{experiment}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise BagError(f"run folder {out} exists and is not empty; expected a new one")
    except FileExistsError as error:
        raise BagError(f"run folder {out} is a file; expected a folder") from error
    except OSError as error:
        if isinstance(error, BagError):
            raise
        raise BagError(f"run folder {out} cannot be made: {error.strerror}") from error
    if not os.access(out, os.W_OK):
        raise BagError(f"run folder {out} cannot be written: permission denied")
    return out


def discard_if_empty(folder: Path) -> bool:
    """Remove a run's folder without bags, unless an aborted run left its reason and logs; return whether."""
    if any(folder.glob("*/metadata.yaml")) or (folder / _STALLS).exists():
        return False
    shutil.rmtree(folder, ignore_errors=True)
    return True


def pair_folders(folder: Path) -> list[Path]:
    """Return the folders with both bags ``sim`` and ``hw`` of a run: its own, and those of its repeats in order."""
    repeats = [place for place in (folder / REPEATS).glob("*") if place.name.isdigit() and (place / "sim").is_dir()]
    return [folder, *sorted(repeats, key=lambda place: int(place.name))]


def is_repeat(folder: Path) -> bool:
    """Return whether a folder with the bags ``sim`` and ``hw`` is a repeat of the run folder around it."""
    run = folder.parent.parent
    return folder.parent.name == REPEATS and folder.name.isdigit() and (run / "sim").is_dir() and (run / "hw").is_dir()


def write_looks(folder: Path, number: int) -> None:
    """Store the number of interim analyses of a run folder."""
    write_json(folder / _LOOKS, {"looks": number})


def read_looks(folder: Path) -> int:
    """Return the number of interim analyses of a run folder; 0 for a run that was recorded once."""
    try:
        return int(json.loads((folder / _LOOKS).read_text(encoding="utf-8"))["looks"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def write_stall(folder: Path, reason: str, logs: str) -> None:
    """Add a run that a stalled computer aborted to the record of a run folder, with its folder of ``logs`` or ""."""
    write_json(folder / _STALLS, {"stalls": [*read_stalls(folder), {"reason": reason, "logs": logs}]})


def read_stalls(folder: Path) -> list[dict[str, str]]:
    """Return reason and logs of each aborted run before the one in a run folder, in order."""
    try:
        stalls = json.loads((folder / _STALLS).read_text(encoding="utf-8"))["stalls"]
        return [{key: str(stall[key]) for key in ("reason", "logs")} for stall in stalls]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        return [{"reason": f"{_STALLS} cannot be read ({type(error).__name__})", "logs": ""}]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def provenance() -> dict[str, Any]:
    """Return what made a run or a file: versions, revision, and the command line as it was typed."""
    return {
        "versions": versions(),
        "git_revision": git_revision(),
        "command": shlex.join(["python", *sys.orig_argv[1:]]),
    }


def git_revision() -> str:
    """Return the revision of the project's checkout, with ``+changes`` where it was edited; empty outside one."""
    here = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(here), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        revision = git("rev-parse", "--short=12", "HEAD")
        return revision + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that the file appears whole or not at all."""
    write_atomically(path, json_text(content) + "\n")
