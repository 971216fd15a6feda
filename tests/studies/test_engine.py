"""Studies go on where they stopped, from the priors that they promise, on days spoiled as they say."""

import json
from argparse import Namespace
from concurrent.futures import Future
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest

from pipeline.config import SolveConfig, load_fleet
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import exp_so3, inverse, log_so3, transform_points
from pipeline.geometry.spherical import from_spherical, to_spherical
from tests.benchmarks.recovery import changed_radar
from tests.benchmarks.studies import engine, rigs, table1
from tests.benchmarks.studies.commits import is_same_code
from tests.benchmarks.studies.days import SETS, Day, DaySpec, label_by_network
from tests.benchmarks.studies.engine import Run, key_of, prior_of, read_results, run_study, spoiled
from tests.benchmarks.studies.looks import heading, look, read_looks
from tests.benchmarks.studies.verdict import _derived, _simulated, fault_of
from tests.makers.fleet_files import fleet_toml
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

SPEC = DaySpec(7, "urban")
MEASURED = [prefix + q for prefix in ("", "prior_") for q in ("az_deg", "el_deg", "range_m")]
TRUTH = {
    "T_camera_lidar": T_CAMERA_LIDAR.tolist(),
    "T_lidar_radar": T_LIDAR_RADAR.tolist(),
    "T_camera_radar": (T_CAMERA_LIDAR @ T_LIDAR_RADAR).tolist(),
    "dt_camera_lidar_s": 0.0,
    "dt_lidar_radar_s": 0.0,
    "dt_camera_radar_s": 0.0,
}


@pytest.fixture
def day(tmp_path) -> Day:
    (tmp_path / "fleet.toml").write_text(fleet_toml("vehicle-1"))
    return Day(SPEC, make_day(frames=10), TRUTH, load_fleet(tmp_path / "fleet.toml"), {})


def off_by(day: Day, how) -> tuple[float, float]:
    """Angle [deg] and shift [m] of the camera-lidar prior."""
    prior = prior_of(day, how, 3)
    turn = log_so3(prior.T_camera_lidar[:3, :3] @ T_CAMERA_LIDAR[:3, :3].T)
    return np.degrees(np.linalg.norm(turn)), np.linalg.norm(
        prior.T_camera_lidar[:3, 3] - T_CAMERA_LIDAR[:3, 3]
    )


def test_an_exact_prior_is_off_by_exactly_so_much_and_says_so(day):
    assert off_by(day, ("exact", 5.0, 0.3)) == pytest.approx((5.0, 0.3))
    prior = prior_of(day, ("exact", 5.0, 0.3), 3)
    assert (np.degrees(prior.rotation_sigma_rad), prior.translation_sigma_m) == pytest.approx((5.0, 0.3))


def test_a_hidden_error_is_the_same_but_the_prior_knows_nothing_of_it(day):
    assert off_by(day, ("hidden", 12.0, 0.05)) == pytest.approx((12.0, 0.05))
    assert np.degrees(prior_of(day, ("hidden", 12.0, 0.05), 3).rotation_sigma_rad) == pytest.approx(2.0)
    assert (
        engine.search_range(("hidden", 12.0, 0.05))["search_rotation_deg"]
        == SolveConfig().search_rotation_deg
    )


def test_drawn_priors_scatter_by_their_sigmas(day):
    turns, shifts = [], []
    for seed in range(300):
        prior = prior_of(day, ("drawn", 2.0, 0.05), seed)
        turns.append(log_so3(prior.T_lidar_radar[:3, :3] @ T_LIDAR_RADAR[:3, :3].T))
        shifts.append(prior.T_lidar_radar[:3, 3] - T_LIDAR_RADAR[:3, 3])
    assert np.degrees(np.std(turns)) == pytest.approx(2.0, rel=0.08)
    assert np.std(shifts) == pytest.approx(0.05, rel=0.08)


def test_a_logged_prior_is_tf_static(day):
    assert off_by(day, ("logged", 2.0, 0.05)) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_search_range_contains_a_prior_error_that_is_known():
    assert engine.search_range(("exact", 10.0, 0.5)) == pytest.approx(
        {"search_rotation_deg": 12.0, "search_translation_m": 0.6}
    )


