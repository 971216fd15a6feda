"""The unit that costs are counted in: an objective in naive NumPy, over frames of distance maps."""

import time
from functools import cache

import numpy as np

from pipeline.rig.se3 import exp_se3

POSES, FRAMES, POINTS, WIDTH, HEIGHT, PENALTY = 90, 6, 10_000, 912, 470, 1.0
ROBUST_PX, SKY = 20.0, 1.0
FOCAL_PX, CENTRE_PX = 456.0, (455.5, 234.5)


@cache
def workload():
    """Distance maps, sky masks, points ahead and poses like those of a differential evolution on its way."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    maps = []
    for _ in range(FRAMES):
        centres = rng.uniform([0, 0], [WIDTH, HEIGHT], (25, 2)).astype(np.float32)
        distance = np.sqrt(
            ((u[..., None] - centres[:, 0]) ** 2 + (v[..., None] - centres[:, 1]) ** 2).min(-1)
        )
        maps.append((np.maximum(distance - 30, 0).astype(np.float64), (v < 150).astype(np.float64)))
    points = []
    for _ in range(FRAMES):
        angle = rng.uniform([-0.5, -0.2], [0.5, 0.2], (POINTS, 2))
        order = np.lexsort((angle[:, 0], np.round(angle[:, 1] * 100)))  # in rings, as a lidar reports them
        a = angle[order]
        points.append(
            np.stack([np.tan(a[:, 0]), np.tan(a[:, 1]), np.ones(POINTS)], -1)
            * rng.uniform(5, 80, (POINTS, 1))
        )
    T = exp_se3(rng.normal(size=(POSES, 6)) * np.array([0.02] * 3 + [0.1] * 3))
    return maps, points, T


def naive(maps, points, T):
    """What one writes first: per pose and frame, two maps, robust function at run time."""
    out = np.zeros((len(T), len(points)))
    for i, t in enumerate(T):
        for f, ((distance, sky), p) in enumerate(zip(maps, points, strict=True)):
            q = p @ t[:3, :3].T + t[:3, 3]
            z = np.maximum(q[:, 2], 0.5)
            u = FOCAL_PX * q[:, 0] / z + CENTRE_PX[0]
            v = FOCAL_PX * q[:, 1] / z + CENTRE_PX[1]
            seen = (q[:, 2] >= 0.5) & (u >= 0) & (v >= 0) & (u <= WIDTH - 1.001) & (v <= HEIGHT - 1.001)
            uc, vc = np.where(seen, u, 0.0), np.where(seen, v, 0.0)
            d = bilinear(distance, uc, vc)
            cost = d * d / (d * d + ROBUST_PX**2) + SKY * bilinear(sky, uc, vc)
            out[i, f] = np.where(seen, cost, PENALTY).sum()
    return out


def bilinear(image, u, v):
    iu, iv = u.astype(np.int64), v.astype(np.int64)
    a, b = u - iu, v - iv
    top = image[iv, iu] * (1 - a) + image[iv, iu + 1] * a
    return top * (1 - b) + (image[iv + 1, iu] * (1 - a) + image[iv + 1, iu + 1] * a) * b


def unit_s(rounds=5, poses=6):
    """CPU seconds of naive NumPy over 100,000 points on this machine now: the best of some rounds."""
    maps, points, T = workload()
    best = np.inf
    for _ in range(rounds):
        start = time.process_time()
        naive(maps, points, T[:poses])
        best = min(best, time.process_time() - start)
    return best / poses / (FRAMES * POINTS) * 1e5
