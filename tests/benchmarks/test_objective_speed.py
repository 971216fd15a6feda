"""Speed of the objectives as the methods call them, as ratios to the same in plain NumPy: CPU time, one thread.

Rows, points, settings and batches are those of a day of the demo rig; both sides say the same of them first. Ratios are
the best of interleaved rounds in one process.
"""

import numpy as np
import pytest

from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState, scales
from pipeline.calibrate.numerics.bias_floors import OUTLIER_DENSITY
from pipeline.calibrate.numerics.response_surface import DESIGN
from pipeline.geometry.changes import changed
from pipeline.objective.camera_lidar.own_motion import lidar_velocities
from pipeline.objective.camera_lidar.score import KernelSettings, prepare_terms
from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
from pipeline.objective.radar.registration import (
    BOUNCE_PRIOR,
    SIGMA_START,
    normal_equations,
    registration_frames,
)
from schemas.calibrations import PAIRS
from tests.benchmarks import numpy_objectives
from tests.benchmarks.kernel_workload import best_cpu_s
from tests.makers.simulated_days import simulated_day

ROUNDS, FRAMES = 5, 12
MARGIN_RAD = np.radians(6.0)  # the search range of the paper's methods
CANDIDATES = 90  # a generation of their evolution


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Observations of a few frames of the demo rig, and the true poses."""
    made = simulated_day(tmp_path_factory.mktemp("objective"), frames=FRAMES)
    return made.observations, made.truth


@pytest.fixture(scope="module")
def losses(day):
    rows, truth = day
    return {
        "camera_lidar": camera_lidar_loss(rows, truth["camera_lidar"], MARGIN_RAD),
        "camera_radar": camera_radar_loss(rows, truth["camera_radar"], MARGIN_RAD),
        "lidar_radar": lidar_radar_loss(rows),
    }


def test_the_camera_lidar_score_is_many_times_as_fast_as_numpy(day, gate):
    """One response surface of the refinement: edges and markings of all frames at 133 alignments."""
    rows, truth = day
    T = truth["camera_lidar"]
    velocity = lidar_velocities(rows, truth["lidar_radar"])
    terms = prepare_terms(rows, T, velocity, reach_rad=np.radians(8.0)).sharp(5.0)
    terms = terms.in_view(T, np.radians(2.0))
    state = AlignmentState(T, 0.01)
    settings = terms.fitted(state.alone, KernelSettings.wide(1.5, 2), np.random.default_rng(0))
    at = state.moved(1.8 * scales(terms, settings) * DESIGN)
    few = state.moved(1.8 * scales(terms, settings) * DESIGN[:4])
    ours, plain = terms.score(few, settings), numpy_objectives.score(terms, few, settings)
    assert np.abs(plain).max() > 10
    np.testing.assert_allclose(ours, plain, atol=0.01 * np.abs(plain).max())
    fast, slow = best_cpu_s(
        ROUNDS,
        lambda: terms.score(at, settings),
        lambda: numpy_objectives.score(terms, few, settings),
    )
    points = len(terms.edges.xyz_m) + len(terms.markings.xyz_m)
    print(f"\n{points / FRAMES:.0f} points a frame, {1e-6 * points * len(at.dt_s) / fast:.0f} M points/s")
    gate("score_vs_numpy", slow / len(few.dt_s) / (fast / len(at.dt_s)))


def test_the_registration_is_many_times_as_fast_as_numpy(day, gate):
    """One step of the last search: all detections of all frames, the radar's own sigmas, bounces, normal equations."""
    rows, truth = day
    T = truth["lidar_radar"]
    frames = registration_frames(rows, T, np.random.default_rng(0))
    how = (frames, T, 0.005, SIGMA_START, BOUNCE_PRIOR, OUTLIER_DENSITY)
    ours, plain = normal_equations(*how), numpy_objectives.registration(*how)
    for a, b in zip((ours.H, ours.g, ours.information, ours.cost), plain, strict=True):
        assert np.abs(b).max() > 0.1
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())
    fast, slow = best_cpu_s(
        ROUNDS, lambda: normal_equations(*how), lambda: numpy_objectives.registration(*how)
    )
    pairs = np.diff(frames.radar_first) @ np.diff(frames.lidar_first)
    print(f"\n{len(frames.radar_m) / frames.count:.0f} detections, {pairs / frames.count:.2g} pairs a frame")
    gate("registration_vs_numpy", slow / fast)


@pytest.mark.parametrize("pair", PAIRS)
def test_the_papers_losses_are_faster_than_numpy(day, losses, gate, pair):
    """One generation of the paper's evolution: the pair's loss of all frames at 90 poses within the search range."""
    rows, truth = day
    loss, plain = losses[pair], numpy_objectives.paper_losses(rows, losses)[pair]
    x = np.random.default_rng(0).uniform(-1, 1, (CANDIDATES, 6)) * np.array([MARGIN_RAD] * 3 + [0.3] * 3)
    poses = changed(truth[pair], x)
    few = poses[:3]
    ours, theirs = loss.frame_losses(few), np.stack([plain(T) for T in few])
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours, theirs, atol=0.01)
    fast, slow = best_cpu_s(ROUNDS, lambda: loss.frame_losses(poses), lambda: [plain(T) for T in few])
    gate(f"paper_{pair}_vs_numpy", slow / len(few) / (fast / len(poses)))
