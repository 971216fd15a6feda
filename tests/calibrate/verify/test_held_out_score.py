"""What held-out frames say of a pose: the truth is near their own optimum, a displaced pose is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.calibrate.verify import held_out_score as held_out_score_module
from pipeline.calibrate.verify.held_out import held_out_update
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.target_accuracy import claims_of
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, log_so3
from pipeline.rig.spherical import from_spherical
from tests.makers.radar_scenes import DT_S, GROUND_M, T_LIDAR_RADAR, street_day
from tests.makers.traced_scenes import DENSE, ROAD, SPARSE, T_TRUE, TERRAIN, traced_day

SIGMA = np.array([*np.radians([0.05] * 3), 0.02, 0.02, 0.02])
LIMIT = np.radians(0.4)


def result(pair, T, dt_s):
    seen = np.ones(6, bool)
    return PairEstimate(
        pair,
        T,
        np.diag(SIGMA**2),
        seen.astype(float),
        seen,
        50,
        time_offset_s=dt_s,
        time_offset_sigma_s=0.003,
    )


def turned(T, axis, degrees):
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return from_rotation_translation(exp_so3(vector) @ T[:3, :3], T[:3, 3])


def claims(estimate, day, prior):
    score = held_out_score(estimate, day, prior, SolveConfig())
    covariance = np.diag([*SIGMA**2, *score.extra_variance])
    update = held_out_update(score.derivatives, covariance, score.bias, np.arange(len(day)) // 2)
    return claims_of(estimate.pair, estimate.T, estimate.covariance, update, LIMIT, 0.995)


@pytest.fixture(scope="module", params=[SPARSE, DENSE], ids=["16 rings", "dense"])
def traced(request):
    return traced_day(request.param, 16, seed=7)


@pytest.fixture(scope="module")
def street():
    return street_day(16, seed=5)


def test_camera_lidar_frames_agree_with_the_truth_and_contradict_half_a_degree(traced):
    prior = Prior(T_TRUE, np.eye(4), np.radians(2), 0.1)
    here = claims(result("camera_lidar", T_TRUE, 0.0), traced, prior)
    assert not any(c.is_contradicted for c in here.values())
    for axis, name in ((1, "azimuth"), (0, "elevation")):
        off = claims(result("camera_lidar", turned(T_TRUE, axis, 0.5), 0.0), traced, prior)[name]
        assert off.is_contradicted
        assert off.margin < here[name].margin


def test_registration_contradicts_a_degree_of_yaw_and_leaves_elevation_alone(street):
    prior = Prior(np.eye(4), T_LIDAR_RADAR, np.radians(2), 0.1)
    here = claims(result("lidar_radar", T_LIDAR_RADAR, DT_S), street, prior)
    assert not here["azimuth"].is_contradicted
    off = claims(result("lidar_radar", turned(T_LIDAR_RADAR, 2, 1.0), DT_S), street, prior)
    assert off["azimuth"].is_contradicted
    tilted = claims(result("lidar_radar", turned(T_LIDAR_RADAR, 1, 2.0), DT_S), street, prior)
    assert tilted["elevation"].shift_rad < np.radians(0.05)  # its elevations are not scored
    assert tilted["elevation"].remaining_sigma_rad == pytest.approx(tilted["elevation"].sigma_rad, rel=0.02)


def test_costs_compare_azimuth_and_range_of_the_radar_and_nothing_else(street):
    prior = Prior(np.eye(4), T_LIDAR_RADAR, np.radians(2), 0.1)
    score = held_out_score(result("lidar_radar", T_LIDAR_RADAR, DT_S), street, prior, SolveConfig())
    best = np.nanmean(score.cost(T_LIDAR_RADAR))
    np.testing.assert_allclose(
        score.cost(turned(T_LIDAR_RADAR, 1, 3.0)), score.cost(T_LIDAR_RADAR), rtol=1e-3
    )
    for yaw in (-1.0, 1.0):
        assert np.nanmean(score.cost(turned(T_LIDAR_RADAR, 2, yaw))) > best


def test_a_street_that_is_dense_nearby_does_not_prefer_a_radar_that_is_farther_back(monkeypatch):
    # Ground in even steps of elevation, detections anywhere: nothing tells where along the way they are.
    rng, day = np.random.default_rng(3), street_day(12, seed=5)
    for k, o in enumerate(day):
        ranges = -GROUND_M / np.tan(rng.uniform(0.03, 0.4, 6000))
        ground = from_spherical(np.stack([rng.uniform(-0.9, 0.9, 6000), np.zeros(6000), ranges], -1))
        ground[:, 2] = GROUND_M
        seen = np.stack([rng.uniform(6, 25, 300), rng.uniform(-5, 5, 300), np.full(300, -1.0)], -1)
        day[k] = replace(
            o,
            lidar_map_xyz_m=ground.astype(np.float32),
            lidar_map_is_ground=np.ones(6000, np.uint8),
            lidar_map_cluster=np.full(6000, -1, np.int32),
            radar_xyz_m=seen.astype(np.float32),
            radar_residual_mps=np.zeros(300, np.float32),
            radar_motion=np.zeros(300, np.uint8),
            radar_cluster=np.full(300, -1, np.int32),
        )
    back = from_rotation_translation(T_LIDAR_RADAR[:3, :3], T_LIDAR_RADAR[:3, 3] - 0.5 * T_LIDAR_RADAR[:3, 0])

    def preferred():
        estimate = result("lidar_radar", T_LIDAR_RADAR, DT_S)
        cost = held_out_score(estimate, day, Prior(np.eye(4), back, np.radians(2), 0.1), SolveConfig()).cost
        return float(np.mean(cost(T_LIDAR_RADAR) - cost(back)))

    without_slope = preferred()
    monkeypatch.setattr(held_out_score_module, "_trend_along_axis", lambda T, value: 0 * value(T))
    by_value = preferred()
    assert by_value > 0.03
    assert abs(without_slope) < 0.25 * by_value


def test_camera_lidar_costs_prefer_the_truth(traced):
    wrong = turned(T_TRUE, 1, 2.0)
    prior = Prior(wrong, np.eye(4), np.radians(2), 0.1)
    score = held_out_score(result("camera_lidar", T_TRUE, 0.0), traced, prior, SolveConfig())
    assert score.cost(T_TRUE).sum() < score.cost(wrong).sum()
    without_points = [replace(o, lidar_edge_xyz_m=np.zeros((0, 3), np.float32), lidar_edge_side=np.zeros(0, np.uint8),
                     lidar_edge_jump_m=np.zeros(0, np.float32), lidar_edge_gap_rad=np.zeros(0, np.float32),
                     lidar_edge_points=np.zeros(0, np.int32), marking_xyz_m=np.zeros((0, 3), np.float32),
                     marking_z=np.zeros(0, np.float32)) if i == 0 else o
             for i, o in enumerate(traced)]  # fmt: skip
    cost = held_out_score(result("camera_lidar", T_TRUE, 0.0), without_points, prior, SolveConfig()).cost(
        T_TRUE
    )
    assert np.isnan(cost[0])
    assert np.isfinite(cost[1:]).all()
    assert np.degrees(np.linalg.norm(log_so3(wrong[:3, :3] @ T_TRUE[:3, :3].T))) == pytest.approx(2.0)


def on_a_square_brighter_to_the_right(day, times):
    """As many more markings, all without paint: the ground is road as far as one sees, brighter from left to right."""
    out = []
    for o in day:
        labels = cv2.imdecode(np.frombuffer(o.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
        labels[labels == TERRAIN] = ROAD
        rising = np.broadcast_to(np.linspace(1, 255, labels.shape[1]), labels.shape)
        bright = np.where(labels == ROAD, rising, 0).astype(np.uint8)
        out.append(
            replace(
                o,
                labels_png=cv2.imencode(".png", labels)[1].tobytes(),
                road_contrast_png=cv2.imencode(".png", bright)[1].tobytes(),
                marking_xyz_m=np.repeat(o.marking_xyz_m, times, axis=0),
                marking_z=np.repeat(o.marking_z, times, axis=0),
            )
        )
    return out


def test_markings_that_are_bright_everywhere_decide_no_comparison():
    day = on_a_square_brighter_to_the_right(traced_day(DENSE, 8, seed=7), 100)
    prior = Prior(turned(T_TRUE, 1, 1.0), np.eye(4), np.radians(2), 0.1)
    cost = held_out_score(result("camera_lidar", T_TRUE, 0.0), day, prior, SolveConfig()).cost
    for degrees in (-2.0, 2.0):
        assert cost(T_TRUE).sum() < cost(turned(T_TRUE, 1, degrees)).sum()
