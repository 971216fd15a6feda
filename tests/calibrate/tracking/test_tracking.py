"""The tracking baseline on tracks made by function: what is paired, what is found, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.tracking.association import Bearings, associate, shared_sightings
from pipeline.calibrate.tracking.object_tracks import (
    Motion,
    Scan,
    Track,
    follow,
    lidar_tracks,
    motions,
    moves_over_ground,
    passes_by,
    turn_between,
)
from pipeline.calibrate.tracking.solve import PairTracks, calibrate_pair, solve_tracking
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import changed, exp_so3, inverse, log_so3, transform_points
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import HALF_SIZE_M, T_CAMERA_LIDAR, T_LIDAR_RADAR, draw, make_day

STEP_S, SIGHTINGS = 0.5, 8
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TURN = np.radians([0.8, -1.1, 1.3])


def make_track(position_m, velocity_mps, first_frame=0, drive=0):
    """A track at constant velocity, `position_m` being the first of its sightings."""
    n = len(position_m)
    return Track(
        drive, np.arange(first_frame, first_frame + n), np.zeros(n, int),
        position_m, np.tile(velocity_mps, (n, 1)), np.full(n, 0.5), np.full(n, 0.7), position_m,
    )  # fmt: skip


def objects(rng, count):
    """Paths of road users in the lidar's axes, each with its velocity; the car stands."""
    for _ in range(count):
        start = np.array([rng.uniform(12, 55), rng.uniform(-14, 14), rng.uniform(-1.5, 1.0)])
        velocity = np.array([rng.choice([-1, 1]) * rng.uniform(3, 9), rng.uniform(-1.5, 1.5), 0.0])
        yield start + velocity * STEP_S * np.arange(SIGHTINGS)[:, None], velocity


def tracks_of_a_pair(rng, T_other_lidar, count=30, wrong=0.0, noise_m=0.3, elevation=True, inverted=True):
    """The same objects in lidar and other sensor; a share of the other's bearings belongs to nothing the lidar sees."""
    lidar, other = [], []
    for k, (path, velocity) in enumerate(objects(rng, count)):
        seen = transform_points(T_other_lidar, path) + rng.normal(size=path.shape) * noise_m
        if k < wrong * count:  # as far away and as fast, but up to 3 degrees elsewhere
            swing = exp_so3(rng.uniform(-1, 1, 3) * np.radians([0, 3, 3]) + np.radians([0, 1.5, 1.5]))
            seen = seen @ swing.T
        turned = T_other_lidar[:3, :3] @ velocity
        # Objects one after another in time: what is asked here is the rotation, not who is who.
        lidar.append(make_track(path + rng.normal(size=path.shape) * noise_m, velocity, 10 * k))
        other.append(make_track(seen, turned, 10 * k))
    return PairTracks(lidar, other, np.eye(3) if inverted else LEVEL, inverted, elevation)


def turned_prior(degrees=1.0):
    """The truth's rotation moved by TURN, its translation kept."""
    return changed(T_LIDAR_RADAR, np.r_[TURN * degrees, np.zeros(3)])


def error_deg(T, T_true):
    return np.degrees(log_so3(T[:3, :3] @ T_true[:3, :3].T))


@pytest.mark.parametrize(("wrong", "rms_deg"), [(0.0, 0.06), (0.3, 0.15)])
def test_a_small_rotation_is_recovered_even_where_three_tracks_in_ten_are_wrong(wrong, rms_deg):
    # The wrong ones all lie to one side, by 1.5 deg on average: plain least squares would err by 0.4 deg.
    prior = Prior(T_CAMERA_LIDAR, turned_prior(), np.radians(2), 0.02)
    assert np.abs(error_deg(prior.T_lidar_radar, T_LIDAR_RADAR)).max() > 1.2
    errors, agreeing = [], []
    for seed in range(10):
        tracks = tracks_of_a_pair(np.random.default_rng(seed), inverse(T_LIDAR_RADAR), wrong=wrong)
        found = calibrate_pair("lidar_radar", tracks, prior, np.random.default_rng(0))
        errors.append(error_deg(found.T, T_LIDAR_RADAR))
        assert np.all(np.abs(errors[-1]) < 3 * np.degrees(np.sqrt(np.diag(found.covariance)[:3])))
        agreeing.append(found.diagnostics["tracks_agreeing"])
    # Nearly all right ones stay; of the wrong ones more than half go (some lie within the noise of right ones).
    assert 0.8 * 30 * (1 - wrong) <= np.mean(agreeing) <= 30 * (1 - 0.5 * wrong)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[1:].max() < rms_deg
    assert rms[0] < 0.4  # roll: only what is beside the line of sight tells it


