"""The paper's tables and figures beside ours: what is printed is what was measured, and the page opens by itself."""

import json
import re
from types import SimpleNamespace

import numpy as np

from pipeline.config import load_fleet
from pipeline.geometry.se3 import exp_se3
from pipeline.report.overlays import Extrinsics, Scene
from schemas.calibrations import PAIRS
from tests.benchmarks.studies import paper_figures, paper_ssl, paper_table, reflector_table
from tests.benchmarks.studies.engine import RESULTS, read_results
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day
from tests.makers.training_lakes import frame_of


def test_the_papers_columns_are_means_of_the_lines_measured_and_its_rows_stand_below_ours():
    results = [
        json.loads(line) for name in paper_table.FILES for line in (RESULTS / name).read_text().splitlines()
    ]
    name = "pairwise-optimisation, learned drivable areas"
    lines = paper_table.paper_table(results, "Table 1", "").splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"| {name} |"))
    mine = [r for r in results if r.get("row") == name]
    told = [float(v) for v in lines[at].strip("| ").split(" | ")[1:]]
    assert told[0] == len(mine) == 10
    assert abs(told[5] - np.mean([r["pairs"]["lidar_radar"]["az_deg"] for r in mine])) < 6e-4
    assert np.allclose(told[8:], np.mean([r["loop"] for r in mine], axis=0), atol=6e-4)
    assert "paper: pairwise optimization" in lines[at + 1]
    assert "*1.43* | *0.83* | *0.01*" in lines[at + 1]  # the loop that the paper prints
    joint = next(line for line in lines if line.startswith("| joint |"))
    assert joint.endswith("closed | closed | closed |")  # not an accuracy of zero
    urban, highway = (paper_table.values_of(results, name, e) for e in ("urban", "highway"))
    assert len(urban) == len(highway) == 5
    committed = (RESULTS / "table1_paper.md").read_text()
    assert "\n".join(lines) in committed
    runs = json.loads((RESULTS / "paper_ssl.json").read_text())["runs"]
    own = paper_table.own_table(read_results(RESULTS / paper_table.OWN), runs)
    assert own.count("one frame, one pass") == 2
    assert own in committed


def test_the_papers_own_training_is_told_by_single_passes_and_days_with_its_share_of_samples():
    line = {"method": "pairwise-ssl", "day": {"environment": "urban"}}
    passes = {p: {"prior": [[1.0, 2.0, 0.1]], "errors": [[[0.5, 0.6, 0.2], [9.0] * 3]]} for p in PAIRS}
    day = {p: {"az_deg": 3.0, "el_deg": 4.0, "range_m": 0.3} for p in PAIRS}
    results = [
        line | {"part": "frames", "starts": {"prior": passes}},
        line | {"part": "days", "pairs": day, "loop": [5.0, 6.0, 0.4]},
    ]
    lines = paper_table.own_table(results, {"joint": {"samples": 40_000}}).splitlines()
    assert lines[1] == "joint 1.00%"
    start, frame, whole, printed = lines[5:]
    assert start.endswith("| 1 | 1.000 | 2.000 | 1.000 | 2.000 | 1.000 | 2.000 | 0.100 | - | - | - |")
    assert frame.endswith("| 1 | 0.500 | 0.600 | 0.500 | 0.600 | 0.500 | 0.600 | 0.200 | - | - | - |")
    assert whole.endswith("| 3.000 | 4.000 | 0.300 | 5.000 | 6.000 | 0.400 |")
    assert printed.startswith("| *paper: pairwise SSL")


