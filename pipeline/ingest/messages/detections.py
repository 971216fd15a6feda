"""Road users logged as 2D boxes, or as 3D boxes in the camera's own frame, projected to 2D boxes.

3D boxes in any other frame are refused: their projection needs the calibration to be estimated, and they would
confirm any prior that was used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import from_quaternion, transform_points

__all__ = ["DETECTIONS_3D", "Detections", "read_detections", "read_detections_3d"]

DETECTIONS_3D = (
    "vision_msgs/msg/Detection3DArray",
    "autoware_perception_msgs/msg/DetectedObjects",
    "autoware_auto_perception_msgs/msg/DetectedObjects",
)
# autoware_perception_msgs/ObjectClassification; 0 is unknown.
_AUTOWARE = {1: "car", 2: "truck", 3: "bus", 4: "trailer", 5: "motorcycle", 6: "bicycle", 7: "pedestrian"}
# Points on a box of side 1: corners and midpoints of edges, because a lens bends edges outwards.
_ON_A_BOX = np.array(list(product((-0.5, 0.0, 0.5), repeat=3)))
_UNIT_TOLERANCE = 0.01  # largest deviation of a quaternion's length from 1; beyond it is damaged
_Box = Float[np.ndarray, " 4"] | None
# Boxes, classes, scores, and the number of detections without a box or a class.
Detections = tuple[Float32[np.ndarray, "N 4"], list[str], Float32[np.ndarray, " N"], int]


def read_detections(message: Any) -> Detections:
    """Boxes (x0 y0 x1 y1 [px]), classes as logged, scores, and number of detections without box or class.

    A rotated box becomes its upright bounding box. Version 3 and later of vision_msgs name a class
    `hypothesis.class_id`, earlier ones `id`; version 4 has the centre in `center.position`.
    """
    return _columns((_upright_box(d.bbox), *_likeliest(d)) for d in message.detections)


def read_detections_3d(message: Any, camera: Camera, camera_frame: str) -> Detections:
    """The same of boxes in 3D, of a vision_msgs/Detection3DArray or Autoware's DetectedObjects.

    Raises:
        ValueError: the boxes are not in `camera_frame`, the image's optical frame.
    """
    frame = str(message.header.frame_id).lstrip("/")
    if frame != camera_frame:
        raise ValueError(
            f"3D boxes in frame {frame!r} can be projected only with the calibration that is to be estimated: log them "
            f"in the camera's frame {camera_frame!r}, or 2D detections of the image"
        )
    if hasattr(message, "objects"):
        return _columns(_autoware(thing, camera) for thing in message.objects)
    found = ((_box(d.bbox.center, d.bbox.size, camera), *_likeliest(d)) for d in message.detections)
    return _columns((box, name or None, score) for box, name, score in found)


def _columns(found: Iterable[tuple[_Box, str | None, float]]) -> Detections:
    """Columns of the detections with a box and a class, and the number of the others."""
    rows = list(found)
    kept = [(box, name, score) for box, name, score in rows if box is not None and name is not None]
    boxes = np.array([box for box, _, _ in kept], np.float32).reshape(-1, 4)
    scores = [score if math.isfinite(score) else 0.0 for _, _, score in kept]
    return boxes, [name for _, name, _ in kept], np.array(scores, np.float32), len(rows) - len(kept)


def _likeliest(detection: Any) -> tuple[str | None, float]:
    """Class with the highest score; None without a hypothesis."""
    hypotheses = [getattr(r, "hypothesis", r) for r in detection.results]
    named = [(str(h.class_id if hasattr(h, "class_id") else h.id), float(h.score)) for h in hypotheses]
    return max(named, key=lambda pair: pair[1] if math.isfinite(pair[1]) else 0.0, default=(None, 0.0))


def _autoware(thing: Any, camera: Camera) -> tuple[_Box, str | None, float]:
    likely = max(thing.classification, key=lambda c: c.probability, default=None)
    name = None if likely is None else _AUTOWARE.get(int(likely.label))
    box = _box(thing.kinematics.pose_with_covariance.pose, thing.shape.dimensions, camera)
    return box, name, float(thing.existence_probability)


def _box(pose: Any, size: Any, camera: Camera) -> _Box:
    """Upright box of the visible part, in the image; None if the box is invalid or partly behind the camera."""
    p, q = pose.position, pose.orientation
    t, q_wxyz = np.array([p.x, p.y, p.z], np.float64), np.array([q.w, q.x, q.y, q.z], np.float64)
    sides = np.array([size.x, size.y, size.z], np.float64)
    is_box = bool(np.all(np.isfinite([*t, *q_wxyz, *sides])) and np.all(sides > 0))
    if not is_box or abs(np.linalg.norm(q_wxyz) - 1) > _UNIT_TOLERANCE:
        return None
    uv, is_seen = camera.project(transform_points(from_quaternion(q_wxyz, t), _ON_A_BOX * sides))
    if not is_seen.all():
        return None
    least, most = np.array([-0.5, -0.5]), np.array([camera.width_px, camera.height_px]) - 0.5
    low, high = np.clip(uv.min(axis=0), least, most), np.clip(uv.max(axis=0), least, most)
    return np.concatenate([low, high]) if np.all(high > low) else None


def _upright_box(bbox: Any) -> _Box:
    centre = getattr(bbox.center, "position", bbox.center)
    x, y, width, height, theta = (
        float(v) for v in (centre.x, centre.y, bbox.size_x, bbox.size_y, bbox.center.theta)
    )
    if not math.isfinite(x + y + width + height + theta) or width <= 0 or height <= 0:
        return None
    c, s = abs(math.cos(theta)), abs(math.sin(theta))
    half_x, half_y = (c * width + s * height) / 2, (s * width + c * height) / 2
    return np.array([x - half_x, y - half_y, x + half_x, y + half_y])
