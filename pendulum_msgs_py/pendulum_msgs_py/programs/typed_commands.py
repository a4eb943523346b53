"""Printed commands as the user's shell finds them."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from functools import cache
from pathlib import Path

__all__ = ["as_typed"]

_COMMAND = re.compile(r"(?<![\w/.-])python(?= -m pendulum_)")


def as_typed(text: str) -> str:
    """Return a text whose ``python -m pendulum_...`` start with a path of this interpreter.

    ``python`` stays if the shell finds this interpreter by it, as in an activated virtual environment; the path is
    relative if it lies below the working folder.
    """
    return _COMMAND.sub(lambda _: _interpreter(os.environ.get("PATH", ""), Path.cwd()), text)


@cache
def _interpreter(path: str, folder: Path) -> str:
    running = Path(sys.executable).absolute()
    for name in ("python", "python3"):
        found = shutil.which(name, path=path)
        if found and Path(found).absolute().parent == running.parent and running.samefile(found):
            return name
    plain = running.with_name("python")
    running = plain if plain.is_file() else running
    return shlex.quote(str(running.relative_to(folder) if running.is_relative_to(folder) else running))
