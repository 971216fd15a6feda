"""Tracks of moving clusters: true velocities through aliased Doppler, identities, gaps and drives."""

import numpy as np
import pytest

from pipeline.perceive.tracks import ClusterReturns, EgoMotion, TrackState, advance_tracks, measure_clusters

PERIOD_MPS = 10.394


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


class World:
    """Road users at constant velocity over ground, and what a radar that drives an arc sees of them when."""

    def __init__(self, users, speed=12.0, yaw_rate=0.0, period=PERIOD_MPS, noise=0.15, seed=0):
        self.users, self.speed, self.yaw_rate, self.period, self.noise = users, speed, yaw_rate, period, noise
        self.rng = np.random.default_rng(seed)

    def pose(self, t):
        if self.yaw_rate == 0:
            return 0.0, np.array([self.speed * t, 0.0])
        heading = self.yaw_rate * t
        return heading, self.speed / self.yaw_rate * np.array([np.sin(heading), 1 - np.cos(heading)])

    def truth(self, t):
        heading, origin = self.pose(t)
        back = rotation(-heading)
        return [(back @ (np.add(p, np.multiply(v, t)) - origin), back @ np.array(v)) for p, v in self.users]

    def returns(self, t):
        centre, rate = [], []
        for position, velocity in self.truth(t):
            seen = position + self.rng.normal(0, self.noise, 2)
            u = seen / np.linalg.norm(seen)
            centre.append([*seen, 0.3])
            rate.append(u @ velocity + self.rng.normal(0, 0.1))
        rate = np.array(rate)
        if self.period:
            rate -= self.period * np.round(rate / self.period)
        count = np.full(len(rate), 5, np.int32)
        return ClusterReturns(np.array(centre, np.float32).reshape(-1, 3), rate.astype(np.float32), count)

    def follow(self, times, drives=None, ego_known=True):
        state, found = TrackState(), []
        for i, t in enumerate(times):
            ego = EgoMotion((self.speed, 0.0) if ego_known else None, self.yaw_rate)
            drive = 0 if drives is None else drives[i]
            state, tracks = advance_tracks(state, int(t * 1e9), drive, ego, self.returns(t), self.period)
            found.append(tracks)
        return found


USERS = [
    ([40.0, 3.0], [-13.0, 0.2]), ([18.0, -0.5], [11.0, 0.0]), ([30.0, -8.0], [-0.5, 1.6]),
    ([25.0, 12.0], [4.0, -6.0]),
]  # fmt: skip


@pytest.mark.parametrize("period", [PERIOD_MPS, None])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.25])
def test_velocities_over_ground_are_found_whatever_the_doppler_wrap(period, yaw_rate):
    world = World(USERS, yaw_rate=yaw_rate, period=period)
    times = np.arange(0, 1.6, 0.2)
    last = world.follow(times)[-1]
    for k, (_, velocity) in enumerate(world.truth(times[-1])):
        assert last.velocity_mps[k, :2] == pytest.approx(velocity, abs=1.0)


@pytest.mark.parametrize("step_s", [0.1, 0.3, 0.6, 1.2])
def test_each_road_user_keeps_one_identity(step_s):
    users = [([60.0, 3.0], [-9.0, 0.0]), ([18.0, -0.5], [11.0, 0.0]), ([30.0, -9.0], [8.0, 0.0])]
    found = World(users, speed=10.0).follow(np.arange(0, 5 * step_s, step_s))
    assert np.unique([t.identity for t in found], axis=0).shape == (1, 3)
    assert found[-1].age.tolist() == [5, 5, 5]


@pytest.mark.parametrize(
    ("times", "drives", "ego_known"),
    [
        ([0.0, 0.2, 3.0], [0, 0, 0], True), ([0.0, 0.2, 0.4], [0, 0, 1], True),
        ([0.0, 0.2, 0.1], [0, 0, 0], True), ([0.0, 0.1, 0.2], [0, 0, 0], False),
    ],
    ids=["gap", "new drive", "clock jumps back", "no ego velocity"],
)  # fmt: skip
def test_what_cannot_be_linked_starts_new_identities(times, drives, ego_known):
    found = World(USERS).follow(times, drives, ego_known)
    first, second, third = (t.identity.tolist() for t in found)
    assert (first == second) is ego_known
    assert len({*second, *third}) == 8
    assert found[2].age.tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize(("period", "rate"), [(PERIOD_MPS, PERIOD_MPS / 2), (None, 0.0)])
def test_cluster_rates_are_averaged_on_the_circle_of_the_period(period, rate):
    xyz = np.array([[10, 0, 0], [10, 1, 0], [30, 0, 0]], np.float32)
    residual = np.array([5.1, -5.1, 2.0], np.float32)  # 5.1 and -5.1 are 0.194 apart modulo 10.394
    returns = measure_clusters(xyz, residual, np.array([0, 0, 1], np.int32), period)
    assert abs(returns.rate_mps[0]) == pytest.approx(rate, abs=1e-5)
    assert returns.rate_mps[1] == pytest.approx(2.0, abs=1e-5)
    assert returns.points.tolist() == [2, 1]
    none = measure_clusters(xyz, residual, np.full(3, -1, np.int32), period)
    state, tracks = advance_tracks(TrackState(), 0, 0, EgoMotion((0.0, 0.0), None), none, period)
    assert (tracks.xyz_m.shape, state.filters.state.shape) == ((0, 3), (0, 4))
