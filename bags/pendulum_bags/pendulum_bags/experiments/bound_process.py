"""A process that does not outlive the one that started it."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

from pendulum_msgs_py.programs.starter import bound_environment

__all__ = ["start_bound_process"]


def start_bound_process(
    command: Sequence[str],
    *,
    environment: Mapping[str, str],
    output: IO[bytes],
    niceness: int = 0,
    pass_fds: Sequence[int] = (),
) -> subprocess.Popen[bytes]:
    """Start a program in a process group of its own, so that this process passes Ctrl-C on, in order.

    Args:
        command: Program and arguments.
        environment: All of its variables.
        output: Receives its output.
        niceness: Scheduling priority to give away, or to take where it is negative and permitted.
        pass_fds: Descriptors that it keeps open.
    """
    return subprocess.Popen(
        list(command),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env=bound_environment(environment),
        start_new_session=True,
        pass_fds=tuple(pass_fds),
        # Priorities only; no lock is taken between fork and exec.
        preexec_fn=_set_priority(niceness),  # noqa: PLW1509
    )


def _set_priority(niceness: int) -> Callable[[], None]:
    def set_priority() -> None:
        # Taking priority is a privilege; without it the run is as good as the machine is idle.
        with contextlib.suppress(PermissionError):
            os.nice(niceness)
        # Where Linux shares the cores among sessions first (autogroup), a session goes or stays behind as a whole.
        if now := os.getpriority(os.PRIO_PROCESS, 0):
            with contextlib.suppress(OSError):
                Path("/proc/self/autogroup").write_text(str(now), encoding="ascii")

    return set_priority
