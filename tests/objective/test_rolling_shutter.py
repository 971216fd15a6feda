"""Each point is where its own image row saw it: the law of the projection, its inverse, and where it is used."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import (
    AlignmentState,
    align_camera_lidar,
    analyse_camera_lidar,
)
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.core.config import SolveConfig
from pipeline.core.rigs import CameraPrior
from pipeline.objective.camera_lidar.points import row_delays_s
from pipeline.objective.camera_lidar.score import prepare_terms
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, inverse, log_so3, perturb_exactly, transform_points
from tests.makers.traced_scenes import DENSE, SPARSE, T_TRUE, traced_day

READOUT_S = 0.05


@pytest.fixture(scope="module", params=[SPARSE, DENSE], ids=["pinhole", "f-theta"])
def terms(request):
    day = traced_day(request.param, 3, seed=2)
    velocity = np.array([[14.0, 1.0, 0.1], [25.0, 0.0, 0.0], [3.0, -0.5, 0.0]])
    made = prepare_terms(day, T_TRUE, velocity, reach_rad=0.0, readout_s=READOUT_S)
    return replace(made, yaw_rate=np.array([0.4, -0.2, 0.0]), gap_s=np.array([0.01, -0.02, 0.0]))


def driven(p, terms, f, by_s):
    """What stands still at p, in lidar axes, as long before the frame's time."""
    turn = exp_so3(np.array([0.0, 0.0, terms.yaw_rate[f] * by_s]))
    return turn @ (p + by_s * terms.velocity_lidar[f])


def test_a_static_point_is_where_the_car_was_when_its_own_row_was_exposed(terms):
    at = AlignmentState(T_TRUE, 0.02).alone
    seen = terms.exposed_at(at)
    camera = terms.maps.camera
    for before, after in ((terms.edges, seen.edges), (terms.markings, seen.markings)):
        frame = np.repeat(np.arange(terms.frames), np.diff(before.start))
        uv = []
        for f, delay_s, p in zip(frame, after.exposure_s, before.xyz_m.astype(float), strict=True):
            # Driven on for its row's delay, then for what lies between sweep and image.
            late = driven(p, terms, f, -float(delay_s))
            seen_m = driven(late, terms, f, 0.02 - terms.gap_s[f])
            uv.append(camera.project(transform_points(T_TRUE, seen_m[None]))[0][0])
        uv = np.array(uv)
        inside = camera.contains(uv)
        assert inside.sum() > 100
        expected_s = row_delays_s(uv[:, 1], camera.height_px, READOUT_S)
        np.testing.assert_allclose(after.exposure_s[inside], expected_s[inside], atol=2e-4)
    assert np.abs(seen.edges.exposure_s).max() > 0.1 * READOUT_S


def test_the_readout_time_of_the_prior_reaches_every_step_of_camera_lidar():
    day = traced_day(DENSE, 6, seed=1, dt_s=0.02, readout_s=READOUT_S)
    T = perturb_exactly(T_TRUE, np.radians(1.0), 0.03, np.random.default_rng(0))
    prior = Prior(T, np.eye(4), float(np.radians(2.0)), 0.05, camera=CameraPrior(READOUT_S))
    aligned = align_camera_lidar(day, prior, SolveConfig(), np.random.default_rng(0))
    turn = log_so3((aligned.state.T_camera_lidar @ inverse(T_TRUE))[:3, :3])
    assert np.degrees(np.abs(turn)).max() < 0.3
    terms = aligned.problem.terms
    there = terms.exposed_at(aligned.state.alone)
    # Exposed at the last state before this one: they know their rows to a hundredth of the readout.
    for a, b in ((terms.edges, there.edges), (terms.markings, there.markings)):
        np.testing.assert_allclose(a.exposure_s, b.exposure_s, atol=0.01 * READOUT_S)
    e = analyse_camera_lidar(aligned, np.random.default_rng(0), heading_rad=0.0)
    score = held_out_score(e, day, prior, SolveConfig())
    without = held_out_score(e, day, replace(prior, camera=CameraPrior()), SolveConfig())
    assert np.nansum(score.cost(e.T)) < np.nansum(without.cost(e.T))
