"""Files of unknown origin, read within bounds on their size."""

from __future__ import annotations

import io
import stat
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from pendulum_msgs_py.errors import DataError

__all__ = ["read_bounded", "read_parts", "sentence_of", "shown"]


def read_bounded(path: Path, where: str, largest: int) -> bytes:
    """Return the content of a file of at most ``largest`` bytes; ``where`` names it in messages.

    Raises:
        DataError: It is missing, no file, too large, or cannot be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or a pipe"
            raise DataError(f"{where} is {kind}; expected a file")
        if status.st_size > largest:
            raise DataError(f"{where} has {status.st_size} bytes; expected at most {largest}")
        with path.open("rb") as file:
            return file.read(largest + 1)
    except FileNotFoundError as error:
        raise DataError(f"{where} does not exist") from error
    except (OSError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DataError(f"{where} cannot be read: {reason}") from error


def read_parts(
    content: bytes, kind: str, check: Callable[[list[zipfile.ZipInfo]], list[zipfile.ZipInfo]]
) -> list[bytes]:
    """Return parts of a zip archive.

    Args:
        content: Archive.
        kind: Expected kind, for messages.
        check: Refuses names and sizes before anything is unpacked, and returns the parts to read.

    Returns:
        Content of each part, with one byte more than the directory's size if there is more, because that size is not
        trusted.

    Raises:
        DataError: The archive is incomplete, or ``check`` refuses it.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            found = []
            for entry in check(archive.infolist()):
                with archive.open(entry) as file:
                    found.append(file.read(entry.file_size + 1))
            return found
    except DataError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError, RuntimeError, EOFError) as error:
        raise DataError(f"it is no whole {kind} archive ({sentence_of(error)})") from error


def shown(value: object) -> str:
    """Return a value for a message, shortened if long."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."


def sentence_of(error: BaseException) -> str:
    """Return the text of a library's error, as part of one sentence."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:157]}..."
