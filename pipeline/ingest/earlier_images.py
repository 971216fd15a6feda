"""For each image of a moment, an earlier one of the same camera, some metres of driving before.

From the two, perception finds how the camera moves. Most logs have more images than moments, so the earlier one is
read from the log too, and kept small without colour; if it is the image of an earlier moment, its stamp
suffices. Messages are looked at in the order in which they were logged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np

from pipeline.ingest.index import DayIndex
from pipeline.ingest.messages.decoding import DECODE_ERRORS
from pipeline.ingest.messages.image import EncodedImage
from schemas.image_motion import tracking_scale

__all__ = ["EarlierImages"]

_WAY_M, _LEAST_M, _MOST_M = 3.0, 1.0, 6.0
_SPAN_S, _LEAST_S, _MOST_S = 0.3, 0.04, 1.5  # without odometry: 1 to 6 m at 3.5 to 20 m/s
_LATEST_S = 0.6  # likewise
_ANOTHER = 0.3  # what another image costs, in logarithms of the way
_STANDING_MPS = 0.3
_STEPS = 12  # of the integral of odometry
_QUALITY = 92
# Why an image has no earlier one; perception adds its own reasons.
NO_EARLIER, TOO_FAR, STAMPS_JUMP, STANDING, SAME_IMAGE = (
    "no_earlier_image",
    "images_too_far_apart",
    "stamps_jump",
    "standing",
    "same_image_again",
)


def _off(span_s: float, driven_m: float, *, is_kept: bool) -> float:
    """How far an image is from the best one; one that is kept anyway comes first. `driven_m` is NaN if unknown."""
    by_way = np.log(span_s / _SPAN_S) if np.isnan(driven_m) else np.log(abs(driven_m) / _WAY_M)
    return float(abs(by_way)) + (0.0 if is_kept else _ANOTHER)


class EarlierImages:
    """Finds the earlier image of each image of one camera; asked in the order of moments.

    Args:
        picture: reads the image of a message; raises one of DECODE_ERRORS if it is damaged.
    """

    def __init__(self, index: DayIndex, sensor: str, picture: Callable[[int], EncodedImage]) -> None:
        self._index, self._captures, self._picture = index, index.captures(sensor), picture
        self._kept: set[int] = set()  # images of moments

    def columns(self, place: int, now: bytes) -> Mapping[str, Any]:
        """Columns `EarlierColumns` of a message's image, which is then an earlier one of those that follow."""
        found = self._nearest(place)
        self._kept.add(place)
        if isinstance(found, str):
            return {"earlier_missing": found}
        image = None
        if found not in self._kept:
            try:
                earlier = self._picture(found)
            except DECODE_ERRORS:
                return {"earlier_missing": NO_EARLIER}
            if earlier.data == now:
                return {"earlier_missing": SAME_IMAGE}
            image = _small_grey(earlier)
        stamp_ns = self._captures.stamps[found]
        return {"earlier_stamp_ns": stamp_ns, "earlier_image": image, **self._motion(stamp_ns, place)}

    def _nearest(self, place: int) -> int | str:
        """The best earlier image, or why there is none."""
        stamps, located = self._captures.stamps, self._captures.located
        now_ns, found, last_ns, driven_m = stamps[place], dict[int, float](), stamps[place], 0.0
        speed = self._index.ego.motion_at(np.array([now_ns], np.int64))[0][0]
        nearest = np.nan, np.inf
        for k in range(place - 1, -1, -1):
            if located[k].log != located[place].log or now_ns - stamps[k] > _MOST_S * 1e9:
                break
            if stamps[k] >= last_ns:
                return STAMPS_JUMP
            ends = np.array([stamps[k], last_ns], np.int64)
            driven_m += float(self._index.ego.motion_at(ends)[0].mean()) * (last_ns - stamps[k]) * 1e-9
            last_ns = stamps[k]
            span_s = (now_ns - stamps[k]) * 1e-9
            nearest = (driven_m, span_s) if k == place - 1 else nearest
            is_near = span_s <= _LATEST_S if np.isnan(driven_m) else _LEAST_M <= abs(driven_m) <= _MOST_M
            if is_near and span_s >= _LEAST_S:
                found[k] = _off(span_s, driven_m, is_kept=k in self._kept)
        if found:
            return min(found, key=found.__getitem__)
        if abs(speed) < _STANDING_MPS:
            return STANDING
        has_one = place > 0 and located[place - 1].log == located[place].log
        way_m, span_s = nearest
        is_far = span_s > _LATEST_S if np.isnan(way_m) else abs(way_m) > _MOST_M
        return TOO_FAR if has_one and is_far else NO_EARLIER

    def _motion(self, earlier_ns: int, place: int) -> Mapping[str, float]:
        """The car's motion by odometry, from the earlier image to this one; empty if it is not known throughout."""
        stamps = np.linspace(earlier_ns, self._captures.stamps[place], _STEPS + 1).astype(np.int64)
        speed, yaw_rate = self._index.ego.motion_at(stamps)
        if not (np.isfinite(speed).all() and np.isfinite(yaw_rate).all()):
            return {}
        s = (stamps - earlier_ns) * 1e-9
        return {
            "ego_driven_m": float(np.trapezoid(speed, s)),
            "ego_turned_rad": float(np.trapezoid(yaw_rate, s)),
            "ego_turned_by_clock_radps": float(yaw_rate[-1] - yaw_rate[0]),
        }


def _small_grey(image: EncodedImage) -> bytes | None:
    """The image at the size of tracking without colour, as JPEG; None if it cannot be decoded."""
    scale = tracking_scale(image.width_px)
    halved = image.format == "jpeg" and scale < 1
    flag = cv2.IMREAD_REDUCED_GRAYSCALE_2 if halved else cv2.IMREAD_GRAYSCALE
    grey = cv2.imdecode(np.frombuffer(image.data, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None:
        return None
    size = math.ceil(image.width_px * scale), math.ceil(image.height_px * scale)
    if grey.shape != size[::-1]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    ok, blob = cv2.imencode(".jpg", grey, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    assert ok, "OpenCV cannot encode a grey JPEG"
    return bytes(blob)