def test_a_radar_without_elevation_keeps_roll_and_pitch_at_the_prior():
    tracks = tracks_of_a_pair(np.random.default_rng(3), inverse(T_LIDAR_RADAR), elevation=False)
    prior = Prior(T_CAMERA_LIDAR, turned_prior(), np.radians(2), 0.02)
    found = calibrate_pair("lidar_radar", tracks, prior, np.random.default_rng(0))
    assert found.observable[:3].tolist() == [False, False, True]
    assert np.degrees(np.sqrt(found.covariance[1, 1])) >= 1.99
    assert abs(error_deg(found.T, T_LIDAR_RADAR)[2]) < 0.25


def test_the_jacobian_of_the_bearings_is_that_of_finite_differences():
    rng = np.random.default_rng(4)
    points, angles = rng.uniform([8, -9, -2], [50, 9, 3], (5, 3)), np.zeros((5, 2))
    for T, level, inverted in ((T_CAMERA_LIDAR, LEVEL, False), (T_LIDAR_RADAR, np.eye(3), True)):
        bearings = Bearings(points, angles, np.ones(5), np.arange(5), level, inverted)
        J = bearings.residuals(T)[1]
        for k, x in enumerate(1e-6 * np.eye(6)):
            plus, minus = (bearings.residuals(changed(T, s))[0] for s in (x, -x))
            np.testing.assert_allclose(J[..., k], (plus - minus) / 2e-6, atol=1e-6)


def test_association_follows_the_motion_not_the_nearest_position():
    # Two cars abreast, one faster; a radar turned by 4 deg sees the faster one, nearly at the place of the slower one.
    ahead = np.arange(4)[:, None] * STEP_S - 0.75
    fast, slow = np.array([10.0, 0, 0]), np.array([6.0, 0, 0])
    lidar = [
        make_track(np.array([30.0, -1.2, 0]) + fast * ahead, fast),
        make_track(np.array([30.0, 1.2, 0]) + slow * ahead, slow),
    ]
    R = exp_so3(np.array([0, 0, np.radians(4.0)]))
    radar = [replace(lidar[0], position_m=lidar[0].position_m @ R.T)]
    right, wrong = (np.linalg.norm(t.position_m[1:3] - radar[0].position_m[1:3], axis=1) for t in lidar)
    assert np.all(wrong + 0.3 < right)
    found = associate(shared_sightings(lidar, radar), np.eye(4), np.radians(4.0))
    assert (found.reference.tolist(), found.other.tolist()) == ([0], [0])
    # Where motion does not tell them apart, the place does.
    alike = [
        lidar[0],
        replace(lidar[0], position_m=lidar[0].position_m @ (R @ exp_so3(np.array([0, 0, 0.01]))).T),
    ]
    assert associate(shared_sightings(alike, radar), np.eye(4), np.radians(4.0)).reference.tolist() == [1]


