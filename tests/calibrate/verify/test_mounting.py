"""The direction in the image and the mounting are two claims: the second is as good as the principal point is known."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.numerics.bias_floors import RADAR_ELEVATION_BIAS_RAD
from pipeline.calibrate.verify.target_accuracy import (
    DIRECTIONS,
    camera_turn_sigma_rad,
    claims_of,
    mounting_covariance,
)
from pipeline.core.rigs import CameraPrior, CameraTopics
from pipeline.report.day import pair_view
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.rig.targets import errors_at_targets, target_sigmas
from tests.benchmarks.studies.metrics import transform_of
from tests.calibrate.test_contradictions import records_of
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

POSES = {
    "camera_lidar": T_CAMERA_LIDAR,
    "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR,
    "lidar_radar": T_LIDAR_RADAR,
}
COVARIANCE = np.diag([*np.radians([0.03] * 3), 0.01, 0.01, 0.01]) ** 2
K = np.array([[400.0, 0, 320], [0, 500.0, 200], [0, 0, 1]])


def solution(**diagnostics):
    seen = np.ones(6, bool)
    return Solution(
        "joint",
        {
            pair: PairEstimate(pair, T, COVARIANCE, np.ones(6), seen, 40, diagnostics=diagnostics)
            for pair, T in POSES.items()
        },
    )


@pytest.mark.parametrize("pair", ["camera_lidar", "camera_radar"])
def test_a_pixel_of_the_principal_point_is_a_turn_of_the_camera(pair):
    turn = camera_turn_sigma_rad(solution(), CameraPrior(centre_sigma_px=4.0, centre_is_stated=True), K)
    assert turn == pytest.approx([4 / 500, 4 / 400])
    T = POSES[pair]
    own = target_sigmas(pair, T, COVARIANCE)
    wider = mounting_covariance(pair, T, COVARIANCE, turn)
    mounted = target_sigmas(pair, T, wider)
    bias = RADAR_ELEVATION_BIAS_RAD * (pair == "camera_radar")
    np.testing.assert_allclose(mounted, np.hypot(own, np.hypot([4 / 400, 4 / 500], [0, bias])), rtol=0.03)


@pytest.mark.parametrize("pair", ["camera_radar", "lidar_radar"])
def test_a_radars_own_elevation_error_turns_it_about_itself_and_leaves_azimuth(pair):
    T = POSES[pair]
    bent = T @ from_rotation_translation(exp_so3(np.array([0, RADAR_ELEVATION_BIAS_RAD, 0])), np.zeros(3))
    azimuth, elevation, _ = errors_at_targets(pair, bent, T)
    wider = mounting_covariance(pair, T, COVARIANCE, np.zeros(2))
    alone = target_sigmas(pair, T, wider - COVARIANCE)
    np.testing.assert_allclose(alone, [azimuth, elevation], atol=2e-5)
    assert alone[1] == pytest.approx(RADAR_ELEVATION_BIAS_RAD, rel=0.05)  # a lever arm of a metre


def test_what_the_day_measured_counts_before_what_is_stated_and_a_default_states_nothing():
    measured = solution(mounting_pitch_sigma_rad=0.002, mounting_yaw_sigma_rad=0.003)
    assert camera_turn_sigma_rad(measured, CameraPrior(), K) == pytest.approx([0.002, 0.003])
    assert camera_turn_sigma_rad(solution(), CameraPrior(), K) is None
    topics = {
        "image": "/i",
        "info": "/c",
        "semantics": {"source": "topics", "labels": "/l", "detections": "/d"},
    }
    assert not CameraTopics.model_validate(topics).known.centre_is_stated
    stated = CameraTopics.model_validate(topics | {"centre_sigma_px": 1.0}).known
    assert stated == replace(
        CameraPrior(), centre_is_stated=True
    )  # the default's number, but somebody's word


def test_where_nobody_knows_the_principal_point_the_image_is_certified_and_the_mounting_is_not():
    def claims(pair, turn):
        T = POSES[pair]
        mounting = mounting_covariance(pair, T, COVARIANCE, turn)
        return claims_of(pair, T, COVARIANCE, None, np.radians(0.2), 0.995, mounting=mounting)

    for turn, certified in ((None, False), (np.radians([0.2, 0.2]), False), (np.radians([0.01, 0.01]), True)):
        found = claims("camera_lidar", turn)
        assert [found[name].margin > 0 for name in DIRECTIONS] == [True, True]
        assert [found[name].certifies_mounting for name in DIRECTIONS] == [certified, certified]
    assert mounting_covariance("camera_lidar", T_CAMERA_LIDAR, COVARIANCE, None) is None
    # No camera stands between lidar and radar: azimuth is the mounting's, whoever knows of the principal point.
    assert claims("lidar_radar", None)["azimuth"].certifies_mounting


@pytest.fixture(scope="module")
def traced():
    return traced_day(DENSE, 40, seed=7)


@pytest.mark.slow
def test_four_pixels_are_right_in_the_image_and_certify_no_mounting(traced):
    info = traced[0].camera_K.copy()
    info[0, 2] += 4.0
    prior = Prior(T_TRUE, np.eye(4), np.radians(2), 0.05)
    record = records_of([replace(o, camera_K=info) for o in traced], prior)["camera_lidar"]
    assert (record.status, record.determined) == ("accepted", ["azimuth", "elevation"])
    found, turn = transform_of(record), exp_so3(np.array([0.0, -4 / info[0, 0], 0.0]))
    seen_through_info = from_rotation_translation(turn @ T_TRUE[:3, :3], T_TRUE[:3, 3])
    in_image = errors_at_targets("camera_lidar", found, seen_through_info)[0]
    mounted = errors_at_targets("camera_lidar", found, T_TRUE)[0]
    assert in_image < 3 * record.azimuth_sigma_rad
    assert mounted > 6 * record.azimuth_sigma_rad
    assert record.mounting_determined == []
    assert mounted < 3 * record.mounting_azimuth_sigma_rad
    np.testing.assert_array_less(np.diag(record.covariance)[:2], np.diag(record.mounting_covariance)[:2])
    assert record.diagnostics["camera_cx_px"] == info[0, 2]
    page = pair_view(record)
    assert "in the image with this CameraInfo" in page.certified
    assert page.mounting.startswith("not certified; sigma")
