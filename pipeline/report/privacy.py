"""Pictures with people and number plates made unrecognisable: road users in mosaic.

The mosaic covers pixels of road users' classes and detections, grown by a margin; all of a picture whose camera has
no semantics. A person found by neither segmenter nor detector stays visible; if that must not happen, draw pages
without pictures.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["road_user_mask", "without_road_users"]

# Cityscapes train ids of person, rider, car, truck, bus, train, motorcycle and bicycle: plates sit on vehicles.
_FIRST_ROAD_USER, _LAST_ROAD_USER = 11, 18
# A face is an eighth of a person's height and a plate a quarter of a car's width (0.5 of 1.8 m): tiles that large show
# neither. Of the image's height, since a nearer road user has larger features; 1/40 of 940 px is 23 px, a face 6 m away
# through the paper's camera.
_TILE_SHARE = 1 / 40
_MARGIN_SHARE = 0.1  # of a box: detectors cut feet and mirrors off
_GROWN_PX = 5  # of the label image: outlines wander by a few


def without_road_users(frame: Frame, observation: Observation) -> Frame:
    """The frame with its road users in mosaic; without an image where its bytes are no picture."""
    image = cv2.imdecode(np.frombuffer(frame.image, np.uint8), cv2.IMREAD_COLOR) if frame.image else None
    if image is None:
        return replace(frame, image=b"")
    mask = road_user_mask(observation, (frame.image_width_px, frame.image_height_px))
    height, width = image.shape[:2]
    hidden = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    tile = max(1.0, _TILE_SHARE * height)
    few = (max(1, round(width / tile)), max(1, round(height / tile)))
    mosaic = cv2.resize(
        cv2.resize(image, few, interpolation=cv2.INTER_AREA), (width, height), interpolation=cv2.INTER_NEAREST
    )
    _, encoded = cv2.imencode(".png", np.where(hidden[..., None], mosaic, image))
    return replace(frame, image=encoded.tobytes())


def road_user_mask(observation: Observation, size_px: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels of the full image (width, height) of road users by labels or detections, with a margin.

    All pixels, if nothing was looked for.
    """
    if observation.is_unlabelled:
        return np.ones(size_px[::-1], bool)
    labels: UInt8[np.ndarray, "h w"] | None = cv2.imdecode(
        np.frombuffer(observation.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE
    )
    width, height = size_px
    mask = np.zeros((height, width), np.uint8)
    if labels is not None:
        found = ((labels >= _FIRST_ROAD_USER) & (labels <= _LAST_ROAD_USER)).astype(np.uint8)
        grown = cv2.dilate(found, np.ones((2 * _GROWN_PX + 1,) * 2, np.uint8))
        mask = cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST)
    for x0, y0, x1, y1 in observation.road_user_boxes_px.astype(np.float64):
        dx, dy = _MARGIN_SHARE * (x1 - x0), _MARGIN_SHARE * (y1 - y0)
        left, right = (int(np.clip(v, 0, width)) for v in (x0 - dx, np.ceil(x1 + dx)))
        top, bottom = (int(np.clip(v, 0, height)) for v in (y0 - dy, np.ceil(y1 + dy)))
        mask[top:bottom, left:right] = 1
    return mask > 0
