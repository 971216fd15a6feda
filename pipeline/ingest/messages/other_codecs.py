"""Compressed images other than JPEG and PNG: WebP, AVIF and JPEG 2000, decoded by OpenCV.

Sources of the headers: RFC 9649 (WebP); ISO/IEC 23008-12, 6.5.3 (AVIF's ispe); ISO/IEC 15444-1, A.5.1 (SIZ).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator

import cv2
import numpy as np

__all__ = ["decode_other"]


def decode_other(data: bytes, check_size: Callable[[int, int], object]) -> np.ndarray:
    """Pixels as 8 bit grey or BGR; `check_size` sees width and height first, and raises if implausible.

    Raises:
        ValueError: another format, or damaged.
    """
    sizes = next((of for at, magic, of in _FORMATS if data[at : at + len(magic)] == magic), None)
    if sizes is None:
        raise ValueError("neither JPEG, PNG, WebP, AVIF nor JPEG 2000")
    try:
        found = list(sizes(data))
        for width_px, height_px in found:
            check_size(width_px, height_px)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS) if found else None
    except (cv2.error, struct.error):
        pixels = None
    if pixels is None:
        raise ValueError("image is damaged")
    return np.asarray(pixels)


def _webp_sizes(data: bytes) -> Iterator[tuple[int, int]]:
    """Sizes of the canvas and of every frame; the kind of a chunk determines their position."""
    for match in re.finditer(rb"VP8[XL ]", data[:64]):
        kind, at = match[0], match.end() + 4
        if kind == b"VP8X":
            width, height = (int.from_bytes(data[i : i + 3], "little") for i in (at + 4, at + 7))
            yield 1 + width, 1 + height
        elif kind == b"VP8L":
            bits = struct.unpack_from("<I", data, at + 1)[0]
            yield 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        else:
            width, height = struct.unpack_from("<HH", data, at + 6)
            yield width & 0x3FFF, height & 0x3FFF


def _avif_sizes(data: bytes) -> Iterator[tuple[int, int]]:
    for match in re.finditer(rb"ispe", data.partition(b"mdat")[0]):
        yield struct.unpack_from(">II", data, match.end() + 4)


def _jpeg2000_sizes(data: bytes) -> Iterator[tuple[int, int]]:
    at = data.find(b"\xff\x4f\xff\x51")
    if at >= 0:
        right, bottom, left, top = struct.unpack_from(">IIII", data, at + 8)
        yield right - left, bottom - top


_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
# For each format: position and value of its signature, and the function that reads the sizes in its header.
_FORMATS: tuple[tuple[int, bytes, Callable[[bytes], Iterator[tuple[int, int]]]], ...] = (
    (8, b"WEBP", _webp_sizes),
    (4, b"ftypavif", _avif_sizes),
    (0, b"\x00\x00\x00\x0cjP  ", _jpeg2000_sizes),
    (0, b"\xff\x4f\xff\x51", _jpeg2000_sizes),
)