def test_the_page_of_figures_needs_nothing_from_outside_and_tells_errors_against_the_truth():
    observations = make_day(3, seed=1)
    scenes = [Scene(frame_of(o, np.random.default_rng(i)), o) for i, o in enumerate(observations)]
    truth = {
        "camera_lidar": T_CAMERA_LIDAR,
        "camera_radar": T_CAMERA_LIDAR @ T_LIDAR_RADAR,
        "lidar_radar": T_LIDAR_RADAR,
    }
    right = Extrinsics(truth["camera_lidar"], truth["camera_radar"], truth["lidar_radar"])
    turned = exp_se3(np.array([0.0, np.radians(1.5), 0.0, 0.0, 0.0, 0.0])) @ T_CAMERA_LIDAR
    wrong = Extrinsics(turned, turned @ T_LIDAR_RADAR, T_LIDAR_RADAR)
    states = dict.fromkeys(paper_figures.METHODS, right)
    day = SimpleNamespace(true_of=truth.__getitem__)
    page = paper_figures.figures_page("a day", scenes, wrong, states, [(wrong, right)] * 3, day)
    assert [f"Figure {n}" in page for n in (1, 3, 4)] == [True] * 3
    assert "prior: camera-lidar 1.50 / 0.0" in page  # 1.5 deg to a side
    assert "joint: camera-lidar 0.00 / 0.00, camera-radar 0.00 / 0.00" in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert len(re.findall(r"<figure>", page)) == 2 + 8 + 12
    halves = [dict.fromkeys(paper_figures.HALVES, state) for state in (right, wrong)]
    both = paper_figures.extended_page("days", [(day, scenes[:2]), (day, scenes[:1])], halves)
    assert "Extended data figure 1" in both
    assert len(re.findall(r"<figure>", both)) == 8 + 4
    assert "joint-ssl: camera-lidar 1.50 / 0.0" in both.partition("Extended data figure 2")[2]
    empty = paper_figures.without_lidar(scenes[0])
    assert len(empty.frame.lidar_xyz_m) == 0
    assert len(empty.observation.radar_track_xyz_m) == len(scenes[0].observation.radar_track_xyz_m)


def test_a_learning_curve_is_continued_by_its_power_law_and_not_where_it_does_not_fall(tmp_path):
    samples = np.array([1e3, 2e3, 4e3, 6e3, 8e3])
    law = 0.7 + 3.0 * samples**-0.25
    found = paper_ssl.extrapolated(samples, law, 0.7)
    assert abs(found["slope"] + 0.25) < 1e-3
    assert abs(found["at_paper"] - (0.7 + 3.0 * paper_ssl.PAPER_SAMPLES**-0.25)) < 1e-3
    assert abs(found["halved_at"] / (8e3 * 16) - 1) < 0.01
    assert paper_ssl.extrapolated(samples, law[::-1], 0.7) is None
    assert paper_ssl.extrapolated(samples[:2], law[:2], 0.7) is None
    lines = [{"step": 500, "validation/alignment": 1.25}, {"step": 510, "loss": 1.0}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert paper_ssl.curve_of(tmp_path, 4) == {"samples": [2000], "loss": [1.25]}


def test_runs_of_one_pair_and_of_all_stand_in_one_table_and_one_picture():
    errors = {"guess": [1.5, 1.5, 0.05], "answer": [1.2, 0.9, 0.09], "shift_m": [0.1, 0.0, -0.8]}
    loss = {"guess": 2.0, "answer": 1.5, "truth": 1.0}
    run = {"samples": 40_000, "minutes": 12.0, "loss": loss, "extrapolated": None}
    run["curve"] = {"samples": [2000, 40_000], "loss": [1.75, 1.25]}
    told = {
        "joint": run | {"errors": dict.fromkeys(PAIRS, errors)},
        "pairwise lidar-radar": run | {"errors": {"lidar_radar": errors}},
    }
    lines = paper_ssl.table({"commit": "c", "date": "d", "frames": 2}, told).splitlines()
    joint, alone = (line.split(" | ") for line in lines if "40,000" in line)
    assert joint[1:3] == alone[1:3] == ["40,000 (1.00%)", "12.0 (20)"]  # a hundredth in 12 minutes
    assert joint[3] == "1.50 / 1.50 -> 1.20 / 0.90"
    assert not alone[3].strip()
    assert not alone[4].strip()
    assert alone[5].startswith("1.50 / 1.50 / 0.050 -> 1.20 / 0.90 / 0.090")
    assert "pairwise lidar-radar: lidar_radar [0.1, 0.0, -0.8]" in "\n".join(lines)
    left = paper_ssl.left_of(told["joint"])
    assert left == {"samples": [0, 2000, 40_000], "left": [100.0, 75.0, 25.0]}
    assert paper_ssl.drawn(dict.fromkeys(told, left)).count(">pairwise lidar-radar<") == 1


def test_reflectors_are_recorded_and_every_method_has_run_before_they_are_evaluated(tmp_path):
    names = [name for name, _ in reflector_table.steps_of(tmp_path, 2)]
    own = ["drives", "stands", "ingest", "standing", "perceive", *reflector_table.METHODS]
    assert names == [f"vehicle-{n} {what}" for n in (1, 2) for what in own]
    fleet = load_fleet(tmp_path / "fleet.toml")
    assert fleet.rig_of("vehicle-2").radar.drivable.model == "shipped:radar_drivable"
    assert fleet.solve.paper_loss_scale == "none"  # the paper's row to the letter
    fleet.require_files()
