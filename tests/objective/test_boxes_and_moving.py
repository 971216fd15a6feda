"""Vehicle boxes and moving clusters: Jacobians, what roll and pitch owe to the bias, time, gates."""

from dataclasses import replace

import numpy as np

from pipeline.objective.radar.moving_clusters import (
    camera_azimuth_residuals,
    lidar_azimuth_residuals,
    moving_clusters,
)
from pipeline.objective.radar.vehicle_boxes import (
    BoxPairs,
    box_equations,
    box_pairs,
    elevation_residuals,
    vehicle_boxes,
)
from pipeline.rig.se3 import exp_se3, transform_points
from pipeline.rig.spherical import camera_direction_angles
from tests.makers.radar_scenes import DT_S, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

T_CAMERA_RADAR = T_CAMERA_LIDAR @ T_LIDAR_RADAR


def central_differences(residual, unknowns, h=1e-6):
    columns = []
    for k in range(unknowns):
        step = np.zeros(unknowns)
        step[k] = h
        columns.append((residual(step) - residual(-step)) / (2 * h))
    return np.stack(columns, -1)


def test_box_jacobian_agrees_with_central_differences():
    day = street_day(6)
    pairs = box_pairs(day, vehicle_boxes(day), T_CAMERA_RADAR, 0.2)
    assert pairs.count > 8
    bias = np.array([0.01, -0.01])

    def residual(step):
        return elevation_residuals(pairs, exp_se3(step[:6]) @ T_CAMERA_RADAR, bias + step[6:])[0]

    _, J = elevation_residuals(pairs, T_CAMERA_RADAR, bias)
    assert np.allclose(J, central_differences(residual, 8), atol=1e-6)


def solve_roll_and_bias(pairs):
    """Roll and bias with pitch and the rest held, as least squares from the term alone."""
    T, bias = T_CAMERA_RADAR, np.zeros(2)
    keep = [2, 6]  # the camera's optical axis
    for _ in range(8):
        H, g, _ = box_equations(pairs, T, bias, 1)
        step = np.zeros(8)
        step[keep] = -np.linalg.solve(H[0][np.ix_(keep, keep)], g[0][keep])
        T, bias = exp_se3(step[:6]) @ T, bias + step[6:]
    return T, bias


def test_roll_owes_nothing_to_the_constant_below_the_box_centre():
    rng = np.random.default_rng(0)
    n = 60
    azimuth, elevation = rng.uniform(-0.45, 0.45, n), rng.normal(0, 0.02, n)
    roll = np.radians(2.0)
    true_T = exp_se3(np.array([0, 0, roll, 0, 0, 0])) @ T_CAMERA_RADAR
    lidar = 20 * np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1
    )
    camera = transform_points(T_CAMERA_LIDAR, lidar)
    seen = camera_direction_angles(camera)
    radar = transform_points(np.linalg.inv(true_T), camera)
    rolls = []
    for bias in (0.0, np.radians(-1.0)):
        pairs = BoxPairs(radar, seen[:, 0], seen[:, 1] - bias, np.zeros(n, np.int64), np.zeros(n, np.int64))
        T, found = solve_roll_and_bias(pairs)
        rolls.append((T @ np.linalg.inv(T_CAMERA_RADAR))[1, 0])
        assert abs(found[0] - bias) < np.radians(0.03)
    assert np.allclose(rolls, np.sin(roll), atol=np.radians(0.03))


def test_a_radar_without_elevation_gives_no_boxes():
    day = street_day(3, elevation=False)
    pairs = box_pairs(day, vehicle_boxes(day), T_CAMERA_RADAR, 0.2)
    assert pairs.count == 0
    H, g, sigma = box_equations(pairs, T_CAMERA_RADAR, np.zeros(2), 3)
    assert not H.any()
    assert not g.any()
    assert np.isnan(sigma)


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
