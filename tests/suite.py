"""``make test``: each package's tests on two cores at once, then what crosses packages, one test after the other.

Tests of one file stay together, so that what a file prepares is prepared once. Named files or folders run as pytest is
told.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence

import pytest

from tests.fixtures import PROJECT

__all__ = ["main"]

_ALONE = ("pendulum_lqr/test/test_lqr_nodes.py", "pendulum_lqr/test/test_running_plant.py")
"""Tests of a package that keep a plant's time, and so run with those that cross packages."""
_NOTHING_SELECTED = int(pytest.ExitCode.NO_TESTS_COLLECTED)


def main(arguments: Sequence[str]) -> int:
    """Run the suite and return pytest's exit code: the first that is not zero.

    Args:
        arguments: Pytest's own, such as ``-k name``.
    """
    if any((PROJECT / argument.split("::")[0]).exists() for argument in arguments):
        return _pytest(*arguments)
    packages = sorted(str(path) for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*/test"))
    workers = str(min(2, os.cpu_count() or 1))
    quiet = [f"--ignore={name}" for name in _ALONE]
    codes = [
        _pytest("-n", workers, "--dist", "loadfile", *quiet, *packages, *arguments),
        _pytest("tests", *_ALONE, *arguments),
    ]
    # A name may be in one part only.
    counted = [code for code in codes if code != _NOTHING_SELECTED] or [_NOTHING_SELECTED]
    return next((code for code in counted if code), 0)


def _pytest(*arguments: str) -> int:
    """Run pytest in a process of its own: what the first run has imported must not slow the second."""
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=PROJECT, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