def test_tracks_that_contradict_each_other_are_not_paired():
    path = np.array([30.0, 2, 0]) + np.array([5.0, 0, 0]) * STEP_S * np.arange(6)[:, None]
    lidar = [make_track(path, np.array([5.0, 0, 0]))]
    assert len(associate(shared_sightings(lidar, lidar), np.eye(4), np.radians(1)).reference) == 1
    for other in (
        make_track(path + [15.0, 0, 0], np.array([5.0, 0, 0])),  # too far
        make_track(path, np.array([-8.0, 0, 0])),  # the wrong way
        make_track(path @ exp_so3(np.array([0, 0, 0.15])).T, np.array([5.0, 0, 0])),  # beyond the prior
        make_track(path, np.array([5.0, 0, 0]), first_frame=5),  # another time
        make_track(path, np.array([5.0, 0, 0]), drive=1),
    ):
        assert not len(associate(shared_sightings(lidar, [other]), np.eye(4), np.radians(1)).reference)


@pytest.mark.parametrize(("turn", "expected"), [(0.0, False), (1.0, True)])
def test_a_turned_sensor_is_called_miscalibrated_and_a_true_one_is_not(turn, expected):
    called = []
    for seed in range(5):
        tracks = tracks_of_a_pair(np.random.default_rng(seed), inverse(T_LIDAR_RADAR), count=20, wrong=0.1)
        prior = Prior(T_CAMERA_LIDAR, turned_prior(turn), np.radians(2), 0.02)
        d = calibrate_pair("lidar_radar", tracks, prior, np.random.default_rng(0)).diagnostics
        called.append(d["decalibration_statistic"] > d["decalibration_threshold"])
    assert called == [expected] * 5


def test_the_filter_follows_an_object_past_a_moving_car_and_finds_its_velocity_over_ground():
    rng, turn, speed = np.random.default_rng(6), 0.1, 10.0
    heading, place, scans = 0.0, np.zeros(2), []
    standing, walker = np.array([[40.0, 8.0], [25.0, -9.0]]), np.array([30.0, 2.0])
    for i in range(12):
        R = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        seen = (np.vstack([standing, walker + np.array([4.0, 1.0]) * i * STEP_S]) - place) @ R
        seen = seen[rng.permutation(3)] + rng.normal(size=(3, 2)) * 0.05
        motion = Motion((speed, 0.0), turn, 0.01)
        xyz, covariance = np.column_stack([seen, np.zeros(3)]), np.tile(0.05 * np.eye(2), (3, 1, 1))
        scans.append(Scan(i, 0, round(i * STEP_S * 1e9), motion, xyz, covariance))
        middle = heading + turn * STEP_S / 2
        place = place + speed * STEP_S * np.array([np.cos(middle), np.sin(middle)])
        heading += turn * STEP_S
    tracks = follow(scans)
    assert sorted(t.sightings for t in tracks) == [12, 12, 12]
    speeds = sorted(float(np.linalg.norm(t.velocity_mps[-1])) for t in tracks)
    assert speeds[1] < 0.6
    assert speeds[2] == pytest.approx(np.hypot(4, 1), abs=0.6)


def test_the_turn_of_the_car_is_read_off_the_standing_clusters():
    rng = np.random.default_rng(7)
    before = np.column_stack([rng.uniform(-40, 60, 60), rng.uniform(-40, 40, 60), np.zeros(60)])
    turn, way = 0.05, 4.0
    R = exp_so3(np.array([0, 0, turn]))
    now = (before - way * np.array([np.cos(turn / 2), np.sin(turn / 2), 0])) @ R
    assert turn_between(before, now + rng.normal(size=now.shape) * 0.1, way, 0.5) == pytest.approx(
        turn, abs=0.006
    )
    assert turn_between(before[:3], now, way, 0.5) is None


@pytest.fixture(scope="module")
def day():
    """A drive of a standing car past which six cars go, seen by all three sensors, twice."""
    day = make_day(1, seed=0)[0]
    frames = []
    for drive in range(2):
        rng = np.random.default_rng(drive)
        start = np.column_stack([np.linspace(14, 34, 6), np.linspace(-6, 6, 6), rng.uniform(-1, 0, 6)])
        velocity = np.column_stack([np.tile([4.0, -3.0], 3), np.tile([0.8, -0.8, 0.0], 2), np.zeros(6)])
        for i in range(8):
            frames.append(one_frame(day, start + velocity * i * STEP_S, velocity, len(frames), drive))
    return frames


