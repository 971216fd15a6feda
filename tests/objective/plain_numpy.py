"""Plain NumPy beside the room's own: central differences, and the registration of radars without compiled code."""

import numpy as np

from pipeline.objective.radar.registration import RANGE_M, VIEW_MARGIN_RAD
from pipeline.objective.radar.registration_neighbours import CUT
from pipeline.rig.se3 import inverse, to_spherical, transform_points


def central_differences(function, unknowns, h=1e-6):
    """Derivatives of a function at zero, the last axis by unknown."""
    steps = h * np.eye(unknowns)
    return np.stack([(function(step) - function(-step)) / (2 * h) for step in steps], -1)


def registration(frames, T_lidar_radar, dt_s, sigma, bounce_prior, outlier):
    """`normal_equations`, every detection against every lidar point: H, g, information [2, F, ...], cost [F]."""
    F = frames.count
    H, g, info, cost = np.zeros((2, F, 8, 8)), np.zeros((2, F, 8)), np.zeros((2, F, 8, 8)), np.zeros(F)
    for f in range(F):
        distances, wd, wb, tells = _assignments(frames, f, T_lidar_radar, dt_s, sigma, bounce_prior)
        direct, total, both = wd.sum(1), (wd + wb).sum(1), wd + wb
        cost[f] = -np.log(total + outlier).mean()
        gamma, safe = (total >= 1e-6) * total / (total + outlier), np.maximum(total, 1e-12)
        radar = frames.radar_m[frames.radar_first[f] : frames.radar_first[f + 1]]
        J = _jacobians(frames, f, T_lidar_radar, radar, frames.stamp_gap_s[f] + dt_s) / sigma[:, None]
        for row, d in enumerate(distances):
            w, n = (wd, np.maximum(direct, 1e-12)) if row == 1 else (both, safe)
            mean, square = (w * d).sum(1) / n, (w * d * d).sum(1) / n
            weight = gamma * direct / safe * tells if row == 1 else gamma
            known = weight * np.maximum(0, 1 - np.maximum(0, square - mean**2))
            part, j = int(row == 1), J[:, row]
            g[part, f] += (weight * mean) @ j
            H[part, f] += np.einsum("m,mp,mq->pq", weight, j, j)
            info[part, f] += np.einsum("m,mp,mq->pq", known, j, j)
    return H, g, info, cost


def _assignments(frames, f, T_lidar_radar, dt_s, sigma, bounce_prior):
    """Distances in sigmas (azimuth, elevation, range) and weights of all pairs, and whose elevation counts."""
    radar = frames.radar_m[frames.radar_first[f] : frames.radar_first[f + 1]]
    lidar = frames.lidar_m[frames.lidar_first[f] : frames.lidar_first[f + 1]]
    tau, plane = frames.stamp_gap_s[f] + dt_s, frames.plane[f]
    height = lidar @ plane[:3] + plane[3] if frames.has_plane[f] else np.zeros(len(lidar))
    mirrored = lidar - 2 * height[:, None] * plane[:3]
    seen, mirror = (_seen_later(frames, f, T_lidar_radar, p, tau) for p in (lidar, mirrored))
    measured, at = to_spherical(radar), transform_points(T_lidar_radar, radar)
    limits = frames.lidar_elevation_rad
    margin = VIEW_MARGIN_RAD + min(2 * sigma[1], 0.25 * (limits[1] - limits[0]))
    low, high = np.tan(np.clip(limits + np.array([margin, -margin]), -1.5, 1.5))
    over_ground = np.hypot(at[:, 0], at[:, 1])
    tells = (low * over_ground < at[:, 2]) & (at[:, 2] < high * over_ground) & frames.has_elevation[f]
    da, de, dr = ((seen[None, :, k] - measured[:, None, k]) / sigma[k] for k in range(3))
    db = (mirror[None, :, 1] - measured[:, None, 1]) / sigma[1]
    d2 = da**2 + dr**2
    reached = (d2 <= CUT) & (np.abs(seen[:, 0]) < 1.6) & (seen[:, 2] < RANGE_M[1] + 5.0)
    wd = reached * (1 - bounce_prior) * np.exp(-0.5 * (d2 + tells[:, None] * de**2))
    wb = reached * tells[:, None] * (height >= 0.3) * bounce_prior * np.exp(-0.5 * (d2 + db**2))
    return (da, de, dr), wd, wb, tells


def _seen_later(frames, f, T_lidar_radar, lidar, tau):
    """Spherical radar coordinates of standing points, tau after the lidar saw them."""
    x, y, z = transform_points(inverse(T_lidar_radar), lidar).T
    turn, shift = frames.yaw_rate_radps[f] * tau, frames.velocity_mps[f] * tau
    return to_spherical(np.stack([x + turn * y - shift[0], y - turn * x - shift[1], z - shift[2]], -1))


def _jacobians(frames, f, T_lidar_radar, radar, tau):
    """d(azimuth, elevation, range)/d(left twist of T_lidar_radar, dt, range bias) of what appears at the detections."""
    v, w = frames.velocity_mps[f], frames.yaw_rate_radps[f]
    R = T_lidar_radar[:3, :3]
    q = radar + v * tau
    x = q[:, 0] - w * tau * q[:, 1]
    q = np.stack([x, q[:, 1] + w * tau * x, q[:, 2]], -1)
    p = transform_points(T_lidar_radar, q)
    x, y, z = radar.T
    h2, r2 = x * x + y * y, (radar**2).sum(1)
    h, r, o = np.sqrt(h2), np.sqrt(r2), np.zeros_like(x)
    s = np.stack(
        [
            np.stack([-y / h2, x / h2, o], -1),
            np.stack([-x * z / (h * r2), -y * z / (h * r2), h / r2], -1),
            radar / r[:, None],
        ],
        1,
    )
    J = np.zeros((len(radar), 3, 8))
    flow = np.stack([v[0] - w * q[:, 1], v[1] + w * q[:, 0], np.full(len(q), v[2])], -1)
    J[..., 6] = -np.einsum("mrk,mk->mr", s, flow)
    first = s[..., 0] - w * tau * s[..., 1]
    u = np.stack([first, s[..., 1] + w * tau * first, s[..., 2]], -1) @ R.T
    J[..., :3], J[..., 3:6], J[:, 2, 7] = np.cross(u, p[:, None]), -u, 1.0
    return J
