"""The objectives of `joint` and of the paper's methods in plain NumPy, one pose and frame at a time.

The same terms, points and constants as `pipeline.objective`, exact camera models, float64, nothing compiled. Benchmarks
compare values (both must say the same) and CPU time.
"""

import numpy as np

from pipeline.geometry.se3 import inverse, transform_points
from pipeline.geometry.spherical import to_spherical
from pipeline.objective.camera_lidar.image_maps import CONTRAST_STEP, NO_BOUNDARY
from pipeline.objective.paper import camera_lidar, camera_radar, lidar_radar
from pipeline.objective.paper.classes import SKY, camera_at_label_size, labels_of
from pipeline.objective.radar.registration import RANGE_M, VIEW_MARGIN_RAD
from pipeline.objective.radar.registration_neighbours import CUT


def score(terms, at, settings):
    """`Terms.score`: edges and markings of each frame at each alignment [P, F]."""
    out = np.zeros((len(at.dt_s), terms.frames))
    for p, poses in enumerate(terms.poses(at).astype(np.float64)):
        for f, rows in enumerate(poses.reshape(-1, 3, 4)):
            for points, term in ((terms.edges, _edges), (terms.markings, _markings)):
                mine = slice(points.start[f], points.start[f + 1])
                uv, valid = terms.maps.camera.project(points.xyz_m[mine] @ rows[:, :3].T + rows[:, 3])
                centre = np.array(terms.maps.camera.centre_px)
                u, v = (centre + at.focal[p] * (uv - centre)).T
                out[p, f] += term(terms, points, mine, f, u, v, valid, settings)
    return out


def _edges(terms, edges, mine, f, u, v, valid, settings):
    height, width = terms.maps.labels.shape[1:]
    seen = valid & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    u, v, side, kind, gap = (
        u[seen],
        v[seen],
        edges.side[mine][seen],
        edges.kind[mine][seen],
        edges.gap_rad[mine][seen],
    )
    iu, iv = (u + 0.5).astype(int), (v + 0.5).astype(int)
    offset = terms.maps.offsets[f, side, iv, iu].astype(np.float64)
    r = offset + 0.5 + np.where(side < 2, iu - u, iv - v)
    sigma = np.hypot(settings.sigma_px, gap * terms.maps.camera.focal_px[0] / np.sqrt(12))
    match, chance = settings.match[kind], settings.chance[kind, np.minimum(np.abs(r).astype(int), 127)]
    matched = match * (2 / np.pi) / sigma / (1 + (r / sigma) ** 2) ** 2 / chance
    return np.log(1 - match + np.where(offset == NO_BOUNDARY, 0, matched)).sum() * settings.edge_weight


def _markings(terms, markings, mine, f, u, v, valid, settings):
    del markings, mine
    contrast = terms.maps.contrast[settings.contrast_level, f]
    height, width = contrast.shape
    seen = valid & (u >= 0) & (v >= 0) & (u <= width - 1.01) & (v <= height - 1.01)
    total = bilinear(contrast.astype(np.float64), u[seen], v[seen]).sum()
    return total * settings.delta * CONTRAST_STEP * settings.marking_weight


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


def registration_cost(frames, T_lidar_radar, dt_s, sigma, bounce_prior, outlier):
    """The cost [F] alone."""
    out = np.zeros(frames.count)
    for f in range(frames.count):
        _, wd, wb, _ = _assignments(frames, f, T_lidar_radar, dt_s, sigma, bounce_prior)
        out[f] = -np.log((wd + wb).sum(1) + outlier).mean()
    return out


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


def paper_losses(rows, losses):
    """The paper's three losses of these frames as functions of ONE pose, by pair; `losses` holds the prepared ones."""
    labels = [labels_of(o) for o in rows]
    cameras = [camera_at_label_size(o, m) for o, m in zip(rows, labels, strict=True)]
    objects = [camera_lidar.object_cost_map(m, c) for m, c in zip(labels, cameras, strict=True)]
    sky = [np.where(m == SKY, camera_radar.PENALTY, 0.0) for m in labels]
    cl, cr, lr = (losses[pair] for pair in ("camera_lidar", "camera_radar", "lidar_radar"))
    clusters, detections = _points_of(cl.frames), _points_of(cr.detections)
    return {
        "camera_lidar": lambda T: _map_means(clusters, objects, cameras, camera_lidar.PENALTY, T),
        "camera_radar": lambda T: (
            (_map_means(detections, sky, cameras, camera_radar.PENALTY, T) + _track_means(cr, cameras, T))
            * cr.informative
        ),
        "lidar_radar": lambda T: _lidar_radar(lr, T),
    }


def _points_of(folded):
    return np.split(folded.xyz_m.T.astype(np.float64), folded.first[1:-1])


def _map_means(points, maps, cameras, penalty, T):
    out = np.zeros(len(points))
    for f, (p, image, camera) in enumerate(zip(points, maps, cameras, strict=True)):
        if len(p):
            uv, valid = camera.project(transform_points(T, p))
            u, v = uv.T
            height, width = image.shape
            seen = valid & (u >= 0) & (v >= 0) & (u <= width - 1.001) & (v <= height - 1.001)
            value = bilinear(image, np.where(seen, u, 0), np.where(seen, v, 0))
            out[f] = np.where(seen, value, penalty).mean()
    return out


def _track_means(loss, cameras, T):
    out = np.zeros(len(cameras))
    for f, camera in enumerate(cameras):
        tracks = loss.tracks_radar[loss.track_frame == f]
        if len(tracks):
            uv, valid = camera.project(transform_points(T, tracks))
            d2 = ((uv[:, None] - loss.centres_px[f]) ** 2).sum(-1).min(1)
            scale = camera_radar.SCALE_RAD * camera.focal_px[0]
            out[f] = np.where(valid, d2 / (d2 + scale**2), 1.0).mean()
    return out


def _lidar_radar(loss, T):
    out = np.zeros(len(loss.flat))
    for f, image in enumerate(loss.radar_maps):
        cells, tracks, centres = (
            points[first[f] : first[f + 1]]
            for points, first in (
                (loss.drivable_lidar, loss.drivable_first),
                (loss.tracks_radar, loss.track_first),
                (loss.centres_lidar, loss.centre_first),
            )
        )
        if loss.lidar_area_m2[f] > 0 and loss.radar_area_m2[f] > 0:
            at = transform_points(inverse(T), cells.astype(np.float64)) / lidar_radar.CELL_M - 0.5
            v, u = at[:, 0], at[:, 1] + image.shape[1] // 2
            seen = (u >= 0) & (v >= 0) & (u < image.shape[1] - 1) & (v < image.shape[0] - 1)
            inside = np.where(seen, bilinear(image, np.where(seen, u, 0), np.where(seen, v, 0)), 0).mean()
            overlap = inside * loss.lidar_area_m2[f]
            out[f] += 1 - overlap / (loss.lidar_area_m2[f] + loss.radar_area_m2[f] - overlap)
        if len(tracks) and len(centres):
            apart = transform_points(T, tracks)[:, None] - centres
            d2 = (apart[..., : 2 if loss.flat[f] else 3] ** 2).sum(-1).min(1)
            out[f] += (d2 / (d2 + lidar_radar.SCALE_M**2)).mean()
    return out


def bilinear(image, u, v):
    iu, iv = u.astype(np.int64), v.astype(np.int64)
    a, b = u - iu, v - iv
    top = image[iv, iu] * (1 - a) + image[iv, iu + 1] * a
    return top * (1 - b) + (image[iv + 1, iu] * (1 - a) + image[iv + 1, iu + 1] * a) * b
