"""Logged camera images, label images and camera intrinsics; encoded images stay byte for byte.

Compressed images other than JPEG and PNG: WebP, AVIF and JPEG 2000, decoded by OpenCV.

Sources of the headers: RFC 9649 (WebP); ISO/IEC 23008-12, 6.5.3 (AVIF's ispe); ISO/IEC 15444-1, A.5.1 (SIZ).
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.rig.cameras import Camera

__all__ = [
    "MOST_PIXELS", "EncodedImage", "encode_pixels", "encode_raw_image", "inspect_image", "label_image",
    "read_camera_info",
]  # fmt: skip


def _decode_other(data: bytes) -> np.ndarray:
    """Pixels of another codec as 8 bit grey or BGR; raises ValueError as `inspect_image`."""
    sizes = next((of for at, magic, of in _FORMATS if data[at : at + len(magic)] == magic), None)
    if sizes is None:
        raise ValueError("neither JPEG, PNG, WebP, AVIF nor JPEG 2000")
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        found = list(sizes(data))
        for width_px, height_px in found:
            _possible(width_px, height_px)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if found else None
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


# For each format: position and value of its signature, and the function that reads the sizes in its header.
_FORMATS: tuple[tuple[int, bytes, Callable[[bytes], Iterator[tuple[int, int]]]], ...] = (
    (8, b"WEBP", _webp_sizes),
    (4, b"ftypavif", _avif_sizes),
    (0, b"\x00\x00\x00\x0cjP  ", _jpeg2000_sizes),
    (0, b"\xff\x4f\xff\x51", _jpeg2000_sizes),
)
_MODELS = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "kannala_brandt4": "equidistant",
}
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_EOI = b"\xff\xd9"
_JPEG_SOF = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}
_JPEG_SOS, _JPEG_ALONE = 0xDA, {0x01, *range(0xD0, 0xD9)}
# Channels, bytes per value, and conversion to BGR. ROS names a Bayer pattern by its first two pixels, OpenCV by
# the middle of the second row: hence RGGB = "BG".
_RAW: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8uc1": (1, 1, None),
    "mono16": (1, 2, None),
    "16uc1": (1, 2, None),
    "bgr8": (3, 1, None),
    "8uc3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUYV),
    "nv12": (1, 1, cv2.COLOR_YUV2BGR_NV12),
}
_LEAST_FOCAL_PX = 10.0  # a fisheye of 190 deg on 64 pixels has 20
# Four times the pixels of car cameras (8 Mpx): decoding the size in a forged header would take minutes and
# all memory.
MOST_PIXELS = 32_000_000


@dataclass(frozen=True)
class EncodedImage:
    """JPEG or PNG bytes with the size from their header."""

    data: bytes
    format: str
    width_px: int
    height_px: int


def inspect_image(data: bytes) -> EncodedImage:
    """Check an encoded image without decoding its pixels: JPEG structure and end marker, PNG checksums.

    WebP, AVIF and JPEG 2000 are converted to PNG.

    Raises:
        ValueError: another format, or truncated, or visibly damaged.
    """
    if data[:3] == b"\xff\xd8\xff":
        return EncodedImage(data, "jpeg", *_possible(*_jpeg_size(data)))
    if data[:8] == _PNG_MAGIC:
        width, height, *_ = _png_header(data)
        return EncodedImage(data, "png", *_possible(width, height))
    return encode_pixels(_decode_other(data))


def encode_pixels(pixels: np.ndarray) -> EncodedImage:
    """PNG of grey or BGR pixels."""
    height_px, width_px = pixels.shape[:2]
    return EncodedImage(_to_png(pixels), "png", *_possible(width_px, height_px))


def encode_raw_image(message: Any) -> EncodedImage:
    """PNG of a raw sensor_msgs/Image; colours become BGR for OpenCV, nothing is rescaled.

    Raises:
        ValueError: an unsupported encoding, or fewer bytes than the size requires.
    """
    encoding = str(message.encoding).lower()
    pixels = _raw_pixels(message, encoding)
    conversion = _RAW[encoding][2]
    if conversion is not None:
        pixels = cv2.cvtColor(pixels, conversion)
    return EncodedImage(_to_png(pixels), "png", int(message.width), int(message.height))


def label_image(message: Any) -> bytes:
    """PNG mono8 of a label image: a PNG CompressedImage unchanged, or a mono8/8UC1/16-bit Image encoded here.

    Raises:
        ValueError: a lossy or coloured image (its labels would be wrong), a damaged one, or labels above 255.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        if data[:8] != _PNG_MAGIC:
            raise ValueError("label images must be PNG: a lossy format blends labels")
        width, height, depth, colour = _png_header(data)
        _possible(width, height)
        if (depth, colour) != (8, 0):
            raise ValueError("label images must be 8 bit grey PNG: colours and palettes are not labels")
        return data
    encoding = str(message.encoding).lower()
    if encoding not in {"mono8", "8uc1", "mono16", "16uc1"}:
        raise ValueError(f"label images must be mono8 or 8UC1, not {message.encoding}")
    pixels = _raw_pixels(message, encoding)
    if pixels.max(initial=0) > 255:
        raise ValueError("labels above 255")
    return _to_png(pixels.astype(np.uint8))


