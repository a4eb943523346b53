"""Atomic writing of files, and its errors."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pendulum_msgs_py.errors import PendulumError

__all__ = ["write_atomically", "writing"]

_NOT_REPLACED = {errno.EACCES, errno.EPERM, errno.EBUSY, errno.EROFS, errno.EINVAL}
"""Errors of replacing a writable file: no right to its folder or owner, or it is a mount."""


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write bytes, or text as UTF-8, to a file atomically, with the folders above it.

    No temporary file remains after a full disk or Ctrl-C. Links stay links; a file keeps owner and mode. What must not
    be replaced is overwritten: devices and pipes, files with several names or extended attributes, files in another
    user's folder, the process's standard output.

    Raises:
        OSError: The file cannot be written, or path or text are invalid.
    """
    try:
        data = content.encode() if isinstance(content, str) else content
        if b"\0" in os.fsencode(path):
            raise ValueError("embedded null character")
        # Links only: the folders above may not be readable.
        target = path.resolve() if path.is_symlink() else path
    except ValueError as error:
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    except RuntimeError as error:
        raise _link_cycle(path) from error
    # Newer Pythons resolve a cycle of links as far as they get.
    if target.is_symlink():
        raise _link_cycle(path)
    status = path.stat() if path.exists() else None
    if status is not None and not _may_be_replaced(target, status):
        path.write_bytes(data)
        return
    try:
        _replace(target, data, status)
    except OSError as error:
        if status is None or error.errno not in _NOT_REPLACED:
            raise OSError(error.errno, error.strerror, str(path)) from error
        path.write_bytes(data)


def _may_be_replaced(target: Path, status: os.stat_result) -> bool:
    if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        return False
    for descriptor in range(3):
        # A shell continues to write to a program's standard output.
        with suppress(OSError):
            if os.path.samestat(status, os.fstat(descriptor)):
                return False
    # A read-only file must not be replaced, even if its folder allows that: overwriting it raises.
    if not os.access(target, os.W_OK):
        return False
    attributes: list[str] = []
    with suppress(OSError):  # not every file system has any
        attributes = os.listxattr(target)
    return not any(name.startswith(("user.", "system.posix_acl")) for name in attributes)


def _replace(target: Path, data: bytes, status: os.stat_result | None) -> None:
    # A random name cannot be a link that another user prepared, nor the name of another thread.
    temporary = target.with_name(f".{secrets.token_hex(8)}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # The temporary file must not be more readable than the one that it replaces.
        mode = 0o666 if status is None else 0o600
        with open(temporary, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(data)
        if status is not None:
            os.chown(temporary, status.st_uid, status.st_gid)
            temporary.chmod(stat.S_IMODE(status.st_mode))
        temporary.replace(target)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _link_cycle(path: Path) -> OSError:
    return OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))


@contextmanager
def writing(what: str, failure: type[PendulumError]) -> Iterator[None]:
    """Turn an ``OSError`` of writing into ``failure`` with one sentence on ``what``, the thing with its path."""
    try:
        yield
    except PendulumError:
        raise
    except OSError as error:
        raise failure(f"{what} cannot be written: {error.strerror or error}") from error
