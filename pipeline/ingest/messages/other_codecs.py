"""Compressed images that are neither JPEG nor PNG: pixels of WebP, AVIF and JPEG 2000, by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["decode_other"]

# Where the bytes that tell a format lie, and what they are.
_MAGIC = ((8, b"WEBP"), (4, b"ftypavif"), (0, b"\x00\x00\x00\x0cjP  "), (0, b"\xff\x4f\xff\x51"))


def decode_other(data: bytes) -> np.ndarray:
    """Pixels as 8 bit grey or BGR.

    Raises:
        ValueError: none of these formats, or damaged.
    """
    if not any(data[at : at + len(magic)] == magic for at, magic in _MAGIC):
        raise ValueError("neither JPEG, PNG, WebP, AVIF nor JPEG 2000")
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("image is damaged")
    return np.asarray(pixels)
