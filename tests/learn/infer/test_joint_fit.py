"""Pairs by all frames at once: gradients, the way to the peak, what is not told, and places that fit alike."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.joint_day import Expected, climbed, fit_of, fitted_day, scores
from pipeline.learn.infer.radar_evidence import RadarEvidence
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.rendering import FrameSensors
from pipeline.rig.se3 import (
    adjoint,
    exp_se3,
    from_spherical,
    inverse,
    log_se3,
    to_spherical,
    transform_points,
)
from schemas.training import GRID_CLASSES
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR

GRID = Grid(0.4, 38.4, 16.0, -22.4)
P = np.diag([np.radians(2.0) ** 2] * 3 + [0.2**2] * 3)
CLOCK_SIGMA_S = 0.05
CLASSES = 3


def frame(seed, T=T_CAMERA_LIDAR, objects=14):
    """Boxes of one class each in front of a background, as an image would have them, and points on both.

    The car drives at another speed in each frame.
    """
    rng = np.random.default_rng(seed)
    width, height = GRID.width, GRID.height
    likely = np.full((height, width, CLASSES), 0.05)
    likely[..., 0] = 0.9
    points, classes = [], []
    for k in range(objects):
        azimuth, elevation = rng.uniform(-34, 34), rng.uniform(-16, 10)
        half, distance, kind = rng.uniform(1, 4, 2), rng.uniform(5, 40), 1 + k % 2
        rows = (np.array([elevation + half[1], elevation - half[1]]) - GRID.top_deg) / -GRID.cell_deg
        columns = (np.array([azimuth + half[0], azimuth - half[0]]) - GRID.left_deg) / -GRID.cell_deg
        (top, bottom), (left, right) = (v.round().astype(int) for v in (rows, columns))
        box = np.s_[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        likely[box] = np.where(np.arange(CLASSES) == kind, 0.9, 0.05)
        inside = rng.uniform(-1.0, 1.0, (60, 2)) * 1.6
        angles = np.radians(np.array([azimuth, elevation]) + inside * half)
        x, y = -np.tan(angles[:, 0]), -np.tan(angles[:, 1]) / np.cos(angles[:, 0])
        points.append(np.stack([x, y, np.ones(60)], 1) * distance)
        hit = (np.abs(inside) < 1).all(1)
        classes.append(np.where(hit, kind, 0))
    seen = np.concatenate(points)
    probability = np.where(np.arange(CLASSES) == np.concatenate(classes)[:, None], 0.9, 0.05)
    travel = np.array([0.0, 0.0, rng.uniform(-0.2, 0.2), rng.uniform(2, 20), 0.0, 0.0])
    return FrameEvidence(
        GRID,
        np.log(likely).astype(np.float32),
        transform_points(inverse(T), seen).astype(np.float32),
        probability.astype(np.float32),
        np.ones(len(seen), np.float32),
        travel,
    )


def with_paint(classes, paint):
    """A frame with a second kind of evidence: what another frame shows of one class, on a map of its own."""
    none = np.full((GRID.height, GRID.width, len(GRID_CLASSES) - CLASSES), -5.0, np.float32)
    hits = paint.probability[:, 1] > 0.5
    columns = np.zeros((len(classes.points_m) + hits.sum(), len(GRID_CLASSES) + 1), np.float32)
    columns[: len(classes.points_m), :CLASSES] = classes.probability
    columns[len(classes.points_m) :, -1] = 1.0
    return FrameEvidence(
        GRID,
        np.concatenate([classes.maps, none, paint.maps[..., 1:2]], axis=2),
        np.concatenate([classes.points_m, paint.points_m[hits]]),
        columns,
        np.ones(len(columns), np.float32),
    )


# As networks list them: kernels of .9 deg, 1.5 deg, half a metre; detections that move count less.
LEARNED = {
    "log_width": np.log([0.015, 0.026, 0.5]),
    "log_floor": np.log([0.4]),
    "weigh.bias": np.array([0.8]),
}
LEARNED |= {"weigh.weight": np.array([-0.8, 0.8, -0.6])}
LEARNED = {f"core.radar_matcher.{name}": values.astype(np.float32) for name, values in LEARNED.items()}


def radar_frame(seed, T=T_LIDAR_RADAR, has_elevation=True, late_s=0.0):
    """Posts of 1 to 4 m, some detected where they stand and as far off as a radar errs, and clutter.

    The car drives at another speed in each frame; the scan is `late_s` after the sweep.
    """
    rng = np.random.default_rng(seed)
    azimuth, distance = np.radians(rng.uniform(-35, 35, 40)), rng.uniform(6, 60, 40)
    posts = from_spherical(np.stack([azimuth, np.zeros(40), distance], -1))
    objects = posts[rng.integers(0, 40, 500)] + rng.uniform([0, 0, -1.7], [0.1, 0.1, 2.0], (500, 3))
    travel = np.array([0.0, 0.0, rng.uniform(-0.2, 0.2), rng.uniform(2, 20), 0.0, 0.0])
    seen = transform_points(inverse(T) @ exp_se3(-late_s * travel), objects[rng.integers(0, 500, 120)])
    errors = rng.normal(size=(120, 3)) * [0.006, 0.012, 0.15]
    clutter = rng.uniform([5, -20, -2], [60, 20, 2], (40, 3))
    detections = np.concatenate([from_spherical(to_spherical(seen) + errors), clutter]).astype(np.float32)
    no, features = np.zeros((0, 4), np.float32), np.zeros((160, 3), np.float32)
    image = np.zeros((4, 1, 1), np.float32)
    sensors = FrameSensors(image, no[:, :3], no, detections, features, has_elevation)
    found = RadarEvidence.of(sensors, objects.astype(np.float32), LEARNED)
    return replace(found, travel=adjoint(inverse(T)) @ travel)


@pytest.fixture(scope="module")
def scans():
    return [radar_frame(seed) for seed in range(16)]


@pytest.fixture(scope="module")
def day():
    return [frame(seed) for seed in range(16)]


BLOCK = np.arange(16) // 2


def off_by(*step):
    return exp_se3(np.array(step)) @ T_CAMERA_LIDAR


def known(T):
    return Expected(T, P, CLOCK_SIGMA_S)


@pytest.mark.parametrize("kind", ["day", "scans"])
def test_the_gradient_is_the_scores_own_derivative(kind, request):
    day = request.getfixturevalue(kind)
    T = off_by(0.011, -0.007, 0.013, 0.05, -0.03, 0.08)
    T = T if kind == "day" else T @ inverse(T_CAMERA_LIDAR) @ T_LIDAR_RADAR
    _, gradient = scores(day, T, 0.01)
    for k, h in enumerate([1e-6] * 3 + [1e-5] * 3 + [1e-6]):
        step = np.zeros(7)
        step[k] = h
        ahead, behind = (scores(day, exp_se3(s[:6]) @ T, 0.01 + s[6])[0] for s in (step, -step))
        # Between cells' centres the score has corners, which single points meet.
        wrong = np.abs((ahead - behind) / (2 * h) - gradient[..., k])
        assert np.median(wrong) < 0.02 * np.abs(gradient[..., k]).max()


def test_all_frames_together_find_rotation_and_shift_from_two_degrees_away(day):
    start = off_by(*np.radians([1.2, -1.2, 1.0]), 0.12, -0.1, 0.1)
    fit = fit_of(day, BLOCK, (start, 0.0), known(start))
    error = log_se3(fit.T @ inverse(T_CAMERA_LIDAR))
    assert np.abs(np.degrees(error[:3])).max() < 0.15
    assert np.abs(error[3:5]).max() < 0.05
    sigma = np.sqrt(np.diag(np.linalg.inv(fit.information + known(start).precision)))
    assert np.abs(np.append(error, fit.dt_s) / sigma).max() < 3.5


def test_scans_together_find_the_radars_rotation_and_clock_and_one_without_elevation_leaves_those():
    """The clock of the radar is 40 ms ahead: each scan is later than its stamp says."""
    start = exp_se3(np.array([*np.radians([0.5, -1.2, 1.0]), 0.05, -0.04, 0.05])) @ T_LIDAR_RADAR
    for has_elevation in (True, False):
        scans = [radar_frame(seed, has_elevation=has_elevation, late_s=0.04) for seed in range(16)]
        fit = fit_of(scans, BLOCK, (start, 0.0), known(start))
        error = log_se3(fit.T @ inverse(T_LIDAR_RADAR))
        sigma = np.sqrt(np.diag(np.linalg.inv(fit.information + known(start).precision)))
        assert np.abs(np.append(error, fit.dt_s - 0.04) / sigma).max() < 3.5
        assert sigma[2] < np.radians(0.15)
        assert sigma[6] < 0.01
        assert (sigma[1] < np.radians(0.3)) == has_elevation


def test_frames_that_show_nothing_leave_the_prior_and_say_so(day):
    blank = [FrameEvidence(f.grid, 0 * f.maps - 1, f.points_m, f.probability, f.worth) for f in day]
    prior = off_by(0.02, 0, 0, 0, 0, 0)
    assert climbed(blank, (prior, 0.0), known(prior))[0] == pytest.approx(prior)
    found = fit_of(blank, BLOCK, (prior, 0.0), known(prior))
    assert pytest.approx(prior) == found.T
    assert not found.information.any()


def test_evidence_that_is_astray_by_scenes_weighs_little():
    """Paint of every scene is turned by another degree: the classes decide."""
    turn = np.radians(np.random.default_rng(3).normal(0, 1.0, (8, 3)))
    frames = [with_paint(frame(s), frame(s + 90, off_by(*turn[s // 2], 0, 0, 0))) for s in range(16)]
    start, before = (T_CAMERA_LIDAR, 0.0), known(T_CAMERA_LIDAR)
    found = fit_of(frames, BLOCK, start, before).T
    by_paint = climbed(frames, start, before, np.array([3.0, 300.0]))[0]
    error_deg, astray_deg = (np.degrees(log_se3(T @ inverse(T_CAMERA_LIDAR))[:3]) for T in (found, by_paint))
    assert np.linalg.norm(error_deg) < 0.06
    assert np.linalg.norm(astray_deg) > 0.2


def fitted(frames, candidates):
    before = known(off_by(*np.radians([1.0, 1.0, 0.5]), 0.05, 0.05, 0.05))
    return fitted_day("camera_lidar", lambda _: frames, BLOCK, candidates, before)


def test_a_day_whose_pilots_went_astray_comes_back_by_the_frames_that_did_not(day):
    """The mean of the pilot frames is 3 deg off; two frames of twelve had answered rightly."""
    astray = [off_by(*np.radians([0.3, 3.0, 0.0]), 0, 0, 0) for _ in range(10)]
    right = [off_by(*np.radians([0.3, -0.2, 0.1]), 0, 0, 0)] * 2
    found = fitted(day, [*astray, *right, astray[0]])
    error = np.degrees(log_se3(found.estimate().T @ inverse(T_CAMERA_LIDAR))[:3])
    assert np.abs(error).max() < 0.2
    assert found.failed == []


def test_frames_that_fit_in_two_places_alike_fail_a_check():
    """Half of the frames were taken with a camera turned by 3 deg."""
    turned = off_by(0, np.radians(3.0), 0, 0, 0, 0)
    mixed = [frame(seed, turned if seed // 2 % 2 else T_CAMERA_LIDAR) for seed in range(16)]
    found = fitted(mixed, [T_CAMERA_LIDAR, turned])
    assert any("frames disagree" in check.sentence for check in found.failed)
