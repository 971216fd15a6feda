"""What may be claimed at the targets: where they lie, laws, coverage, held-out updates, image and mounting."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from pipeline.calibrate.numerics.nuisances import RADAR_ELEVATION_BIAS_RAD
from pipeline.calibrate.verify.held_out import held_out_update
from pipeline.calibrate.verify.target_accuracy import (
    DIRECTIONS,
    Claim,
    camera_turn_sigma_rad,
    claims_of,
    mounting_covariance,
    seen_targets,
    target_jacobian,
    unseen_failure,
    views_of,
)
from pipeline.core.rigs import CameraPrior, CameraTopics
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_se3, from_spherical, inverse, to_spherical, transform_points
from pipeline.rig.targets import DEFAULT_TARGETS, errors_at_targets, target_sigmas
from schemas.calibrations import PAIRS
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.radar_scenes import street_day
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, TRUTH

SIGMA = np.array([*np.radians([0.05] * 3), 0.02, 0.02, 0.02])


@pytest.mark.parametrize("pair", TRUTH)
def test_the_jacobian_predicts_the_errors_at_the_targets(pair):
    rng = np.random.default_rng(0)
    J = target_jacobian(pair, TRUTH[pair])
    for _ in range(5):
        xi = rng.normal(size=6) * 1e-3
        found = errors_at_targets(pair, exp_se3(xi) @ TRUTH[pair], TRUTH[pair])
        np.testing.assert_allclose(np.abs(J @ xi).mean(axis=1), found[:2], atol=2e-5)


def test_the_bound_is_the_quantile_of_the_absolute_error():
    for shift, confidence in ((0.0, 0.995), (0.05, 0.995), (1.0, 0.995), (0.02, 0.9)):
        bound = Claim(0.1, shift, 1e-3, 9.0, 0.2, confidence).bound_rad
        inside = norm.cdf(bound, shift, 0.1) - norm.cdf(-bound, shift, 0.1)
        assert inside == pytest.approx(confidence, abs=1e-9)


def test_the_own_sigma_decides_until_held_out_frames_contradict_it():
    agreed = Claim(0.05, 0.1, 0.05, 0.045, 0.2, 0.995)
    assert agreed.bound_rad == pytest.approx(0.05 * norm.ppf(0.9975))
    contradicted = Claim(0.05, 0.1, 0.03, 0.045, 0.2, 0.995)
    assert contradicted.is_contradicted
    assert contradicted.bound_rad > 0.2 > agreed.bound_rad


def quadratic_frames(truth, blocks, rng, scatter=1.0, information=400.0):
    """Log likelihoods of frames with a common optimum near `truth` (steps of 6, dt, nuisance), by block."""
    F = len(blocks)
    scale = np.array([*np.radians([0.3] * 3), 0.1, 0.1, 0.1, 0.01, 0.003])
    H = np.broadcast_to(np.diag(information / scale**2) / F, (F, 8, 8))
    shared = rng.normal(size=(blocks.max() + 1, 8)) * scatter * np.sqrt(information / (blocks.max() + 1))
    noise = shared[blocks] / np.bincount(blocks)[blocks][:, None] / scale

    def derivatives(step, width):
        del width
        return noise - np.einsum("fij,j->fi", H, step - truth), H

    return derivatives


COVARIANCE = np.diag([*SIGMA**2, 0.005**2, 0.003**2])
BIAS = np.zeros(8)


def updates(count, scatter=1.0, off=0.0, blocks=12):
    """Held-out updates of results whose errors are as their covariance says, and then `off` [rad] more in yaw."""
    rng = np.random.default_rng(3)
    block = np.repeat(np.arange(blocks), 3)
    for _ in range(count):
        error = rng.normal(size=8) * np.sqrt(np.diag(COVARIANCE)) + off * np.eye(8)[2]
        found = held_out_update(quadratic_frames(-error, block, rng, scatter), COVARIANCE, BIAS, block)
        yield error, found


@pytest.mark.parametrize("scatter", [1.0, 4.0])
def test_a_held_out_update_is_right_about_its_own_sigma_however_much_scenes_scatter(scatter):
    remaining, shifts = [], []
    for error, found in updates(150, scatter):
        remaining.append((error[:6] + found.shift)[2] / np.sqrt(found.covariance[2, 2]))
        shifts.append(found.shift[2] / np.sqrt(found.shift_covariance[2, 2]))
    assert 0.75 < np.std(remaining) < 1.15
    assert 0.75 < np.std(shifts) < 1.2
    assert np.mean(np.abs(shifts) > 3) < 0.03


def test_frames_that_say_nothing_change_nothing_and_two_scenes_are_too_few():
    rng = np.random.default_rng(0)
    block = np.repeat(np.arange(6), 2)
    silent = quadratic_frames(np.zeros(8), block, rng, information=1e-6)
    found = held_out_update(silent, COVARIANCE, BIAS, block)
    np.testing.assert_allclose(found.covariance, COVARIANCE[:6, :6], rtol=1e-3)
    assert np.all(np.abs(found.shift) < 1e-3 * SIGMA)
    two = np.repeat([0, 1], 6)
    assert held_out_update(quadratic_frames(np.zeros(8), two, rng), COVARIANCE, BIAS, two) is None


def test_held_out_frames_make_nothing_surer_than_their_own_bias():
    rng = np.random.default_rng(1)
    block = np.repeat(np.arange(12), 3)
    bias = np.array([0, 0, np.radians(0.2), 0, 0, 0, 0, 0])
    wide = COVARIANCE * 100
    found = held_out_update(quadratic_frames(np.zeros(8), block, rng, information=1e6), wide, bias, block)
    claim = claims_of("lidar_radar", np.eye(4), wide[:6, :6], found, np.radians(0.4), 0.995)["azimuth"]
    assert np.degrees(claim.remaining_sigma_rad) == pytest.approx(0.2, abs=0.02)
    sharp = COVARIANCE / 100
    found = held_out_update(quadratic_frames(np.zeros(8), block, rng), sharp, bias, block)
    claim = claims_of("lidar_radar", np.eye(4), sharp[:6, :6], found, np.radians(0.4), 0.995)["azimuth"]
    assert claim.remaining_sigma_rad == claim.sigma_rad  # and nothing less sure than it was


ANGLES_DEG = np.degrees(to_spherical(DEFAULT_TARGETS)[:, :2])

# About the lidar's own axes: roll, pitch and yaw of .3, .1 and .05 deg, some centimetres.
OF_LIDAR = np.diag([*np.radians([0.3, 0.1, 0.05]), 0.03, 0.02, 0.05]) ** 2


def turn(degrees):
    return exp_se3(np.radians(degrees) * np.eye(6)[2])


def around(azimuths_deg, elevations_deg=(-20.0, 10.0), seed=0):
    """Points of a sensor that sees these azimuths."""
    rng, n = np.random.default_rng(seed), 4000
    angles = np.radians([rng.uniform(*azimuths_deg, n), rng.uniform(*elevations_deg, n)])
    return from_spherical(np.column_stack([*angles, np.full(n, 20.0)])).astype(np.float32)


def day(lidar=(-180.0, 180.0), radar=(-50.0, 50.0)):
    columns = {"lidar_map_xyz_m": around(lidar), "radar_xyz_m": around(radar, (-5.0, 5.0), 1)}
    return [replace(o, **columns) for o in street_day(3)]


def prior(T_camera_lidar=T_CAMERA_LIDAR, T_lidar_radar=T_LIDAR_RADAR):
    return Prior(T_camera_lidar, T_lidar_radar, np.radians(2.0), 0.05)


@pytest.mark.parametrize("pair", PAIRS)
def test_before_a_trio_that_looks_ahead_targets_are_where_they_were(pair):
    targets = seen_targets(pair, prior(), views_of(day()))
    found = to_spherical(targets)
    np.testing.assert_allclose(np.degrees(found[:, :2]), ANGLES_DEG, atol=3.0)
    np.testing.assert_allclose(found[:, 2], [15, 25, 40])


@pytest.mark.parametrize("degrees", [90, -90, 140])
def test_a_rig_turned_on_its_lidar_has_the_same_sigmas(degrees):
    """Camera and radar look to the left; what is known of the scene about the car turns with them."""
    R = turn(degrees)
    turned = prior(T_CAMERA_LIDAR @ inverse(R), R @ T_LIDAR_RADAR)
    views = views_of(day())
    for pair in PAIRS:
        ahead, aside = (seen_targets(pair, p, views) for p in (prior(), turned))
        expected = transform_points(R, ahead) if pair == "camera_lidar" else ahead
        np.testing.assert_allclose(aside, expected, atol=0.05)
        # A left perturbation turns with the parent, which is the lidar itself where the radar is its child.
        C = OF_LIDAR
        if pair == "lidar_radar":
            A = np.kron(np.eye(2), R[:3, :3])
            C = A @ OF_LIDAR @ A.T
        np.testing.assert_allclose(
            target_sigmas(pair, turned.of(pair), C, aside),
            target_sigmas(pair, prior().of(pair), OF_LIDAR, ahead),
            rtol=0.01,
        )


def test_targets_stay_in_the_view_of_the_narrower_sensor():
    views = views_of(day(lidar=(20.0, 34.0)))
    targets = seen_targets("camera_lidar", prior(), views)
    azimuths_deg = np.degrees(to_spherical(targets)[:, 0])
    assert ((azimuths_deg > 19) & (azimuths_deg < 35)).all()
    assert views["lidar"](targets).all()
    uv, valid = CAMERA.project(transform_points(T_CAMERA_LIDAR, targets))
    assert valid.all()
    assert CAMERA.contains(uv).all()


def test_sensors_that_look_apart_have_no_targets_and_the_check_says_so():
    behind = prior(T_CAMERA_LIDAR @ inverse(turn(180)))
    views = views_of(day())
    assert seen_targets("camera_radar", behind, views) is None
    assert seen_targets("camera_lidar", behind, views) is not None
    assert "camera and radar see no direction in common" in unseen_failure("camera_radar").sentence


OF_POSE = np.diag([*np.radians([0.03] * 3), 0.01, 0.01, 0.01]) ** 2
K = np.array([[400.0, 0, 320], [0, 500.0, 200], [0, 0, 1]])


def solution(**diagnostics):
    known = (OF_POSE, np.ones(6), np.ones(6, bool), 40)
    pairs = {p: PairEstimate(p, T, *known, diagnostics=diagnostics) for p, T in TRUTH.items()}
    return Solution("joint", pairs)


@pytest.mark.parametrize("pair", ["camera_lidar", "camera_radar"])
def test_a_pixel_of_the_principal_point_is_a_turn_of_the_camera(pair):
    turn = camera_turn_sigma_rad(solution(), CameraPrior(centre_sigma_px=4.0, centre_is_stated=True), K)
    assert turn == pytest.approx([4 / 500, 4 / 400])
    T = TRUTH[pair]
    own = target_sigmas(pair, T, OF_POSE)
    mounted = target_sigmas(pair, T, mounting_covariance(pair, T, OF_POSE, turn))
    bias = RADAR_ELEVATION_BIAS_RAD * (pair == "camera_radar")
    np.testing.assert_allclose(mounted, np.hypot(own, np.hypot([4 / 400, 4 / 500], [0, bias])), rtol=0.03)


@pytest.mark.parametrize("pair", ["camera_radar", "lidar_radar"])
def test_a_radars_own_elevation_error_turns_it_about_itself_and_leaves_azimuth(pair):
    T = TRUTH[pair]
    bent = T @ exp_se3(RADAR_ELEVATION_BIAS_RAD * np.eye(6)[1])
    azimuth, elevation, _ = errors_at_targets(pair, bent, T)
    wider = mounting_covariance(pair, T, OF_POSE, np.zeros(2))
    alone = target_sigmas(pair, T, wider - OF_POSE)
    np.testing.assert_allclose(alone, [azimuth, elevation], atol=2e-5)
    assert alone[1] == pytest.approx(RADAR_ELEVATION_BIAS_RAD, rel=0.05)  # a lever arm of a metre


def test_what_the_day_measured_counts_before_what_is_stated_and_a_default_states_nothing():
    measured = solution(mounting_pitch_sigma_rad=0.002, mounting_yaw_sigma_rad=0.003)
    assert camera_turn_sigma_rad(measured, CameraPrior(), K) == pytest.approx([0.002, 0.003])
    assert camera_turn_sigma_rad(solution(), CameraPrior(), K) is None
    topics = THREE_SENSORS["camera"]
    assert not CameraTopics.model_validate(topics).known.centre_is_stated
    stated = CameraTopics.model_validate(topics | {"centre_sigma_px": 1.0}).known
    # The default's number, but somebody's word.
    assert stated == replace(CameraPrior(), centre_is_stated=True)


def test_where_nobody_knows_the_principal_point_the_image_is_certified_and_the_mounting_is_not():
    def claims(pair, turn):
        T = TRUTH[pair]
        mounting = mounting_covariance(pair, T, OF_POSE, turn)
        return claims_of(pair, T, OF_POSE, None, np.radians(0.2), 0.995, mounting=mounting)

    for turn, certified in ((None, False), (np.radians([0.2, 0.2]), False), (np.radians([0.01, 0.01]), True)):
        found = claims("camera_lidar", turn)
        assert [found[name].margin > 0 for name in DIRECTIONS] == [True, True]
        assert [found[name].certifies_mounting for name in DIRECTIONS] == [certified, certified]
    assert mounting_covariance("camera_lidar", T_CAMERA_LIDAR, OF_POSE, None) is None
    # No camera stands between lidar and radar: azimuth is the mounting's, whoever knows of the principal point.
    assert claims("lidar_radar", None)["azimuth"].certifies_mounting
