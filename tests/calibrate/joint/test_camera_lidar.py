"""Recovery of a known pose and time offset, with and without labels, honest sigmas, and what must be refused."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import _usable, align_camera_lidar
from pipeline.calibrate.joint.camera_lidar.observability import time_offset_variance
from pipeline.calibrate.joint.camera_lidar.profiles import TimeOffsetProfile
from pipeline.calibrate.verify.day_checks import MOVED_SIGMAS, PART_FLOOR_RAD, clock_alarms
from pipeline.core.config import ChecksConfig, SolveConfig
from pipeline.core.errors import SolveError
from pipeline.core.rigs import CameraPrior
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import (
    change_between,
    change_covariance,
    exp_so3,
    from_rotation_translation,
    perturb_exactly,
)
from tests.makers.camera_lidar import estimate_camera_lidar, prior_off_by, turn_and_sigma_deg
from tests.makers.solve_scenes import make_day
from tests.makers.traced_scenes import DENSE, SPARSE, T_TRUE, traced_day, without_labels


@pytest.mark.parametrize(
    ("rig", "frames", "dt_s", "gap_s"),
    [(SPARSE, 16, 0.03, 0.04), pytest.param(DENSE, 8, 0.03, 0.04, marks=pytest.mark.slow), (DENSE, 8, 0.08, 0.0)],
    ids=["16 rings, gaps of their own", "dense, gaps of their own", "dense, a time offset far off"],
)  # fmt: skip
def test_pose_and_time_offset_are_recovered_from_four_degrees(rig, frames, dt_s, gap_s):
    gaps_s = np.random.default_rng(2).uniform(-gap_s, gap_s, frames)
    day = traced_day(rig, frames, seed=1, dt_s=dt_s, gaps_s=gaps_s)
    e = estimate_camera_lidar(day, prior_off_by(4.0))
    turn_deg, sigma_deg = turn_and_sigma_deg(e)
    assert np.abs(turn_deg).max() < 0.35
    assert (np.abs(turn_deg) < 5 * sigma_deg).all()
    assert abs(e.time_offset_s - dt_s) < 0.015
    assert e.frames_used == frames


def test_frames_of_unknown_speed_are_left_out_where_most_are_known():
    day = make_day(8)
    some = [replace(o, ego_speed_mps=None) if k in (2, 5) else o for k, o in enumerate(day)]
    assert _usable(some) == ([0, 1, 3, 4, 6, 7], {"own speed unknown": 2})
    none = [replace(o, ego_speed_mps=None) if k else o for k, o in enumerate(day)]
    assert _usable(none) == (list(range(8)), {})


def test_road_without_reflectivity_leaves_the_edges_to_do_it():
    day = traced_day(DENSE, 8, seed=1, reflective=False)
    e = estimate_camera_lidar(day, prior_off_by(3.0, 0.05, 1))
    assert np.abs(turn_and_sigma_deg(e)[0]).max() < 0.3
    assert e.diagnostics["marking_weight"] == 0.0


@pytest.mark.slow
def test_rows_a_degree_apart_tell_pitch_where_the_road_shows_nothing():
    spinning = replace(SPARSE, elevations_deg=np.arange(-16.0, 16.0))
    day = traced_day(spinning, 16, seed=1, reflective=False)
    e = estimate_camera_lidar(day, prior_off_by(2.0, 0.05, 1))
    pitch_deg, sigma_deg = np.degrees([change_between(T_TRUE, e.T)[0], np.sqrt(e.covariance[0, 0])])
    assert e.observable[0]
    assert sigma_deg < 0.25
    assert abs(pitch_deg) < 3 * sigma_deg


def test_a_car_that_stands_says_what_it_sees_and_that_it_knows_it_less_well():
    """One scene does not know its own sigma; what it shows is better than a prior that it shows to be wrong."""
    (scene,) = traced_day(DENSE, 1, seed=1, reflective=False)
    rng, names = np.random.default_rng(0), ("xyz_m", "side", "jump_m", "gap_rad", "points")
    day = []
    for k in range(8):  # of the same borders other beams meet other points
        seen = rng.random(len(scene.lidar_edge_side)) < 0.15
        edges = {f"lidar_edge_{n}": getattr(scene, f"lidar_edge_{n}")[seen] for n in names}
        day.append(replace(scene, stamp_ns=scene.stamp_ns + k * 300_000_000, **edges))
    off = from_rotation_translation(exp_so3(np.radians([0.0, 0.0, 1.0])) @ T_TRUE[:3, :3], T_TRUE[:3, 3])
    prior = Prior(off, np.eye(4), float(np.radians(2.0)), 0.05)
    e = estimate_camera_lidar(day, prior)
    error, sigma = change_between(T_TRUE, e.T), np.sqrt(np.diag(change_covariance(e.T, e.covariance)))
    assert e.observable[:4].all()
    assert not e.observable[5]
    assert (np.abs(error[:4]) < 2 * sigma[:4]).all()
    assert (
        np.degrees(sigma[:3]).max() < 1.0
    )  # half of the prior's; .3 to .5 by processor, as steps end elsewhere


def prior_along_the_axis(sigma_m):
    """A prior that is wrong only along the optical axis, where a few frames say little."""
    T = T_TRUE.copy()
    T[2, 3] += 0.04
    return Prior(T, np.eye(4), float(np.radians(2.0)), sigma_m)


def test_what_the_day_cannot_determine_stays_at_the_prior_with_its_sigma_and_the_time_offset_says_so():
    day = traced_day(SPARSE, 12, seed=1, dt_s=0.03)
    prior = prior_along_the_axis(0.1)
    e = estimate_camera_lidar(day, prior)
    change = change_between(prior.T_camera_lidar, e.T)
    sigma = np.sqrt(np.diag(change_covariance(e.T, e.covariance)))
    assert not e.observable[5]
    assert e.observability[5] < 0.5
    assert change[5] == pytest.approx(0.0, abs=1e-9)
    assert sigma[5] == pytest.approx(0.1, rel=0.05)
    assert e.observable[:3].all()
    assert np.abs(change[:3]).max() > 1e-6
    assert np.linalg.eigvalsh(e.covariance).min() > 0
    assert abs(e.time_offset_s - 0.03) < 3 * e.time_offset_sigma_s


def test_stamps_of_a_clock_that_is_kept_are_right_and_a_wrong_word_about_them_is_named():
    """The camera exposes 40 ms after the sweep; by default, its clock is expected to be 40 ms off."""
    kept = replace(prior_off_by(2.0), camera=CameraPrior(stamp_sigma_s=0.001))
    e = estimate_camera_lidar(traced_day(SPARSE, 12, seed=1, gaps_s=np.full(12, 0.04)), kept)
    assert (e.time_offset_prior_s, e.time_offset_sigma_s <= 0.001) == (0.0, True)
    assert np.abs(turn_and_sigma_deg(e)[0]).max() < 0.35
    wrong = estimate_camera_lidar(traced_day(SPARSE, 12, seed=1, dt_s=0.03), kept)
    alarms = [clock_alarms({"camera_lidar": x}, {"camera_lidar": 0.001}, ChecksConfig()) for x in (e, wrong)]
    assert [[c.fault for of in found.values() for c in of] for found in alarms] == [[], ["time_offset"]]


@pytest.mark.parametrize("walking_mps", [None, 1.0])
def test_the_less_is_known_along_the_axis_the_less_is_known_of_the_time_offset(walking_mps):
    # A car that stands dt later looks as if it stood further on: in a jam by a second per metre.
    day = traced_day(SPARSE, 6, seed=3)
    if walking_mps is not None:
        day = [replace(o, ego_speed_mps=walking_mps) for o in day]  # images are taken with their sweeps
    begun = align_camera_lidar(day, prior_off_by(1.0, 0.03, 2), SolveConfig(), np.random.default_rng(5))
    timed = TimeOffsetProfile(begun.state, 1e-6, 0.0)
    expected_s = begun.problem.config.time_offset_sigma_s

    def day_variance(tz_sigma_m):
        problem = replace(begun.problem, tz_variance=tz_sigma_m**2)
        return 1 / (1 / time_offset_variance(problem, begun.state, begun.kernel, timed) - 1 / expected_s**2)

    forward_mps = begun.problem.terms.velocity_lidar @ begun.state.T_camera_lidar[2, :3]
    share_s = float(forward_mps.sum() / np.sum(forward_mps**2)) * 0.1
    assert 0.5 * share_s**2 < day_variance(0.1) - day_variance(0.02) < 1.5 * share_s**2


def test_what_the_day_knows_better_than_the_prior_is_left_to_the_day():
    day = traced_day(DENSE, 10, seed=1, dt_s=0.03)
    prior = prior_along_the_axis(0.6)
    e = estimate_camera_lidar(day, prior)
    sigma = np.sqrt(np.diag(change_covariance(e.T, e.covariance)))
    assert e.observable.all()
    assert 0.03 < sigma[5] < 0.3
    assert abs(e.T[2, 3] - T_TRUE[2, 3]) < 3 * sigma[5]
    assert e.T[2, 3] != prior.T_camera_lidar[2, 3]


@pytest.mark.slow
def test_the_search_follows_a_prior_that_says_it_may_be_far_off():
    day = traced_day(DENSE, 10, seed=1, dt_s=0.03)
    T = perturb_exactly(T_TRUE, np.radians(14.0), 0.5, np.random.default_rng(3))
    prior = Prior(T, np.eye(4), float(np.radians(14.0)), 0.5)
    rotation, shift = SolveConfig().search_range(prior.sigmas)
    assert np.degrees(rotation) > 14
    assert shift > 0.5
    e = estimate_camera_lidar(day, prior)
    assert np.abs(turn_and_sigma_deg(e)[0]).max() < 0.4
    near = Prior(T, np.eye(4), 0.01, 0.01)
    assert SolveConfig().search_range(near.sigmas) == (np.radians(6.0), 0.3)


def test_days_of_hardly_any_frame_or_edge_are_refused():
    day = traced_day(SPARSE, 6, seed=3)
    with pytest.raises(SolveError, match="frames"):
        estimate_camera_lidar(day[:3], prior_off_by(1.0, 0.03, 2))
    away = prior_off_by(0.0, 0.0, 0).T_camera_lidar.copy()
    away[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ away[:3, :3]  # looks backwards, where nothing was traced
    with pytest.raises(SolveError, match="edges"):
        estimate_camera_lidar(day, Prior(away, np.eye(4), 0.03, 0.05))


@pytest.mark.parametrize(
    ("rig", "frames"),
    [(SPARSE, 16), pytest.param(DENSE, 8, marks=pytest.mark.slow)],
    ids=["16 rings", "dense"],
)
def test_a_day_without_labels_shows_the_pose_within_its_sigma(rig, frames):
    found = estimate_camera_lidar(without_labels(traced_day(rig, frames, seed=1)), prior_off_by(2.0))
    error, sigma = turn_and_sigma_deg(found)
    assert np.abs(error).max() < 0.35
    assert (np.abs(error) < 3 * sigma).all()
    assert not found.disproved


@pytest.mark.slow
def test_a_camera_that_turns_at_noon_is_seen_to_move_without_labels_too():
    turned = replace(SPARSE, T_camera_lidar=from_rotation_translation(
        exp_so3(np.radians([0.0, 1.0, 0.0])) @ T_TRUE[:3, :3], T_TRUE[:3, 3]
    ))  # fmt: skip
    morning, noon = traced_day(SPARSE, 16, seed=1), traced_day(turned, 16, seed=2)
    late = [replace(o, stamp_ns=o.stamp_ns + 10**12, camera_stamp_ns=o.camera_stamp_ns + 10**12, drive=o.drive + 9)
            for o in noon]  # fmt: skip
    found = estimate_camera_lidar(without_labels([*morning, *late]), prior_off_by(1.0))
    assert np.abs(found.parts.sigmas(PART_FLOOR_RAD)).max() > MOVED_SIGMAS
    still = estimate_camera_lidar(
        without_labels([*morning, *traced_day(SPARSE, 16, seed=2)]), prior_off_by(1.0)
    )
    assert still.parts is None or np.abs(still.parts.sigmas(PART_FLOOR_RAD)).max() < MOVED_SIGMAS
