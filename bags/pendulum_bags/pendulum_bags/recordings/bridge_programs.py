"""Programs of the bridge, which these packages know by their command lines alone."""

from __future__ import annotations

import os
import subprocess
import sys

from pendulum_msgs_py.programs.starter import bound_environment

__all__ = ["last_words", "run_bridge_program"]


def run_bridge_program(
    *arguments: str, timeout: float, deaf_to_ctrl_c: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run ``python -m pendulum_hw_bridge`` with arguments; return its code and what it printed.

    After ``timeout`` [s] subprocess.TimeoutExpired is raised. ``deaf_to_ctrl_c``: it outlives this process.
    """
    return subprocess.run(
        [sys.executable, "-m", "pendulum_hw_bridge", *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        timeout=timeout,
        check=False,
        env=None if deaf_to_ctrl_c else bound_environment(os.environ),
        start_new_session=deaf_to_ctrl_c,
    )


def last_words(said: str, otherwise: str) -> str:
    """Return the last line of what a program said, without its mark of an error."""
    words = said.strip().splitlines()
    return words[-1].removeprefix("error: ") if words else otherwise
