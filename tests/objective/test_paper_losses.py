"""The paper's losses: lowest near the truth, penalties where the paper wants them, the loop term."""

import numpy as np
import pytest

from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.classes import loop_loss, loop_transform
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
from pipeline.rig.se3 import exp_so3, inverse
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

TRUTH = {
    "camera_lidar": T_CAMERA_LIDAR,
    "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR,
    "lidar_radar": T_LIDAR_RADAR,
}
MARGIN_RAD = np.radians(3.0)


@pytest.fixture(scope="module")
def day():
    return make_day(16)


def loss_of(pair, observations):
    if pair == "camera_lidar":
        return camera_lidar_loss(observations, TRUTH[pair], MARGIN_RAD)
    if pair == "camera_radar":
        return camera_radar_loss(observations, TRUTH[pair], MARGIN_RAD)
    return lidar_radar_loss(observations)


def turned(T, axis, angle_deg):
    T = T.copy()
    T[:3, :3] = exp_so3(np.radians(angle_deg) * np.eye(3)[axis]) @ T[:3, :3]
    return T


@pytest.mark.parametrize("pair", TRUTH)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_every_loss_grows_when_the_pose_turns_by_two_degrees(day, pair, axis):
    loss = loss_of(pair, day)
    values = loss.frame_losses(np.stack([turned(TRUTH[pair], axis, a) for a in (-2, 0, 2)])).mean(axis=1)
    if (pair, axis) in {
        ("camera_lidar", 2),
        ("camera_radar", 2),
        ("lidar_radar", 0),
    }:  # roll: far objects hardly move
        assert values[1] <= min(values[0], values[2]) + 1e-3
    else:
        assert values[1] < 0.97 * min(values[0], values[2])


def test_drivable_iou_lies_between_0_and_1_and_falls_with_yaw(day):
    loss = lidar_radar_loss(day)
    iou = loss.drivable_iou(np.stack([turned(T_LIDAR_RADAR, 2, a) for a in (-8, -4, 0, 4, 8)])).mean(axis=1)
    assert np.all((iou > 0) & (iou < 1))
    assert iou[2] > 0.65  # the ragged rim of 1 m cells costs the rest
    assert iou[0] < iou[1] < iou[2] > iou[3] > iou[4]


def test_loop_of_consistent_transforms_costs_nothing_and_grows_with_each_angle():
    cl, lr = TRUTH["camera_lidar"], TRUTH["lidar_radar"]
    closed = loop_transform(cl, lr, cl @ lr)
    assert loop_loss(closed) == pytest.approx(0, abs=1e-12)
    angles = np.array([0.01, -0.02, 0.03])
    open_by = np.eye(4)
    open_by[:3, :3] = euler_matrix(angles)
    open_by[:3, 3] = [0.1, -0.2, 0.0]
    T_camera_radar = inverse(open_by) @ cl @ lr
    assert loop_loss(loop_transform(cl, lr, T_camera_radar)) == pytest.approx(0.06 + 0.3)


def euler_matrix(angles):
    roll, pitch, yaw = (exp_so3(a * e) for a, e in zip(angles, np.eye(3), strict=True))
    return yaw @ pitch @ roll


def test_frames_without_anything_to_compare_say_so():
    empty = make_day(
        2, radar_track_xyz_m=np.zeros((0, 3), np.float32), radar_drivable_azimuth_rad=np.zeros(0, np.float32),
        radar_drivable_range_m=np.zeros(0, np.float32), lidar_map_cluster=np.full(780, -1, np.int32),
    )  # fmt: skip
    for pair in TRUTH:
        loss = loss_of(pair, empty)
        assert not loss.informative.any()
        assert loss.frame_losses(TRUTH[pair][None]).tolist() == [[0, 0]]
