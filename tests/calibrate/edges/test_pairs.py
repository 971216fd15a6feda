"""Evidence of camera-lidar, lidar-radar and camera-radar, of two sensors each, as the adjustment takes it."""

import numpy as np
import pytest

from pipeline.calibrate.adjust.adjusted import AdjustmentLimits
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.adjust.three import EDGES, LIDAR, poses_of, three_sensors
from pipeline.calibrate.edges.pairs import PAIR_ESTIMATORS, camera_radar_evidence, pair_prior
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import log_so3, perturb_exactly
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

CONFIG = SolveConfig()


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    T = [perturb_exactly(T, np.radians(2.0), 0.05, rng) for T in (T_CAMERA_LIDAR, T_LIDAR_RADAR)]
    return poses_of(Prior(*T, float(np.radians(2.0)), 0.05), {})


def evidence(poses, kind, **changes):
    prior = pair_prior(poses, EDGES[kind])
    return PAIR_ESTIMATORS[kind](
        street_day(20), EDGES[kind], prior, CONFIG, np.random.default_rng(1), **changes
    )


def test_a_pairs_prior_is_that_of_the_rig_between_its_sensors(poses):
    prior = pair_prior(poses, EDGES["lidar_radar"])
    np.testing.assert_allclose(prior.T_lidar_radar, poses.T["radar"])
    assert prior.rotation_sigma_rad == pytest.approx(np.radians(2.0), rel=1e-6)
    assert prior.translation_sigma_m == pytest.approx(0.05, rel=1e-6)
    assert not prior.knows("camera_lidar")
    both = pair_prior(poses, EDGES["camera_radar"])
    np.testing.assert_allclose(both.T_camera_radar, poses.between("camera", "radar"))
    assert both.rotation_sigma_rad == pytest.approx(np.radians(2.0) * np.sqrt(2), rel=1e-6)


def test_a_radar_finds_its_yaw_on_the_lidar_by_their_edge_alone(poses):
    found = evidence(poses, "lidar_radar")
    assert found.checks == ()
    rig = adjust(three_sensors(["lidar_radar"]), poses, [found], AdjustmentLimits(CONFIG.time_offset_sigma_s))
    error = log_so3(T_LIDAR_RADAR[:3, :3].T @ rig.poses.T["radar"][:3, :3])
    assert abs(error[2]) < 4 * np.sqrt(rig.poses.covariance_between("lidar", "radar")[2, 2])
    assert rig.sensors["radar"].determined[2]
    assert rig.sensors["camera"].untied == "shares nothing with another sensor"
    assert rig.poses.reference == LIDAR


def test_camera_radar_without_boxes_says_nothing_of_pitch_and_roll(poses):
    found = camera_radar_evidence(
        street_day(5), EDGES["camera_radar"], pair_prior(poses, EDGES["camera_radar"]), CONFIG,
        np.random.default_rng(1), boxes=False,
    )  # fmt: skip
    prior = 1 / (2 * np.radians(2.0) ** 2)
    assert np.diag(found.information)[[0, 2]].max() < 0.1 * prior
    assert found.information[1, 1] > 10 * prior
