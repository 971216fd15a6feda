"""De-skewing against motions integrated by other means, and in a log with a lever arm."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ingest.captures import deskew
from pipeline.rig.se3 import exp_se3, inverse, transform_points


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


def test_odometry_deskews_the_sweeps_of_a_log_with_its_lever_arm(kit, tmp_path, run_ingest):
    result, frames = run_ingest(kit.Kit().drive().driven(10.0, 0.2).mcap(tmp_path / "a.mcap"))
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
