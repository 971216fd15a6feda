"""The basin: each term beyond chance, the evidence that an end leads, the search range as a hard limit; refinement."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar import initialise
from pipeline.calibrate.joint.camera_lidar import refine as module
from pipeline.calibrate.joint.camera_lidar.initialise import Basin, difference, find_basin
from pipeline.calibrate.joint.camera_lidar.profiles import far_time_offset
from pipeline.calibrate.joint.camera_lidar.refine import (
    SCHEDULE,
    AlignmentState,
    Scored,
    prior_value,
    refine,
    scales,
)
from pipeline.calibrate.joint.camera_lidar.rotation_search import (
    TERMS,
    Evidence,
    by_chance,
    grid_maxima,
    wrong_poses,
)
from pipeline.calibrate.numerics.covariance import CLEARLY
from pipeline.core.config import SolveConfig
from pipeline.core.sections import SearchRange
from pipeline.objective.camera_lidar.points import Points, lidar_velocities
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, prepare_terms
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import (
    change_between,
    exp_so3,
    from_rotation_translation,
    inverse,
    log_so3,
    rotation_angle_rad,
    transform_points,
)
from tests.makers.camera_lidar import prior_off_by
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

REACH_RAD = np.radians(8.0)
_BRIGHT = 600  # pixels of each image on which markings are put
KERNEL = KernelSettings.wide(*SCHEDULE.kernels[0])
KERNEL_DEG = 0.8  # at which ends are compared: 4 px of 300 px/rad


@pytest.fixture(scope="module")
def day():
    return traced_day(DENSE, 10, seed=3)


@pytest.fixture(scope="module")
def terms(day):
    velocity = lidar_velocities(day, np.eye(4))
    return prepare_terms(day, T_TRUE, velocity, reach_rad=REACH_RAD + np.radians(2.0))


def searched(terms, prior, limits=None):
    config = SolveConfig()
    limits = limits or config.search_range(prior.sigmas)
    thin = Scored(terms.sharp(), KERNEL, prior, config, limits)
    return find_basin(terms, thin, np.random.default_rng(0), np.arange(terms.frames))


def bright_on_bright(terms, T):
    """Markings on the road that lie on the brightest places of each image at a pose."""
    camera, contrast = terms.maps.camera, terms.maps.contrast[0]
    ahead, placed = inverse(T), []
    for f in range(terms.frames):
        v, u = np.unravel_index(np.argsort(contrast[f], axis=None)[-_BRIGHT:], contrast[f].shape)
        rays = camera.unproject(np.column_stack([u, v]).astype(float))
        placed.append(transform_points(ahead, 12.0 * rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    points = np.concatenate(placed).astype(np.float32)
    none = np.zeros(len(points), np.uint8)
    start = np.arange(terms.frames + 1) * _BRIGHT
    gap = np.zeros(len(points), np.float32)
    return Points(points, start, none, none, gap, gap, np.arange(terms.frames))


def turned(T, turn_rad):
    return from_rotation_translation(exp_so3(turn_rad) @ T[:3, :3], T[:3, 3])


def degrees_off(T):
    return np.degrees(rotation_angle_rad(T @ inverse(T_TRUE)))


def test_a_grid_of_rotations_has_the_truth_among_its_maxima(terms):
    off, rng = prior_off_by(7.0, 0.05, 1), np.random.default_rng(0)
    wrong = wrong_poses(off, REACH_RAD, 0.05, rng)
    found = grid_maxima(terms.sharp(), off, REACH_RAD, wrong, rng)
    assert [name for name, _ in found][1:4] == list(TERMS)  # each term's own best is among them
    # Half a step of the grid per axis, and roll's is twice as wide; the shift turns near points a little.
    assert degrees_off(found[0][1]) < 1.6


def test_the_basin_is_found_from_five_degrees_and_leads_over_all_other_ends(terms):
    basin = searched(terms, prior_off_by(5.0, 0.05, 1))
    assert degrees_off(basin.state.T_camera_lidar) < KERNEL_DEG
    assert not basin.doubt
    assert sum(basin.evidence) > basin.needed
    assert basin.rival_z > CLEARLY


def test_bright_stretches_of_road_at_a_wrong_roll_do_not_outvote_the_edges(terms):
    """As on a day of another simulator: markings know nothing of the truth, and score thousands 7 deg off."""
    prior = prior_off_by(5.0, 0.05, 1)
    elsewhere = turned(T_TRUE, np.radians([0.0, 0.0, 7.0]))
    misled = replace(terms, markings=bright_on_bright(terms, elsewhere))
    wrong_at, true_at = AlignmentState(elsewhere).alone, AlignmentState(T_TRUE).alone
    ahead = [(misled.score(at, KERNEL)).sum() for at in (wrong_at, true_at)]
    assert ahead[0] > ahead[1]  # by the sum of the scores the wrong pose wins
    basin = searched(misled, prior)
    assert degrees_off(basin.state.T_camera_lidar) < KERNEL_DEG


def test_a_truth_out_of_reach_is_not_found(terms):
    prior = replace(prior_off_by(1.0, 0.02, 1), T_camera_lidar=turned(T_TRUE, np.radians([9.0, 25.0, 0.0])))
    basin = searched(terms, prior)
    assert degrees_off(basin.state.T_camera_lidar) > 5.0
    assert basin.doubt


@pytest.mark.parametrize(("frames", "said"), [(10, "markings contradict"), (1, "")])
def test_a_term_contradicts_an_end_only_where_its_own_lead_holds_over_the_frames(terms, frames, said):
    """A lidar that is blind to paint has its brightest places somewhere too: in one frame, and so in their sum."""
    prior = prior_off_by(1.0, 0.02, 5)
    wrong = wrong_poses(prior, REACH_RAD, 0.05, np.random.default_rng(0))
    elsewhere = turned(T_TRUE, np.radians([0.0, 0.0, 7.0]))
    bright = bright_on_bright(terms, elsewhere)
    misled = replace(terms, markings=bright.chosen(np.arange(len(bright.xyz_m)) < frames * _BRIGHT))
    evidence = Evidence(misled, KERNEL, ((40.0, 30.0), (-40.0, -30.0))).measured(wrong)
    scored = Scored(misled, KERNEL, prior, SolveConfig())
    search = initialise._Search(scored, evidence, np.arange(terms.frames))
    best, rival = (search._end("edges", AlignmentState(T)) for T in (T_TRUE, elsewhere))
    basin = Basin(best.state, KERNEL, "edges", 2, (40.0, 0.0, 0.0), 13.0, 0.1, np.inf)
    ahead = replace(rival, evidence=np.array([0.0, 30.0, 0.0]))
    doubt = search._doubt(basin, [ahead], is_last=True)
    assert doubt.startswith(said)
    assert bool(doubt) == bool(said)
    assert search._doubt(basin, [ahead], is_last=False)  # candidates are left to ask
    led = replace(basin, evidence=(70.0, 0.0, 0.0))
    assert not search._doubt(led, [ahead], is_last=True)  # the others lead by far more


def test_a_term_without_data_weighs_nothing(terms):
    prior, rng = prior_off_by(1.0, 0.02, 5), np.random.default_rng(0)
    wrong = wrong_poses(prior, REACH_RAD, 0.05, rng)
    blank = terms.of_kinds(edges=True, markings=False)
    evidence = Evidence(blank, KERNEL, ((40.0, 30.0),)).measured(wrong)
    assert evidence.weighted().marking_weight == 0.0
    assert evidence.weighted().edge_weight == 1.0
    assert evidence.of(wrong)[:, 1].tolist() == [0.0] * len(wrong)
    assert evidence.terms_with_values == 2  # so chance has no third term either


def test_the_best_of_many_chance_poses_shows_as_much_as_drawn_ones():
    rng = np.random.default_rng(0)
    best = rng.exponential(size=(300, 2000, 3)).sum(2).max(1)
    assert by_chance(2000, 3) == pytest.approx(np.median(best), abs=0.6)


def test_the_state_of_an_earlier_day_is_looked_at_where_the_day_does_not_decide(terms, monkeypatch):
    prior = replace(prior_off_by(5.0, 0.05, 6), T_camera_lidar_before=T_TRUE)
    decided = searched(terms, prior)
    alone = searched(terms, replace(prior, T_camera_lidar_before=None))
    assert np.array_equal(decided.state.T_camera_lidar, alone.state.T_camera_lidar)  # it changes no bit of it
    wrong = turned(prior.T_camera_lidar, np.radians([5.0, 0.0, 5.9]))
    monkeypatch.setattr(initialise, "grid_maxima", lambda *_: [("all terms", wrong)])
    rescued = searched(terms, prior)
    assert rescued.origin == "state"
    assert degrees_off(rescued.state.T_camera_lidar) < KERNEL_DEG


def test_no_climb_leaves_the_search_range(terms):
    prior = prior_off_by(4.0, 0.05, 7)
    limits = SearchRange(np.radians(2.0), 0.03)
    scored = Scored(terms.sharp(), KERNEL, prior, SolveConfig(), limits)
    state = refine(scored, AlignmentState(prior.T_camera_lidar), steps=12)
    turn = log_so3(state.T_camera_lidar[:3, :3] @ prior.T_camera_lidar[:3, :3].T)
    assert np.abs(turn).max() < limits.rotation_rad + 1e-9
    assert np.abs(turn).max() > 0.9 * limits.rotation_rad  # the truth lies beyond: it went as far as it may
    shift = state.T_camera_lidar[:3, 3] - prior.T_camera_lidar[:3, 3]
    assert np.abs(shift).max() < limits.translation_m + 1e-9


def test_a_state_within_the_range_is_not_touched():
    prior, limits = prior_off_by(1.0, 0.02, 8), SearchRange(np.radians(6.0), 0.3)
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


def test_a_rival_near_by_is_asked_again_by_a_sharper_kernel(terms):
    basin = replace(searched(terms, prior_off_by(1.0, 0.02, 5)), rival_z=1.0, doubt="")
    sharper = KernelSettings.wide(*SCHEDULE.kernels[-1])
    scored = Scored(terms, sharper, prior_off_by(1.0, 0.02, 5), SolveConfig())
    best, same, other = (
        AlignmentState(turned(T_TRUE, np.radians([angle, 0.0, 0.0]))) for angle in (0.0, 0.1, 1.0)
    )
    assert not initialise.settled(basin, scored, best, same).doubt  # both starts lead there
    assert not initialise.settled(basin, scored, best, other).doubt  # the frames reject it
    assert "fits the frames as well" in initialise.settled(basin, scored, other, best).doubt
    assert initialise.settled(replace(basin, doubt="chance"), scored, best, same).doubt == "chance"


@pytest.fixture(scope="module")
def scored(terms):
    return Scored(terms, KernelSettings.wide(1.5, 2), prior_off_by(0.0, 0.0, 0), SolveConfig())


def value(scored, state):
    score = float(scored.terms.score(state.alone, scored.kernel).sum())
    return score + float(prior_value(state.alone, scored.prior, scored.config)[0])


@pytest.mark.parametrize("radius", [1.8, 8.0])
def test_a_refinement_never_ends_lower_than_it_began_however_wide_its_surface(scored, radius, monkeypatch):
    monkeypatch.setattr(module, "_SURFACE_SIZE", radius)
    rng = np.random.default_rng(1)
    scale = scales(scored.terms, scored.kernel)
    for steps in (1, 5):
        for _ in range(4):
            start = AlignmentState(T_TRUE).stepped(rng.normal(size=8) * scale)
            end = refine(scored, start, steps=steps)
            assert value(scored, end) >= value(scored, start)


def test_a_camera_whose_clock_is_half_a_second_off_is_seen_from_where_nothing_matches():
    day = traced_day(DENSE, 12, seed=5, dt_s=0.02)
    terms = prepare_terms(day, T_TRUE, lidar_velocities(day, np.eye(4)), reach_rad=np.radians(8.0))
    slid = AlignmentState(T_TRUE, dt_s=0.52)
    found_s, z = far_time_offset(terms, slid, KernelSettings.wide(1.5, 2), np.random.default_rng(0))
    assert abs(found_s - 0.02) < 0.04
    assert z > 2
