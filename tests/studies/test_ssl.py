"""The studies of networks ask the right files about the right days, start where they say, and add up what they find."""

import json
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import onnx
import pytest

from pipeline.config import load_fleet
from pipeline.geometry.se3 import exp_se3, inverse, log_se3, rotation_angle_rad
from pipeline.learn.infer.aggregate import BIAS_SIGMA
from schemas.calibrations import PAIRS
from tests.benchmarks.studies import (
    ssl_cross_rig,
    ssl_fleet,
    ssl_measures,
    ssl_photographs,
    ssl_table1,
)
from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay, Where, fleet_days, table1_days
from tests.benchmarks.studies.ssl_tables import abrupt_table, frame_values, frames_table, sigma_table
from tests.makers.fleet_files import fleet_toml
from tests.makers.solve_scenes import T_CAMERA_LIDAR, T_LIDAR_RADAR, make_day

TRUTH = {
    "T_camera_lidar": T_CAMERA_LIDAR.tolist(),
    "T_lidar_radar": T_LIDAR_RADAR.tolist(),
    "T_camera_radar": (T_CAMERA_LIDAR @ T_LIDAR_RADAR).tolist(),
}


@pytest.fixture
def models(tmp_path) -> ModelSet:
    write_network(tmp_path / "a.onnx", "one network")
    return ModelSet.parse(f"matching={tmp_path / 'a.onnx'}")


def write_network(path, name, card=None):
    """A file with a graph, though one that answers nothing."""
    model = onnx.helper.make_model(onnx.helper.make_graph([], name, [], []))
    onnx.helper.set_model_props(model, {"card": json.dumps(card or {})})
    onnx.save(model, path)


def test_a_network_is_measured_again_when_it_was_trained_on_and_not_when_its_card_was_written(models):
    before = models.key
    write_network(models.files[0], "one network", card={"results": "good"})
    assert models.key == before
    write_network(models.files[0], "one network", card={"bias_sigma": {"camera_lidar": [0.1] * 6}})
    assert models.key != before
    write_network(models.files[0], "another network")
    assert models.key != before


@pytest.fixture
def day(tmp_path) -> SslDay:
    (tmp_path / "fleet.toml").write_text(fleet_toml("vehicle-1"))
    where = Where(tmp_path, "vehicle-1", "2026-03-02", 1007)
    return SslDay(where, make_day(frames=10), TRUTH, load_fleet(tmp_path / "fleet.toml"))


def test_one_file_is_a_joint_network_and_three_are_pairwise_ones():
    joint, apart = ModelSet.parse("concat=a.onnx"), ModelSet.parse("x=a.onnx,b.onnx,c.onnx")
    assert (joint.method, joint.row) == ("joint-ssl", "joint-ssl (concat)")
    assert (apart.method, apart.row) == ("pairwise-ssl", "pairwise-ssl")
    assert [f.name for f in apart.by_name.values()] == ["a.onnx", "b.onnx", "c.onnx"]
    assert list(apart.by_name) == list(PAIRS)
    for wrong in ("a.onnx", "x=a.onnx,b.onnx", "x="):
        with pytest.raises(SystemExit, match="neither"):
            ModelSet.parse(wrong)


def test_the_products_configuration_names_the_files(day, models):
    learn = models.configured(day.fleet, 2).learn
    assert (learn.model, learn.iterations) == (str(models.files[0]), 2)


def test_only_vehicles_that_taught_nobody_tune_anything(tmp_path):
    manifest = {"vehicles": {"train": ["vehicle-2"], "val": ["vehicle-3"], "test": ["vehicle-11"]}}
    (tmp_path / "lake" / "training").mkdir(parents=True)
    (tmp_path / "lake" / "training" / "manifest.json").write_text(json.dumps(manifest))
    for vehicle in ("vehicle-2", "vehicle-3", "vehicle-11"):
        (tmp_path / "truth" / vehicle).mkdir(parents=True)
        (tmp_path / "truth" / vehicle / "2026-01-05.json").write_text("{}")
    assert {w.vehicle: w.seed for w in fleet_days(tmp_path)} == {"vehicle-3": 1003, "vehicle-11": 1011}


