"""Images from a video logged packet by packet: decoded forward from the last key frame.

A message holds the data of one image (foxglove.CompressedVideo; sensor_msgs/CompressedImage with a video
format), without B frames. Source: ITU-T H.264, table 7-1; ITU-T H.265, table 7-1 (types of NAL units).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from pipeline.core.errors import MissingExtraError
from pipeline.ingest.messages.image import MOST_PIXELS

__all__ = ["VideoPictures", "video_codec"]

_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}
_START_CODE = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
_H264_IDR = 5
_H265_IRAP = range(16, 22)
# Longest distance to a key frame: ten seconds at 30 Hz, the usual maximum of encoders.
_MOST_PACKETS = 300
# Gap in periods between stamps: closer to two than to one, so an image is missing that others refer to.
_LOST_PERIODS = 1.7


def video_codec(format_: str) -> str | None:
    """Decoder name for a message's format; None if it is not a video."""
    return _CODECS.get(format_.strip().lower())


class VideoPictures:
    """Images of a video stream by message index; fast if read in order.

    `read` returns format and data of a message. Nothing is decoded across a gap in `stamps_ns`.
    """

    def __init__(self, read: Callable[[int], tuple[str, bytes]], stamps_ns: Int64[np.ndarray, " N"]) -> None:
        self._read = read
        gaps = np.diff(stamps_ns)
        period_ns = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else 0.0
        self._is_broken = np.concatenate([[True], (gaps <= 0) | (gaps > _LOST_PERIODS * period_ns)])
        self._decoder: Any = None
        self._last = -1  # index of the last packet that was decoded

    def picture(self, place: int) -> UInt8[np.ndarray, "H W 3"]:
        """The image of a message as BGR.

        Raises:
            ValueError: no key frame before it, a damaged or missing packet, or a stream with B frames.
            MissingExtraError: PyAV is not installed.
        """
        av = _pyav()
        packets = self._packets(place)
        first = place - len(packets) + 1
        if self._last != first - 1 or _is_key(*packets[0]):
            self._decoder = _decoder(av, packets[0][0])
        self._last = -1  # until success: after an error the next image starts from a key frame
        try:
            decoded = [
                f for i, p in enumerate(packets, first) for f in self._decoder.decode(_packet(av, p[1], i))
            ]
        except av.FFmpegError as err:
            raise ValueError(f"video cannot be decoded: {err}") from err
        found = [frame for frame in decoded if frame.pts == place]
        if not found or found[0].is_corrupt:
            raise ValueError("video has B frames or is damaged: its data gives no whole picture")
        self._last = place
        return np.asarray(found[0].to_ndarray(format="bgr24"), np.uint8)

    def _packets(self, place: int) -> list[tuple[str, bytes]]:
        """Packets to decode for an image: from its key frame on, or from the decoder's current position."""
        packets: list[tuple[str, bytes]] = []
        for i in range(place, max(place - _MOST_PACKETS, -1), -1):
            packets.insert(0, self._read(i))
            if _is_key(*packets[0]) or (
                self._decoder is not None and i - 1 == self._last and not self._is_broken[i]
            ):
                return packets
            if self._is_broken[i]:
                break
        raise ValueError("no video key frame before this image was read")


def _is_key(format_: str, data: bytes) -> bool:
    codec = video_codec(format_)
    headers = (match[1][0] for match in _START_CODE.finditer(data))
    if codec == "h264":
        return any(header & 0x1F == _H264_IDR for header in headers)
    return any(header >> 1 & 0x3F in _H265_IRAP for header in headers)


def _packet(av: ModuleType, data: bytes, place: int) -> Any:
    packet = av.Packet(data)
    packet.pts = place
    return packet


def _decoder(av: ModuleType, format_: str) -> Any:
    # One thread and low delay: an image is returned with its packet. Errors are raised, not concealed.
    decoder = av.CodecContext.create(video_codec(format_), "r")
    decoder.thread_count = 1
    decoder.options = {"err_detect": "explode", "max_pixels": str(MOST_PIXELS)}
    decoder.flags |= av.codec.context.Flags.low_delay
    return decoder


def _pyav() -> ModuleType:
    try:
        import av  # noqa: PLC0415  # an extra
    except ImportError as err:
        raise MissingExtraError("video", "av") from err
    return av
