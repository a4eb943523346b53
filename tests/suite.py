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
    "tests/acceptance/test_experiment.py",
    "tests/integration/test_experiments.py",
    "tests/acceptance/test_console.py",
    "tests/integration/test_plant_interface.py",
    "tests/acceptance/test_first_day.py",
    "tests/integration",
    "tests/faults/test_bridge_faults.py",
    "tests/faults/test_disk_faults.py",
    "tests/faults/test_live_faults.py",
    "tests/faults/test_network_faults.py",
    "tests/faults/test_security_policy.py",
    "tests/faults/test_system_faults.py",
    "pendulum_lqr/test/test_lqr_nodes.py",
    "pendulum_lqr/test/test_running_plant.py",
)
"""Tests with processes that run in real time, longest first: what computes must not take their cores."""
_COMPUTES = (
    "tests/acceptance/test_readme.py",
    "tests/acceptance/test_docs.py",
    "pendulum_sim/test/test_batch.py",
    "pendulum_sim/test/test_mechanism_batch.py",
    "bags/pendulum_bags/test/test_identification_intervals.py",
    "bags/pendulum_bags/test",
    "tests",
)
"""What comes first of all others, longest first too: a long file at the end would leave a core idle."""
_NOTHING_SELECTED = int(pytest.ExitCode.NO_TESTS_COLLECTED)


def main(arguments: Sequence[str]) -> int:
    """Run the suite and return pytest's exit code: the first that is not zero.

    Args:
        arguments: Pytest's own, such as ``-k name``.
    """
    # A shell starts what it puts into the background deaf to Ctrl-C, and so would be all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # A test that calls make must not hand on what this run was asked for; and hundreds of processes start faster from
    # modules that were compiled once.
    for name in ("MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS", "ARGS", "PYTHONDONTWRITEBYTECODE"):
        os.environ.pop(name, None)
    if any((PROJECT / argument.split("::")[0]).exists() for argument in arguments):
        return _pytest(*arguments)
    in_time = _files(_KEEPS_TIME)
    packages = sorted(str(path) for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*/test"))
    others = [name for name in _files((*_COMPUTES, *packages)) if name not in in_time]
    workers = ("-n", str(min(2, os.cpu_count() or 1)), "--dist", "loadfile", "--no-loadscope-reorder")
    codes = [_pytest(*workers, *others, *arguments), _pytest(*in_time, *arguments)]
    # A name may be in one part only.
    counted = [code for code in codes if code != _NOTHING_SELECTED] or [_NOTHING_SELECTED]
    return next((code for code in counted if code), 0)


def _files(names: Sequence[str]) -> list[str]:
    """Return files of tests, each once, in this order; pytest would sort a folder's among those that it is told."""
    found = [path for name in names for path in (sorted((PROJECT / name).rglob("test_*.py")) or [PROJECT / name])]
    return list(dict.fromkeys(str(path.relative_to(PROJECT)) for path in found))


def _pytest(*arguments: str) -> int:
    """Run pytest in a process of its own: what the first run has imported must not slow the second."""
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=PROJECT, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
