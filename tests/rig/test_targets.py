"""The paper's error at corner reflectors, from truth and from picks, and its Table 1."""

import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.calibrate.judging import Judged, Judging
from pipeline.calibrate.records import Inputs, record_of
from pipeline.calibrate.select.frames import Selection
from pipeline.calibrate.solved import SolvedDay
from pipeline.calibrate.verify.target_accuracy import Claim
from pipeline.calibrate.verify.verdict import Verdict
from pipeline.core.config import FleetConfig
from pipeline.evaluate.comparison import compare, current_runs
from pipeline.evaluate.table import as_markdown, as_parquet, table_rows
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import exp_so3, inverse, transform_points
from pipeline.rig.targets import (
    DEFAULT_TARGETS,
    Picks,
    PickUncertainty,
    error_sigma_at_picks,
    errors_at_targets,
    errors_of_picks,
    loop_error_sigma,
    loop_errors,
)
from pipeline.store.partitions import Partition
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

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
    claims = dict.fromkeys(("azimuth", "elevation"), Claim(0.003, 0.0, 0.003, 0.002, 0.007, 0.995))
    judged = dict.fromkeys(PAIRS, Judged(Verdict("accepted", ""), None, claims))
    metrics, fired = {p: {} for p in PAIRS}, dict.fromkeys(PAIRS, True)
    solution = Solution(method, pairs)
    judging = Judging(day, selection, prior, FleetConfig.model_construct(), PAIRS, None)
    solved = SolvedDay(day, selection, prior, solution, judged, empty, judging, [], metrics, fired)
    return [record_of(about, p, solved) for p in PAIRS]


def compared_runs(picks=None):
    records = [*make_run(), *make_run(method="joint-optimisation", key="k2", off_deg=0.5, speed=30.0)]
    return [compare(run, None if picks else TRUTH, picks) for run in current_runs(records)]


def test_tables_hold_our_errors_and_the_papers_rows_as_other_data():
    comparisons = compared_runs()
    texts = as_markdown(table_rows(comparisons), comparisons, ["positions: made up"])
    first, extended = texts["Table 1"], texts["Extended data table 1"]
    ours = next(line for line in first.splitlines() if line.startswith("| joint | all"))
    assert "| 1 | 0.20" in ours
    assert "3 of 3 pairs" in ours
    assert "| joint-optimisation | highway | 1 | 0.50" in extended
    assert "highway" not in first
    printed = (
        "| paper: joint optimization | all | other data | 0.22 / 0.27 | 0.20 / 0.45 | 0.36 / 0.72 / 0.14 |"
    )
    lines = first.splitlines()
    row = next(i for i, line in enumerate(lines) if line.startswith(printed))
    assert lines[row - 1].startswith("| joint-optimisation | all | 1 |")
    assert "| (prior) | all | 2 | 2.0" in first
    assert "- positions: made up" in first


def test_methods_without_records_keep_their_rows_with_dashes():
    comparisons = compared_runs()
    texts = as_markdown(table_rows(comparisons), comparisons)
    assert "| joint-ssl | all | 0 | - | - | - | - |  |" in texts["Table 1"]
    assert "| joint-ssl | urban | 0 | - | - | - | - |  |" in texts["Extended data table 1"]


def test_a_loop_closed_by_construction_is_called_so_and_the_independent_one_is_told():
    run = {p: replace(r, loop_rotation_rad=np.radians(0.12), loop_translation_m=0.04) for p, r in
           current_runs(make_run(off_deg=0.0))[0].items()}  # fmt: skip
    comparisons = [compare(run, TRUTH)]
    rows = table_rows(comparisons)
    remark = "- joint closes the loop by construction; loop of its independent pairs: 0.120 deg, 0.040 m"
    assert remark in as_markdown(rows, comparisons)["Table 1"]
    opened = [compare(current_runs(make_run(off_deg=0.3))[0], TRUTH)]
    assert "closes the loop" not in as_markdown(table_rows(opened), opened)["Table 1"]


def test_a_loop_of_rotations_only_is_told_without_a_shift():
    run = {p: replace(r, loop_rotation_rad=np.radians(0.9)) for p, r in
           current_runs(make_run(off_deg=0.0))[0].items()}  # fmt: skip
    comparisons = [compare(run, TRUTH)]
    rows = table_rows(comparisons)
    assert "independent pairs: 0.900 deg, over rotations only" in as_markdown(rows, comparisons)["Table 1"]
    told = [
        r for r in pq.read_table(pa.BufferReader(as_parquet(rows))).to_pylist() if r["independent_loop_deg"]
    ]
    assert [r["independent_loop_m"] for r in told] == [None] * len(told)
    assert len(told) == 2  # of all environments, and of the run's own


