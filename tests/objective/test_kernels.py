"""The kernel against a plain NumPy reference, and its gradient against finite differences."""

import numpy as np
import pytest

from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_se3, transform_points
from pipeline.objective.paper.cost_maps import fold_frames, frame_costs, frame_gradients, pack_quads

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


@pytest.mark.parametrize("name", CAMERAS)
def test_gradient_equals_finite_differences(name):
    camera = CAMERAS[name]
    # Only points that stay inside the image: at its rim the cost jumps to the penalty.
    p = cloud(5, 3000)[7:]
    uv, valid = camera.project(p)
    p = p[valid & camera.contains(uv, 25.0)]
    frames = fold_frames([p], [smooth_cost(6)], [camera], PENALTY)
    values, g, H = frame_gradients(frames, np.eye(4)[None])
    steps = np.array([4e-3] * 3 + [4e-2] * 3)
    up = frame_costs(frames, exp_se3(np.diag(steps)))[:, 0]
    down = frame_costs(frames, exp_se3(-np.diag(steps)))[:, 0]
    numeric = (up - down) / (2 * steps)
    scale = np.sqrt(len(p) * np.diag(H[0, 0]))
    np.testing.assert_allclose(g[0, 0] / scale, numeric / scale, atol=6e-3)
    np.testing.assert_allclose(values, frame_costs(frames, np.eye(4)[None]), rtol=1e-5)


def test_gauss_newton_matrix_is_the_sum_of_outer_products():
    camera = CAMERAS["pinhole"]
    cost = smooth_cost(7)
    p = cloud(8)[50:51]
    frames = fold_frames([p], [cost], [camera], PENALTY)
    values, g, H = frame_gradients(frames, np.eye(4)[None])
    np.testing.assert_allclose(H[0, 0], np.outer(g[0, 0], g[0, 0]) / (2 * values[0, 0]), rtol=1e-4, atol=1e-9)


def test_newton_steps_with_gradient_and_matrix_find_the_minimum():
    camera = CAMERAS["f-theta"]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    rng = np.random.default_rng(9)
    target = rng.uniform([30, 30], [WIDTH - 30, HEIGHT - 30], (12, 2))
    points = camera.unproject(target) * rng.uniform(8, 40, (12, 1))
    d2 = np.min((u[..., None] - target[:, 0]) ** 2 + (v[..., None] - target[:, 1]) ** 2, axis=-1)
    frames = fold_frames([points], [d2 / (d2 + 15.0**2)], [camera], PENALTY)
    T = exp_se3(np.array([0.01, -0.015, 0.01, 0.0, 0.0, 0.0]))
    damping = 1e-2
    for _ in range(60):
        value, g, H = frame_gradients(frames, T[None])
        step = np.linalg.solve(H[0, 0] + damping * np.diag(np.diag(H[0, 0]) + 1e-3), -g[0, 0])
        better = frame_costs(frames, (exp_se3(step) @ T)[None])[0, 0] < value[0, 0]
        T, damping = (exp_se3(step) @ T, damping / 3) if better else (T, damping * 4)
    uv, _ = camera.project(transform_points(T, points))
    assert np.abs(uv - target).max() < 0.7  # from up to 3.5 px


def test_points_out_of_view_and_behind_the_camera_cost_the_penalty():
    frames = fold_frames(
        [np.array([[0.0, 0, -5], [100.0, 0, 5], [0, 0, 0.1]])],
        [np.zeros((HEIGHT, WIDTH))],
        [CAMERAS["f-theta"]],
        2.5,
    )
    assert frame_costs(frames, np.eye(4)[None])[0, 0] == pytest.approx(
        5.0
    )  # f-theta sees what is near as well
    frames = fold_frames(
        [np.array([[0.0, 0, -5], [100.0, 0, 5], [0, 0, 0.1]])],
        [np.zeros((HEIGHT, WIDTH))],
        [CAMERAS["pinhole"]],
        2.5,
    )
    assert frame_costs(frames, np.eye(4)[None])[0, 0] == pytest.approx(7.5)


def test_quads_hold_a_pixel_and_its_three_neighbours():
    bytes_map = np.arange(12, dtype=np.uint8).reshape(3, 4)
    q = pack_quads(bytes_map)
    assert [(int(q[1, 2]) >> s) & 255 for s in (0, 8, 16, 24)] == [6, 7, 10, 11]
    assert q[2, 3] == 11


def test_a_frame_without_points_costs_nothing():
    frames = fold_frames(
        [np.zeros((0, 3)), cloud(1)], [smooth_cost(1)] * 2, [CAMERAS["pinhole"]] * 2, PENALTY
    )
    assert frame_costs(frames, poses(3))[:, 0].tolist() == [0, 0, 0]


def test_a_map_of_the_wrong_size_is_refused():
    with pytest.raises(ValueError, match="does not fit camera"):
        fold_frames([cloud(1)], [np.zeros((3, 3))], [CAMERAS["pinhole"]], PENALTY)
