"""Drives through simulated worlds: motion that agrees with itself, and a world that stays where it is."""

import numpy as np
import pytest

from pipeline.simulate.logs.recording import _odometry
from pipeline.simulate.world.casting import World, chunk_mesh
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.meshes import CHUNK_M
from pipeline.simulate.world.traffic import actors_at


@pytest.mark.parametrize("environment", ["urban", "highway"])
def test_the_next_frame_sees_the_same_road_users_a_little_further_on(environment):
    drive = Drive(9, environment, 20.0, 0)
    for t in (2.0, 9.0):
        now, then = ({a.key: a for a in actors_at(drive, x)} for x in (t, t + 0.1))
        same = now.keys() & then.keys()
        assert len(same) >= 0.7 * len(now)
        assert len(same) >= 5
        step = np.array([then[k].T_map_actor[:3, 3] - now[k].T_map_actor[:3, 3] for k in same])
        speed = np.array([now[k].velocity_map for k in same])
        np.testing.assert_allclose(step, 0.1 * speed, atol=0.08)
        assert all(then[k].kind == now[k].kind for k in same)


def test_the_standing_world_is_the_same_from_everywhere():
    drive = Drive(9, "urban", 30.0, 0)
    world = World(drive)
    first, later = world.around(30.0), World(drive).around(30.0 + 2 * CHUNK_M)
    shared = chunk_mesh(drive, 3).corners.astype(np.float64)
    for standing in (first, later):
        corners = {tuple(p) for p in np.round(standing.mesh.corners.reshape(-1, 3) + standing.origin, 1)}
        hits = [tuple(p) in corners for p in np.round(shared.reshape(-1, 3), 1)]
        assert np.mean(hits) > 0.8  # single precision turns some last digits


@pytest.mark.parametrize("environment", ["urban", "highway"])
def test_nobody_drives_through_us(environment):
    drive = Drive(4, environment, 20.0, 0)
    for t in np.arange(1.0, 19.0, 1.5):
        T = drive.ego.poses(np.array([t]))[0]
        for actor in actors_at(drive, float(t)):
            ahead, left, _ = T[:3, :3].T @ (actor.T_map_actor[:3, 3] - T[:3, 3])
            assert abs(ahead - 1.3) > 2.0 or abs(left) > 0.9, (actor.kind, ahead, left)


def test_odometry_tells_our_speed_within_a_percent_or_so():
    drive = Drive(6, "highway", 30.0, 0)
    rows = _odometry(drive, np.random.default_rng(0))
    t, speed = np.array([r[0] for r in rows]), np.array([r[2] for r in rows])
    true = np.linalg.norm(drive.ego.velocities(t)[0], axis=1)
    assert abs(np.median(speed / true) - 1) < 0.02
    end, start = rows[-1][1][:3, 3], rows[0][1][:3, 3]
    path = drive.ego.poses(t[[0, -1]])[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(end - start), np.linalg.norm(path[1] - path[0]), rtol=0.02)


def test_we_drive_where_we_look_and_never_turn_on_the_spot():
    stops = 0
    for seed in range(6):
        ego = Drive(seed, "urban", 60.0, 0).ego
        t = np.arange(1.0, 59.0, 0.05)
        velocity, omega = ego.velocities(t)
        speed, forward = np.linalg.norm(velocity, axis=1), ego.poses(t)[:, :3, 0]
        stops += np.any(speed < 0.05)
        fast = speed > 3
        across = np.linalg.norm(velocity[fast] - speed[fast, None] * forward[fast], axis=1) / speed[fast]
        assert np.max(across) < 0.03
        assert np.abs(omega[speed < 0.05]).max(initial=0) < 0.02
        assert np.abs(omega[:, 2]).max() < 0.5
    assert stops > 0
