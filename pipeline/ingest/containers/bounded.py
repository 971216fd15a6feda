"""Decompression that gives no more than was announced: damaged or forged bytes must not cost a machine its memory."""

from __future__ import annotations

import bz2

import lz4.frame
import zstandard

__all__ = ["MOST_CHUNK_BYTES", "OversizedError", "most_bytes", "unpack_bz2", "unpack_lz4", "unpack_zstd"]

# Logs shrink by 2 to 10, label images alone by some hundred: beyond, and beyond what any worker has room for, it is a
# bomb. A single chunk or message of up to 32 MiB (a raw picture of 8 Mpx has 24) may be as uniform as it likes.
_MOST_RATIO = 100
_ANYWAY_BYTES = 32 << 20
MOST_CHUNK_BYTES = 512 << 20


class OversizedError(ValueError):
    """What would unpack to more than what is packed can hold in earnest."""


def most_bytes(packed_bytes: int) -> int:
    """The most that so many packed bytes may become."""
    return max(_ANYWAY_BYTES, _MOST_RATIO * packed_bytes)


def unpack_zstd(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """The content of a zstd frame of at most `limit_bytes`; no memory is taken for a frame that announces more.

    Raises:
        OversizedError: it unpacks to more than `most_bytes`.
        ValueError: it is larger than `limit_bytes`, or announces that it is.
        zstandard.ZstdError: no whole zstd frame.
    """
    _check_ratio(data, limit_bytes)
    announced = zstandard.get_frame_parameters(data).content_size
    if announced == zstandard.CONTENTSIZE_UNKNOWN:
        # Without a size a buffer as large as allowed would be taken at once: read as much as there is instead.
        content = zstandard.ZstdDecompressor().stream_reader(data).read(limit_bytes + 1)
        return _at_most(limit_bytes, content)
    if announced > limit_bytes:
        raise ValueError(f"a zstd frame of {announced} bytes where {limit_bytes} were announced")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit_bytes)


def unpack_lz4(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """The content of an lz4 frame of at most `limit_bytes`.

    Raises:
        OversizedError: it unpacks to more than `most_bytes`.
        ValueError: it is larger than `limit_bytes`.
        RuntimeError: no lz4 frame.
    """
    _check_ratio(data, limit_bytes)
    return _at_most(limit_bytes, lz4.frame.LZ4FrameDecompressor().decompress(data, limit_bytes + 1))


def unpack_bz2(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """The content of bz2 data of at most `limit_bytes`.

    Raises:
        OversizedError: it unpacks to more than `most_bytes`.
        ValueError: it is larger than `limit_bytes`.
        OSError: no bz2 data.
    """
    _check_ratio(data, limit_bytes)
    return _at_most(limit_bytes, bz2.BZ2Decompressor().decompress(data, limit_bytes + 1))


def _check_ratio(data: bytes | memoryview, announced_bytes: int) -> None:
    if announced_bytes > min(most_bytes(len(data)), MOST_CHUNK_BYTES):
        raise OversizedError(f"{len(data)} bytes that would unpack to {announced_bytes}")


def _at_most(limit_bytes: int, content: bytes) -> bytes:
    if len(content) > limit_bytes:
        raise ValueError(f"more than the {limit_bytes} bytes that were announced")
    return content
