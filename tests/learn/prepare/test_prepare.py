"""`boresight prepare`: sides stay apart in what is written, runs repeat, resume and grow, and say what they did."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jobs.cli import main
from pipeline.core.config import load_fleet
from pipeline.learn.prepare.inventory import read_leaks, take_inventory, write_inventory
from pipeline.learn.prepare.sides import frame_sides
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.rig.se3 import exp_se3, to_quaternion
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_manifest, read_rows
from pipeline.store.views import frames_of, observations_of, perceived_days
from schemas.calibrations import CALIBRATIONS
from schemas.columns import POSE_COLUMNS
from schemas.training import SPLITS, TRAINING, TrainingRow
from tests.makers import solve_scenes, training_lakes
from tests.makers.fleet_files import fleet_toml
from tests.makers.lakes import write_frames, write_observations, write_records
from tests.makers.table_rows import make_record

VEHICLES = ("a", "b", "c", "d", "e")


def rows_of(lake):
    return [r for p in lake.partitions(TRAINING.name) for r in read_rows(lake, TRAINING, p, TrainingRow)]


def assert_sides_apart(rows, *kinds):
    for kind in kinds:
        side = {}
        for row in rows:
            assert side.setdefault(getattr(row, kind), row.split) == row.split, kind


def test_one_day_is_split_by_stretches_with_a_guard_between_them(tmp_path):
    lake = Lake.at(tmp_path)
    training_lakes.fill(lake, "a", "2026-01-01", frames=40)  # 1 s apart, drives of 8 frames 30 s apart
    fleet = training_lakes.fleet_of(
        ["a"], by=["place"], place_s=4, guard_s=2.5, val_fraction=0.2, test_fraction=0.2
    )
    result = training_lakes.prepare_all(lake, fleet)[Partition("a", "2026-01-01")]
    rows = rows_of(lake)
    assert {r.split for r in rows} == set(SPLITS)
    assert_sides_apart(rows, "place")
    assert result.rejected["next_to_other_split"] > 0
    for row in rows:
        other = [abs(row.stamp_ns - r.stamp_ns) for r in rows if r.split != row.split]
        assert min(other) >= 2.5e9


@pytest.mark.parametrize("positions", ["map", "local"])
def test_frames_of_two_sides_are_far_apart_also_over_the_border_of_a_cell_and_on_another_pass(
    tmp_path, positions
):
    lake, rng = Lake.at(tmp_path), np.random.default_rng(5)
    for vehicle in "ab":  # up and down the same street, at any time
        training_lakes.fill(lake, vehicle, "2026-01-01", 60)
        east, north = rng.uniform(0, 450, 60), rng.uniform(0, 30, 60)
        frames = [
            replace(f, ego_tx_m=float(east[i]), ego_ty_m=float(north[i]), log="one")
            for i, f in enumerate(frames_of(lake, Partition(vehicle, "2026-01-01")))
        ]
        write_frames(lake, Partition(vehicle, "2026-01-01"), frames, "crossed")
    fleet = training_lakes.fleet_of(
        "ab", positions=positions, by=["place"], val_fraction=0.3, test_fraction=0.3, guard_s=0
    )
    surveys = [survey_day(p, lake, fleet.prepare) for p in perceived_days(lake)]
    plan = plan_days(surveys, fleet.prepare, {})
    at = []
    for survey in surveys:
        sides, lost = frame_sides(survey, plan, fleet.prepare)
        home = survey.partition.vehicle if positions == "local" else ""
        at += [(home, s, survey.x_m[i], survey.y_m[i]) for i, s in enumerate(sides) if s is not None]
        assert lost["next_to_other_split"] > 0
    apart = [np.hypot(a[2] - b[2], a[3] - b[3]) for a in at for b in at if a[0] == b[0] and a[1] != b[1]]
    assert min(apart) > fleet.prepare.split.guard_m / np.sqrt(2)
    assert len(at) > 60


def test_three_vehicles_on_two_days_keep_four_fifths_of_their_frames_without_a_setting(tmp_path, capsys):
    own = tmp_path / "fleet.toml"
    grid = "[prepare.grid]\nwidth_deg = 51.2\nheight_deg = 25.6"
    own.write_text(fleet_toml(*"abc", sections=f"[prepare]\nlidar_points = 1024\nedge_points = 128\n{grid}"))
    call = ["prepare", "--fleet", str(own), "--lake", str(tmp_path), "--executor", "inline"]
    for seed, (vehicle, day) in enumerate((v, f"2026-01-0{d}") for v in "abc" for d in (1, 2)):
        training_lakes.fill(Lake.at(tmp_path), vehicle, day, 6, seed=seed)
    assert main(call) == 0
    told = json.loads(capsys.readouterr().out)
    assert sum(told["frames"].values()) >= 0.8 * 36
    assert all(told["frames"].values())
    assert told["choices"][0]["split_by"] == ["vehicle", "place"]
    assert told["leaks"] == 0
    rows = rows_of(Lake.at(tmp_path))
    assert_sides_apart(rows, "vehicle", "place")
    # Another day does not change the keys, and moves nothing.
    before = {(r.vehicle, r.day, r.frame_index): r.split for r in rows}
    training_lakes.fill(Lake.at(tmp_path), "c", "2026-01-03", 6, seed=9)
    assert main(call) == 0
    after = {(r.vehicle, r.day, r.frame_index): r.split for r in rows_of(Lake.at(tmp_path))}
    assert before.items() <= after.items()
    assert len(after) == 42


def test_an_empty_side_is_an_error_before_training(tmp_path, capsys):
    own = tmp_path / "fleet.toml"
    own.write_text(fleet_toml(*"abc", sections=PREPARE))
    training_lakes.fleet_lake(tmp_path, "abc", frames=3)
    call = ["prepare", "--fleet", str(own), "--lake", str(tmp_path), "--executor", "inline"]
    assert main([*call, "--vehicles", "a"]) == 3
    capsys.readouterr()
    assert main(["train", "--data", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    assert "no frames on side val: run prepare again" in capsys.readouterr().out
    assert not (tmp_path / "run").exists()


def test_the_same_work_is_done_once_and_what_is_lost_comes_back_the_same(tmp_path):
    lake = training_lakes.fleet_lake(tmp_path, VEHICLES[:3], frames=3)
    fleet = training_lakes.fleet_of(VEHICLES, by=["vehicle"])
    training_lakes.prepare_all(lake, fleet)
    before = {r.vehicle: r for r in rows_of(lake)}
    assert {r.status for r in training_lakes.prepare_all(lake, fleet).values()} == {"cached"}
    gone = Partition("b", "2026-01-01")
    (lake.folder(TRAINING.name, gone) / "part-0.parquet").unlink()
    again = training_lakes.prepare_all(lake, fleet)
    assert {p.vehicle: r.status for p, r in again.items()} == {"a": "cached", "b": "done", "c": "cached"}
    for row in (r for r in rows_of(lake) if r.frame_index == before[r.vehicle].frame_index):
        old = before[row.vehicle]
        assert all(np.array_equal(getattr(row, n), getattr(old, n)) for n in row.__dataclass_fields__)


def test_frames_that_perception_refused_or_that_changed_their_prior_are_counted(tmp_path):
    lake = Lake.at(tmp_path)
    training_lakes.fill(lake, "a", "2026-01-01", 6)
    partition = Partition("a", "2026-01-01")
    observations = list(observations_of(lake, partition))
    moved = exp_se3(np.array([0, 0, 0, 9.0, 0, 0])) @ observations[4].priors["camera_lidar"]
    priors = observations[4].priors | {"camera_lidar": moved}
    observations[4] = replace(observations[4], log="b.mcap", priors=priors)
    write_observations(lake, partition, [o for o in observations if o.frame_index != 2], "other")
    result = training_lakes.prepare_all(lake, training_lakes.fleet_of(["a"], by=["vehicle"]))[partition]
    assert (result.rows, result.rejected) == (4, {"not_perceived": 1, "prior_changed": 1})


def test_a_day_without_prior_is_refused_with_its_reason(tmp_path):
    lake = Lake.at(tmp_path)
    training_lakes.fill(lake, "a", "2026-01-01", 3)
    partition = Partition("a", "2026-01-01")
    observations = list(observations_of(lake, partition))
    rows = [replace(o, priors={"lidar_radar": o.priors["lidar_radar"]}) for o in observations]
    write_observations(lake, partition, rows, "other")
    result = training_lakes.prepare_all(lake, training_lakes.fleet_of(["a"], by=["vehicle"]))[partition]
    assert result.status == "refused"
    assert result.reason == "no sample: 3 no_prior"


def test_views_that_come_back_on_another_side_are_found_and_barred(tmp_path):
    lake = Lake.at(tmp_path)
    for number, vehicle in enumerate(VEHICLES):
        seed = 77 if vehicle in "ab" else None  # a and b show the same scenes under two names
        training_lakes.fill(lake, vehicle, f"2026-01-0{number + 1}", 3, seed=seed)
    fleet = training_lakes.fleet_of(VEHICLES, by=["vehicle"], val_fraction=0.3, test_fraction=0.3)
    training_lakes.prepare_all(lake, fleet)
    split = {r.vehicle: r.split for r in rows_of(lake)}
    inventory = take_inventory(lake, 16)
    twins = {split["a"], split["b"]}
    assert len(twins) == 2, "the seed puts both on one side: the test proves nothing"
    assert {v for v, _, _ in inventory.leaks} <= {"a", "b"}
    assert len(inventory.leaks) == 3
    assert take_inventory(lake, 0).leaks == []
    write_inventory(lake, inventory, {"settings": {}})
    barred = read_leaks(lake)
    assert {p.vehicle for p in barred} < {"a", "b"}
    assert set.union(*barred.values()) == {0, 1, 2}


@pytest.mark.slow
def test_any_number_of_workers_writes_the_same_rows(tmp_path, capsys):
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml(*"abc", sections=PREPARE))
    written = []
    for name, options in (("one", ["--executor", "inline"]), ("two", ["--workers", "2"])):
        lake = training_lakes.fleet_lake(tmp_path / name, "abc", frames=2)
        assert main(["prepare", "--fleet", str(fleet), "--lake", str(lake.root), *options]) == 0
        written.append(rows_of(lake))
    capsys.readouterr()
    assert len(written[0]) == len(written[1]) == 6
    for a, b in zip(*written, strict=True):
        assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in a.__dataclass_fields__)


PREPARE = """
[prepare]
lidar_points = 512
edge_points = 64
[prepare.split]
by = ["vehicle"]
"""


def test_the_job_tells_counts_and_exit_codes(tmp_path, capsys):
    lake = training_lakes.fleet_lake(tmp_path / "lake", VEHICLES[:3], frames=2)
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(fleet_toml(*VEHICLES, sections=PREPARE))
    arguments = ["prepare", "--fleet", str(fleet), "--lake", str(lake.root), "--executor", "inline"]

    def run(*more):
        code = main([*arguments, *more])
        return code, json.loads(capsys.readouterr().out.splitlines()[-1])

    code, told = run("--vehicles", "a", "--vehicles", "b")
    assert (code, told["status"]) == (3, "held")  # two vehicles fill two sides
    assert [p["side"] for p in told["problems"]] == ["test"]
    assert told["next_steps"] == [
        f"set val_fraction and test_fraction to 0 under [prepare.split] in {fleet}, or add days; then prepare again"
    ]
    code, told = run()
    assert (code, told["status"], told["done"], told["cached"]) == (0, "done", 1, 2)
    assert told["next_steps"] == [f"boresight train --data {lake.root} --out run"]
    assert told["frames"] == {"train": 2, "val": 2, "test": 2}
    assert sum(told["environments"]["train"].values()) == 2
    assert [c["split_by"] for c in told["choices"] if c["chosen"]] == [["vehicle"]]
    costs = {" ".join(c["split_by"]): c for c in told["choices"]}
    assert costs["vehicle"]["frames"] == told["frames"]
    strict = costs["vehicle day place"]  # one day, so all frames on one side
    assert (strict["frames"], strict["lost"]) == ({"train": 6, "val": 0, "test": 0}, {})
    manifest = json.loads((lake.root / "training" / "manifest.json").read_text())
    assert manifest["choices"] == told["choices"]
    assert manifest["frames"] == told["frames"]
    assert manifest["settings"]["lidar_points"] == 512 == load_fleet(fleet).prepare.lidar_points
    first = lake.partitions(TRAINING.name)[0]
    assert read_manifest(lake, TRAINING, first).kept["frames"] == 2
    assert run("--from", "2027-01-01")[0] == 2
    assert run("--vehicles", "nobody")[0] == 2
    assert run("--workers", "0")[0] == 2


@pytest.mark.parametrize(
    ("status", "unsure", "name"), [("accepted", 0, "joint"), ("held", 1, "joint"), ("held", 0, "prior")]
)
def test_samples_look_through_what_joint_found_that_day(tmp_path, status, unsure, name):
    lake = Lake.at(tmp_path)
    training_lakes.fill(lake, "a", "2026-01-01", frames=5)
    T = exp_se3(np.array([0.01, 0.02, -0.01, 0.1, 0.0, 0.0])) @ solve_scenes.T_CAMERA_LIDAR
    told = dict(zip(POSE_COLUMNS, [*to_quaternion(T), *T[:3, 3]], strict=True)) | {"time_offset_s": 0.03}
    told |= {"status": status, "diagnostics": {"unsure_only": float(unsure)}}
    record = make_record(np.random.default_rng(0), "key", "a", "2026-01-01", **told)
    write_records(lake, CALIBRATIONS, [record], "key")
    training_lakes.prepare_all(lake, training_lakes.fleet_of(["a"], val_fraction=0, test_fraction=0))
    expected, dt_s = (T, 0.03) if name == "joint" else (solve_scenes.T_CAMERA_LIDAR, 0.0)
    for row in rows_of(lake):
        assert row.reference == name
        shift = [row.reference_camera_lidar_tx_m, row.reference_camera_lidar_ty_m]
        np.testing.assert_allclose(shift, expected[:2, 3], atol=1e-9)
        assert row.camera_lag_s == pytest.approx(0.001 - dt_s)
