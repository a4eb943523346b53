"""Decompression with a bound: no chunk and no file may cost more memory than it claims, or than any recorder needs."""

from __future__ import annotations

import io
from typing import BinaryIO

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Bytes

__all__ = ["decompress", "decompress_bounded", "decompress_torn"]

_MAX_CHUNK = 1 << 28  # decompressed bytes of one chunk: recorders write chunks of about 1 MB, bombs larger ones


def decompress(packed: Bytes, compression: str, size: int, name: str) -> bytes:
    """Return the content of a chunk.

    Never more is decompressed than the head of the chunk says, and that has a bound.

    Raises:
        BagError: Unknown compression, a chunk larger than any recorder's, or the bytes are damaged.
    """
    if size > _MAX_CHUNK:
        raise BagError(f"{name}: a chunk claims to hold {size} bytes; expected at most {_MAX_CHUNK}")
    if compression == "zstd":
        import zstandard

        try:
            claimed = zstandard.frame_content_size(packed.data)  # -1 where the frame does not say
            if claimed not in (-1, size):
                raise BagError(f"{name}: a chunk claims to hold {claimed} bytes; its head says {size}")
            raw = zstandard.ZstdDecompressor().decompress(packed.data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise BagError(f"{name}: a compressed chunk is damaged ({error})") from None
    elif compression == "lz4":
        import lz4.frame

        try:
            raw = lz4.frame.LZ4FrameDecompressor().decompress(packed.tobytes(), max_length=size + 1)
        except (RuntimeError, EOFError) as error:
            raise BagError(f"{name}: a compressed chunk is damaged ({error})") from None
    else:
        raise BagError(f"{name}: chunk compression is {compression!r}; expected zstd, lz4 or none")
    if len(raw) != size:
        raise BagError(f"{name}: a chunk holds {len(raw)} bytes; its head says {size}")
    return raw


def decompress_torn(packed: Bytes, compression: str, size: int) -> bytes:
    """Return the beginning of a chunk whose end was cut off, as far as its compression gives it back.

    Raises:
        BagError: Unknown compression, a chunk larger than any recorder's, or the bytes are damaged.
    """
    if size > _MAX_CHUNK:
        raise BagError(f"a chunk claims to hold {size} bytes; expected at most {_MAX_CHUNK}")
    if compression == "zstd":
        import zstandard

        parts, left = [], size
        try:
            with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(packed.tobytes())) as stream:
                while left > 0 and (part := stream.read(min(left, 1 << 20))):
                    parts.append(part)
                    left -= len(part)
        except zstandard.ZstdError as error:
            raise BagError(f"a compressed chunk is damaged ({error})") from None
        return b"".join(parts)
    if compression == "lz4":
        import lz4.frame

        try:
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed.tobytes(), max_length=size))
        except (RuntimeError, EOFError) as error:
            raise BagError(f"a compressed chunk is damaged ({error})") from None
    raise BagError(f"chunk compression is {compression!r}; expected zstd, lz4 or none")


def decompress_bounded(packed: BinaryIO, name: str, limit: int = _MAX_CHUNK) -> bytes:
    """Return the content of a zstd stream that does not say how much it holds, or cannot be believed.

    Raises:
        BagError: It holds more than ``limit`` bytes, or is damaged.
    """
    import zstandard

    parts, size = [], 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while part := stream.read(1 << 20):
                parts.append(part)
                size += len(part)
                if size > limit:
                    raise BagError(f"{name} holds more than {limit} bytes when decompressed")
    except (OSError, zstandard.ZstdError) as error:
        if isinstance(error, BagError):
            raise
        raise BagError(f"{name} cannot be decompressed: {error}") from None
    return b"".join(parts)
