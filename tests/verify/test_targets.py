"""The paper's error at corner reflectors, from truth and from picks, and its Table 1."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibration_records import Inputs, record_of
from pipeline.geometry.se3 import exp_so3, inverse, transform_points
from pipeline.objective.problem import PairEstimate, Prior, Solution
from pipeline.solve.select import Selection
from pipeline.store.partitions import Partition
from pipeline.verify.evaluation import compare, current_runs, table_1
from pipeline.verify.targets import DEFAULT_TARGETS, Picks, errors_at_targets, errors_of_picks, loop_errors
from pipeline.verify.verdict import Verdict
from schemas.calibrations import PAIRS
from tests.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

TRUTH = {
    "camera_lidar": T_CAMERA_LIDAR,
    "lidar_radar": T_LIDAR_RADAR,
    "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR,
}


def turned(T, axis, angle_deg):
    T = T.copy()
    T[:3, :3] = exp_so3(np.radians(angle_deg) * np.eye(3)[axis]) @ T[:3, :3]
    return T


def test_targets_lie_at_15_25_and_40_metres():
    np.testing.assert_allclose(np.linalg.norm(DEFAULT_TARGETS, axis=1), [15, 25, 40])


@pytest.mark.parametrize(
    ("pair", "yaw_axis", "pitch_axis"),
    [("camera_lidar", 1, 0), ("camera_radar", 1, 0), ("lidar_radar", 2, 1)],
)
def test_a_turn_shows_as_its_angle(pair, yaw_axis, pitch_axis):
    yawed = errors_at_targets(pair, turned(TRUTH[pair], yaw_axis, 0.5), TRUTH[pair])
    assert np.degrees(yawed[0]) == pytest.approx(0.5, abs=0.03)
    assert np.degrees(yawed[1]) < 0.05
    pitched = errors_at_targets(pair, turned(TRUTH[pair], pitch_axis, 0.5), TRUTH[pair])
    assert np.degrees(pitched[1]) == pytest.approx(0.5, abs=0.03)


def test_a_shift_ahead_shows_as_range():
    T = T_LIDAR_RADAR.copy()
    T[0, 3] += 0.2
    assert errors_at_targets("lidar_radar", T, T_LIDAR_RADAR)[2] == pytest.approx(0.2, abs=0.005)


def test_the_loop_of_consistent_transforms_is_closed_and_an_open_one_shows_its_angle():
    np.testing.assert_allclose(loop_errors(TRUTH), 0, atol=1e-12)
    opened = TRUTH | {"lidar_radar": turned(T_LIDAR_RADAR, 2, 0.3)}
    assert np.degrees(loop_errors(opened)[0]) == pytest.approx(0.3, abs=0.02)


def picks_of(shift_px=(0.0, 0.0)):
    lidar = DEFAULT_TARGETS
    pixels = CAMERA.project(transform_points(T_CAMERA_LIDAR, lidar))[0] + np.array(shift_px)
    return Picks(pixels, lidar, transform_points(inverse(T_LIDAR_RADAR), lidar), CAMERA)


@pytest.mark.parametrize("pair", PAIRS)
def test_picks_of_the_truth_show_no_error(pair):
    error = errors_of_picks(pair, TRUTH[pair], picks_of())
    assert np.degrees(np.nanmax(error[:2])) < 1e-6
    assert np.isnan(error[2]) == (pair != "lidar_radar")


def test_pixel_deviations_become_angles():
    error = errors_of_picks("camera_lidar", T_CAMERA_LIDAR, picks_of(shift_px=(5.0, 0.0)))
    assert error[0] == pytest.approx(5 / 500, rel=0.1)  # off-axis pixels span a little less
    assert np.degrees(error[1]) < 0.03


def make_run(method="joint", seed=0, key="k1", off_deg=0.2, speed=10.0):
    prior = Prior(turned(T_CAMERA_LIDAR, 1, 2), turned(T_LIDAR_RADAR, 2, 2), np.radians(2), 0.05)
    covariance = np.diag([np.radians(0.2) ** 2] * 3 + [0.05**2] * 3)
    pairs = {
        p: PairEstimate(
            p,
            turned(TRUTH[p], 1 if p != "lidar_radar" else 2, off_deg),
            covariance,
            np.ones(6),
            np.ones(6, bool),
            40,
        )
        for p in PAIRS
    }
    empty = {p: [] for p in PAIRS}
    selection = Selection(empty, empty, dict.fromkeys(PAIRS, 0), {p: {} for p in PAIRS})
    day = [replace(o, ego_speed_mps=speed) for o in make_day(1)]
    about = Inputs(Partition("v", "2024-01-01"), method, key, seed, ())
    return [
        record_of(
            about, p, Solution(method, pairs), prior, Verdict("accepted", ""), None, selection, day,
            before={}, after={}, triggered=True,
        )
        for p in PAIRS
    ]  # fmt: skip


def test_table_holds_our_errors_and_the_papers_rows_as_other_data():
    runs = current_runs(
        [*make_run(), *make_run(method="joint-optimisation", key="k2", off_deg=0.5, speed=30.0)]
    )
    text = table_1([compare(run, TRUTH) for run in runs])
    ours = next(line for line in text.splitlines() if line.startswith("| joint | all"))
    assert "| 1 | 0.20" in ours
    assert "3 of 3 pairs" in ours
    assert "| joint-optimisation | highway | 1 | 0.50" in text
    assert (
        "| paper: joint optimization | all | other data | 0.22 / 0.27 | 0.20 / 0.45 | 0.36 / 0.72 / 0.14 |"
        in text
    )
    assert "| (prior) | all | 2 | 2.0" in text


def test_normalised_errors_are_errors_in_sigmas():
    comparison = compare(current_runs(make_run(off_deg=0.2))[0], TRUTH)
    assert np.abs(comparison.normalised).max() == pytest.approx(1.0, rel=0.05)
    assert len(comparison.normalised) == 18
    doubtful = compare(current_runs(make_run(off_deg=0.2))[0], TRUTH, truth_sigma=(np.radians(0.2), 0.05))
    np.testing.assert_allclose(doubtful.normalised, comparison.normalised / np.sqrt(2))


def test_a_repeated_run_counts_once_and_another_seed_counts_again():
    records = [*make_run(key="old"), *make_run(key="new", off_deg=0.1), *make_run(key="other", seed=1)]
    runs = current_runs(records)
    assert sorted(next(iter(r.values())).work_key for r in runs) == ["new", "other"]


def test_a_refused_run_has_no_errors():
    records = [replace(r, qw=None) for r in make_run()]
    assert compare(current_runs(records)[0], TRUTH) is None
