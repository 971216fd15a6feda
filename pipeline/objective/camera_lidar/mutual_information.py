"""Mutual information of a lidar point's height and range with its label: finds the basin.

Biased by half a degree of pitch on real logs, so it has no part in the final estimate.

Source: Pandey, McBride, Savarese, Eustice 2015, "Automatic extrinsic calibration of vision and lidar by
maximizing mutual information", with semantic classes in place of brightness.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from pipeline.objective.camera_lidar.projection_loops import most_points, project_points

__all__ = ["class_information"]

_LABELS = 20  # 19 Cityscapes classes and void


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def class_information(
    camera: Float32[np.ndarray, " 18"],
    labels: UInt8[np.ndarray, "I H W"],
    points: Float32[np.ndarray, "N 3"],
    kind: UInt8[np.ndarray, " N"],
    start: Int64[np.ndarray, " G"],
    image: Int64[np.ndarray, " F"],
    poses: Float32[np.ndarray, "P F 12"],
    kinds: int,
) -> Float64[np.ndarray, " P"]:
    """Nats per projected point times the share of points that project into the image, at each pose, over all frames."""
    count, frames = poses.shape[0], poses.shape[1]
    height, width = labels.shape[1], labels.shape[2]
    out = np.zeros(count)
    f4 = np.float32
    u_max, v_max = f4(width - 1), f4(height - 1)
    # Frames outside, poses inside: one frame's labels stay in the cache.
    table = np.zeros((count, kinds, _LABELS))
    xyz = np.ascontiguousarray(points.T)
    us, vs = np.empty(most_points(start), np.float32), np.empty(most_points(start), np.float32)
    for f in range(frames):
        for p in range(count):
            project_points(camera, xyz, start[f], start[f + 1], poses[p, f], f4(1), us, vs)
            for i in range(start[f], start[f + 1]):
                u, v = us[i - start[f]], vs[i - start[f]]
                if u >= f4(0) and v >= f4(0) and u <= u_max and v <= v_max:
                    table[
                        p, kind[i], min(labels[image[f], int(v + f4(0.5)), int(u + f4(0.5))], _LABELS - 1)
                    ] += 1.0
    for p in range(count):
        out[p] = _information(table[p]) / points.shape[0]
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _information(table: np.ndarray) -> float:
    """Mutual information of a table of counts, times its total [nats]."""
    total = table.sum()
    by_kind, by_label = table.sum(1), table.sum(0)
    information = 0.0
    for a in range(table.shape[0]):
        for b in range(table.shape[1]):
            if table[a, b] > 0:
                information += table[a, b] * np.log(table[a, b] * total / (by_kind[a] * by_label[b]))
    return information
