"""Ego motion, de-skewing and static transforms against constructions with known answers."""

from types import SimpleNamespace as Space

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.se3 import exp_se3, inverse, to_quaternion, transform_points
from pipeline.ingest.deskew import deskew, planar_motion
from pipeline.ingest.messages.odometry import EgoTrack
from pipeline.ingest.messages.transforms import TransformTree

START = 1_700_000_000 * 10**9


@settings(max_examples=25, deadline=None)
@given(st.floats(-10, 40), st.floats(-1, 1), st.integers(0, 100))
def test_a_static_world_seen_from_a_moving_car_stands_still_after_deskewing(speed, yaw_rate, seed):
    rng = np.random.default_rng(seed)
    T_vehicle_lidar = exp_se3(rng.normal(size=6) * [0.3, 0.3, 2, 1, 1, 1])
    world = rng.uniform(-50, 50, (60, 3))  # in the lidar frame at the stamp
    time = np.linspace(-0.1, 0.02, 60).astype(np.float32)
    seen = np.empty((60, 3))
    for i, t in enumerate(time.astype(float)):
        # Drive in 1000 straight steps: an arc by other means than the closed form.
        yaws = yaw_rate * t * (np.arange(1000) + 0.5) / 1000
        T = np.eye(4)
        T[:2, :2] = [
            [np.cos(yaw_rate * t), -np.sin(yaw_rate * t)],
            [np.sin(yaw_rate * t), np.cos(yaw_rate * t)],
        ]
        T[0, 3], T[1, 3] = speed * t * np.cos(yaws).mean(), speed * t * np.sin(yaws).mean()
        seen[i] = transform_points(inverse(T_vehicle_lidar) @ inverse(T) @ T_vehicle_lidar, world[i])
    still = deskew(seen.astype(np.float32), time, speed, yaw_rate, T_vehicle_lidar)
    np.testing.assert_allclose(still, world, atol=1e-4)


def test_points_at_the_stamp_stay_where_they_are():
    points = np.random.default_rng(0).uniform(-50, 50, (50, 3)).astype(np.float32)
    np.testing.assert_allclose(
        deskew(points, np.zeros(50, np.float32), 30.0, 0.5, np.eye(4)), points, atol=1e-5
    )
    assert planar_motion(np.array([0.1]), 20.0, 0.0)[1] == pytest.approx(2.0)


def odometry(kit, track, t, yaw):
    track.add(START + int(t * 1e9), kit.Kit().odometry(0, 10 * t, yaw, 10 + t, 0.1 * t))


def test_ego_motion_is_interpolated_between_messages_and_through_half_a_turn(kit):
    track = EgoTrack()
    for t in (0.2, 0.0, 0.1):  # reordered
        odometry(kit, track, t, np.pi - 0.05 + t)
    state = track.at(START + 50_000_000)
    assert state.speed_mps == pytest.approx(10.05)
    assert state.yaw_rate_radps == pytest.approx(0.005)
    np.testing.assert_allclose(state.T_odom_vehicle[:3, 3], [0.5, 0, 0], atol=1e-12)
    yaw = np.arctan2(state.T_odom_vehicle[1, 0], state.T_odom_vehicle[0, 0])
    assert abs(yaw) == pytest.approx(np.pi)
    assert track.at(START + 100_000_000).speed_mps == pytest.approx(10.1)


def test_ego_motion_is_not_made_up_outside_or_across_a_gap(kit):
    track = EgoTrack()
    assert track.at(START) is None
    for t in (0.0, 0.1, 0.9):
        odometry(kit, track, t, 0.0)
    assert track.at(START - 1) is None
    assert track.at(START + 900_000_001) is None
    assert track.at(START + 500_000_000) is None
    assert track.at(START + 50_000_000) is not None
    assert not track.add(START, kit.Kit().odometry(0, np.nan, 0, 0, 0))


def test_transforms_are_found_along_the_tree_in_both_directions():
    rng = np.random.default_rng(1)
    names = ["map", "base", "kit", "camera", "lidar", "radar", "alone", "island"]
    parents = {
        "base": "map",
        "kit": "base",
        "camera": "kit",
        "lidar": "kit",
        "radar": "base",
        "island": "alone",
    }
    T_map = {"map": np.eye(4), "alone": np.eye(4)}
    tree = TransformTree()
    for child, parent in parents.items():
        T = exp_se3(rng.normal(size=6))
        T_map[child] = T_map[parent] @ T
        assert tree.add(f"/{parent}", child, tuple(to_quaternion(T)), tuple(T[:3, 3]))
    for a in names[:6]:
        for b in names[:6]:
            np.testing.assert_allclose(tree.lookup(a, b), inverse(T_map[a]) @ T_map[b], atol=1e-12)
    assert tree.lookup("camera", "island") is None
    assert tree.lookup("camera", "nowhere") is None
    assert tree.lookup("", "camera") is None


def test_a_ring_of_transforms_ends_the_search():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.add(parent, child, (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert tree.lookup("a", "d") is None


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0)]
)
def test_what_is_no_rotation_is_not_taken(q):
    tree = TransformTree()
    assert not tree.add("a", "b", q, (0.0, 0.0, 0.0))
    assert tree.lookup("a", "b") is None
    entry = Space(
        header=Space(frame_id="a"),
        child_frame_id="b",
        transform=Space(
            rotation=Space(w=q[0], x=q[1], y=q[2], z=q[3]), translation=Space(x=0.0, y=0.0, z=0.0)
        ),
    )
    assert tree.add_message(Space(transforms=[entry])) == 1


def test_odometry_deskews_the_sweeps_of_a_log_with_its_lever_arm(kit, tmp_path, run_ingest):
    drive = kit.Kit().drive()
    for i in range(-3, 9):
        stamp = kit.START_NS + i * kit.PERIOD_NS // 2
        drive.add(kit.ODOMETRY, "nav_msgs/msg/Odometry", stamp, drive.odometry(stamp, 0.0, 0.0, 10.0, 0.2))
    result, frames = run_ingest(drive.mcap(tmp_path / "a.mcap"))
    assert "sweeps_deskewed_without_lever_arm" not in result.rejected
    columns = kit.lidar(2)
    T_vehicle_lidar = np.eye(4)
    T_vehicle_lidar[:3, 3] = 1.0, 0.0, 1.8
    as_logged = np.stack([columns[n] for n in "xyz"], -1)
    expected = deskew(as_logged, columns["time"], 10.0, 0.2, T_vehicle_lidar)
    assert frames[2].lidar_deskewed
    assert frames[2].ego_speed_mps == pytest.approx(10.0)
    assert frames[2].ego_yaw_rate_radps == pytest.approx(0.2)
    np.testing.assert_allclose(frames[2].lidar_xyz_m, expected, atol=1e-5)
    assert np.abs(expected - as_logged).max() > 0.9  # a car at 10 m/s moves a metre in a sweep

    plain = run_ingest(tmp_path / "a.mcap", fleet=kit.fleet(ingest={"deskew": False}), name="plain")[1][2]
    assert not plain.lidar_deskewed
    np.testing.assert_array_equal(plain.lidar_xyz_m, as_logged)
