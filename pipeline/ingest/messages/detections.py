"""Logged road users: vision_msgs/Detection2DArray of every version, read by attribute names."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float32

__all__ = ["read_detections"]


def read_detections(
    message: Any,
) -> tuple[Float32[np.ndarray, "N 4"], list[str], Float32[np.ndarray, " N"], int]:
    """Boxes (x0 y0 x1 y1 [px]), classes as logged, scores, and number of detections without box or class.

    A rotated box becomes its upright bounding box. Version 3 and later of vision_msgs name a class
    `hypothesis.class_id`, earlier ones `id`; version 4 has the centre in `center.position`.
    """
    boxes, classes, scores, dropped = [], [], [], 0
    for detection in message.detections:
        box = _box(detection.bbox)
        hypotheses = [_hypothesis(r) for r in detection.results]
        if box is None or not hypotheses:
            dropped += 1
            continue
        name, score = max(hypotheses, key=lambda h: h[1])
        boxes.append(box)
        classes.append(name)
        scores.append(score)
    return np.array(boxes, np.float32).reshape(-1, 4), classes, np.array(scores, np.float32), dropped


def _box(bbox: Any) -> tuple[float, float, float, float] | None:
    centre = getattr(bbox.center, "position", bbox.center)
    x, y, width, height, theta = (
        float(v) for v in (centre.x, centre.y, bbox.size_x, bbox.size_y, bbox.center.theta)
    )
    if not math.isfinite(x + y + width + height + theta) or width <= 0 or height <= 0:
        return None
    c, s = abs(math.cos(theta)), abs(math.sin(theta))
    half_x, half_y = (c * width + s * height) / 2, (s * width + c * height) / 2
    return x - half_x, y - half_y, x + half_x, y + half_y


def _hypothesis(result: Any) -> tuple[str, float]:
    inner = getattr(result, "hypothesis", result)
    name = str(inner.class_id if hasattr(inner, "class_id") else inner.id)
    score = float(inner.score)
    return name, score if math.isfinite(score) else 0.0
