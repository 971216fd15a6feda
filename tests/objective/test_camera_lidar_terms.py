"""Boundary maps, analytic gradients, the sign of the time offset, and what the score says of right and wrong poses."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.estimate import AlignmentState
from pipeline.objective.camera_lidar.edges import chance_of, fit_match_share
from pipeline.objective.camera_lidar.image_maps import CameraMaps, boundary_offsets
from pipeline.objective.camera_lidar.points import Points, lidar_velocities
from pipeline.objective.camera_lidar.projection_loops import camera_parameters, project_point, project_points
from pipeline.objective.camera_lidar.score import Alignments, KernelSettings, Terms, prepare_terms
from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import perturb_exactly
from tests.makers.traced_scenes import DENSE, SPARSE, T_TRUE, traced_day

SKY, CAR = 10, 13


@pytest.fixture(scope="module", params=[SPARSE, DENSE], ids=["16 rings pinhole", "dense f-theta"])
def terms(request):
    day = traced_day(request.param, 6, seed=2, dt_s=0.03)
    return prepare_terms(day, T_TRUE, lidar_velocities(day, np.eye(4)), reach_rad=0.1).sharp()


_K = np.array([[400.0, 0, 210], [0, 420.0, 95], [0, 0, 1]])
_DISTORTED = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003]
CAMERAS = {
    "pinhole": Camera("plumb_bob", _K, np.zeros(5), 420, 190),
    "distorted": Camera("rational_polynomial", _K, np.array(_DISTORTED), 420, 190),
    "f-theta": Camera("equidistant", np.array([[260.0, 0, 210], [0, 250.0, 95], [0, 0, 1]]), np.zeros(4), 420, 190),
}  # fmt: skip


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_gradients_agree_with_differences_of_the_score(camera):
    """On maps without steps (one straight boundary, an even ramp of contrast) both must be the same."""
    rng = np.random.default_rng(0)
    n, F = 400, 2
    xyz = np.stack([rng.uniform(6, 30, n), rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)], -1).astype(
        np.float32
    )
    none, start = np.zeros(n, np.float32), np.array([0, 150, n])
    points = Points(xyz, start, np.zeros(n, np.uint8), np.zeros(n, np.uint8), none, none, np.arange(F))
    labels = np.full((camera.height_px, camera.width_px), SKY, np.uint8)
    labels[:, :200] = CAR
    offsets = np.stack([boundary_offsets(labels)] * F)
    contrast = np.stack(
        [np.add.outer(np.zeros(190), np.arange(420) - 210).clip(-120, 120).astype(np.int8)] * F
    )[None]
    maps = CameraMaps(camera, offsets, contrast, np.stack([labels] * F))
    velocity = np.array([[12.0, 0.5, 0.0], [5.0, 0.0, 0.0]])
    yaw_rate = np.array([0.3, -0.1])
    parameters = camera_parameters(camera)
    terms = Terms(maps, parameters, points, points, points, velocity, yaw_rate, np.zeros(F), 0.03)
    level = KernelSettings.wide(20.0, 0)
    state = AlignmentState(T_TRUE, 0.02, 1.001)
    terms = terms.exposed_at(state.alone)
    analytic = terms.camera_gradient(state.alone, level)[0].sum(0)
    np.testing.assert_array_equal(terms.gradient(state.alone, level)[0].sum(0), analytic[:8])
    h = np.array([1e-3] * 3 + [1e-2] * 3 + [2e-3, 2e-3])
    value = terms.score(state.moved(np.concatenate([np.diag(h), -np.diag(h)])), level).sum(1)
    np.testing.assert_allclose(analytic[:8], (value[:8] - value[8:]) / (2 * h), rtol=0.02, atol=2.0)

    def score(right_px, down_px, longer_s):
        shifted = parameters + np.array([0, 0, 0, right_px, down_px, *np.zeros(13)], np.float32)
        other = replace(terms, camera=shifted, readout_s=terms.readout_s + longer_s)
        return other.exposed_at(state.alone).score(state.alone, level).sum()

    h = np.array([0.4, 0.4, 0.01])
    differences = [
        (score(*step) - score(*-step)) / (2 * size) for step, size in zip(np.diag(h), h, strict=True)
    ]
    # A later row sees points elsewhere, in a later row again: a few hundredths more by differences.
    np.testing.assert_allclose(analytic[8:], differences, rtol=0.05, atol=0.5)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_vector_projection_agrees_with_the_point_by_point_one_and_marks_what_cannot_be_seen(camera):
    c = camera_parameters(camera)
    xyz = np.random.default_rng(0).normal(0, 10, (3, 500)).astype(np.float32)
    u, v = np.empty(500, np.float32), np.empty(500, np.float32)
    pose = np.eye(4)[:3].reshape(-1).astype(np.float32)
    project_points(c, xyz, 0, 500, pose, np.float32(1.0), u, v)
    alone = [project_point(c, *p) for p in xyz.T]
    seen = np.array([a[2] for a in alone])
    np.testing.assert_array_equal(u == -1, ~seen)
    np.testing.assert_allclose(np.stack([u, v], -1)[seen], [a[:2] for a in alone if a[2]], atol=0.02)


def test_a_gap_between_the_stamps_is_a_time_offset_of_its_frame_the_other_way_round(terms):
    gaps = np.random.default_rng(0).uniform(-0.04, 0.04, terms.frames)
    moving = replace(terms, yaw_rate=np.full(terms.frames, 0.2))
    gapped = replace(moving, gap_s=gaps).poses(AlignmentState(T_TRUE, 0.03).alone)[0]
    for f, gap in enumerate(gaps):
        without = replace(moving, gap_s=np.zeros(terms.frames)).poses(
            AlignmentState(T_TRUE, 0.03 - gap).alone
        )
        np.testing.assert_allclose(gapped[f], without[0, f], atol=1e-6)
    kept = replace(terms, gap_s=gaps).of_frames(np.array([1, 0]))
    np.testing.assert_array_equal(kept.gap_s, gaps[[1, 0]])


def test_score_is_best_at_the_true_pose_and_time_offset(terms):
    level = KernelSettings.wide(3.0, 1)
    rng = np.random.default_rng(0)
    wrong = [perturb_exactly(T_TRUE, np.radians(1.0), 0.05, rng) for _ in range(20)]
    T = np.stack([T_TRUE, *wrong])
    score = terms.score(Alignments(T, np.full(21, 0.03), np.ones(21)), level).sum(1)
    assert score.argmax() == 0
    offsets = np.array([-0.06, 0.0, 0.03, 0.09])
    at = Alignments(np.repeat(T_TRUE[None], 4, 0), offsets, np.ones(4))
    assert terms.score(at, level).sum(1).argmax() == 2


def test_edges_seen_throughout_are_in_sight_at_every_alignment_and_no_others_are_left_out(terms):
    turned = AlignmentState(T_TRUE, 0.02).changed(
        np.outer([-0.4, 0.4], np.eye(8)[1])
    )  # 0.4 rad to either side
    one, other = (
        Alignments(turned.T_camera_lidar[k : k + 1], turned.dt_s[k : k + 1], turned.focal[k : k + 1])
        for k in (0, 1)
    )
    both = terms.seen_throughout(turned)
    kept = len(both.edges.xyz_m)
    assert both.edges_in_view(one)[0] == both.edges_in_view(other)[0] == kept
    assert 0 < kept < min(terms.edges_in_view(one)[0], terms.edges_in_view(other)[0])
    assert len(terms.seen_throughout(one).edges.xyz_m) == terms.edges_in_view(one)[0]
    in_turn = terms.seen_throughout(one).seen_throughout(other)
    np.testing.assert_array_equal(in_turn.edges.xyz_m, both.edges.xyz_m)


def test_share_of_matches_is_recovered_and_vanishes_where_there_are_none():
    rng = np.random.default_rng(0)
    chance_px = rng.uniform(-90, 90, 4000)
    matched = np.where(rng.random(4000) < 0.3, rng.normal(0, 0.8, 4000), rng.uniform(-90, 90, 4000))
    kind = np.repeat(np.array([0, 1], np.uint8), 4000)
    chance = chance_of(np.tile(chance_px, 2).astype(np.float32), kind, 2)
    here = np.concatenate([matched, rng.uniform(-90, 90, 4000)]).astype(np.float32)
    share = fit_match_share(here, kind, np.full(8000, 1.5), chance)
    assert share[0] == pytest.approx(0.3, abs=0.05)
    assert share[1] < 0.03
