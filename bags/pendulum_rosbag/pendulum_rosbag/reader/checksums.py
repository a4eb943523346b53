"""Checksums of MCAP chunks, compared beside reading: a byte that a disk or a cable changed is told, not handed over."""

from __future__ import annotations

import zlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Bytes
from pendulum_rosbag.reader.mcap_chunks import Chunk

__all__ = ["Checksums"]


class Checksums:
    """Checksums of the chunks of one file, compared in a thread of their own while the reader goes on.

    Each chunk is compared once, however many topics are read from it.

    Args:
        path: The file.
        enabled: Whether to compare anything.
    """

    def __init__(self, path: Path, *, enabled: bool) -> None:
        self._path = path
        self._enabled = enabled
        self._sound: set[int] = set()
        self._begun: list[tuple[Chunk, Future[int]]] = []
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Checksums:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
        self._begun.clear()

    def compare(self, chunk: Chunk, raw: Bytes) -> None:
        """Begin to compare the checksum of a chunk's content."""
        if not self._enabled or not chunk.crc or chunk.offset in self._sound:
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "checksums")  # (zlib works outside the interpreter's lock)
        self._begun.append((chunk, self._pool.submit(zlib.crc32, raw.data)))

    def finish(self) -> None:
        """Wait for what was begun.

        Raises:
            BagError: The content of a chunk is not what was written.
        """
        for chunk, crc in self._begun:
            if crc.result() != chunk.crc:
                raise BagError(
                    f"{self._path}: the chunk at byte {chunk.offset} is damaged (checksum {crc.result():08x}; expected "
                    f"{chunk.crc:08x}); repair the bag, which saves all others"
                )
            self._sound.add(chunk.offset)