@pytest.mark.parametrize(("how", "K"), [("focal:0.03", (515.0, 319.5)), ("centre:20", (500.0, 339.5))])
def test_wrong_intrinsics_are_in_every_row_and_nothing_else_changes(day, how, K):
    rows = spoiled(day.rows, how)
    assert all((o.camera_K[0, 0], o.camera_K[0, 2]) == pytest.approx(K) for o in rows)
    assert replace(rows[3], camera_K=day.rows[3].camera_K).labels_png == day.rows[3].labels_png


def test_a_wrong_principal_point_is_a_turned_camera_and_pixels_fall_into_place(day):
    T = engine.reference(day, "camera_lidar", "centre:20")
    point = np.array([[20.0, 0.3, -0.4]])
    seen = CAMERA.project(transform_points(T_CAMERA_LIDAR, point))[0]
    K = CAMERA.K + np.array([[0, 0, 20], [0, 0, 20], [0, 0, 0]])
    wrong = Camera(CAMERA.model, K, CAMERA.D, CAMERA.width_px, CAMERA.height_px)
    again = wrong.project(transform_points(T, point))[0]
    assert np.abs(again - seen).max() < 0.5
    assert engine.reference(day, "lidar_radar", "centre:20") == pytest.approx(T_LIDAR_RADAR)


def test_a_radar_is_measured_against_where_its_detections_point(day):
    bias_rad = 0.01
    biased = replace(day, truth=day.truth | {"radar_elevation_bias_rad": bias_rad})
    target = np.array([[30.0, 0.0, 0.4]])  # in radar axes, straight ahead but for its height
    azimuth, elevation, range_m = to_spherical(target)[0]
    seen = from_spherical(np.array([[azimuth, elevation + bias_rad, range_m]]))
    found = transform_points(engine.reference(biased, "lidar_radar", ""), seen)
    assert found == pytest.approx(transform_points(T_LIDAR_RADAR, target), abs=1e-3)
    assert engine.reference(biased, "camera_lidar", "") == pytest.approx(T_CAMERA_LIDAR)


def test_stamps_that_lie_are_later_on_the_camera_and_earlier_on_the_radar_and_so_is_the_truth(day):
    rows = spoiled(day.rows, "stamps:0.06")
    for before, after in zip(day.rows, rows, strict=True):
        assert after.camera_stamp_ns - before.camera_stamp_ns == 60_000_000
        assert after.radar_stamp_ns - before.radar_stamp_ns == -60_000_000
        assert after.stamp_ns == before.stamp_ns
    # stamp_camera = stamp_lidar + dt, stamp_lidar = stamp_radar + dt
    for pair, late_s in (("camera_lidar", 0.06), ("lidar_radar", 0.06), ("camera_radar", 0.12)):
        true = replace(day, truth=day.truth | {f"dt_{pair}_s": 0.01})
        assert engine.true_offset_s(true, pair, "stamps:0.06") == pytest.approx(0.01 + late_s)
        assert engine.true_offset_s(true, pair, "") == 0.01


def test_few_frames_are_spread_over_the_day(day):
    assert [o.frame_index for o in spoiled(day.rows, "few:3")] == [0, 4, 9]
    with pytest.raises(ValueError, match="no such fault"):
        spoiled(day.rows, "rain")


class Inline:
    """A pool that works at once, in this process."""

    def __init__(self, *_args, **_kwargs): ...
    def __enter__(self):
        return self

    def __exit__(self, *_error): ...
    def submit(self, work, *args):
        future = Future()
        future.set_result(work(*args))
        return future


@pytest.fixture
def calls(monkeypatch, tmp_path) -> list[Run]:
    """The runs that a study did not find done; its code is commit aaa, and nobody has looked at anything yet."""
    made = []

    def work(run, _root):
        made.append(run)
        return {"cpu_s": 0.1, "pairs": {}, "refused": "nothing"}

    monkeypatch.setattr(engine, "ProcessPoolExecutor", Inline)
    monkeypatch.setattr(engine, "_work", work)
    monkeypatch.setattr(engine, "commit_now", lambda: "aaa")
    monkeypatch.setattr(engine, "look", partial(look, record=tmp_path / "seeds.toml"))
    return made


