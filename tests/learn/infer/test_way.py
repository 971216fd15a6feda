"""Direction of travel beside networks: it measures a radar's pitch, and outweighs a network that contradicts it."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.learn.infer.pitch_by_travel import WayTurn, informed_by_way, updated_by_way, way_turn
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import inverse, log_se3
from schemas.calibrations import PAIRS
from tests.makers.doppler_streets import GROUND_M, T_LIDAR_RADAR, day_of, scene, turned
from tests.makers.solve_scenes import T_CAMERA_LIDAR

SIGMA = np.array([*np.radians([0.5, 0.3, 0.1]), 0.02, 0.02, 0.1])
PRIOR_COVARIANCE = np.diag([np.radians(2.0) ** 2] * 3 + [0.2**2] * 3)


def estimate_of(pair, T, sigma=SIGMA):
    covariance = np.diag(sigma**2)
    return PairEstimate(
        pair, T, covariance, np.full(6, 0.9), np.ones(6, bool), 12, common_covariance=0.25 * covariance
    )


def solution_at(T_lidar_radar, T_camera_radar, camera_lidar_sigma_deg=0.05):
    sure = np.array([*np.radians([camera_lidar_sigma_deg] * 3), 0.02, 0.02, 0.02])
    at = {"camera_lidar": T_CAMERA_LIDAR, "lidar_radar": T_lidar_radar, "camera_radar": T_camera_radar}
    sigmas = {"camera_lidar": sure, "lidar_radar": SIGMA, "camera_radar": SIGMA[[1, 2, 0, 3, 4, 5]]}
    return Solution("joint-ssl", {p: estimate_of(p, at[p], sigmas[p]) for p in PAIRS})


def prior():
    return Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.2)


def numbers(way, turn_deg, sigma_deg=0.2):
    return replace(way, turn_rad=np.radians(turn_deg), variance=np.radians(sigma_deg) ** 2, floor=0.0)


WAY = WayTurn(np.array([0.0, 1.0, 0.0]), 0.0, 1e-5, 1e-6, 40)


@pytest.fixture(scope="module")
def street():
    return day_of(3, 16, noise_deg=2.0)


@pytest.mark.parametrize("pitch_deg", [-2.0, 1.0, 2.5])
def test_the_way_alone_finds_by_how_much_a_radar_is_pitched(street, pitch_deg):
    way = way_turn(street, turned(T_LIDAR_RADAR, np.radians(pitch_deg)))
    assert abs(way.turn_rad + np.radians(pitch_deg)) < 3 * way.sigma_rad
    assert np.degrees(way.sigma_rad) < 0.4
    assert way.axis @ [0, 1, 0] > 0.99


def test_the_more_a_radar_sees_below_the_road_the_less_surely_the_way_tells_its_pitch(street):
    days = (street, day_of(3, 16, noise_deg=2.0), day_of(3, 16, noise_deg=0.5, displaced=0.4))
    plane = np.array([0.0, 0.0, 1.0, -GROUND_M])
    bare, noisy, low = (
        way_turn([replace(o, ground_plane=p) for o in day], T_LIDAR_RADAR)
        for day, p in zip(days, (None, plane, plane), strict=True)
    )
    assert noisy.floor < 1.5 * bare.floor
    assert low.floor > 4 * noisy.floor
    assert abs(low.turn_rad) < 3 * low.sigma_rad


def test_standing_cars_flat_radars_and_few_frames_change_nothing(street):
    rng = np.random.default_rng(1)
    solution = solution_at(T_LIDAR_RADAR, T_CAMERA_LIDAR @ T_LIDAR_RADAR)
    standing = [scene(rng, speed=1.0) for _ in range(8)]
    flat = [replace(o, radar_has_elevation=False) for o in street]
    for day in (standing, flat, street[:4], []):
        assert informed_by_way(solution, day, prior()) is solution


def test_one_frame_counts_by_the_usual_scatter_and_outweighs_no_network(street):
    way = way_turn(street[:1], turned(T_LIDAR_RADAR, np.radians(2.0)))
    assert abs(way.turn_rad + np.radians(2.0)) < 3 * way.sigma_rad
    assert np.degrees(way.sigma_rad) > 0.6
    solution = solution_at(turned(T_LIDAR_RADAR, np.radians(2.0)), T_CAMERA_LIDAR @ T_LIDAR_RADAR)
    every = informed_by_way(solution, street[:1], prior()).pairs
    assert every["camera_radar"] is solution.pairs["camera_radar"]
    told = every["lidar_radar"]
    moved = log_se3(told.T @ inverse(solution.pairs["lidar_radar"].T))[1]
    assert moved == pytest.approx(way.turn_rad * SIGMA[1] ** 2 / (SIGMA[1] ** 2 + way.sigma_rad**2), rel=0.01)
    assert told.covariance[1, 1] < SIGMA[1] ** 2
    assert told.notes == []


def test_a_network_whose_detections_point_wrong_gives_way_in_both_radar_pairs(street):
    wrong = turned(T_LIDAR_RADAR, np.radians(2.0))
    solution = solution_at(wrong, T_CAMERA_LIDAR @ wrong)
    told = informed_by_way(solution, street, prior()).pairs
    truth = {"lidar_radar": T_LIDAR_RADAR, "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR}
    for pair, T in truth.items():
        error = log_se3(told[pair].T @ inverse(T))[:3]
        sigma = np.sqrt(np.diag(told[pair].covariance)[:3])
        assert np.degrees(np.abs(error)).max() < 0.4
        assert np.all(np.abs(error) < 3 * sigma)
        assert "the network's answer has less weight" in told[pair].notes[0]
        np.testing.assert_allclose(told[pair].T[:3, 3], solution.pairs[pair].T[:3, 3], atol=1e-12)
    assert told["camera_lidar"] is solution.pairs["camera_lidar"]


def test_what_agrees_is_averaged_by_information_and_gets_surer():
    before = estimate_of("lidar_radar", T_LIDAR_RADAR)
    after = updated_by_way(before, numbers(WAY, 0.1), PRIOR_COVARIANCE)
    moved_deg = np.degrees(log_se3(after.T @ inverse(before.T))[1])
    assert moved_deg == pytest.approx(0.1 * 0.3**2 / (0.3**2 + 0.2**2), rel=0.05)
    sigma_deg = np.degrees(np.sqrt(after.covariance[1, 1]))
    assert sigma_deg == pytest.approx((0.3**-2 + 0.2**-2) ** -0.5, rel=0.05)
    assert after.notes == []
    assert np.array_equal(np.delete(np.diag(after.covariance)[:3], 1), np.delete(SIGMA[:3] ** 2, 1))


@pytest.mark.parametrize("turn_deg", [0.0, 0.5, 3.0])
def test_covariances_stay_covariances_and_the_common_part_stays_inside(turn_deg):
    after = updated_by_way(
        estimate_of("lidar_radar", T_LIDAR_RADAR), numbers(WAY, turn_deg), PRIOR_COVARIANCE
    )
    scale = 1 / np.sqrt(np.diag(after.covariance))
    for part in (after.covariance, after.common_covariance, after.covariance - after.common_covariance):
        assert np.linalg.eigvalsh(part * np.outer(scale, scale)).min() > -1e-9