def test_seeds_of_networks_days_are_nobody_elses(tmp_path):
    others = {d.seed for days in SETS.values() for d in days}
    cross = {d.seed for d in ssl_cross_rig.DAYS}
    assert len(cross) == 8
    assert not others & cross
    assert ssl_fleet.FLEET.seed not in others | cross
    rigs = {ssl_fleet.spec_of("rigs", n).seed for n in range(ssl_fleet.RIGS.vehicles)}
    assert len(rigs) == ssl_fleet.RIGS.vehicles
    assert not rigs & (others | cross)
    assert [w.seed for w in table1_days(tmp_path)][:2] == [SETS["table1"][0].seed, SETS["table1"][5].seed]


def test_a_third_of_the_fleet_of_rigs_drives_at_dusk():
    specs = [ssl_fleet.spec_of("rigs", n) for n in range(30)]
    assert sum(bool(spec.faults) for spec in specs) == 10
    assert {spec.environments for spec in specs} == {"urban", "highway", "mixed"}
    assert len({spec.rig for spec in specs}) == len({spec.semantics for spec in specs}) == 30


class Halving:
    """A network that takes half of every pair's error away at each pass."""

    pairs = PAIRS

    def __init__(self, *_args): ...

    def sensors(self, *_args):
        return None

    def estimate(self, _sensors, T_camera_lidar, T_lidar_radar, T_camera_radar, iterations):
        truth = (T_CAMERA_LIDAR, T_CAMERA_LIDAR @ T_LIDAR_RADAR, T_LIDAR_RADAR)
        start = (T_camera_lidar, T_camera_radar, T_lidar_radar)
        off = [log_se3(T @ inverse(T_true)) for T, T_true in zip(start, truth, strict=True)]
        found = []
        for k in range(iterations):
            half = [exp_se3(xi / 2 ** (k + 1)) @ T for xi, T in zip(off, truth, strict=True)]
            found.append(SimpleNamespace(of=dict(zip(PAIRS, half, strict=True)).get))
        return found


@pytest.fixture
def measured(day, models, monkeypatch):
    monkeypatch.setattr(ssl_measures, "open_networks", lambda *_: [Halving()])
    monkeypatch.setattr(ssl_measures, "SingleFrameCalibrator", Halving)
    monkeypatch.setattr(SslDay, "spread", lambda self, count: (self.rows[:count], [None] * count))
    return ssl_measures.measure_frames(models, day, 4, list(ssl_measures.STARTS))


def test_every_pass_of_every_frame_is_measured_from_a_start_of_its_own(measured):
    for start, (deg, _) in ssl_measures.STARTS.items():
        for pair in PAIRS:
            found = measured["starts"][start][pair]
            prior, errors = np.array(found["prior"]), np.array(found["errors"])
            assert errors.shape == (4, 3, 3)
            assert len(np.unique(prior[:, 0])) == 4
            shares = errors[..., :2].mean(axis=(0, 2)) / prior[:, :2].mean()
            assert shares == pytest.approx([1 / 2, 1 / 4, 1 / 8], rel=0.2)
        turned = np.linalg.norm(np.array(measured["starts"][start]["lidar_radar"]["change"])[:, :3], axis=1)
        assert np.degrees(turned) == pytest.approx(np.full(4, deg / 8), rel=0.02)


def test_priors_are_those_of_table_1(day):
    prior = day.prior(2.0, 0.2, 7)
    assert np.degrees(rotation_angle_rad(prior.T_camera_lidar @ inverse(T_CAMERA_LIDAR))) == pytest.approx(2)
    assert np.degrees(prior.rotation_sigma_rad) == pytest.approx(2.0)
    assert prior.translation_sigma_m == pytest.approx(0.2)


def test_frames_of_all_days_are_averaged_together(measured):
    line = measured | {"method": "m", "part": "frames"}
    other = json.loads(json.dumps(line | {"method": "n"}))
    errors = frame_values([line, other, line], "m", "prior", "camera_lidar", "errors")
    assert errors.shape == (8, 3, 3)
    assert not len(frame_values([line], "m", "no such start", "camera_lidar", "errors"))
    az = errors[:, 2, 0]
    assert f"{az.mean():.2f} / " in frames_table([line, line])
    assert f"{np.median(errors[:, 2, 0]):.2f} / " in abrupt_table([line], ["prior"])


