"""Ego motion between odometry messages, and none where there is none."""

import numpy as np
import pytest

from pipeline.ingest.messages.odometry import EgoTrack

START = 1_700_000_000 * 10**9


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
    assert np.isnan(track.motion_at(np.array([START]))).all()
    for t in (0.0, 0.1, 0.9):
        odometry(kit, track, t, 0.0)
    since_ns = np.array([-1, 0, 50_000_000, 100_000_000, 500_000_000, 900_000_000, 900_000_001])
    known = [False, True, True, True, False, True, False]
    assert [track.at(START + t) is not None for t in since_ns.tolist()] == known
    speed, yaw_rate = track.motion_at(START + since_ns)
    np.testing.assert_allclose(speed, np.where(known, 10 + since_ns * 1e-9, np.nan))
    np.testing.assert_allclose(yaw_rate, np.where(known, since_ns * 1e-10, np.nan), atol=1e-15)
    assert not track.add(START, kit.Kit().odometry(0, np.nan, 0, 0, 0))
