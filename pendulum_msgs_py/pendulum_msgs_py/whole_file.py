"""Files that appear whole or not at all, whatever ends the writing; and the sentence for those that cannot."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pendulum_msgs_py.errors import PendulumError

__all__ = ["write_whole", "writing"]


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file and the folders above it; until all is written, what was there before stays.

    Nothing is left beside it where the disk is full or Ctrl-C comes in between. A link stays a link, and what is no
    file, such as ``/dev/stdout``, is written to as it is.

    Args:
        path: Where to write.
        content: Bytes, or text to be written as UTF-8.

    Raises:
        OSError: The file cannot be written, or the path or the text cannot be one.
    """
    try:
        data = content.encode() if isinstance(content, str) else content
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        target = path.resolve()
        if target.exists() and not os.access(target, os.W_OK):
            # A folder that may be written to would let it be replaced.
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    except (ValueError, RuntimeError) as error:  # no path, no text, or links in a circle
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    beside = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(data)
        beside.replace(target)
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)


@contextmanager
def writing(what: str, failure: type[PendulumError]) -> Iterator[None]:
    """Say in a sentence why what is written within could not be.

    Args:
        what: The thing, with its path.
        failure: Class of the error to raise.

    Raises:
        PendulumError: Of that class, where an ``OSError`` ended the writing; errors of ours stay what they are.
    """
    try:
        yield
    except PendulumError:
        raise
    except OSError as error:
        raise failure(f"{what} cannot be written: {error.strerror or error}") from error