def read_camera_info(message: Any) -> Camera:
    """Intrinsics of a sensor_msgs/CameraInfo, with ROS 1 (D, K) or ROS 2 (d, k) names.

    Raises:
        ValueError: no intrinsics (zero K), an unknown distortion model, or no image size.
    """
    K = np.array(message.k if hasattr(message, "k") else message.K, np.float64).reshape(3, 3)
    D = np.array(message.d if hasattr(message, "d") else message.D, np.float64)
    name = str(message.distortion_model).strip().lower()
    if message.width < 1 or message.height < 1:
        raise ValueError("camera_info gives no image size")
    if not np.any(K[:2, :2]):
        raise ValueError("camera_info has a zero K: the camera is not calibrated")
    if not np.all(np.isfinite(K)) or 0 < min(K[0, 0], K[1, 1]) < _LEAST_FOCAL_PX:
        raise ValueError(
            f"camera_info has a focal length of {K[0, 0]:.4g} px: K must be in pixels, not normalised by the image size"
        )
    if not np.all(np.isfinite(D)):
        raise ValueError("camera_info has a distortion that is not finite")
    if name == "" and not np.any(D):  # as written by drivers that rectify
        name, D = "plumb_bob", D[:0]
    if name not in _MODELS:
        raise ValueError(f"distortion model {message.distortion_model!r} is none of {', '.join(_MODELS)}")
    return Camera(_MODELS[name], K, _distortion(_MODELS[name], D), int(message.width), int(message.height))


def _distortion(model: str, D: Float[np.ndarray, " N"]) -> Float[np.ndarray, " M"]:
    longest = 4 if model == "equidistant" else 8
    if np.any(D[longest:]):  # thin prism and tilt terms of OpenCV's models with 12 and 14 coefficients
        raise ValueError(f"{model} with more than {longest} distortion coefficients is not supported")
    return D[:longest]


def _jpeg_size(data: bytes) -> tuple[int, int]:
    if not data.rstrip(b"\0").endswith(_JPEG_EOI):  # some cameras pad with zeros
        raise ValueError("JPEG is cut off (no end marker)")
    position, size = 2, (0, 0)
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            raise ValueError("JPEG is damaged (no marker where one must be)")
        marker = data[position + 1]
        if marker == 0xFF or marker in _JPEG_ALONE:
            position += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(data[position + 2 : position + 4])
        if marker in _JPEG_SOF:
            size = (
                int.from_bytes(data[position + 7 : position + 9]),
                int.from_bytes(data[position + 5 : position + 7]),
            )
        if marker == _JPEG_SOS:
            if min(size) < 1:
                raise ValueError("JPEG gives no size")
            return size
        position += 2 + max(length, 2)
    raise ValueError("JPEG holds no picture")


def _possible(width_px: int, height_px: int) -> tuple[int, int]:
    if width_px * height_px > MOST_PIXELS:
        raise ValueError(f"{width_px} x {height_px} pixels are more than a camera has: a damaged header")
    return width_px, height_px


def _png_header(data: bytes) -> tuple[int, int, int, int]:
    """Width, height, bit depth and colour type; also verifies every chunk's checksum."""
    position, kind = len(_PNG_MAGIC), b""
    while kind != b"IEND":
        length = int.from_bytes(data[position : position + 4])
        end = position + 8 + length
        kind = data[position + 4 : position + 8]
        if end + 4 > len(data):
            raise ValueError("PNG is cut off")
        if zlib.crc32(memoryview(data)[position + 4 : end]) != int.from_bytes(data[end : end + 4]):
            raise ValueError("PNG is damaged (checksum)")
        position = end + 4
    if data[12:16] != b"IHDR":
        raise ValueError("PNG has no header")
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    if min(width, height) < 1:
        raise ValueError("PNG gives no size")
    return width, height, depth, colour


def _raw_pixels(message: Any, encoding: str) -> np.ndarray:
    if encoding not in _RAW:
        raise ValueError(f"image encoding {message.encoding!r} is not supported")
    channels, size, _ = _RAW[encoding]
    height, width, row = int(message.height), int(message.width), int(message.width) * channels * size
    if encoding == "nv12":  # below the luma rows, half as many rows hold the colours of 2x2 pixels each
        if height % 2 or width % 2:
            raise ValueError(f"nv12 needs even sides, not {width}x{height}")
        height += height // 2
    step = int(message.step) or row
    data = np.asarray(message.data, np.uint8)
    if min(height, width) < 1 or step < row or len(data) < step * (height - 1) + row:
        raise ValueError(
            f"{len(data)} bytes are too few for {width}x{height} {message.encoding} with step {step}"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    if size == 2:
        rows = rows.copy().view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    return np.ascontiguousarray(rows.reshape(height, width, channels) if channels > 1 else rows)


def _to_png(pixels: UInt8[np.ndarray, ...] | np.ndarray) -> bytes:
    # Level 1: raw images compress to nearly the same size in a fifth of the default's time.
    ok, encoded = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise ValueError("image cannot be encoded as PNG")
    return encoded.tobytes()
