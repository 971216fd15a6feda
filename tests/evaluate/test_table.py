"""The paper's Table 1 of records against truth and against picks."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.evaluate.comparison import compare, current_runs
from pipeline.evaluate.table import as_markdown, as_parquet, table_rows
from pipeline.rig.graph import pose_columns
from pipeline.rig.se3 import inverse, transform_points
from pipeline.rig.targets import DEFAULT_TARGETS, Picks, PickUncertainty
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS, CalibrationRecord
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, TRUTH, turned


def make_run(method="joint", seed=0, key="k1", off_deg=0.2, environment="urban"):
    """Records of the three pairs, off by a yaw and by .2 deg and 5 cm of sigma; priors 2 deg off."""
    axes = {pair: 1 if pair != "lidar_radar" else 2 for pair in PAIRS}
    about = {"vehicle": "v", "day": "2024-01-01", "status": "accepted", "reason": "", "code_version": "v"}
    about |= {"method": method, "work_key": key, "seed": seed, "environment": environment}
    about |= {"covariance": np.diag([np.radians(0.2) ** 2] * 3 + [0.05**2] * 3), "observable": [True] * 6}
    frames = ("parent_frame", "child_frame")
    return [
        CalibrationRecord(
            pair=pair,
            **dict(zip(frames, FRAMES_OF_PAIR[pair], strict=True)),
            **pose_columns(turned(TRUTH[pair], axis, off_deg)),
            **pose_columns(turned(TRUTH[pair], axis, 2.0), "prior_"),
            **about,
        )
        for pair, axis in axes.items()
    ]


def compared_runs(picks=None):
    records = [
        *make_run(),
        *make_run(method="joint-optimisation", key="k2", off_deg=0.5, environment="highway"),
    ]
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
    assert (
        "| joint-optimisation | 18 | 83% | 100% | 1.02 |" in first + extended
    )  # one axis in six by 2.5 sigmas


def test_a_loop_closed_by_construction_is_called_so_and_the_independent_one_is_told():
    run = {p: replace(r, loop_rotation_rad=np.radians(0.12), loop_translation_m=0.04) for p, r in
           current_runs(make_run(off_deg=0.0))[0].items()}  # fmt: skip
    comparisons = [compare(run, TRUTH)]
    rows = table_rows(comparisons)
    remark = "- joint closes the loop by construction; loop of its independent pairs: 0.120 deg, 0.040 m"
    assert remark in as_markdown(rows, comparisons)["Table 1"]
    opened = [compare(current_runs(make_run(off_deg=0.3))[0], TRUTH)]
    assert "closes the loop" not in as_markdown(table_rows(opened), opened)["Table 1"]


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


def picks_with_radar_sigma(sigma_m):
    pixels = CAMERA.project(transform_points(T_CAMERA_LIDAR, DEFAULT_TARGETS))[0]
    radar = transform_points(inverse(T_LIDAR_RADAR), DEFAULT_TARGETS)
    known = PickUncertainty(np.zeros((3, 2)), np.zeros((3, 3)), np.full((3, 3), sigma_m))
    return Picks(pixels, DEFAULT_TARGETS, radar, CAMERA, spread=known, sigma=known)


def test_a_table_from_picks_states_what_the_truth_is_worth():
    comparisons = compared_runs(picks_with_radar_sigma(0.1))
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
