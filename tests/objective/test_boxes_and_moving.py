"""Vehicle boxes and moving clusters: Jacobians, what roll and pitch owe to the bias, time, gates."""

from dataclasses import replace

import numpy as np

from pipeline.objective.radar.moving_clusters import (
    camera_azimuth_residuals,
    lidar_azimuth_residuals,
    moving_clusters,
)
from pipeline.objective.radar.vehicle_boxes import box_pairs, elevation_residuals, vehicle_boxes
from pipeline.rig.se3 import exp_se3
from tests.makers.radar_scenes import DT_S, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR
from tests.objective.plain_numpy import central_differences

T_CAMERA_RADAR = T_CAMERA_LIDAR @ T_LIDAR_RADAR


def test_box_jacobian_agrees_with_central_differences():
    day = street_day(6)
    pairs = box_pairs(vehicle_boxes(day), T_CAMERA_RADAR, 0.2)
    assert pairs.count > 8
    bias = np.array([0.01, -0.01])

    def residual(step):
        return elevation_residuals(pairs, exp_se3(step[:6]) @ T_CAMERA_RADAR, bias + step[6:])[0]

    _, J = elevation_residuals(pairs, T_CAMERA_RADAR, bias)
    assert np.allclose(J, central_differences(residual, 8), atol=1e-6)


def test_boxes_behind_a_nearer_one_are_left_out():
    day = street_day(1)
    boxes = np.array([[200, 100, 300, 180], [220, 120, 330, 230]], np.float32)
    o = replace(
        day[0],
        road_user_boxes_px=boxes,
        road_user_classes=["car", "car"],
        road_user_scores=np.ones(2, np.float32),
    )
    assert len(vehicle_boxes([o]).kind) == 1


def test_azimuth_jacobians_agree_with_central_differences():
    clusters = moving_clusters(street_day(6))

    def against_lidar(step):
        return lidar_azimuth_residuals(clusters, exp_se3(step) @ T_LIDAR_RADAR, DT_S)[0]

    def against_camera(step):
        return camera_azimuth_residuals(clusters, exp_se3(step) @ T_CAMERA_RADAR, 0.1)[0]

    _, J, _ = lidar_azimuth_residuals(clusters, T_LIDAR_RADAR, DT_S)
    assert len(J) > 8
    assert np.allclose(J, central_differences(against_lidar, 6), atol=1e-6)
    _, J, _ = camera_azimuth_residuals(clusters, T_CAMERA_RADAR, 0.1)
    assert len(J) > 8
    assert np.allclose(J, central_differences(against_camera, 6), atol=1e-6)


def test_in_a_turn_clusters_are_turned_back_to_when_sweep_and_image_were_taken():
    day = [
        replace(o, ego_yaw_rate_radps=0.5, radar_stamp_ns=o.stamp_ns + (k - 3) * 10_000_000)
        for k, o in enumerate(street_day(7))
    ]
    still = replace(moving_clusters(day), relative_mps=np.zeros((moving_clusters(day).count, 3)))
    azimuth = np.arctan2(still.point_radar_m[:, 1], still.point_radar_m[:, 0])
    # The scan came later: by then the car had turned to the left, and what stands to the right.
    for earlier, by_s in (
        (still.at_lidar_time(0.02), 0.02 + 0.01 * (still.frame - 3)),
        (still.at_image_time(), 0.01 * (still.frame - 3)),
    ):
        np.testing.assert_allclose(np.arctan2(earlier[:, 1], earlier[:, 0]) - azimuth, 0.5 * by_s, atol=1e-9)
        np.testing.assert_allclose(
            np.linalg.norm(earlier, axis=1), np.linalg.norm(still.point_radar_m, axis=1)
        )
