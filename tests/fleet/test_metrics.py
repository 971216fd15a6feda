"""What monitoring reads of a night, by Prometheus' own parser."""

import pytest

from pipeline.core.results import Effort, Outcome
from pipeline.fleet.metrics import NightEnd, Tally, write_metrics
from pipeline.fleet.nightly import DayOutcome
from schemas.versions import CODE_VERSION

parser = pytest.importorskip("prometheus_client.parser", reason="pip install 'boresight[ops]'")


DAY = "2026-03-02"


def stage_outcome(stage, vehicle, status="done", seconds=2.0, **values):
    key = "" if status == "failed" else f"key of {stage}"
    effort = Effort("2026-03-03T01:00:00.000000Z", seconds, 1000, 100)
    return Outcome(stage, vehicle, DAY, status, key, effort=effort, **values)


def day_outcome(vehicle, status="done", pairs=None, results=()):
    return DayOutcome(vehicle, DAY, status, pairs=pairs or {}, results=tuple(results))


def tally():
    counted = Tally()
    accepted = {"camera_lidar": "accepted", "lidar_radar": "held"}
    stages = [stage_outcome("ingest", "car"), stage_outcome("calibrate", "car", seconds=9.5)]
    counted.add(day_outcome("car", "held", accepted, stages))
    counted.add(day_outcome("bus", "failed", results=[stage_outcome("ingest", "bus", "failed", seconds=1.0)]))
    return counted


def end(exit_code, ended_s=2000.0):
    moved = [{"vehicle": 'a "car"', "sensor": "radar", "since": "2026-03-01"}]
    return NightEnd(exit_code, 1000.0, ended_s, {"GREEN": 7, "RED": 1}, moved)


def samples(path):
    families = parser.text_string_to_metric_families(path.read_text())
    return {
        (s.name, *(v for k, v in sorted(s.labels.items()) if k != "fleet")): s.value
        for f in families
        for s in f.samples
    }


def test_a_night_is_told_in_numbers(tmp_path):
    write_metrics(tmp_path / "night.prom", "test", tally(), end(3))
    found = samples(tmp_path / "night.prom")
    assert found["boresight_last_success_timestamp_seconds",] == 2000
    assert found["boresight_duration_seconds",] == 1000
    assert found["boresight_exit_code",] == 3
    assert found["boresight_info", CODE_VERSION] == 1
    assert [found["boresight_vehicle_days", s] for s in ("held", "failed", "done")] == [1, 1, 0]
    assert found["boresight_records", "lidar_radar", "held"] == 1
    assert found["boresight_vehicles", "GREEN"] == 7
    assert found["boresight_sensor_moved", "radar", "2026-03-01", 'a "car"'] == 1
    assert found["boresight_stage_seconds", "ingest"] == 3
    assert found["boresight_stage_seconds", "calibrate"] == 9.5
    assert found["boresight_stage_read_bytes", "ingest"] == 2000
    assert found["boresight_stage_written_bytes", "calibrate"] == 100
    assert found["boresight_stage_ends", "ingest", "failed"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["night.prom"]


@pytest.mark.parametrize(("code", "last"), [(0, 9000), (3, 9000), (1, 2000)])
def test_what_is_held_is_a_success_and_a_failure_leaves_the_last_success_as_it_was(code, last, tmp_path):
    file = tmp_path / "night.prom"
    write_metrics(file, "test", tally(), end(0))
    write_metrics(file, "test", tally(), end(code, 9000.0))
    assert samples(file)["boresight_last_success_timestamp_seconds",] == last
    assert samples(file)["boresight_last_run_timestamp_seconds",] == 9000


@pytest.mark.parametrize("damage", [b"", b"\xff\xfe", b"boresight_last_success_timestamp_seconds{ 1"])
def test_a_first_failure_has_no_last_success(damage, tmp_path):
    file = tmp_path / "night.prom"
    file.write_bytes(damage)
    write_metrics(file, "test", tally(), end(1))
    assert ("boresight_last_success_timestamp_seconds",) not in samples(file)
