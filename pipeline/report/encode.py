"""Pictures as text inside a page: JPEG and PNG as data URIs."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from jaxtyping import UInt8

__all__ = ["jpeg_uri", "png_uri"]

_JPEG_QUALITY = 82


def jpeg_uri(image_bgr: UInt8[np.ndarray, "H W 3"], width_px: int | None = None) -> str:
    """A photograph, scaled down to `width_px` where it is wider."""
    if width_px is not None and image_bgr.shape[1] > width_px:
        height = round(image_bgr.shape[0] * width_px / image_bgr.shape[1])
        image_bgr = cv2.resize(image_bgr, (width_px, height), interpolation=cv2.INTER_AREA)
    return _uri("jpeg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def png_uri(image_bgr: UInt8[np.ndarray, "H W 3"]) -> str:
    """Image as a PNG data URI: lossless, so that single dots stay sharp."""
    return _uri("png", image_bgr, [cv2.IMWRITE_PNG_COMPRESSION, 6])


def _uri(kind: str, image_bgr: UInt8[np.ndarray, "H W 3"], options: list[int]) -> str:
    done, data = cv2.imencode(f".{kind}", image_bgr, options)
    assert done, "OpenCV encodes every uint8 image"
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"
