"""What the kernel's benchmarks run on: a population's worth of poses over frames of distance maps, and references.

Source: evidence on performance, section A.1 and benchmark definitions 1 to 6.
"""

import time
from functools import cache

import numba
import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_se3
from pipeline.objective.paper.cost_maps import fold_frames
from tests.benchmarks.numpy_objectives import bilinear

POSES, FRAMES, POINTS, WIDTH, HEIGHT, PENALTY = 90, 6, 10_000, 912, 470, 1.0
ROBUST_PX, SKY = 20.0, 1.0
FOCAL_PX, CENTRE_PX = 456.0, (455.5, 234.5)
CAMERA = Camera(
    "plumb_bob",
    np.array([[FOCAL_PX, 0, CENTRE_PX[0]], [0, FOCAL_PX, CENTRE_PX[1]], [0, 0, 1]]),
    np.zeros(0),
    WIDTH,
    HEIGHT,
)


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
    costs = [d * d / (d * d + ROBUST_PX**2) + SKY * s for d, s in maps]
    return maps, points, fold_frames(points, costs, [CAMERA] * FRAMES, PENALTY), T


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


def naive_cpu_s(rounds=5, poses=6):
    """CPU seconds of the naive cost of one pose, all frames: the unit that slower things are counted in."""
    maps, points, _, T = workload()
    return best_cpu_s(rounds, lambda: naive(maps, points, T[:poses]))[0] / poses


@numba.njit(fastmath=True, error_model="numpy")
def arithmetic_and_gather(poses, xs, ys, zs, words, focal, cu, cv, width, out):
    """The least that a point costs: projection and one load at the pixel, neither clipped nor interpolated.

    Points are taken where they are in view at every pose.
    """
    f4 = np.float32
    mask = np.uint32(0x7FFFFFFF)
    for p in range(len(poses)):
        t = poses[p]
        total = np.int32(0)
        for i in range(len(xs)):
            z = t[8] * xs[i] + t[9] * ys[i] + t[10] * zs[i] + t[11]
            iz = f4(1) / z
            u = (t[0] * xs[i] + t[1] * ys[i] + t[2] * zs[i] + t[3]) * iz * focal + cu
            v = (t[4] * xs[i] + t[5] * ys[i] + t[6] * zs[i] + t[7]) * iz * focal + cv
            total += np.int32(
                words[np.uint32(np.uint32(np.int32(v) * width + np.int32(u)) & mask)] & np.uint32(255)
            )
        out[p] = total


def best_cpu_s(rounds, *functions):
    """Best CPU time of each function over interleaved rounds."""
    best = [np.inf] * len(functions)
    for _ in range(rounds):
        for k, function in enumerate(functions):
            start = time.process_time()
            function()
            best[k] = min(best[k], time.process_time() - start)
    return best
