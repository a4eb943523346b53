"""Files that appear whole or not at all, whatever ends the writing."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

__all__ = ["write_whole"]


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file and the folders above it; until all is written, what was there before stays.

    Nothing is left beside it where the disk is full or Ctrl-C comes in between.

    Args:
        path: Where to write.
        content: Bytes, or text to be written as UTF-8.

    Raises:
        OSError: The file cannot be written.
        ValueError: The path cannot be one.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(content.encode() if isinstance(content, str) else content)
        beside.replace(path)
    finally:
        with suppress(OSError, ValueError):
            beside.unlink(missing_ok=True)
