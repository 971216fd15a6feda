"""How many evaluations a search needs to 0.02 deg: a differential evolution on everything against small, then descent.

Evaluations are points looked at over points of the whole objective; one of value, gradient and matrix counts as many
values as it takes time. Both searches look at the same frames through the same kernel and stop at the same place: the
objective's own optimum.

Source of scene and goal: evidence on performance, section A.3 and benchmark definition 6.
"""

import numpy as np
from scipy.optimize import differential_evolution

from pipeline.calibrate.numerics.differential_evolution import evolve
from pipeline.calibrate.paper.minimise import poses_about
from pipeline.geometry.se3 import exp_so3, log_so3
from pipeline.objective.paper.cost_maps import fold_frames, frame_costs, frame_gradients
from tests.benchmarks.kernel_workload import CAMERA, CENTRE_PX, FOCAL_PX, HEIGHT, PENALTY, WIDTH

FRAMES, POINTS, SHARE = 8, 3000, 20
BOX = np.array([np.radians(3.0)] * 3 + [0.2] * 3)
REACHED_DEG = 0.02
GRADIENT_COUNTS = 2.6  # values, test_kernel: gradient_overhead
SEEDS = 6


def make_scene():
    """Blobs in the image, points on their rims seen from the truth; a narrow cost of all, a wide one of some."""
    rng = np.random.default_rng(3)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    points, narrow, wide = [], [], []
    for _ in range(FRAMES):
        centres = rng.uniform([150, 100], [WIDTH - 150, HEIGHT - 100], (20, 2)).astype(np.float32)
        radius = rng.uniform(10, 30, 20).astype(np.float32)
        gaps = np.hypot(u[..., None] - centres[:, 0], v[..., None] - centres[:, 1]) - radius
        distance = np.abs(gaps).min(-1).astype(np.float64)  # to the nearest rim
        which, angle = rng.integers(0, 20, POINTS), rng.uniform(0, 2 * np.pi, POINTS)
        uv = centres[which] + radius[which, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        ray = np.column_stack([(uv - CENTRE_PX) / FOCAL_PX, np.ones(POINTS)])
        points.append(ray * rng.uniform(5, 40, 20)[which, None])
        for maps, width in ((narrow, 6.0), (wide, 32.0)):
            maps.append(distance**2 / (distance**2 + width**2))

    def fold(maps, step):
        return fold_frames([p[::step] for p in points], maps, [CAMERA] * FRAMES, PENALTY)

    return fold(narrow, 1), fold(wide, SHARE)


def with_prior(x, value):
    """A weak prior on the translation, as the method has it (sigma 5 cm)."""
    return value + 0.002 * np.sum((x[:, 3:] / 0.05) ** 2, axis=1)


def mean_cost(frames, x):
    return with_prior(x, frame_costs(frames, poses_about(np.eye(4), x)).sum(1) / frames.x_m.size)


def descend(frames, x, steps, target=None):
    """Levenberg-Marquardt; the point reached and the gradients looked at, fewer where a target is reached."""
    damping = 1e-3
    value, g, H = derivatives(frames, x)
    for look in range(1, steps):
        if target is not None and distance_deg(x, target) < REACHED_DEG:
            return x, look
        trial = moved(x, -np.linalg.solve(H + damping * np.diag(np.diag(H)), g))
        trial_value, trial_g, trial_H = derivatives(frames, trial)
        if trial_value < value:
            x, value, g, H, damping = trial, trial_value, trial_g, trial_H, damping / 5
        else:
            damping *= 5
    return x, steps


def derivatives(frames, x):
    """Cost with its prior, gradient, Gauss-Newton matrix."""
    value, g, H = (
        a.sum(1)[0] / frames.x_m.size for a in frame_gradients(frames, poses_about(np.eye(4), x[None]))
    )
    stiffness = 0.004 / 0.05**2 * np.array([0.0] * 3 + [1.0] * 3)
    return with_prior(x[None], value)[0], g + stiffness * x, H + np.diag(stiffness)


def moved(x, xi):
    """Parameters after a left perturbation of the pose."""
    R = exp_so3(xi[:3])
    return np.concatenate([log_so3(R @ exp_so3(x[:3])), R @ x[3:] + xi[3:]])


def distance_deg(x, target):
    return np.degrees(np.linalg.norm(log_so3(exp_so3(x[:3]) @ exp_so3(target[:3]).T)))


def paper_style(frames, target, seed):
    """Differential evolution, 90 candidates on all points, until its best is there."""
    evaluations = 0

    def cost(x):
        nonlocal evaluations
        evaluations += x.shape[1]
        return mean_cost(frames, x.T)

    found = differential_evolution(
        cost, list(zip(-BOX, BOX, strict=True)), popsize=15, maxiter=120, mutation=(0.5, 0.9), recombination=0.8,
        tol=0, polish=False, vectorized=True, updating="deferred", rng=seed,
        callback=lambda intermediate_result: distance_deg(intermediate_result.x, target) < REACHED_DEG,
    )  # fmt: skip
    return evaluations, distance_deg(found.x, target) < REACHED_DEG


def small_then_descent(narrow, few, target, seed):
    """A small evolution and a descent on one point in twenty, wide; then descent on all, narrow."""
    looked = 0

    def cost(x):
        nonlocal looked
        looked += len(x)
        return mean_cost(few, x)

    x, _ = evolve(cost, -BOX, BOX, np.random.default_rng(seed), population=30, generations=15)
    x, wide = descend(few, x, 12)
    x, narrow_looks = descend(narrow, x, 30, target)
    evaluations = (looked + GRADIENT_COUNTS * wide) / SHARE + GRADIENT_COUNTS * narrow_looks
    return evaluations, distance_deg(x, target) < REACHED_DEG


def test_small_then_descent_needs_a_sixtieth_of_the_evaluations(gate):
    narrow, few = make_scene()
    target, _ = descend(narrow, np.zeros(6), 40)
    assert distance_deg(target, np.zeros(6)) < 0.05  # the optimum is where the scene was made
    slow = [paper_style(narrow, target, seed) for seed in range(2)]
    fast = [small_then_descent(narrow, few, target, seed) for seed in range(SEEDS)]
    assert all(reached for _, reached in slow)
    assert all(reached for _, reached in fast)
    many, less = np.mean([n for n, _ in slow]), np.mean([n for n, _ in fast])
    print(f"\nevaluations to {REACHED_DEG} deg: {many:.0f} against {less:.0f}")
    gate("evaluations_vs_evolution", many / less)
