"""The loop behind `registration`: soft assignment of radar detections to lidar points, frame by frame.

Long on purpose: a detection's assignments are formed, weighed and summed without being stored.
"""
# numba infers the types of the arguments; annotations would only repeat RegistrationFrames.
# ruff: noqa: ANN001, ANN202, C901, PLR0912, PLR0915
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

__all__ = ["CUT", "STATS", "accumulate_frames"]

STATS = 12  # per frame: log likelihood, detections, assigned, bounced, sums of g r^2 (az, el, r), sums of g (3), spare
_CELL = 1.5  # cell size and reach in sigmas: 5 x 5 cells cover +-3 sigma
_REACH = 2
CUT = 9.0  # squared distance in (azimuth, range) beyond which a lidar point is no neighbour

_jit = numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")


@no_type_check  # keeps the tests' shape checks out of compiled code
@_jit
def _spherical(x, y, z):
    h = np.sqrt(x * x + y * y)
    return np.arctan2(y, x), np.arctan2(z, h), np.sqrt(h * h + z * z)


@no_type_check
@_jit
def _lidar_in_radar(p0, p1, R, t, xyz, plane, motion, mirrors, sph, bounce_el):
    """Spherical radar coordinates of lidar points, and the elevation of their mirror image below the ground."""
    h0 = plane[0] * t[0] + plane[1] * t[1] + plane[2] * t[2] + plane[3]
    for k in range(p0, p1):
        dx, dy, dz = xyz[k, 0] - t[0], xyz[k, 1] - t[1], xyz[k, 2] - t[2]
        height = 0.0
        if mirrors:
            height = plane[0] * dx + plane[1] * dy + plane[2] * dz + h0
        for mirror in range(2):
            if mirror == 1:
                if height < 0.3:  # metres; a lower point is as good as its own mirror image
                    bounce_el[k - p0] = 10.0
                    break
                dx -= 2 * height * plane[0]
                dy -= 2 * height * plane[1]
                dz -= 2 * height * plane[2]
            x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
            y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
            z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
            # Seen tau later: the car has turned by w tau and moved by v tau.
            x, y = x + motion[3] * y - motion[0], y - motion[3] * x - motion[1]
            z -= motion[2]
            a, e, r = _spherical(x, y, z)
            if mirror == 0:
                sph[k - p0, 0], sph[k - p0, 1], sph[k - p0, 2] = a, e, r
            else:
                bounce_el[k - p0] = e


@no_type_check
@_jit
def _sort_into_cells(n, sph, a0, r0, cell_a, cell_r, n_a, n_r, start, order, cell_of):
    start[:] = 0
    for k in range(n):
        i = int(np.floor((sph[k, 0] - a0) / cell_a))
        j = int(np.floor((sph[k, 2] - r0) / cell_r))
        if i < 0 or j < 0 or i >= n_a or j >= n_r:
            cell_of[k] = -1
            continue
        cell_of[k] = i * n_r + j
        start[cell_of[k] + 1] += 1
    for c in range(n_a * n_r):
        start[c + 1] += start[c]
    for k in range(n):
        c = cell_of[k]
        if c >= 0:
            order[start[c]] = k
            start[c] += 1
    for c in range(n_a * n_r, 0, -1):
        start[c] = start[c - 1]
    start[0] = 0


@no_type_check
@_jit
def _jacobian(J, x, y, z, R, t, v, w, tau):
    """d(azimuth, elevation, range of a static lidar point)/d(left twist of T_lidar_radar, tau, range bias).

    The lidar point is the one that appears at (x, y, z): q' = q - (v + w x q) tau with q = T_radar_lidar p.
    """
    turn = w * tau
    qx, qy, qz = x + v[0] * tau, y + v[1] * tau, z + v[2] * tau
    qx, qy = qx - turn * qy, qy + turn * qx
    px = R[0, 0] * qx + R[0, 1] * qy + R[0, 2] * qz + t[0]
    py = R[1, 0] * qx + R[1, 1] * qy + R[1, 2] * qz + t[1]
    pz = R[2, 0] * qx + R[2, 1] * qy + R[2, 2] * qz + t[2]
    h2 = x * x + y * y
    h = np.sqrt(h2)
    r2 = h2 + z * z
    r = np.sqrt(r2)
    for row in range(3):
        if row == 0:
            s0, s1, s2 = -y / h2, x / h2, 0.0
        elif row == 1:
            s0, s1, s2 = -x * z / (h * r2), -y * z / (h * r2), h / r2
        else:
            s0, s1, s2 = x / r, y / r, z / r
        J[row, 6] = -(s0 * (v[0] - w * qy) + s1 * (v[1] + w * qx) + s2 * v[2])
        s0, s1 = s0 - turn * s1, s1 + turn * s0
        # u = R s: gradient in lidar axes; dq = R^T ([p]x dphi - drho), u . ([p]x w) = (u x p) . w
        u0 = R[0, 0] * s0 + R[0, 1] * s1 + R[0, 2] * s2
        u1 = R[1, 0] * s0 + R[1, 1] * s1 + R[1, 2] * s2
        u2 = R[2, 0] * s0 + R[2, 1] * s1 + R[2, 2] * s2
        J[row, 0] = u1 * pz - u2 * py
        J[row, 1] = u2 * px - u0 * pz
        J[row, 2] = u0 * py - u1 * px
        J[row, 3], J[row, 4], J[row, 5] = -u0, -u1, -u2
        J[row, 7] = 1.0 if row == 2 else 0.0


