"""Offsets of detected road users from the lidar's objects: evidence of a network other than the segmenter.

A lidar's object is projected by the pose; if exactly one box surrounds about the same part of the image, both
show one road user. A detector trained apart from the segmenter has other errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int64

from pipeline.rig.cameras import camera_of
from schemas.observations import Observation

__all__ = ["box_offsets"]

_FEWEST_POINTS = 12
_LEAST_PX = 12.0  # of a box, on either side, in the image of the labels' size
_BORDER_PX = 4.0  # nearer to the image's border a road user may be cut
_LEAST_OVERLAP = 0.3  # intersection over union; of the second best pairing at most half of that
_Boxes = Float[np.ndarray, "_ 4"]  # u0 v0 u1 v1


def box_offsets(
    observations: Sequence[Observation], T_camera_lidar: Float[np.ndarray, "F 4 4"]
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, "M 2"]]:
    """Rotations about the camera's x and y that move objects into their boxes [rad], and their frames.

    `T_camera_lidar` is from each frame's lidar points to its image.
    """
    frame, offset = list[int](), list[Float[np.ndarray, " 2"]]()
    for k, (o, T) in enumerate(zip(observations, T_camera_lidar, strict=True)):
        for moved in _frame_offsets(o, T):
            frame.append(k)
            offset.append(moved)
    return np.array(frame, np.int64), np.array(offset, np.float64).reshape(-1, 2)


def _frame_offsets(o: Observation, T: Float[np.ndarray, "4 4"]) -> Iterator[Float[np.ndarray, " 2"]]:
    camera, boxes = camera_of(o), o.road_user_boxes_px.astype(np.float64)
    size = np.array([camera.width_px, camera.height_px] * 2)
    least = _LEAST_PX / o.label_scale
    whole = (boxes[:, :2] > _BORDER_PX).all(1) & (boxes[:, 2:] < size[2:] - _BORDER_PX).all(1)
    boxes = boxes[whole & (boxes[:, 2:] - boxes[:, :2] > least).all(1)]
    objects = _objects(o, T)
    if not len(boxes) or not len(objects):
        return
    overlap = _overlap(boxes, objects)
    for b, row in enumerate(overlap):
        c = int(np.argmax(row))
        rivals = np.concatenate([np.delete(row, c), np.delete(overlap[:, c], b)])
        if row[c] > _LEAST_OVERLAP and (not len(rivals) or rivals.max() < row[c] / 2):
            apart = (boxes[b, :2] + boxes[b, 2:] - objects[c, :2] - objects[c, 2:]) / 2
            yield np.array([-apart[1] / camera.K[1, 1], apart[0] / camera.K[0, 0]])


def _objects(o: Observation, T: Float[np.ndarray, "4 4"]) -> _Boxes:
    """Bounding box in the image of each lidar cluster."""
    xyz = o.lidar_map_xyz_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    uv, is_seen = camera_of(o).project(xyz)
    found = []
    for c in range(len(o.lidar_cluster_centre_m)):
        of = o.lidar_map_cluster == c
        if of.sum() >= _FEWEST_POINTS and is_seen[of].all():
            found.append([*uv[of].min(0), *uv[of].max(0)])
    return np.array(found, np.float64).reshape(-1, 4)


def _overlap(a: _Boxes, b: _Boxes) -> Float[np.ndarray, "_ _"]:
    """Intersection over union of each with each."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=2)
    area = [np.prod(x[:, 2:] - x[:, :2], axis=1) for x in (a, b)]
    return np.asarray(shared / np.maximum(area[0][:, None] + area[1][None] - shared, 1e-9))
