"""``make test``: on two cores at once what computes, then, one test after the other, what keeps a plant's time.

Tests of one file stay together, so that what a file prepares is prepared once. Named files or folders run as pytest is
told.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence

import pytest

from tests.fixtures import PROJECT

__all__ = ["main"]

_KEEPS_TIME = (
    "tests/acceptance/test_console.py",
    "tests/acceptance/test_experiment.py",
    "tests/faults/test_bridge_faults.py",
    "tests/faults/test_disk_faults.py",
    "tests/faults/test_live_faults.py",
    "tests/faults/test_network_faults.py",
    "tests/faults/test_security_policy.py",
    "tests/faults/test_system_faults.py",
    "tests/integration",
    "pendulum_lqr/test/test_lqr_nodes.py",
    "pendulum_lqr/test/test_running_plant.py",
)
"""Tests with processes that run in real time: a neighbour on the same cores would be measured with them."""
_LONGEST = "tests/acceptance/test_readme.py"
"""The file that takes longest comes first, so that the others fill the core beside it."""
_NOTHING_SELECTED = int(pytest.ExitCode.NO_TESTS_COLLECTED)


def main(arguments: Sequence[str]) -> int:
    """Run the suite and return pytest's exit code: the first that is not zero.

    Args:
        arguments: Pytest's own, such as ``-k name``.
    """
    # A shell starts what it puts into the background deaf to Ctrl-C, and so would be all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # A test that calls make must not hand on what this run was asked for.
    for name in ("MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS", "ARGS"):
        os.environ.pop(name, None)
    if any((PROJECT / argument.split("::")[0]).exists() for argument in arguments):
        return _pytest(*arguments)
    packages = sorted(str(path) for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*/test"))
    workers = str(min(2, os.cpu_count() or 1))
    others = [f"--ignore={name}" for name in _KEEPS_TIME]
    codes = [
        _pytest(
            "-n",
            workers,
            "--dist",
            "loadfile",
            "--no-loadscope-reorder",
            *others,
            _LONGEST,
            "tests",
            *packages,
            *arguments,
        ),
        _pytest(*_KEEPS_TIME, *arguments),
    ]
    # A name may be in one part only.
    counted = [code for code in codes if code != _NOTHING_SELECTED] or [_NOTHING_SELECTED]
    return next((code for code in counted if code), 0)


def _pytest(*arguments: str) -> int:
    """Run pytest in a process of its own: what the first run has imported must not slow the second."""
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=PROJECT, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
