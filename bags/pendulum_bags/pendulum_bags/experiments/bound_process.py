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
    """Start a program in a process group of its own, to which this process passes Ctrl-C in order.

    ``environment`` is complete; ``niceness`` may be negative if permitted; ``pass_fds`` are inherited.
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
        # Raising priority needs a privilege.
        with contextlib.suppress(PermissionError):
            os.nice(niceness)
        # With Linux's autogroup the whole session changes priority.
        if now := os.getpriority(os.PRIO_PROCESS, 0):
            with contextlib.suppress(OSError):
                Path("/proc/self/autogroup").write_text(str(now), encoding="ascii")

    return set_priority
