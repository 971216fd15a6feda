"""Terms that read an image at each point: reflectivity against brightness on the road, and mutual information.

Reflectivity determines pitch, roll and yaw with only 16 rings. Ground points that reflect more than the
rest of their ring should project to pixels that are brighter than the rest of their row of the road. The
score is the log likelihood ratio of two normal distributions of unit variance whose means differ by `delta`
(how much brighter the image is under marked points): `delta c - delta^2/2`, linear in the contrast c.
`delta` is estimated from the data, so the term loses its weight if the lidar has no useful intensity or the
road has no paint.

Mutual information of a point's height and range with its label finds the basin. On real logs it is biased by half a
degree of pitch, so it has no part in the final estimate.
Source: Pandey, McBride, Savarese, Eustice 2015, "Automatic extrinsic calibration of vision and lidar by
maximizing mutual information", with semantic classes in place of brightness.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64, UInt8

from pipeline.objective.camera_lidar.projection_loops import (
    along_motion,
    most_points,
    project_points,
    project_with_jacobian,
)

__all__ = ["class_information", "marking_gradients", "marking_scores"]

_LABELS = 20  # 19 Cityscapes classes and void


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def marking_scores(
    camera: Float32[np.ndarray, " 18"], contrast: Int8[np.ndarray, "I H W"],
    points: Float32[np.ndarray, "N 3"], weight: Float32[np.ndarray, " N"], start: Int64[np.ndarray, " G"],
    image: Int64[np.ndarray, " F"], poses: Float32[np.ndarray, "P F 12"], focal: Float32[np.ndarray, " P"],
) -> Float32[np.ndarray, "P F"]:  # fmt: skip
    """Weighted sum of the contrast under each frame's points at each pose; 0 outside the road."""
    count, frames = poses.shape[0], poses.shape[1]
    height, width = contrast.shape[1], contrast.shape[2]
    out = np.zeros((count, frames), np.float32)
    xyz = np.ascontiguousarray(points.T)
    most = most_points(start)
    us, vs = np.empty(most, np.float32), np.empty(most, np.float32)
    place = np.empty(most, np.int32)
    for f in range(frames):
        a, b = start[f], start[f + 1]
        map_ = contrast[image[f]].reshape(-1)
        for p in range(count):
            project_points(camera, xyz, a, b, poses[p, f], focal[p], us, vs)
            out[p, f] = _weighted_sum(map_, us[: b - a], vs[: b - a], weight[a:b], width, height, place)
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
def _weighted_sum(
    map_: np.ndarray, us: np.ndarray, vs: np.ndarray, weight: np.ndarray, width: int, height: int,
    place: np.ndarray,
) -> float:  # fmt: skip
    """Weighted sum of a flat map's values between pixels; branch-free, because branches are unpredictable."""
    zero = np.float32(0)
    u_max, v_max = np.float32(width - 1.01), np.float32(height - 1.01)
    across = np.int32(width)
    for i in range(us.shape[0]):
        u, v = us[i], vs[i]
        seen = (u >= zero) & (v >= zero) & (u <= u_max) & (v <= v_max)
        place[i] = np.int32(v) * across + np.int32(u) if seen else np.int32(-1)
    total = zero
    for i in range(us.shape[0]):
        k = max(place[i], np.int32(0))
        a, b = us[i] - np.float32(np.int32(us[i])), vs[i] - np.float32(np.int32(vs[i]))
        c00, c01 = np.float32(map_[k]), np.float32(map_[k + 1])
        c10, c11 = np.float32(map_[k + width]), np.float32(map_[k + width + 1])
        upper, lower = c00 + a * (c01 - c00), c10 + a * (c11 - c10)
        value = weight[i] * (upper + b * (lower - upper))
        total += value if place[i] >= 0 else zero
    return total


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def marking_gradients(
    camera: np.ndarray, contrast: np.ndarray, points: np.ndarray, weight: np.ndarray, start: np.ndarray,
    image: np.ndarray, poses: np.ndarray, focal: float, motion: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Gradient [F, 11] of each frame's score and its information [F, 11, 11].

    By rotation, translation, time offset, focal scale, principal point and readout time. As in
    `edge_gradients`. The score is linear in the contrast, so the information is that of the likelihood: the
    outer product of each point's gradient.
    """
    frames = poses.shape[0]
    height, width = contrast.shape[1], contrast.shape[2]
    gradient, information = np.zeros((frames, 11)), np.zeros((frames, 11, 11))
    row = np.zeros(11)
    for f in range(frames):
        m = poses[f]
        for i in range(start[f], start[f + 1]):
            x0, y0, z0 = points[i, 0], points[i, 1], points[i, 2]
            x = m[0] * x0 + m[1] * y0 + m[2] * z0 + m[3]
            y = m[4] * x0 + m[5] * y0 + m[6] * z0 + m[7]
            z = m[8] * x0 + m[9] * y0 + m[10] * z0 + m[11]
            u, v, valid, jux, juy, juz, jvx, jvy, jvz = project_with_jacobian(camera, x, y, z)
            ou, ov = u - camera[3], v - camera[4]
            u, v = camera[3] + focal * ou, camera[4] + focal * ov
            if not valid or u < 0 or v < 0 or u > width - 1.01 or v > height - 1.01:
                continue
            iu, iv = int(u), int(v)
            a, b = u - iu, v - iv
            c00, c01 = float(contrast[image[f], iv, iu]), float(contrast[image[f], iv, iu + 1])
            c10, c11 = float(contrast[image[f], iv + 1, iu]), float(contrast[image[f], iv + 1, iu + 1])
            top, bottom, left = c01 - c00, c11 - c10, c10 - c00
            gu = weight[i] * (top + b * (bottom - top))
            gv = weight[i] * (left + a * (bottom - top))
            row[8], row[9] = gu, gv
            row[7] = gu * ou + gv * ov
            gu, gv = focal * gu, focal * gv
            dx, dy, dz = gu * jux + gv * jvx, gu * juy + gv * jvy, gu * juz + gv * jvz
            row[0], row[1], row[2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
            row[3], row[4], row[5] = dx, dy, dz
            row[6] = along_motion(m, motion[f], x, y, z, dx, dy, dz)
            row[10] = (0.5 - (v + 0.5) / height) * row[6]
            for j in range(11):
                gradient[f, j] += row[j]
                for k in range(11):
                    information[f, j, k] += row[j] * row[k]
    return gradient, information


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def class_information(
    camera: Float32[np.ndarray, " 18"], labels: UInt8[np.ndarray, "I H W"],
    points: Float32[np.ndarray, "N 3"], kind: UInt8[np.ndarray, " N"], start: Int64[np.ndarray, " G"],
    image: Int64[np.ndarray, " F"], poses: Float32[np.ndarray, "P F 12"], kinds: int,
) -> Float64[np.ndarray, " P"]:  # fmt: skip
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