def study_args(tmp_path, **changes) -> Namespace:
    plain = {"out": tmp_path / "r.jsonl", "limit": None, "workers": 1, "root": tmp_path, "tuning": False}
    return Namespace(**(plain | {"accept_commits": []} | changes))


def test_a_study_goes_on_where_it_stopped(tmp_path, calls, capsys):
    runs = [Run(SPEC, seed=k, solve={"terms": ["edges", "static"]}) for k in range(3)]
    args = study_args(tmp_path, limit=2)
    run_study(runs, args, lambda results: f"{len(results)} lines")
    assert len(calls) == 2
    args.limit = None
    run_study(runs, args, lambda results: f"{len(results)} lines")
    assert [c.seed for c in calls] == [0, 1, 2]
    lines = read_results(args.out)
    assert {key_of(line) for line in lines} == {run.key for run in runs}
    assert all(line["commit"] and line["date"] for line in lines)
    assert "3 of 3 runs" in args.out.with_suffix(".md").read_text()
    assert "3 lines" in capsys.readouterr().out


@pytest.mark.parametrize(("accepted", "again"), [([], 2), (["aaa"], 0), (["all"], 0), (["ccc"], 2)])
def test_lines_of_other_code_count_only_where_a_person_accepts_them(
    tmp_path, calls, monkeypatch, accepted, again
):
    runs = [Run(SPEC, seed=k) for k in range(2)]
    run_study(runs, study_args(tmp_path), lambda _: "")
    calls.clear()
    monkeypatch.setattr(engine, "commit_now", lambda: "bbb")
    counted = []
    run_study(
        runs, study_args(tmp_path, accept_commits=accepted), lambda results: counted.append(results) or ""
    )
    assert len(calls) == again
    assert [r["commit"] for r in counted[0]] == ["bbb" if again else "aaa"] * 2


@pytest.mark.usefixtures("calls")
def test_a_table_says_first_look_until_other_code_has_looked_at_its_seeds(tmp_path, monkeypatch):
    day = DaySpec(4000, "urban")
    heads = []
    for commit in ("aaa", "aaa", "bbb"):
        monkeypatch.setattr(engine, "commit_now", lambda commit=commit: commit)
        run_study([Run(day), Run(day, seed=len(heads))], study_args(tmp_path), lambda _: "")
        heads.append((tmp_path / "r.md").read_text().splitlines()[0])
    assert heads[0] == heads[1] == "First look: days of seeds 4000"
    assert heads[2] == "Second look (first by commit aaa): days of seeds 4000"
    record = tmp_path / "seeds.toml"
    assert [e.commit for e in read_looks(record)] == ["aaa", "bbb"]


def test_seeds_that_were_seen_are_never_called_fresh(tmp_path):
    def line(seed, commit="bbb"):
        return {"day": {"seed": seed}, "commit": commit}

    record = tmp_path / "seeds.toml"
    record.write_text('[[look]]\nstudy = "x"\nseeds = "300-310, 320"\ncommit = "aaa"\ndate = "2026-01-01"\n')
    assert "First" not in heading([line(305), line(310), line(320)], record)
    assert heading([line(311)], record) == "First look: days of seeds 311"
    assert heading([line(0), line(110)], record) == (
        "Seen throughout (the real day): days of seeds 0; Tuning seeds: days of seeds 110"
    )
    assert "First" not in heading([line(311, "bbb+")], record)


def test_the_committed_record_of_looks_can_be_read_and_knows_the_test_days_of_the_first_release():
    assert all(set(range(200, 210)) & e.seeds for e in read_looks()[:1])
    assert not any(
        e.seeds & {d.seed for name in ("dev", "dev-bad") for d in SETS[name]} for e in read_looks()
    )


def test_code_is_the_same_where_nothing_that_decides_results_differs():
    assert is_same_code("abc", "abc")
    assert not is_same_code("abc+", "abc+")  # nobody knows what a changed working tree held
    assert not is_same_code("0000000", "1111111")
    assert not is_same_code("unknown", "unknown")


def test_every_row_of_the_table_has_a_name_of_its_own_and_its_runs_find_it():
    for row in table1.ROWS:
        (run,) = table1.runs_of([row], [SPEC])
        assert table1.row_name(run) == row.name
    keys = {run.key for run in table1.runs_of(table1.ROWS, SETS["table1"])}
    assert len(keys) == len(table1.ROWS) * len(SETS["table1"])