@no_type_check
@_jit
def accumulate_frames(
    T, tau, range_bias, velocity, yaw_rate, radar, radar_first, lidar, lidar_first, plane, has_plane,
    use_elevation, limits, sigma,
    outlier, bounce_prior, stride, max_range, H, g, info, stats,
) -> None:  # fmt: skip
    """Normal equations of each frame: H (2, F, 8, 8) and g (2, F, 8) for (azimuth and range, elevation), information.

    `info` is H less what the uncertain assignment takes away (Louis 1982), row by row. A detection whose elevation in
    lidar axes is not inside `limits` (tangents, low and high) is assigned by azimuth and range alone.
    """
    # One long body: its buffers are made once for all frames, and each step would pass a dozen of them on.
    R, t = T[:3, :3], T[:3, 3]
    most = 1
    for f in range(len(radar_first) - 1):
        most = max(most, lidar_first[f + 1] - lidar_first[f])
    sph = np.empty((most, 3))
    bounce_el = np.empty(most)
    order = np.empty(most, np.int64)
    cell_of = np.empty(most, np.int64)
    cell_a, cell_r = _CELL * sigma[0], _CELL * sigma[2]
    reach_a = 1.6  # rad; no radar on a car looks further to the side
    n_a, n_r = int(2 * reach_a / cell_a) + 1, int(max_range / cell_r) + 1
    start = np.empty(n_a * n_r + 1, np.int64)
    J = np.empty((3, 8))
    motion = np.empty(4)
    for f in range(len(radar_first) - 1):
        p0, p1 = lidar_first[f], lidar_first[f + 1]
        motion[:3] = velocity[f] * tau[f]
        motion[3] = yaw_rate[f] * tau[f]
        _lidar_in_radar(
            p0, p1, R, t, lidar, plane[f], motion, has_plane[f] and bounce_prior > 0, sph, bounce_el
        )
        for n in range(p1 - p0):
            sph[n, 2] += range_bias
        _sort_into_cells(p1 - p0, sph, -reach_a, 0.0, cell_a, cell_r, n_a, n_r, start, order, cell_of)
        for k in range(radar_first[f], radar_first[f + 1], stride):
            x, y, z = radar[k, 0], radar[k, 1], radar[k, 2]
            a, e, r = _spherical(x, y, z)
            up = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
            flat = np.hypot(
                R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0], R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
            )
            tells = use_elevation[f] and limits[0] * flat < up and up < limits[1] * flat
            i0, j0 = int(np.floor((a + reach_a) / cell_a)), int(np.floor(r / cell_r))
            direct, bounced = 0.0, 0.0
            m0, m1, m2, q0, q1, q2, b0, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            bq0, bq2 = 0.0, 0.0
            for i in range(max(0, i0 - _REACH), min(n_a, i0 + _REACH + 1)):
                lo = start[i * n_r + max(0, min(n_r, j0 - _REACH))]
                hi = start[i * n_r + max(0, min(n_r, j0 + _REACH + 1))]
                for c in range(lo, hi):
                    n = order[c]
                    da, dr = (sph[n, 0] - a) / sigma[0], (sph[n, 2] - r) / sigma[2]
                    d2 = da * da + dr * dr
                    if d2 > CUT:
                        continue
                    de, db = 0.0, 0.0
                    if tells:
                        de = (sph[n, 1] - e) / sigma[1]
                        db = (bounce_el[n] - e) / sigma[1]
                    wd = (1 - bounce_prior) * np.exp(-0.5 * (d2 + de * de))
                    wb = bounce_prior * np.exp(-0.5 * (d2 + db * db)) if tells else 0.0
                    direct += wd
                    bounced += wb
                    m0 += wd * da
                    m1 += wd * de
                    m2 += wd * dr
                    q0 += wd * da * da
                    q1 += wd * de * de
                    q2 += wd * dr * dr
                    b0 += wb * da
                    b2 += wb * dr
                    bq0 += wb * da * da
                    bq2 += wb * dr * dr
            total = direct + bounced
            stats[f, 0] += np.log(total + outlier)
            stats[f, 1] += 1
            if total < 1e-6:
                continue
            gamma = total / (total + outlier)
            share = direct / total
            stats[f, 2] += gamma
            stats[f, 3] += gamma * (1 - share)
            m0, m2, q0, q2 = (m0 + b0) / total, (m2 + b2) / total, (q0 + bq0) / total, (q2 + bq2) / total
            m1, q1 = m1 / max(direct, 1e-12), q1 / max(direct, 1e-12)
            stats[f, 4] += gamma * q0
            if tells:
                stats[f, 5] += gamma * share * q1
                stats[f, 7] += gamma * share
            stats[f, 6] += gamma * q2
            _jacobian(J, x, y, z, R, t, velocity[f], yaw_rate[f], tau[f])
            for row in range(3):
                if row == 1 and not tells:
                    continue
                part = 1 if row == 1 else 0
                weight = gamma * share if row == 1 else gamma
                mean = m0 if row == 0 else (m1 if row == 1 else m2)
                square = q0 if row == 0 else (q1 if row == 1 else q2)
                known = weight * max(0.0, 1.0 - max(0.0, square - mean * mean))
                for p in range(8):
                    jp = J[row, p] / sigma[row]
                    g[part, f, p] += weight * jp * mean
                    for q in range(8):
                        jj = jp * J[row, q] / sigma[row]
                        H[part, f, p, q] += weight * jj
                        info[part, f, p, q] += known * jj