def test_our_numbers_have_three_digits_and_the_paper_s_its_two():
    lines = as_markdown(table_rows(compared_runs()), compared_runs())["Table 1"].splitlines()
    ours = next(line for line in lines if line.startswith("| joint | all"))
    printed = next(line for line in lines if line.startswith("| paper: joint SSL | all"))
    assert {len(n.split(".")[1]) for n in re.findall(r"\d+\.\d+", ours)} == {3}
    assert {len(n.split(".")[1]) for n in re.findall(r"\d+\.\d+", printed)} == {2}


def test_the_parquet_table_says_the_same_as_the_markdown():
    comparisons = compared_runs()
    rows = table_rows(comparisons)
    table = pq.read_table(pa.BufferReader(as_parquet(rows, ["a note"])))
    assert table.schema.metadata[b"truth"] == b"a note"
    content = table.to_pylist()
    ours = next(r for r in content if (r["method"], r["environment"]) == ("joint", "all"))
    assert ours["camera_lidar_azimuth_deg"] == pytest.approx(0.2, abs=0.01)
    assert (ours["source"], ours["accepted_pairs"], ours["pairs"]) == ("ours", 3, 3)
    tracking = [r for r in content if r["method"] == "paper: object tracking [60]"]
    assert [(r["source"], r["runs"], r["loop_range_m"]) for r in tracking] == [
        ("paper (other data)", None, None)
    ]
    assert {r["table"] for r in content if r["environment"] != "all"} == {"Extended data table 1"}


def uncertain_picks(pixel=0.0, lidar=0.0, radar=0.0):
    sizes = zip((2, 3, 3), (pixel, lidar, radar), strict=True)
    uncertainty = PickUncertainty(*(np.full((3, n), sd) for n, sd in sizes))
    return replace(picks_of(), spread=uncertainty, sigma=uncertainty), uncertainty


@pytest.mark.parametrize("pair", PAIRS)
def test_the_truths_own_sigma_is_the_scatter_that_its_picks_make(pair):
    picks, uncertainty = uncertain_picks(0.8, 0.03, 0.1)
    rng = np.random.default_rng(4)
    of_each = []
    for k in range(3):
        pixels, lidar, radar = (
            at[k] + sd[k] * rng.standard_normal((20_000, len(at[k])))
            for at, sd in (
                (picks.pixels, uncertainty.pixels),
                (picks.lidar_m, uncertainty.lidar_m),
                (picks.radar_m, uncertainty.radar_m),
            )
        )
        # The mean absolute value of a normal variable is sqrt(2 / pi) of its sigma.
        of_each.append(
            errors_of_picks(pair, TRUTH[pair], Picks(pixels, lidar, radar, CAMERA)) * np.sqrt(np.pi / 2)
        )
    expected = np.sqrt(np.mean(np.square(of_each), axis=0))
    found = error_sigma_at_picks(pair, TRUTH[pair], picks, uncertainty)
    wanted = slice(3 if pair == "lidar_radar" else 2)
    np.testing.assert_allclose(found[wanted], expected[wanted], rtol=0.03)


def test_a_loop_hardly_cares_where_its_points_were_picked():
    picks, uncertainty = uncertain_picks(lidar=0.1)
    opened = TRUTH | {"lidar_radar": turned(T_LIDAR_RADAR, 2, 0.3)}
    assert np.degrees(loop_error_sigma(opened, picks, uncertainty)[:2]).max() < 0.01


def test_a_table_from_picks_states_what_the_truth_is_worth():
    comparisons = compared_runs(uncertain_picks(radar=0.1)[0])
    text = as_markdown(table_rows(comparisons), comparisons)["Table 1"]
    line = next(x for x in text.splitlines() if x.startswith("| (truth: 1 sigma"))
    lidar_radar = [float(v) for v in line.split("|")[6].split("/")]
    # 0.1 m across at 15, 25 and 40 m; 0.1 m along the beam
    across = np.degrees(0.1 * np.sqrt(np.mean(1 / np.array([15, 25, 40]) ** 2)))
    assert lidar_radar == pytest.approx([across, across, 0.1], rel=0.05)


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
