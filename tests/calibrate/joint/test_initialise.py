"""The basin: candidates of different origin, what vouches for an end, the search range as a hard limit."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar import initialise
from pipeline.calibrate.joint.camera_lidar.initialise import difference, find_basin
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, refine
from pipeline.calibrate.joint.camera_lidar.rotation_grid import grid_maxima
from pipeline.calibrate.joint.camera_lidar.schedule import SCHEDULE
from pipeline.calibrate.joint.failed_checks import unvouched_basin
from pipeline.calibrate.numerics.bias_floors import MAX_GAP_PX
from pipeline.calibrate.numerics.search_range import SearchRange, search_range
from pipeline.config import SolveConfig
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.cameras import camera_of
from pipeline.geometry.changes import change_between
from pipeline.geometry.se3 import (
    exp_so3,
    from_rotation_translation,
    log_so3,
    perturb_exactly,
    transform_points,
)
from pipeline.objective.camera_lidar.score import (
    Alignments,
    KernelSettings,
    lidar_velocities,
    prepare_terms,
)
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

REACH_RAD = np.radians(8.0)
KERNEL_DEG = 0.8  # at which ends are compared: 4 px of 300 px/rad


@pytest.fixture(scope="module")
def day():
    return traced_day(DENSE, 10, seed=3)


@pytest.fixture(scope="module")
def terms(day):
    velocity = lidar_velocities(day, np.eye(4))
    return prepare_terms(day, T_TRUE, velocity, reach_rad=REACH_RAD + np.radians(2.0))


def searched(terms, prior, limits=None):
    kernel = KernelSettings.wide(*SCHEDULE.kernels[0])
    config = SolveConfig()
    limits = limits or search_range(prior, config)
    thin = Scored(terms.sharp(MAX_GAP_PX), kernel, prior, config, limits)
    return find_basin(terms, thin, np.random.default_rng(0))


def off_by(degrees, metres, seed):
    T = perturb_exactly(T_TRUE, np.radians(degrees), metres, np.random.default_rng(seed))
    return Prior(T, np.eye(4), np.radians(2.0), 0.05)


def turned(T, turn_rad):
    return from_rotation_translation(exp_so3(turn_rad) @ T[:3, :3], T[:3, 3])


def degrees_off(T):
    return np.degrees(np.linalg.norm(log_so3(T[:3, :3] @ T_TRUE[:3, :3].T)))


def test_a_grid_of_rotations_has_the_truth_among_its_maxima_on_either_half_of_the_frames(terms):
    off = off_by(7.0, 0.05, 1)
    for k in (0, 1):
        half = terms.sharp(MAX_GAP_PX).of_frames(np.arange(k, terms.frames, 2))
        found = grid_maxima(half, off.T_camera_lidar, REACH_RAD, np.random.default_rng(0))
        assert len(found) == SCHEDULE.grid_maxima
        # Half a step of the grid per axis, and roll's is twice as wide; the shift turns near points a little.
        assert min(degrees_off(T) for T in found) < 1.6


def test_the_basin_is_found_from_five_degrees_and_another_origin_vouches_for_it(terms):
    for seed in (1, 2):
        basin = searched(terms, off_by(5.0, 0.05, seed))
        assert degrees_off(basin.state.T_camera_lidar) < KERNEL_DEG
        assert basin.vouched_by
        assert basin.origin not in basin.vouched_by
        assert not unvouched_basin(basin)


def test_origins_that_are_misled_alike_do_not_decide(terms, monkeypatch):
    prior = off_by(1.0, 0.03, 4)
    wrong = turned(prior.T_camera_lidar, np.radians([0.0, 0.0, 5.9]))
    wrong[:3, 3] += 0.28
    monkeypatch.setattr(initialise, "grid_maxima", lambda *_: [wrong, wrong])
    basin = searched(terms, prior)
    assert degrees_off(basin.state.T_camera_lidar) < KERNEL_DEG
    assert {basin.origin, *basin.vouched_by} == {"prior", "evolution"}


def test_one_origin_alone_vouches_for_nothing(terms, monkeypatch):
    prior = off_by(1.0, 0.02, 5)
    monkeypatch.setattr(
        initialise, "_candidates", lambda *_: iter([("evolution", AlignmentState(prior.T_camera_lidar))] * 3)
    )
    basin = searched(terms, prior)
    assert basin.vouched_by == ()
    assert "evolution" in unvouched_basin(basin)


def test_the_state_of_an_earlier_day_is_looked_at_where_the_others_do_not_agree(terms, monkeypatch):
    prior = replace(off_by(5.0, 0.05, 6), T_camera_lidar_before=T_TRUE)
    agreed = searched(terms, prior)
    assert "state" not in {agreed.origin, *agreed.vouched_by}  # and so changes no bit of it
    wrong = [turned(prior.T_camera_lidar, np.radians([sign * 5.0, 0.0, sign * 5.9])) for sign in (1, -1)]
    halves = itertools.cycle([[wrong[0]], [wrong[1]]])
    monkeypatch.setattr(initialise, "grid_maxima", lambda *_: next(halves))
    monkeypatch.setattr(initialise, "_evolved", lambda *_: AlignmentState(T_TRUE))
    rescued = searched(terms, prior)
    assert degrees_off(rescued.state.T_camera_lidar) < KERNEL_DEG
    assert {rescued.origin, *rescued.vouched_by} >= {"state", "evolution"}


def test_no_climb_leaves_the_search_range(terms):
    prior = off_by(4.0, 0.05, 7)
    limits = SearchRange(np.radians(2.0), 0.03)
    kernel = KernelSettings.wide(*SCHEDULE.kernels[0])
    scored = Scored(terms.sharp(MAX_GAP_PX), kernel, prior, SolveConfig(), limits)
    state = refine(scored, AlignmentState(prior.T_camera_lidar), steps=12)
    turn = log_so3(state.T_camera_lidar[:3, :3] @ prior.T_camera_lidar[:3, :3].T)
    assert np.abs(turn).max() < limits.rotation_rad + 1e-9
    assert np.abs(turn).max() > 0.9 * limits.rotation_rad  # the truth lies beyond: it went as far as it may
    assert (
        np.abs(state.T_camera_lidar[:3, 3] - prior.T_camera_lidar[:3, 3]).max() < limits.translation_m + 1e-9
    )


def test_a_state_within_the_range_is_not_touched():
    prior, limits = off_by(1.0, 0.02, 8), SearchRange(np.radians(6.0), 0.3)
    state = AlignmentState(T_TRUE, 0.01)
    assert state.within(prior, limits) is state
    far = AlignmentState(turned(prior.T_camera_lidar, np.radians([10.0, 1.0, 0.0])), 0.01)
    moved = change_between(prior.T_camera_lidar, far.within(prior, limits).T_camera_lidar)
    assert np.allclose(moved[:3], [limits.rotation_rad, np.radians(1.0), 0.0], atol=1e-9)
    assert difference(far, far) == pytest.approx(np.zeros(8))


def test_edges_in_view_are_those_that_the_camera_model_projects_into_the_image(day, terms):
    T = turned(T_TRUE, np.radians([0.0, 35.0, 4.0]))
    at = Alignments(T[None], np.zeros(1), np.ones(1))
    camera = terms.maps.camera
    uv, valid = camera.project(transform_points(T, terms.edges.xyz_m.astype(np.float64)))
    inside = valid & (uv >= 0).all(1) & (uv[:, 0] <= camera.width_px - 1) & (uv[:, 1] <= camera.height_px - 1)
    assert camera.model == camera_of(day[0]).model
    assert abs(int(terms.edges_in_view(at)[0]) - int(inside.sum())) <= 3  # single precision at the border
    assert 0 < inside.sum() < len(inside)
