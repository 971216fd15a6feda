"""What held-out frames say of a pose: the truth is near their own optimum, a displaced pose is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.calibrate.verify import held_out_score as held_out_score_module
from pipeline.calibrate.verify.held_out import found_elsewhere, held_out_place, held_out_update
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.target_accuracy import claims_of
from pipeline.core.config import SolveConfig
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.se3 import changed, from_spherical, inverse, rotation_angle_rad
from pipeline.rig.targets import DEFAULT_TARGETS
from tests.makers.radar_scenes import DT_S, GROUND_M, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import turned
from tests.makers.traced_scenes import DENSE, ROAD, T_TRUE, TERRAIN, traced_day

SIGMA = np.array([*np.radians([0.05] * 3), 0.02, 0.02, 0.02])
PRIOR = Prior(T_TRUE, T_LIDAR_RADAR, float(np.radians(2.0)), 0.05)
DT = {"camera_lidar": 0.0, "lidar_radar": DT_S}


def result(pair, T):
    return PairEstimate(
        pair, T, np.diag(SIGMA**2), np.ones(6), np.ones(6, bool), 50, time_offset_s=DT[pair],
        time_offset_sigma_s=0.003,
    )  # fmt: skip


def score_of(pair, T, day, prior=PRIOR):
    return held_out_score(result(pair, T), day, prior, SolveConfig())


def claims(pair, T, day):
    score, estimate = score_of(pair, T, day), result(pair, T)
    covariance = np.diag([*SIGMA**2, *score.extra_variance])
    update = held_out_update(score.derivatives, covariance, score.bias, np.arange(len(day)) // 2)
    return claims_of(pair, T, estimate.covariance, update, np.radians(0.4), 0.995)


@pytest.fixture(scope="module")
def traced():
    return traced_day(DENSE, 10, seed=7)


@pytest.fixture(scope="module")
def street():
    return street_day(16, seed=5)


def test_camera_lidar_frames_agree_with_the_truth_and_contradict_half_a_degree(traced):
    here = claims("camera_lidar", T_TRUE, traced)
    assert not any(c.is_contradicted for c in here.values())
    for axis, name in ((1, "azimuth"), (0, "elevation")):
        off = claims("camera_lidar", turned(T_TRUE, axis, 0.5), traced)[name]
        assert off.is_contradicted
        assert off.margin < here[name].margin


def test_registration_contradicts_a_degree_of_yaw_and_leaves_elevation_alone(street):
    assert not claims("lidar_radar", T_LIDAR_RADAR, street)["azimuth"].is_contradicted
    assert claims("lidar_radar", turned(T_LIDAR_RADAR, 2, 1.0), street)["azimuth"].is_contradicted
    tilted = claims("lidar_radar", turned(T_LIDAR_RADAR, 1, 2.0), street)["elevation"]
    assert tilted.shift_rad < np.radians(0.05)  # its elevations are not scored
    assert tilted.remaining_sigma_rad == pytest.approx(tilted.sigma_rad, rel=0.02)


def test_costs_compare_azimuth_and_range_of_the_radar_and_nothing_else(street):
    cost = score_of("lidar_radar", T_LIDAR_RADAR, street).cost
    best = cost(T_LIDAR_RADAR)
    np.testing.assert_allclose(cost(turned(T_LIDAR_RADAR, 1, 3.0)), best, rtol=1e-3)
    for yaw in (-1.0, 1.0):
        assert np.nanmean(cost(turned(T_LIDAR_RADAR, 2, yaw))) > np.nanmean(best)


def test_a_street_that_is_dense_nearby_does_not_prefer_a_radar_that_is_farther_back(monkeypatch):
    # Ground in even steps of elevation, detections anywhere: nothing tells where along the way they are.
    rng, day = np.random.default_rng(3), street_day(12, seed=5)
    for k, o in enumerate(day):
        ranges = -GROUND_M / np.tan(rng.uniform(0.03, 0.4, 6000))
        ground = from_spherical(np.stack([rng.uniform(-0.9, 0.9, 6000), np.zeros(6000), ranges], -1))
        ground[:, 2] = GROUND_M
        seen = np.stack([rng.uniform(6, 25, 300), rng.uniform(-5, 5, 300), np.full(300, -1.0)], -1)
        day[k] = replace(
            o, lidar_map_xyz_m=ground.astype(np.float32), lidar_map_is_ground=np.ones(6000, np.uint8),
            lidar_map_cluster=np.full(6000, -1, np.int32), radar_xyz_m=seen.astype(np.float32),
            radar_residual_mps=np.zeros(300, np.float32), radar_motion=np.zeros(300, np.uint8),
            radar_cluster=np.full(300, -1, np.int32),
        )  # fmt: skip
    back = changed(T_LIDAR_RADAR, np.r_[np.zeros(3), -0.5 * T_LIDAR_RADAR[:3, 0]])

    def preferred():
        cost = score_of("lidar_radar", T_LIDAR_RADAR, day, replace(PRIOR, T_lidar_radar=back)).cost
        return float(np.mean(cost(T_LIDAR_RADAR) - cost(back)))

    without_slope = preferred()
    monkeypatch.setattr(held_out_score_module, "_trend_along_axis", lambda T, value: 0 * value(T))
    by_value = preferred()
    assert by_value > 0.03
    assert abs(without_slope) < 0.25 * by_value


def test_camera_lidar_costs_prefer_the_truth_and_a_frame_without_points_has_none(traced):
    wrong = turned(T_TRUE, 1, 2.0)
    none = {
        name: getattr(traced[0], name)[:0]
        for name in vars(traced[0])
        if name.startswith(("lidar_edge_", "marking_"))
    }
    cost = score_of("camera_lidar", T_TRUE, [replace(traced[0], **none), *traced[1:]]).cost
    assert np.isnan(cost(T_TRUE)[0])
    assert cost(T_TRUE)[1:].sum() < cost(wrong)[1:].sum()


def on_a_square_brighter_to_the_right(day, times):
    """As many more markings, all without paint: the ground is road as far as one sees, brighter from left to right."""
    out = []
    for o in day:
        labels = cv2.imdecode(np.frombuffer(o.labels_png, np.uint8), cv2.IMREAD_GRAYSCALE)
        labels[labels == TERRAIN] = ROAD
        rising = np.broadcast_to(np.linspace(1, 255, labels.shape[1]), labels.shape)
        bright = np.where(labels == ROAD, rising, 0).astype(np.uint8)
        png = [cv2.imencode(".png", image)[1].tobytes() for image in (labels, bright)]
        marks = {name: np.repeat(getattr(o, name), times, axis=0) for name in ("marking_xyz_m", "marking_z")}
        out.append(replace(o, labels_png=png[0], road_contrast_png=png[1], **marks))
    return out


def test_markings_that_are_bright_everywhere_decide_no_comparison(traced):
    day = on_a_square_brighter_to_the_right(traced[:8], 100)
    cost = score_of("camera_lidar", T_TRUE, day, replace(PRIOR, T_camera_lidar=turned(T_TRUE, 1, 1.0))).cost
    for degrees in (-2.0, 2.0):
        assert cost(T_TRUE).sum() < cost(turned(T_TRUE, 1, degrees)).sum()


@pytest.fixture(scope="module")
def place(traced):
    """Where a search on the held-out frames alone ends."""
    return held_out_place(traced, PRIOR, SolveConfig())


def said_of(T, traced, place):
    found = result("camera_lidar", T)
    own = claims_of("camera_lidar", T, found.covariance, None, float(np.radians(0.2)), 0.995)
    sigma_rad = np.array([own[name].sigma_rad for name in ("azimuth", "elevation")])
    cost, blocks = score_of("camera_lidar", T, traced).cost, np.arange(len(traced))
    return found_elsewhere(found, place, cost, sigma_rad, blocks, DEFAULT_TARGETS, 2.33)


def test_a_right_result_is_where_the_held_out_frames_are(traced, place):
    assert np.degrees(rotation_angle_rad(place @ inverse(T_TRUE))) < 0.3
    assert said_of(T_TRUE, traced, place) == []
    assert said_of(turned(T_TRUE, 1, 0.1), traced, place) == []  # two sigmas
    assert held_out_place(traced[:2], PRIOR, SolveConfig()) is None  # frames that show nothing have no place


@pytest.mark.parametrize(("axis", "direction"), [(0, "elevation"), (1, "azimuth")])
def test_a_result_in_another_place_is_disproved_with_how_far_it_is_off(axis, direction, traced, place):
    (check,) = said_of(turned(T_TRUE, axis, 1.5), traced, place)
    assert check.disproves
    off_deg = float(check.sentence.split(f" deg in {direction}")[0].split()[-1])
    assert off_deg == pytest.approx(1.5, abs=0.2)
    assert np.degrees(np.linalg.norm(check.error[:3])) == pytest.approx(1.5, abs=0.3)
