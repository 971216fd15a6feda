"""Refinement of the camera-lidar score: where its steps may lead."""

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar import refine as module
from pipeline.calibrate.joint.camera_lidar.profiles import far_time_offset
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, Scored, prior_value, refine, scales
from pipeline.core.config import SolveConfig
from pipeline.objective.camera_lidar.points import lidar_velocities
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.rig.estimates import Prior
from tests.makers.traced_scenes import DENSE, T_TRUE, traced_day

SHARP = KernelSettings.wide(1.5, 2)


@pytest.fixture(scope="module")
def scored():
    day = traced_day(DENSE, 8, seed=5)
    terms = prepare_terms(day, T_TRUE, lidar_velocities(day, np.eye(4)), reach_rad=np.radians(8.0))
    return Scored(terms, SHARP, Prior(T_TRUE, np.eye(4), np.radians(2.0), 0.05), SolveConfig())


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


@pytest.mark.parametrize("slid_s", [0.5, pytest.param(-0.5, marks=pytest.mark.slow)])
def test_a_camera_whose_clock_is_half_a_second_off_is_seen_from_where_nothing_matches(slid_s):
    day = traced_day(DENSE, 12, seed=5, dt_s=0.02)
    terms = prepare_terms(day, T_TRUE, lidar_velocities(day, np.eye(4)), reach_rad=np.radians(8.0))
    slid = AlignmentState(T_TRUE, dt_s=0.02 + slid_s)
    found_s, z = far_time_offset(terms, slid, SHARP, np.random.default_rng(0))
    assert abs(found_s - 0.02) < 0.04
    assert z > 2


def test_what_is_fixed_stays_at_the_prior(scored):
    fixed = np.isin(np.arange(8), (5, 6, 7))
    start = AlignmentState(T_TRUE).stepped(0.3 * scales(scored.terms, scored.kernel))
    end = refine(scored, start, steps=3, fixed=fixed)
    assert end.T_camera_lidar[2, 3] == scored.prior.T_camera_lidar[2, 3]
    assert (end.dt_s, end.focal) == (start.dt_s, start.focal)
