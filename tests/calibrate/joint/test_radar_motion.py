"""Radar velocities that no odometry explains, and the radar's time offset: dips of the cost beside slopes."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar import search
from pipeline.calibrate.joint.lidar_radar.elevation_errors import ElevationSpread
from pipeline.calibrate.joint.lidar_radar.estimate import (
    contradicts_odometry,
    estimate_lidar_radar,
    turns_unmeasured,
)
from pipeline.calibrate.joint.lidar_radar.problem import SCHEDULE, RadarProblem, RadarState
from pipeline.calibrate.joint.lidar_radar.search import dips
from pipeline.core.config import SolveConfig
from pipeline.objective.radar.moving_clusters import moving_clusters
from pipeline.objective.radar.registration import registration_frames
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import (
    change_between,
    change_covariance,
    exp_so3,
    from_spherical,
    inverse,
    to_spherical,
    transform_points,
)
from tests.makers.radar_scenes import DT_S, SIGMA, T_LIDAR_RADAR, street_day
from tests.makers.solve_scenes import T_CAMERA_LIDAR

LEVER_M = 2.5
MOUNTED_RAD = 0.3  # the radar looks aside


@pytest.fixture(scope="module")
def day():
    """Frames of a car that turns one way and the other, its radar mounted askew."""
    rng = np.random.default_rng(0)
    frames = []
    for k, o in enumerate(street_day(16)):
        rate, speed = 0.4 * np.sin(k), 6.0 + 2 * (k % 5)
        travel = np.array([speed, rate * LEVER_M, 0.0]) + rng.normal(0, 0.05, 3)
        velocity = exp_so3(np.array([0.0, 0.0, -MOUNTED_RAD])) @ travel
        frames.append(replace(o, ego_speed_mps=speed, ego_yaw_rate_radps=rate, radar_velocity_mps=velocity))
    return frames


def spoiled(day, at, change):
    return [replace(o, **change(o)) if k in at else o for k, o in enumerate(day)]


def test_a_car_in_turns_contradicts_nothing(day):
    assert not contradicts_odometry(day).any()
    assert not turns_unmeasured(day).any()
    standing = [replace(o, radar_velocity_mps=np.zeros(3), ego_speed_mps=0.0) for o in day]
    assert not contradicts_odometry(standing).any()


@pytest.mark.parametrize("error", [[-3.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-1.0, -1.0, 0.0]])
def test_frames_whose_velocity_is_a_convoys_are_named(day, error):
    at = {2, 3, 11}
    lied = spoiled(day, at, lambda o: {"radar_velocity_mps": o.radar_velocity_mps + error})
    assert set(np.flatnonzero(contradicts_odometry(lied))) == at


def test_what_the_car_does_not_log_contradicts_nothing(day):
    silent = [
        replace(
            o, ego_speed_mps=None, ego_yaw_rate_radps=None,
            radar_velocity_mps=o.radar_velocity_mps + [0, 3.0 * (k < 3), 0],
        )
        for k, o in enumerate(day)
    ]  # fmt: skip
    assert not contradicts_odometry(silent).any()
    assert turns_unmeasured(silent)[:3].all()
    blind = spoiled(silent, {5}, lambda _: {"radar_velocity_mps": None})
    assert not contradicts_odometry(blind).any()
    assert not turns_unmeasured(blind)[5]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda o, _: {"ego_speed_mps": 1.08 * o.ego_speed_mps},  # another tyre
        lambda o, _: {"ego_speed_mps": 3.6 * o.ego_speed_mps},  # km/h
        lambda _, k: {"ego_speed_mps": float(k), "ego_yaw_rate_radps": 0.4 * np.cos(3 * k)},
    ],
)
def test_an_odometry_that_is_itself_wrong_contradicts_no_day(day, wrong):
    assert not contradicts_odometry([replace(o, **wrong(o, k)) for k, o in enumerate(day)]).any()


def test_a_third_of_a_day_in_a_convoy_moves_nothing_and_is_counted():
    """Frames whose radar takes vehicles that pull away for the ground: they agree among themselves, and are wrong."""
    honest = street_day(24)
    frames = []
    for k, o in enumerate(honest):
        aside = o.radar_xyz_m + np.array([0.9, 0.4, 0.0], np.float32)
        wrong = {"radar_xyz_m": aside, "radar_velocity_mps": o.radar_velocity_mps + [-4.0, -3.0, 0.0]}
        measured = replace(o, ego_yaw_rate_radps=0.0)
        frames.append(replace(measured, **wrong) if k % 3 == 0 else measured)
    prior = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2.0), 0.2)
    found = estimate_lidar_radar(frames, prior, SolveConfig(), np.random.default_rng(0))
    assert found.frames_rejected == {"radar velocity contradicts the odometry": 8}
    assert found.frames_used == 16
    error = change_between(T_LIDAR_RADAR, found.T)
    sigma = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    assert np.all(np.abs(error) < 3 * sigma)
    assert np.abs(error[3:5]).max() < 0.1


def test_a_slope_has_no_dip_wherever_it_leads():
    steps = np.arange(41.0)[:, None]
    slope = np.hstack([0.7 * steps, -2.0 * steps, 0 * steps])
    inner = slice(
        SCHEDULE.dt_dip_steps, -SCHEDULE.dt_dip_steps
    )  # at the ends half of the surroundings are missing
    assert np.allclose(dips(slope)[inner], 0.0)


@pytest.mark.parametrize("slope", [-3.0, 0.0, 3.0])
def test_a_dip_is_deepest_where_it_is_however_steep_the_slope(slope):
    steps = np.arange(61.0)
    cost = slope * steps - 20.0 * np.exp(-0.5 * ((steps - 37) / 1.2) ** 2)
    assert int(np.argmin(dips(cost[:, None])[:, 0])) == 37
    assert (int(np.argmin(cost)) == 37) == (slope == 0.0)  # which its lowest value would not show


@pytest.fixture(scope="module")
def problem():
    """Sixteen frames of streets, at the true pose."""
    return problem_of(street_day(16, seed=5))


def problem_of(rows):
    rng = np.random.default_rng(0)
    return RadarProblem(
        rows, registration_frames(rows, T_LIDAR_RADAR, rng), moving_clusters(rows, with_boxes=False),
        Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2), 0.05), 0.05, np.radians(0.4),
        ElevationSpread(0.1, 0.5),
    )  # fmt: skip


def state_at(dt_s):
    return RadarState(T_LIDAR_RADAR, dt_s, 0.0, SIGMA, 0.0)


@pytest.mark.parametrize("slid_s", [0.6, -0.6])
def test_an_offset_far_beyond_what_is_searched_is_seen_from_anywhere(problem, slid_s):
    far = search.far_time_offset(problem, state_at(DT_S + slid_s))
    assert abs(far["own_dt_s"] - DT_S) < 0.02
    assert far["own_dt_z"] < -2
    right = search.far_time_offset(problem, state_at(DT_S))
    assert abs(right["own_dt_s"] - DT_S) < 0.02


def test_the_radars_own_sigmas_bring_back_an_offset_that_wider_ones_do_not_see(problem, monkeypatch):
    right, slid = state_at(DT_S), state_at(DT_S + 0.04)
    monkeypatch.setattr(search, "comparison_cost", lambda problem, _: np.zeros(problem.frames.count))
    found = search.better_time_offset(search.OtherOffsets(problem, slid))
    assert found is not None
    assert abs(found.dt_s - DT_S) < 0.012  # half a step of 0.2 m
    assert search.better_time_offset(search.OtherOffsets(problem, right)) is None


def tunnel_day(frames, seed=3):
    """Frames of two plain walls, of which lidar and radar see other places every time."""
    rng = np.random.default_rng(seed)

    def walls(count, *ends):
        x, y = rng.uniform(*ends, count), rng.choice([-5.0, 5.0], count)
        return np.stack([x, y, rng.uniform(-1.7, 2.3, count)], -1)

    nothing = np.full(220, -1, np.int32), np.zeros(220, np.uint8), np.zeros(220, np.float32)
    radar = dict(zip(("radar_cluster", "radar_motion", "radar_residual_mps"), nothing, strict=True))
    for o in street_day(frames, seed=5):
        cloud, seen = walls(9000, -10, 80), transform_points(inverse(T_LIDAR_RADAR), walls(220, 3, 60))
        noisy = from_spherical(to_spherical(seen) + rng.normal(size=seen.shape) * SIGMA)
        yield replace(
            o, **radar, lidar_map_xyz_m=cloud.astype(np.float32),
            lidar_map_is_ground=np.zeros(len(cloud), np.uint8),
            lidar_map_cluster=np.full(len(cloud), -1, np.int32), radar_xyz_m=noisy.astype(np.float32),
        )  # fmt: skip


def test_a_time_offset_that_blocks_of_frames_find_anywhere_is_unsure_and_one_they_agree_on_is_not(problem):
    def scatter_s(problem):
        block = np.arange(problem.frames.count) // 2
        return search.time_offset_scatter_s(
            search.OtherOffsets(problem, state_at(DT_S)), block, np.random.default_rng(0)
        )

    assert scatter_s(problem) < 0.012  # half a step of 0.2 m
    assert scatter_s(problem_of(list(tunnel_day(16)))) > 0.03


@pytest.mark.slow
def test_in_a_tunnel_the_time_offset_is_wrong_within_its_sigma_and_nearer_what_is_expected():
    prior = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, np.radians(2), 0.05)
    e = estimate_lidar_radar(list(tunnel_day(24, seed=3)), prior, SolveConfig(), np.random.default_rng(0))
    # Its deepest dip is at 94 ms, 14 ms wide.
    assert 0.02 < abs(e.time_offset_s - e.time_offset_prior_s) < 0.07
    assert abs(e.time_offset_s - e.time_offset_prior_s) < 2 * e.time_offset_sigma_s < 0.11
