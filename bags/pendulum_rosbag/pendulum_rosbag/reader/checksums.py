"""Checksums of MCAP chunks, compared while reading, so that corrupted bytes are reported and not returned."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Bytes
from pendulum_rosbag.reader.mcap_chunks import Chunk

__all__ = ["Checksums", "Comparison"]


class Checksums:
    """Which chunks of a file are known to be sound; each is compared once. ``enabled`` False compares none."""

    def __init__(self, path: Path, *, enabled: bool) -> None:
        self.path = path
        self.enabled = enabled
        self.sound: set[int] = set()
        """Offsets of sound chunks in the file."""
        self._running: set[Comparison] = set()

    def begin(self) -> Comparison:
        """Return a comparison for one pass over the file; several may run at a time."""
        comparison = Comparison(self, self._running.discard)
        self._running.add(comparison)
        return comparison

    def close(self) -> None:
        """End all running passes and their threads."""
        for comparison in list(self._running):
            comparison.end()


class Comparison:
    """Compares the chunks of one pass over a file in a thread of its own; ``on_end`` is called when it ends."""

    def __init__(self, file: Checksums, on_end: Callable[[Comparison], None]) -> None:
        self._file = file
        self._on_end = on_end
        self._begun: list[tuple[Chunk, Future[int]]] = []
        self._pool: ThreadPoolExecutor | None = None
        self._ended = False

    def __enter__(self) -> Comparison:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.end()

    def end(self) -> None:
        """End the thread; pending chunks are not compared."""
        self._ended = True
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
        self._begun.clear()
        self._on_end(self)

    def compare(self, chunk: Chunk, raw: Bytes) -> None:
        """Queue the comparison of a chunk's content; a BagError if the file was closed meanwhile."""
        self._require_going()
        if not self._file.enabled or not chunk.crc or chunk.offset in self._file.sound:
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "checksums")  # zlib releases the interpreter's lock
        self._begun.append((chunk, self._pool.submit(zlib.crc32, raw.data)))

    def finish(self) -> None:
        """Wait for the queued comparisons; a BagError if a chunk is damaged or the file was closed meanwhile."""
        self._require_going()
        for chunk, crc in self._begun:
            if crc.result() != chunk.crc:
                raise BagError(
                    f"{self._file.path}: the chunk at byte {chunk.offset} is damaged (checksum {crc.result():08x}; "
                    f"expected {chunk.crc:08x}); repair the bag, which saves all others"
                )
            self._file.sound.add(chunk.offset)

    def _require_going(self) -> None:
        if self._ended:
            raise BagError(f"{self._file.path} was closed while it was being read")
