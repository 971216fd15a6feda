"""Costs of folded maps against a plain NumPy reference."""

import numpy as np
import pytest

from pipeline.objective.paper.classes import fold_frames, frame_costs
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_se3

WIDTH, HEIGHT, PENALTY = 320, 200, 1.5
K = np.array([[180.0, 0, 158.3], [0, 182.0, 99.1], [0, 0, 1]])
CAMERAS = {
    "pinhole": Camera("plumb_bob", K, np.zeros(0), WIDTH, HEIGHT),
    "plumb_bob": Camera("plumb_bob", K, np.array([-0.12, 0.03, 0.002, -0.003, 0.001]), WIDTH, HEIGHT),
    "rational": Camera(
        "rational_polynomial", K, np.array([0.3, 0.05, 0.001, -0.001, 0.01, 0.5, 0.1, 0.02]), WIDTH, HEIGHT
    ),
    "f-theta": Camera("equidistant", K, np.zeros(0), WIDTH, HEIGHT),
    "kannala-brandt": Camera("equidistant", K, np.array([0.02, -0.004, 0.001, -0.0002]), WIDTH, HEIGHT),
}


def smooth_cost(seed: int) -> np.ndarray:
    """A cost map that changes over tens of pixels, between 0 and about 2."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    waves = [
        np.cos((u * np.cos(a) + v * np.sin(a)) / s + p)
        for a, s, p in rng.uniform([0, 15, 0], [6, 40, 6], (4, 3))
    ]
    return 1.0 + sum(waves) / 4


def cloud(seed: int, n: int = 400) -> np.ndarray:
    """Points ahead of the camera, most of them in view, a few behind."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.9, -0.6, 1], [0.9, 0.6, 1], (n, 3)) * rng.uniform(5, 50, (n, 1))
    points[:7, 2] *= -1
    return points


def reference_cost(points, cost, camera, T):
    """What the kernel must give: exact projection, bilinear interpolation, penalty out of view."""
    p = points @ T[:3, :3].T + T[:3, 3]
    uv, valid = camera.project(p)
    u, v = uv.T
    seen = valid & (p[:, 2] > 0.5) & (u >= 0) & (v >= 0) & (u <= WIDTH - 1) & (v <= HEIGHT - 1)
    u, v = np.where(seen, u, 0), np.where(seen, v, 0)
    iu, iv = np.minimum(u.astype(int), WIDTH - 2), np.minimum(v.astype(int), HEIGHT - 2)
    a, b = u - iu, v - iv
    value = (cost[iv, iu] * (1 - a) + cost[iv, iu + 1] * a) * (1 - b) + (
        cost[iv + 1, iu] * (1 - a) + cost[iv + 1, iu + 1] * a
    ) * b
    return np.where(seen, value, PENALTY).sum()


def poses(n: int, seed: int = 0, angle: float = 0.05, shift: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return exp_se3(rng.normal(size=(n, 6)) * np.array([angle] * 3 + [shift] * 3))


@pytest.mark.parametrize("name", CAMERAS)
def test_costs_equal_the_numpy_reference_for_every_camera_model(name):
    camera = CAMERAS[name]
    clouds, costs = [cloud(1), cloud(2, 700)], [smooth_cost(3), smooth_cost(4)]
    frames = fold_frames(clouds, costs, [camera, camera], PENALTY)
    T = poses(5)
    got = frame_costs(frames, T)
    want = np.array(
        [[reference_cost(p, c, camera, t) for p, c in zip(clouds, costs, strict=True)] for t in T]
    )
    # Bytes round by at most 1/510 of the largest cost, at random; up to three points at the rim may change
    # sides.
    np.testing.assert_allclose(got, want, atol=3 * PENALTY + 0.3)
    assert np.mean(np.abs(got - want) / frames.counts) < 3e-3


@pytest.mark.parametrize(
    ("name", "unseen"), [("f-theta", 2), ("pinhole", 3)]
)  # f-theta sees what is near as well
def test_points_out_of_view_and_behind_the_camera_cost_the_penalty(name, unseen):
    points = np.array([[0.0, 0, -5], [100.0, 0, 5], [0, 0, 0.1]])
    frames = fold_frames([points], [np.zeros((HEIGHT, WIDTH))], [CAMERAS[name]], 2.5)
    assert frame_costs(frames, np.eye(4)[None])[0, 0] == pytest.approx(2.5 * unseen)
