"""What a shell completes, asked of the shell itself."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from pendulum_testing.fixtures import PROJECT

__all__ = ["completed"]

_ASK = (
    'ask() {{ COMP_LINE="$1"; COMP_POINT=${{#1}}; {words}COMPREPLY=(); _pendulum_complete; '
    'echo "${{COMPREPLY[*]}}"; }}\n'
)


def completed(shell: str, script: str, *typed: str) -> list[list[str]]:
    """Return what a shell offers behind each line that was typed; skip the test where there is no such shell.

    Args:
        shell: bash or zsh.
        script: What our completion has it run first.
        typed: The lines.
    """
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    asked = _ASK.format(words="words=(${=1}); " if shell == "zsh" else "")
    text = "\n".join([script, asked, *(f'ask "{line}"' for line in typed)])
    done = subprocess.run([program, "-c", text], capture_output=True, text=True, timeout=60, check=True, cwd=PROJECT)
    return [line.split() for line in done.stdout.splitlines()[-len(typed) :]]
