"""Columns of a camera's motion at one moment, from its image and the earlier one that ingest named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.perceive.camera import decode_grey
from pipeline.perceive.image_motion import (
    ImageMotion,
    MotionReason,
    NoMotionError,
    Tracks,
    motion_of_tracks,
    track,
)
from pipeline.rig.cameras import camera_of
from schemas.captures import Image
from schemas.image_motion import tracking_scale

__all__ = ["EarlierGreys"]

_KEPT_NS = 2 * 10**9
_IS_USER = np.isin(np.arange(256), range(11, 19)).astype(np.uint8)  # person .. bicycle
_MARGIN_PX = 6  # about road users: corners of their outline, and their shadows
_DRIVEN_M, _SAME_GREYS = 0.9, 0.5  # a bonnet's picture differs by its noise, a JPEG of the same one hardly


class EarlierGreys:
    """Grey images of one camera's last moments at the size of tracking; asked in order of time."""

    def __init__(self, readout_s: float = 0.0) -> None:
        self._greys: dict[int, np.ndarray] = {}
        self._readout_s = readout_s  # of a rolling shutter, from the first row to the last

    def columns(
        self,
        image: Image,
        grey: UInt8[np.ndarray, "h w"],
        labels: UInt8[np.ndarray, "h w"] | None,
        boxes_px: Float32[np.ndarray, "N 4"] | None,
    ) -> tuple[Mapping[str, Any], MotionReason | None]:
        """Columns `MotionColumns`; or none, and the reason.

        Args:
            labels: Cityscapes train ids; None without semantics.
            boxes_px: road users in full-image pixels; None without semantics.
        """
        self._greys = {k: v for k, v in self._greys.items() if 0 <= image.stamp_ns - k < _KEPT_NS}
        scale = tracking_scale(image.image_width_px)
        is_left_out = _users(image, labels, boxes_px)
        if scale * image.image_width_px > grey.shape[1] + 1:
            grey = decode_grey(image, scale)
        try:
            tracks, motion = self._motion(image, grey, is_left_out)
        except NoMotionError as err:
            is_of_car = err.reason == MotionReason.STANDING and _is_driven(image)
            return {}, MotionReason.STATIC_TRACKS if is_of_car else err.reason
        finally:
            self._greys[image.stamp_ns] = grey
        assert image.earlier_stamp_ns is not None, "an earlier image was found"
        scale = image.image_width_px / grey.shape[1]
        pixels = np.concatenate([tracks.before_px, tracks.now_px], 1)[motion.inlier]
        return {
            "motion_span_s": (image.stamp_ns - image.earlier_stamp_ns) * 1e-9,
            "motion_turn_rad": motion.turn,
            "motion_direction": motion.direction,
            "motion_covariance": motion.covariance,
            "motion_tracks": len(motion.inlier),
            "motion_tracks_px": ((pixels + 0.5) * scale - 0.5).astype(np.float32),
            "motion_spread": motion.spread,
            "motion_parallax_px": motion.parallax_px,
            "ego_driven_m": image.ego_driven_m,
            "ego_turned_rad": image.ego_turned_rad,
            "ego_turned_by_clock_radps": image.ego_turned_by_clock_radps,
        }, None

    def _motion(
        self, image: Image, grey: np.ndarray, is_left_out: np.ndarray | None
    ) -> tuple[Tracks, ImageMotion]:
        if image.earlier_stamp_ns is None:
            raise NoMotionError(MotionReason(image.earlier_missing or MotionReason.NO_EARLIER))
        before = self._earlier(image, grey.shape)
        if before is None:
            raise NoMotionError(MotionReason.NO_EARLIER)
        if _is_driven(image) and float(np.mean(cv2.absdiff(before, grey))) < _SAME_GREYS:
            raise NoMotionError(MotionReason.SAME_IMAGE)
        camera = camera_of(image).scaled(grey.shape[1] / image.image_width_px)
        if is_left_out is not None and is_left_out.shape != grey.shape:
            small = is_left_out.astype(np.uint8)
            is_left_out = cv2.resize(small, grey.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
        tracks = track(before, grey, camera, is_left_out)
        readout = self._readout_s / ((image.stamp_ns - image.earlier_stamp_ns) * 1e-9)
        return tracks, motion_of_tracks(tracks, (grey.shape[1], grey.shape[0]), readout)

    def _earlier(self, image: Image, shape: tuple[int, ...]) -> np.ndarray | None:
        """The earlier image; None if its moment was not perceived, or it cannot be decoded."""
        if image.earlier_image is None:
            return self._greys.get(image.earlier_stamp_ns or 0)
        found = cv2.imdecode(np.frombuffer(image.earlier_image, np.uint8), cv2.IMREAD_GRAYSCALE)
        if found is None or found.shape == shape:
            return found
        return np.asarray(cv2.resize(found, shape[::-1], interpolation=cv2.INTER_AREA))


def _is_driven(image: Image) -> bool:
    return abs(image.ego_driven_m or 0.0) > _DRIVEN_M


def _users(
    image: Image, labels: np.ndarray | None, boxes_px: np.ndarray | None
) -> Bool[np.ndarray, "h w"] | None:
    """Where road users are, at label size; None if nothing shows it."""
    if labels is None or boxes_px is None:
        return None
    users = cv2.LUT(labels, _IS_USER)
    for x0, y0, x1, y1 in boxes_px * (labels.shape[1] / image.image_width_px):
        users[max(int(y0), 0) : max(int(np.ceil(y1)), 0), max(int(x0), 0) : max(int(np.ceil(x1)), 0)] = 1
    kernel = np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate(users, kernel).astype(bool))