def one_frame(day, centres, velocity, index, drive):
    boxes = draw(centres)[1].astype(np.float32)
    radar = transform_points(inverse(T_LIDAR_RADAR), centres).astype(np.float32)
    stamp = int((1000 + index * STEP_S + 100 * drive) * 1e9)
    n = len(centres)
    return replace(
        day, frame_index=index, drive=drive, stamp_ns=stamp, camera_stamp_ns=stamp, radar_stamp_ns=stamp,
        ego_speed_mps=0.0, ego_yaw_rate_radps=0.0, ground_plane=None,
        lidar_cluster_centre_m=centres.astype(np.float32),
        lidar_cluster_min_m=(centres - HALF_SIZE_M).astype(np.float32),
        lidar_cluster_max_m=(centres + HALF_SIZE_M).astype(np.float32),
        road_user_boxes_px=boxes, road_user_classes=["car"] * n, road_user_scores=np.ones(n, np.float32),
        radar_track_xyz_m=radar, radar_track_velocity_mps=(velocity @ T_LIDAR_RADAR[:3, :3]).astype(np.float32),
        radar_track_id=np.arange(n, dtype=np.int32), radar_track_age=np.full(n, 1 + index % 8, np.int32),
        radar_track_points=np.full(n, 3, np.int32),
    )  # fmt: skip


def solve(day, prior, seed=0, **options):
    return solve_tracking(dict.fromkeys(PAIRS, day), prior, SolveConfig(), seed=seed, **options)


PRIOR = Prior(
    changed(T_CAMERA_LIDAR, np.r_[-0.5 * TURN, np.zeros(3)]), turned_prior(0.5), np.radians(2), 0.02
)


def test_a_day_of_moving_cars_turns_all_three_pairs_towards_the_truth(day):
    truth = Prior(T_CAMERA_LIDAR, T_LIDAR_RADAR, 1.0, 1.0)
    solution = solve(day, PRIOR)
    assert solution.failed_checks == {}
    for pair, axes in (("camera_lidar", [0, 1]), ("lidar_radar", [1, 2]), ("camera_radar", [0, 1])):
        before = error_deg(PRIOR.of(pair), truth.of(pair))[axes]
        after = error_deg(solution.pairs[pair].T, truth.of(pair))[axes]
        assert np.linalg.norm(after) < 0.5 * np.linalg.norm(before)
        assert np.abs(after).max() < 0.3
        assert solution.pairs[pair].frames_used == 16
    T = solution.pairs["camera_lidar"].T @ solution.pairs["lidar_radar"].T
    np.testing.assert_allclose(solution.pairs["camera_radar"].T, T)


def test_a_day_on_which_nothing_moves_is_refused_and_says_so():
    day = make_day(8)
    still = [replace(o, lidar_cluster_centre_m=day[0].lidar_cluster_centre_m,
                     lidar_cluster_min_m=day[0].lidar_cluster_min_m, lidar_cluster_max_m=day[0].lidar_cluster_max_m,
                     drive=0, ego_speed_mps=0.0, ego_yaw_rate_radps=0.0) for o in day]  # fmt: skip
    tracks = lidar_tracks(still, motions(still, PRIOR))
    assert tracks
    assert not any(passes_by(t) or moves_over_ground(t) for t in tracks)
    with pytest.raises(SolveError, match="no moving objects in the lidar"):
        solve(still, PRIOR)


def test_a_camera_that_sees_nobody_leaves_the_radar_calibrated(day):
    blind = [replace(o, road_user_boxes_px=np.zeros((0, 4), np.float32), road_user_classes=[]) for o in day]
    solution = solve(blind, PRIOR)
    assert "too few moving objects" in solution.failed_checks["camera_lidar"][0].sentence
    assert solution.pairs["camera_lidar"].frames_used == 0
    assert np.array_equal(solution.pairs["camera_lidar"].T, PRIOR.T_camera_lidar)
    assert solution.pairs["lidar_radar"].frames_used == 16
