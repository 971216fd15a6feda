"""Bounded decompression: damaged or forged data must not exhaust the machine's memory."""

from __future__ import annotations

import bz2
from typing import Any

import lz4.frame
import zstandard

__all__ = ["MOST_CHUNK_BYTES", "ZSTD_MAGIC", "OversizedError", "most_bytes", "unpack", "unpack_zstd"]

# Logs compress by 2 to 10, only label images by some hundred; data beyond that ratio and beyond a worker's
# memory is a decompression bomb. A single chunk or message of up to 32 MiB (a raw picture of 8 Mpx has 24)
# may have any ratio.
_MOST_RATIO = 100
_ANYWAY_BYTES = 32 << 20
MOST_CHUNK_BYTES = 512 << 20
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_DECOMPRESSORS: dict[str, Any] = {"lz4": lz4.frame.LZ4FrameDecompressor, "bz2": bz2.BZ2Decompressor}


class OversizedError(ValueError):
    """Raised for data that would decompress to more than is plausible for its packed size."""


def most_bytes(packed_bytes: int) -> int:
    """Largest plausible decompressed size of so many packed bytes."""
    return max(_ANYWAY_BYTES, _MOST_RATIO * packed_bytes)


def unpack_zstd(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """Content of a zstd frame of at most `limit_bytes`; a header with more is refused before allocation.

    Raises:
        OversizedError: decompresses to more than `most_bytes`.
        ValueError: larger than `limit_bytes`, by header or content.
        zstandard.ZstdError: not a complete zstd frame.
    """
    _check_ratio(data, limit_bytes)
    announced = zstandard.get_frame_parameters(data).content_size
    if announced == zstandard.CONTENTSIZE_UNKNOWN:
        # Without a size in the header, the library would allocate the whole limit: read piece by piece
        # instead.
        content = zstandard.ZstdDecompressor().stream_reader(data).read(limit_bytes + 1)
        return _at_most(limit_bytes, content)
    if announced > limit_bytes:
        raise ValueError(f"a zstd frame of {announced} bytes where {limit_bytes} were announced")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit_bytes)


def unpack(compression: str, data: bytes | memoryview, size: int) -> bytes:
    """Content of a chunk of this size; `compression` as MCAP and ROS 1 name it.

    Raises:
        OversizedError: as `unpack_zstd`.
        ValueError, OSError, RuntimeError, zstandard.ZstdError: damaged, of another size, or of another compression.
    """
    if compression in ("", "none"):
        content = bytes(data)
    elif compression == "zstd":
        content = unpack_zstd(data, size)
    elif compression in _DECOMPRESSORS:
        _check_ratio(data, size)
        content = _at_most(size, _DECOMPRESSORS[compression]().decompress(data, size + 1))
    else:
        raise ValueError(f"compression {compression!r}")
    if len(content) != size:
        raise ValueError("fewer bytes than were announced")
    return content


def _check_ratio(data: bytes | memoryview, announced_bytes: int) -> None:
    if announced_bytes > min(most_bytes(len(data)), MOST_CHUNK_BYTES):
        raise OversizedError(f"{len(data)} bytes that would unpack to {announced_bytes}")


def _at_most(limit_bytes: int, content: bytes) -> bytes:
    if len(content) > limit_bytes:
        raise ValueError(f"more than the {limit_bytes} bytes that were announced")
    return content