def test_rows_with_learned_areas_are_left_out_with_a_reason_where_there_is_no_model(tmp_path, capsys):
    assert not any(row.spoil for row in table1.rows_for(tmp_path))
    assert "boresight train-radar-drivable" in capsys.readouterr().out
    model = tmp_path / engine.DRIVABLE_MODEL
    model.parent.mkdir()
    model.touch()
    assert table1.rows_for(tmp_path) == list(table1.ROWS)


def test_rows_of_one_method_do_not_mix():
    lines = [
        {"row": row, "method": "joint-optimisation", "day": {"seed": s, "environment": "urban"}, "cpu_s": 1.0}
        | {"pairs": {"camera_lidar": {"status": "held"} | dict.fromkeys(MEASURED, value)}}
        for row, value in ((table1.ROWS[1].name, 1.0), (table1.ROWS[2].name, 2.0))
        for s in (1, 2)
    ]
    text = table1.summary(lines)
    assert f"| {table1.ROWS[1].name} | camera_lidar | 2 | 1.000 +- 0.000 |" in text
    assert f"| {table1.ROWS[2].name} | camera_lidar | 2 | 2.000 +- 0.000 |" in text


def test_a_calibration_is_measured_against_truth_pair_by_pair(day):
    result = engine.calibrate_once(Run(SPEC, method="tracking", seed=1), day)
    assert set(json.loads(json.dumps(result))["pairs"]) == {"camera_lidar", "camera_radar", "lidar_radar"}


def test_the_table_of_rigs_says_how_far_off_the_worst_dof_is_and_what_was_refused():
    pair = {"az_deg": 0.1, "el_deg": 0.2, "range_m": 0.05, "status": "held", "frames_used": 31}
    pair |= {"error": [0.01, 0, 0, 0, -0.08, 0], "sigma": [0.01] * 3 + [0.02] * 3}
    about = {"day": asdict(replace(SPEC, rig="bumper", fault="camera:dusk:1")), "cpu_s": 5.0}
    lines = rigs.summary([about | {"pairs": {"lidar_radar": pair}}]).splitlines()
    assert lines[2] == (
        "| bumper urban camera:dusk:1 | 31 | refused | refused | 0.100 / 0.200 held, far 4.0 (ty) | 0.050 | 5.0 |"
    )


def test_seeds_of_tuning_and_test_sets_never_meet():
    tuning = {d.seed for name, days in SETS.items() if name.startswith("dev") for d in days}
    test = {name: days for name, days in SETS.items() if not name.startswith("dev")}
    # Within a set a seed may come again for the same drives on another car, no day twice.
    assert all(len({d.name for d in days}) == len(days) for days in test.values())
    seeds = [seed for days in test.values() for seed in {d.seed for d in days}]
    assert max(tuning) < 200 <= min(seeds)
    assert len(set(seeds)) == len(seeds)


def test_every_bad_day_of_the_verdict_study_has_a_name_and_good_days_have_none():
    bad = [*(_simulated(d) for d in SETS["verdict"]), *_derived(SETS["coverage"], 3)]
    assert all(fault_of(asdict(run)) for run in bad)
    assert not any(fault_of(asdict(Run(d))) for d in SETS["coverage"])


def test_a_change_of_the_radars_data_is_a_change_of_its_pose():
    row = make_day(frames=1)[0]
    changed = changed_radar(row, np.radians(0.3), 0.05)
    D = np.eye(4)
    D[:3, :3] = exp_so3(np.array([0, 0, np.radians(0.3)]))
    D[1, 3] = 0.05
    seen = transform_points(T_LIDAR_RADAR, row.radar_xyz_m.astype(float))
    again = transform_points(T_LIDAR_RADAR @ inverse(D), changed.radar_xyz_m.astype(float))
    assert again == pytest.approx(seen, abs=1e-4)


def test_a_network_that_labels_a_days_lidar_is_in_its_fleet_file(tmp_path):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml("car"))
    label_by_network(fleet, "shipped:lidar_semantics")
    [rig] = load_fleet(fleet).rigs.values()
    assert rig.lidar.semantics is not None
    assert rig.lidar.semantics.segmenter == "shipped:lidar_semantics"
