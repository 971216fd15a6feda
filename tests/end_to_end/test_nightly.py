"""The installed command on a small simulated fleet: good days, poisoned ones, a bucket, kills, an order to stop."""

import dataclasses
import json
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest

from pipeline.simulate.fleet import FleetSpec
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.views import observations_of
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.makers.commands import BORESIGHT, boresight
from tests.makers.fleet_files import fleet_toml
from tests.makers.kept_days import kept_fleet
from tests.makers.processes import descendants, started, works
from tests.makers.ray_clusters import two_nodes
from tests.makers.s3_server import BUCKET, running

DAYS = ("2026-03-02", "2026-03-03")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Two vehicles for two days in three containers, one poisoned log, one vehicle that fleet.toml does not know."""
    out = tmp_path_factory.mktemp("fleet")
    kept_fleet(FleetSpec(vehicles=2, days=2, frames=12, drives=2, container="mixed"), out)
    poisoned = out / "logs" / "vehicle-3" / DAYS[0]
    poisoned.mkdir(parents=True)
    (poisoned / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)) * 100)
    with (out / "fleet.toml").open("a") as file:
        file.write('\n[vehicles."vehicle-3"]\nrig = "demo"\n')
    shutil.copytree(out / "logs" / "vehicle-1" / DAYS[0], out / "logs" / "stranger" / DAYS[0])
    return out


def command(fleet, lake, *options):
    about = ["--fleet", f"{fleet}/fleet.toml", "--lake", str(lake)]
    return ["nightly", *about, "--logs", f"{fleet}/logs/{{vehicle}}/{{day}}/*", *options]


def run(*arguments, **environment):
    code, summary, _, err = boresight(*arguments, **environment)
    return code, summary, err


def good_days(lake):
    """Vehicle-days with a record of every pair."""
    found = read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord)
    has = {(r.vehicle, r.day, r.pair) for r in found}
    return {(v, d) for v, d, _ in has if all((v, d, pair) in has for pair in PAIRS)}


WANTED = {(v, d) for v in ("vehicle-1", "vehicle-2") for d in DAYS}


@pytest.fixture(scope="module")
def first_night(fleet, tmp_path_factory):
    lake = tmp_path_factory.mktemp("night") / "lake"
    return lake, *run(*command(fleet, lake, "--workers", "2"))


@pytest.mark.slow
def test_the_night_calibrates_what_it_can_and_refuses_the_rest_with_reasons(first_night):
    lake, code, summary, stderr = first_night
    assert code == 2  # a vehicle that fleet.toml lacks
    assert summary["vehicle_days"] == 6
    assert summary["failed"] == 0
    problems = {(p["vehicle"], p["day"]): p for p in summary["problems"] if p["status"] == "refused"}
    assert "no vehicle 'stranger'" in problems["stranger", DAYS[0]]["reason"]
    assert problems["vehicle-3", DAYS[0]]["reason"]
    assert good_days(lake) == WANTED | {("vehicle-3", DAYS[0])}
    refused = read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord, vehicle="vehicle-3")
    assert {r.status for r in refused} == {"refused"}
    assert all(json.loads(line) for line in stderr.splitlines())  # JSON lines without a terminal
    assert Path(summary["report"]).stat().st_size > 10_000


@pytest.mark.slow
def test_a_second_night_finds_nothing_to_do_and_changes_no_byte(fleet, first_night):
    lake, code, summary, _ = first_night
    tables = [p for p in lake.rglob("*.parquet") if "drift" not in p.parts]
    before = {p: p.read_bytes() for p in tables}
    again_code, again, _ = run(*command(fleet, lake, "--executor", "inline"))
    assert again_code == code
    assert again["done"] == 0
    assert again["cached"] == summary["done"] + summary["cached"]
    assert {p: p.read_bytes() for p in before} == before
    after = {p for p in lake.rglob("*.parquet") if "drift" not in p.parts}
    assert after == set(before)


@pytest.mark.slow
def test_status_and_a_dry_run_say_how_every_day_stands_and_why(fleet, first_night, tmp_path):
    lake, _, summary, _ = first_night
    code, told, _ = run("status", "--lake", str(lake), "--json")
    days = {(d["vehicle"], d["day"]): d for d in told["days"]}
    assert code == 0
    # The poisoned vehicle and the stranger have logs of one day.
    assert (told["failed"], told["missing"]) == (0, 2)
    assert {days[key]["status"] for key in WANTED} <= {"done", "partly", "held", "refused"}
    # The stranger, which fleet.toml lacks, is among the refused.
    assert sum(told[s] for s in ("done", "partly", "held", "refused")) == summary["vehicle_days"]
    assert days["vehicle-3", DAYS[1]]["status"] == "missing"
    assert days["vehicle-3", DAYS[0]]["stage"] == "ingest"
    assert days["vehicle-3", DAYS[0]]["reason"].startswith("no usable message")
    assert all(days[key]["seconds"] > 0.1 and days[key]["pairs"] for key in WANTED)
    assert run("status", "--lake", str(lake))[1]["done"] == told["done"]
    before = sorted(lake.rglob("*"))
    code, plan, stderr = run(*command(fleet, lake, "--dry-run"))
    why = {(p["vehicle"], p["day"]): (p["stages"], p["why"]) for p in plan["plan"]}
    assert (code, plan["status"], plan["would_run"]) == (0, "planned", 0)
    assert all(why[key] == ([], "up to date") for key in WANTED)
    assert why["vehicle-3", DAYS[0]][1].startswith("refused by ingest: ")
    assert "stranger" in stderr
    assert sorted(lake.rglob("*")) == before
    _, plan, _ = run(*command(fleet, tmp_path / "lake", "--dry-run"))
    assert {(*p["stages"], p["why"]) for p in plan["plan"] if p["vehicle"] == "vehicle-1"} == {
        ("ingest", "perceive", "calibrate", "no moments yet")
    }
    assert not (tmp_path / "lake").exists()


@pytest.mark.slow
def test_damaged_tables_cost_the_fleet_nothing_and_the_next_night_heals_them(fleet, first_night, tmp_path):
    lake = tmp_path / "lake"
    shutil.copytree(first_night[0], lake)
    ill = Partition("vehicle-1", DAYS[0])
    # Pages of a lidar's features behind a whole footer, and the records' footers.
    files = dict.fromkeys(lake.glob("calibrations/*/*.parquet"), 0)
    files[Lake.at(lake).file("sweep_features", ill, "lidar")] = 4
    for path, keep in files.items():
        whole = path.read_bytes()
        path.write_bytes(whole[:keep] + bytes(len(whole) // 2) + whole[keep + len(whole) // 2 :])
    told = Lake.at(lake)
    assert run("audit", "--fleet", f"{fleet}/fleet.toml", "--lake", str(lake))[1]["damaged"]
    code, summary, _ = run(*command(fleet, lake, "--executor", "inline"))
    assert (code, summary["failed"]) == (2, 0)
    assert good_days(lake) == WANTED | {("vehicle-3", DAYS[0])}
    assert answers(lake) == answers(first_night[0])  # this process finds what workers found
    assert len(list(observations_of(told, ill))) == 12
    code, summary, _ = run(*command(fleet, lake, "--executor", "inline"))
    assert (summary["damaged"], summary["done"]) == ([], 0)


@contextmanager
def nightly_with_workers(fleet, lake):
    """A night in the background, and its workers once they are at work."""
    arguments = [BORESIGHT, *command(fleet, lake, "--workers", "2", "--to", DAYS[0])]
    with started(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 1800
        workers = []
        while len(workers) != 2 or not any(Path(lake).rglob("*.parquet")):
            assert time.monotonic() < deadline, "no workers came to work"
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
            workers = [c for c in descendants(process) if works(c, "spawn_main")]
        yield process, workers


def answers(lake, **of):
    """What the lake has recorded, but for when."""
    found = read_records(Lake.at(lake), CALIBRATIONS, CalibrationRecord, **of)
    rows = [dataclasses.asdict(r) | {"recorded_at": "", "asserted_at": ""} for r in found]
    return sorted(repr(sorted(row.items())) for row in rows)


@pytest.mark.slow
def test_a_cluster_records_what_workers_do_though_a_worker_and_a_node_of_it_die(fleet, first_night, tmp_path):
    told = ("--metrics", f"{tmp_path}/night.prom")
    night = [BORESIGHT, *command(fleet, tmp_path / "ray", "--executor", "ray", "--to", DAYS[0], *told)]
    with (
        two_nodes() as (cluster, (node, _)),
        started(night, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
    ):
        on_node = psutil.Process(node.all_processes["raylet"][0].process.pid)
        deadline = time.monotonic() + 1800
        while not (tasks := [c for c in on_node.children() if works(c, "ray::_work")]):
            assert time.monotonic() < deadline
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        tasks[0].kill()
        while not any(Path(tmp_path / "ray").rglob("perceived/*/*/*.parquet")):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        cluster.remove_node(node, allow_graceful=False)
        out, err = process.communicate(timeout=1800)
    lines = out.splitlines()
    assert (process.returncode, len(lines)) == (2, 1), err  # Ray has nothing to say on stdout
    assert json.loads(lines[0])["failed"] == 0
    assert all(json.loads(line) for line in err.splitlines())
    assert answers(tmp_path / "ray") == answers(first_night[0], day=DAYS[0])
    assert len(answers(tmp_path / "ray")) == 9
    metrics = (tmp_path / "night.prom").read_text()
    for stage in ("ingest", "perceive", "calibrate", "audit", "state", "report"):
        assert f'boresight_stage_seconds{{fleet="synthetic",stage="{stage}"}}' in metrics


@pytest.mark.slow
def test_a_stopped_night_ends_cleanly_a_killed_one_anyhow_and_the_next_one_completes_both(
    fleet, first_night, tmp_path
):
    lake = tmp_path / "lake"
    with nightly_with_workers(fleet, lake) as (process, workers):
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=1800)
        assert process.returncode == 143
        assert json.loads(out.splitlines()[-1])["status"] == "stopped"
        assert psutil.wait_procs(workers, timeout=1800)[1] == []
    assert not list(lake.rglob("*.tmp"))
    with nightly_with_workers(fleet, lake) as (process, workers):
        for victim in (process, *workers):
            victim.kill()
        process.communicate()
        assert psutil.wait_procs(workers, timeout=1800)[1] == []
    code, summary, _ = run(*command(fleet, lake, "--workers", "2", "--to", DAYS[0]))
    assert (code, summary["failed"]) == (2, 0)
    assert answers(lake) == answers(first_night[0], day=DAYS[0])


@pytest.mark.slow
def test_a_night_on_a_bucket_that_answers_503_now_and_then_records_what_one_on_a_folder_does(
    fleet, first_night, tmp_path
):
    shutil.copytree(fleet / "logs" / "vehicle-1" / DAYS[0], tmp_path / "logs" / "vehicle-1" / DAYS[0])
    shutil.copy(fleet / "fleet.toml", tmp_path)
    with running() as s3:
        s3.faults(fail=20, every=5)
        lake = f"s3://{BUCKET}/night/lake"
        night = command(tmp_path, lake, "--executor", "inline", "--no-pictures")
        code, summary, stderr = run(*night, **s3.environment)
        assert code in (0, 3), stderr
        assert (summary["vehicle_days"], summary["damaged"]) == (1, [])
        assert summary["report"].startswith(lake)
        assert run(*night, **s3.environment)[1]["done"] == 0
        of_both = [shown(place, **s3.environment) for place in (lake, first_night[0])]
        status = run("status", "--lake", lake, **s3.environment)[1]
        assert status["failed"] + status["missing"] == 0
        assert s3.faults()["failed"] > 0
    there, here = of_both
    assert len(there) == len(here) == 3
    for a, b in zip(there, here, strict=True):
        for name in set(a) - {"recorded_at", "asserted_at"}:
            np.testing.assert_equal(a[name], b[name], err_msg=name)


def shown(lake, **environment):
    rows = json.loads(boresight("show", "calibrations", "--lake", lake, "--json", **environment).out)
    return sorted(
        (r for r in rows if (r["vehicle"], r["day"]) == ("vehicle-1", DAYS[0])), key=lambda r: r["pair"]
    )


def test_days_outside_the_window_are_not_touched(tmp_path):
    (tmp_path / "fleet.toml").write_text(fleet_toml("vehicle-1"))
    log = tmp_path / "logs" / "vehicle-1" / DAYS[0] / "a.mcap"
    log.parent.mkdir(parents=True)
    log.write_bytes(b"of a day that nobody opens")
    code, summary, _ = run(*command(tmp_path, tmp_path / "lake", "--from", "2027-01-01"))
    assert (code, summary["vehicle_days"]) == (0, 0)
    assert not list((tmp_path / "lake").rglob("*.parquet"))
