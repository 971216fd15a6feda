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


def test_motion_of_many_stamps_is_that_of_each(kit):
    track = EgoTrack()
    unknown = np.array([START, START + 1])
    assert np.isnan(track.motion_at(unknown)).all()
    for t in (0.0, 0.1, 0.9, 1.0):
        odometry(kit, track, t, 0.0)
    stamps = START + np.array([-1, 0, 30, 100, 101, 500, 900, 950, 1000, 1001]) * 1_000_000
    speed, yaw_rate = track.motion_at(stamps)
    for stamp, v, w in zip(stamps, speed, yaw_rate, strict=True):
        state = track.at(int(stamp))
        if state is None:
            assert np.isnan([v, w]).all()
        else:
            assert (v, w) == pytest.approx((state.speed_mps, state.yaw_rate_radps))


def test_ego_motion_is_not_made_up_outside_or_across_a_gap(kit):
    track = EgoTrack()
    assert track.at(START) is None
    for t in (0.0, 0.1, 0.9):
        odometry(kit, track, t, 0.0)
    since_ns = (-1, 50_000_000, 500_000_000, 900_000_001)
    assert [track.at(START + t) is not None for t in since_ns] == [False, True, False, False]
    assert not track.add(START, kit.Kit().odometry(0, np.nan, 0, 0, 0))
