"""Decompression that gives no more than was announced: damaged or forged bytes must not cost a machine its memory."""

from __future__ import annotations

import bz2

import lz4.frame
import zstandard

__all__ = ["unpack_bz2", "unpack_lz4", "unpack_zstd"]


def unpack_zstd(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """The content of a zstd frame of at most `limit_bytes`; no memory is taken for a frame that announces more.

    Raises:
        ValueError: it is larger, or announces that it is.
        zstandard.ZstdError: no whole zstd frame.
    """
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
        ValueError: it is larger.
        RuntimeError: no lz4 frame.
    """
    return _at_most(limit_bytes, lz4.frame.LZ4FrameDecompressor().decompress(data, limit_bytes + 1))


def unpack_bz2(data: bytes | memoryview, limit_bytes: int) -> bytes:
    """The content of bz2 data of at most `limit_bytes`.

    Raises:
        ValueError: it is larger.
        OSError: no bz2 data.
    """
    return _at_most(limit_bytes, bz2.BZ2Decompressor().decompress(data, limit_bytes + 1))


def _at_most(limit_bytes: int, content: bytes) -> bytes:
    if len(content) > limit_bytes:
        raise ValueError(f"more than the {limit_bytes} bytes that were announced")
    return content