def day_line(pair_error, sigma, observable=(1,) * 6, **more):
    pair = {
        "status": "held", "error": list(pair_error), "sigma": list(sigma), "observable": list(observable),
        "az_deg": 0.1, "el_deg": 0.2, "range_m": 0.3, "prior_az_deg": 1.0, "prior_el_deg": 2.0, "prior_range_m": 3.0,
    }  # fmt: skip
    return {"method": "m", "part": "days", "iterations": 3, "pairs": dict.fromkeys(PAIRS, pair)} | more


def test_the_bias_that_sigmas_lack_is_found():
    """Errors of 0.3 deg about a sigma that allows for `BIAS_SIGMA` and 0.1 deg of scatter."""
    rng = np.random.default_rng(0)
    bias = np.array(BIAS_SIGMA["camera_lidar"])
    scatter = np.radians(0.1)
    sigma = np.hypot(bias, scatter)
    lines = [day_line(rng.normal(0, np.hypot(np.radians(0.3), scatter), 6), sigma) for _ in range(2000)]
    row = next(r for r in sigma_table(lines).splitlines() if r.startswith("| m | camera_lidar | rx"))
    cells = [c.strip() for c in row.split("|")]
    assert float(cells[-2]) == pytest.approx(0.3, rel=0.05)
    assert float(cells[-3]) == pytest.approx(np.degrees(bias[0]), abs=1e-3)
    blind = sigma_table([day_line(np.ones(6), sigma, observable=[0, 1, 1, 1, 1, 1])])
    assert "| m | camera_lidar | rx | 0 | -" in blind


def test_a_network_that_was_trained_on_is_measured_again_and_the_old_lines_left_out(
    models, tmp_path, monkeypatch
):
    calls = []

    class Inline:
        def __init__(self, *_args, **_kwargs): ...
        def __enter__(self):
            return self

        def __exit__(self, *_error): ...
        def submit(self, work):
            from concurrent.futures import Future

            future = Future()
            future.set_result(work())
            return future

    def measured(task):
        calls.append(task.where.name)
        return {"key": task.key, "method": task.models.row, "cpu_s": 1.0}

    monkeypatch.setattr(ssl_table1, "ProcessPoolExecutor", Inline)
    monkeypatch.setattr(ssl_table1.Task, "measured", measured)
    where = Where(tmp_path / "paper_urban_100_200", "vehicle-1", "2026-03-02", 200)
    tasks = [ssl_table1.Task(models, where, "frames", 20)]
    assert len(ssl_table1.run_tasks(tasks, tmp_path / "r.jsonl")) == 1
    assert len(ssl_table1.run_tasks(tasks, tmp_path / "r.jsonl")) == 1
    assert calls == ["paper_urban_100_200"]
    assert replace(tasks[0], iterations=2).key != tasks[0].key
    write_network(models.files[0], "the same, trained on")
    again = ssl_table1.run_tasks(tasks, tmp_path / "r.jsonl")
    assert len(calls) == 2
    assert [r["key"] for r in again] == [tasks[0].key]


def test_rows_of_networks_stand_below_those_of_the_other_methods():
    other = day_line(np.zeros(6), np.ones(6)) | {
        "method": "joint",
        "day": {"seed": 200, "environment": "urban"},
        "cpu_s": 1,
    }
    mine = other | {"method": "joint-ssl (matching)"}
    text = ssl_table1.summary([mine], [other])
    lines = [line.split("|")[1].strip() for line in text.splitlines() if "| camera_lidar | 1 |" in line]
    assert lines == ["(prior)", "joint", "joint-ssl (matching)"] * 2  # all days and urban ones; no highway
    assert Namespace(**mine).part == "days"


def test_photographs_are_told_by_what_the_network_is_shown_and_by_log():
    def record(az, status):
        return {"az_deg": az, "el_deg": 0.2, "range_m": 0.05, "status": status}

    days = [dict.fromkeys(PAIRS, record(0.1, "accepted")), dict.fromkeys(PAIRS, record(0.3, "held"))]
    frames = {"log 03": {key: {"mean": [1.0, 0.5, 0.1], "median": [0.4, 0.3, 0.1]} for key in PAIRS}}
    told = ssl_photographs.summary(
        {"new, both": {"days": days, "frames": frames}, "new, image": {"days": days}}
    )
    assert told.count("| new, both | 2 | 0.20 / 0.20 / 0.05 |") == 1
    assert told.count("| 3 of 6 |") == 2
    assert "| new, both | log 03 | 0.40 / 0.30 (1.00 / 0.50) |" in told
