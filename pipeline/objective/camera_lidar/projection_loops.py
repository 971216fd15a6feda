"""Projection inside the compiled loops that look up images: one camera model as a flat parameter vector.

Functions called by kernels with fast arithmetic are inlined (`forceinline`). Otherwise each caller has a copy
with different rounding, and a process that compiles kernels links another copy than one that loads them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, no_type_check

import numba
import numpy as np

if TYPE_CHECKING:
    from pipeline.rig.cameras import Camera

__all__ = [
    "along_motion", "camera_parameters", "count_in_view", "most_points", "project_point", "project_points",
    "project_with_jacobian",
]  # fmt: skip

_PINHOLE, _DISTORTED, _EQUIDISTANT = 0.0, 1.0, 2.0
_POLYNOMIAL_DEGREE = 9


def camera_parameters(camera: Camera) -> np.ndarray:
    """The camera as float32[18] for compiled loops.

    Model, fx, fy, cx, cy, largest tangent squared (or smallest cosine), 10 coefficients, two spare.
    Coefficients: k1 k2 p1 p2 k3 k4 k5 k6 of the pinhole models, or the polynomial k(c) of
    `Camera.fast_polynomial`.
    """
    out = np.zeros(18, np.float32)
    out[1:3], out[3:5] = camera.focal_px, camera.centre_px
    if camera.model == "equidistant":
        coefficients, _ = camera.fast_polynomial(_POLYNOMIAL_DEGREE)
        corners = np.array(
            [[0.0, 0.0], [camera.width_px, 0], [0, camera.height_px], [camera.width_px, camera.height_px]]
        )
        rays = camera.unproject(corners)
        # The polynomial is fitted 10 % beyond the image's corners; cosines below that are outside.
        reach = np.arccos(np.nanmin(rays[:, 2])) if np.isfinite(rays).any() else camera.max_angle_rad
        out[0], out[5] = _EQUIDISTANT, np.cos(min(1.08 * reach, camera.max_angle_rad))
        out[6 : 6 + len(coefficients)] = coefficients
        return out
    distorted = len(camera.D) > 0 and bool(np.any(camera.D))
    out[0] = _DISTORTED if distorted else _PINHOLE
    out[5] = np.tan(camera.max_angle_rad) ** 2
    if distorted:
        out[6 : 6 + len(camera.D)] = camera.D
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(inline="always", fastmath=True, nogil=True)
def project_point(c: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """(u, v, valid) of a point in the optical frame."""
    one = np.float32(1.0)
    if c[0] == np.float32(2.0):
        norm = np.sqrt(x * x + y * y + z * z) + np.float32(1e-6)
        cosine = z / norm
        k = c[15]
        for i in range(14, 5, -1):
            k = k * cosine + c[i]
        s = k / norm
        return c[3] + c[1] * s * x, c[4] + c[2] * s * y, cosine > c[5]
    if z < np.float32(0.3):
        return np.float32(0.0), np.float32(0.0), False
    iz = one / z
    a, b = x * iz, y * iz
    r2 = a * a + b * b
    if r2 > c[5]:
        return np.float32(0.0), np.float32(0.0), False
    if c[0] == np.float32(1.0):
        radial = (one + r2 * (c[6] + r2 * (c[7] + r2 * c[10]))) / (
            one + r2 * (c[11] + r2 * (c[12] + r2 * c[13]))
        )
        two = np.float32(2.0)
        ad = a * radial + two * c[8] * a * b + c[9] * (r2 + two * a * a)
        bd = b * radial + c[8] * (r2 + two * b * b) + two * c[9] * a * b
        a, b = ad, bd
    return c[3] + c[1] * a, c[4] + c[2] * b, True


@no_type_check
@numba.njit(nogil=True, cache=True)
def most_points(start: np.ndarray) -> int:
    """Points of the largest frame: the size of the buffers that `project_points` fills."""
    most = 0
    for f in range(start.shape[0] - 1):
        most = max(most, start[f + 1] - start[f])
    return most


@no_type_check
@numba.njit(fastmath=True, nogil=True, cache=True, forceinline=True, error_model="numpy")
def project_points(
    c: np.ndarray, xyz: np.ndarray, begin: int, end: int, pose: np.ndarray, focal: float, u: np.ndarray,
    v: np.ndarray,
) -> None:  # fmt: skip
    """Fill u, v [px] of points xyz[3, begin:end] by the rows of a 3x4 transform; u = -1 if not visible.

    The loops have no branches, so that they compile to vector instructions: 1 ns a point. `focal` scales the
    image about its principal point.
    """
    one, away = np.float32(1.0), np.float32(-1.0)
    X, Y, Z = xyz[0, begin:end], xyz[1, begin:end], xyz[2, begin:end]
    r00, r01, r02, tx = pose[0], pose[1], pose[2], pose[3]
    r10, r11, r12, ty = pose[4], pose[5], pose[6], pose[7]
    r20, r21, r22, tz = pose[8], pose[9], pose[10], pose[11]
    cu, cv, fu, fv, limit = c[3], c[4], focal * c[1], focal * c[2], c[5]
    c0, c1, c2, c3, c4, c5, c6, c7 = c[6], c[7], c[8], c[9], c[10], c[11], c[12], c[13]
    if c[0] == np.float32(2.0):
        c8, c9 = c[14], c[15]
        for i in range(X.shape[0]):
            x = r00 * X[i] + r01 * Y[i] + r02 * Z[i] + tx
            y = r10 * X[i] + r11 * Y[i] + r12 * Z[i] + ty
            z = r20 * X[i] + r21 * Y[i] + r22 * Z[i] + tz
            nearness = one / (np.sqrt(x * x + y * y + z * z) + np.float32(1e-6))
            q = z * nearness
            k = ((((c9 * q + c8) * q + c7) * q + c6) * q + c5) * q + c4
            k = nearness * ((((k * q + c3) * q + c2) * q + c1) * q + c0)
            u[i] = cu + fu * k * x if q > limit else away
            v[i] = cv + fv * k * y
        return
    for i in range(X.shape[0]):
        x = r00 * X[i] + r01 * Y[i] + r02 * Z[i] + tx
        y = r10 * X[i] + r11 * Y[i] + r12 * Z[i] + ty
        z = r20 * X[i] + r21 * Y[i] + r22 * Z[i] + tz
        nearness = one / z if z >= np.float32(0.3) else one
        a, b = x * nearness, y * nearness
        r2 = a * a + b * b
        seen = z >= np.float32(0.3) and r2 <= limit
        if c[0] == one:
            above, below = one + r2 * (c0 + r2 * (c1 + r2 * c4)), one + r2 * (c5 + r2 * (c6 + r2 * c7))
            radial, cross = above / below, (a + a) * b
            a, b = (
                a * radial + c2 * cross + c3 * (r2 + (a + a) * a),
                b * radial + c2 * (r2 + (b + b) * b) + c3 * cross,
            )
        u[i] = cu + fu * a if seen else away
        v[i] = cv + fv * b


@no_type_check
@numba.njit(fastmath=True, nogil=True, cache=True, error_model="numpy")
def count_in_view(
    c: np.ndarray, xyz: np.ndarray, start: np.ndarray, poses: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Points xyz[3, N] of all frames that each pose (rows of 3x4 transforms, P F 12) puts into the image."""
    count, frames = poses.shape[0], poses.shape[1]
    out = np.zeros(count, np.int64)
    u_max, v_max = np.float32(width - 1), np.float32(height - 1)
    us, vs = np.empty(most_points(start), np.float32), np.empty(most_points(start), np.float32)
    for f in range(frames):
        for p in range(count):
            project_points(c, xyz, start[f], start[f + 1], poses[p, f], np.float32(1.0), us, vs)
            for i in range(start[f + 1] - start[f]):
                u, v = us[i], vs[i]
                if u >= np.float32(0) and v >= np.float32(0) and u <= u_max and v <= v_max:
                    out[p] += 1
    return out


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(nogil=True, cache=True)
def project_with_jacobian(
    c: np.ndarray, x: float, y: float, z: float
) -> tuple[float, float, bool, float, float, float, float, float, float]:
    """(u, v, valid, du/dx, du/dy, du/dz, dv/dx, dv/dy, dv/dz) in double precision."""
    # Long: one branch per camera model, and a call per branch would pass a dozen scalars.
    u, v, valid = project_point(c, x, y, z)
    if not valid:
        return 0.0, 0.0, False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if c[0] == 2.0:
        norm = np.sqrt(x * x + y * y + z * z)
        cosine = z / norm
        k, slope = np.float64(c[15]), 0.0
        for i in range(14, 5, -1):
            slope = slope * cosine + k
            k = k * cosine + c[i]
        # s = k(cosine)/norm; d cosine/d(x, y, z) = (-x z, -y z, x^2 + y^2)/norm^3
        s = k / norm
        n3 = norm * norm * norm
        sx = (-slope * x * z / norm - k * x) / n3
        sy = (-slope * y * z / norm - k * y) / n3
        sz = (slope * (x * x + y * y) / norm - k * z) / n3
        fx, fy = c[1], c[2]
        return (
            u,
            v,
            True,
            fx * (s + x * sx),
            fx * x * sy,
            fx * x * sz,
            fy * y * sx,
            fy * (s + y * sy),
            fy * y * sz,
        )
    iz = 1.0 / z
    a, b = x * iz, y * iz
    aa, ab, ba, bb = 1.0, 0.0, 0.0, 1.0
    if c[0] == 1.0:
        r2 = a * a + b * b
        n, dn = 1 + r2 * (c[6] + r2 * (c[7] + r2 * c[10])), c[6] + r2 * (2 * c[7] + 3 * c[10] * r2)
        d, dd = 1 + r2 * (c[11] + r2 * (c[12] + r2 * c[13])), c[11] + r2 * (2 * c[12] + 3 * c[13] * r2)
        radial, slope = n / d, (dn * d - n * dd) / (d * d)
        p1, p2 = c[8], c[9]
        aa = radial + 2 * a * a * slope + 2 * p1 * b + 6 * p2 * a
        ab = 2 * a * b * slope + 2 * p1 * a + 2 * p2 * b
        ba = ab
        bb = radial + 2 * b * b * slope + 6 * p1 * b + 2 * p2 * a
    aa, ab, ba, bb = c[1] * aa, c[1] * ab, c[2] * ba, c[2] * bb
    return u, v, True, aa * iz, ab * iz, -(aa * a + ab * b) * iz, ba * iz, bb * iz, -(ba * a + bb * b) * iz


@no_type_check
@numba.njit(inline="always", nogil=True)
def along_motion(
    pose: np.ndarray, motion: np.ndarray, x: float, y: float, z: float, dx: float, dy: float, dz: float
) -> float:
    """Derivative by the time offset of a quantity with derivatives (dx, dy, dz) by a camera point (x, y, z).

    `pose` has the rows of the transform from lidar to camera; `motion` is the velocity in camera axes [m/s]
    at its translation, and the yaw rate [rad/s], which rotates points about the lidar's vertical.
    """
    a, b, c = x - pose[3], y - pose[7], z - pose[11]
    up0, up1, up2, turn = pose[2], pose[6], pose[10], motion[3]
    return (
        dx * (motion[0] + turn * (up1 * c - up2 * b))
        + dy * (motion[1] + turn * (up2 * a - up0 * c))
        + dz * (motion[2] + turn * (up0 * b - up1 * a))
    )
