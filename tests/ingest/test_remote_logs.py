"""Logs in a bucket are read as files are, by the parts that are asked for."""

from pathlib import PurePosixPath

import numpy as np
import pytest

import pipeline.store.object_store
from pipeline.core.errors import ConfigError, LogError, StorageError
from pipeline.fleet.pattern import find_vehicle_days
from pipeline.ingest.containers import rosbag2_folder
from pipeline.ingest.containers.reader import content_identity, open_log
from pipeline.store.object_store import Bucket
from pipeline.store.remote_logs import RemoteLog, log_at
from tests.ingest.containers.test_containers import write
from tests.ingest.test_reading_plan import BUDGET, in_bursts, long_drive, same_but_numbers
from tests.makers.s3_server import BUCKET


@pytest.fixture(autouse=True)
def _soon_given_up(monkeypatch):
    for name, value in {"REQUEST_S": 5.0, "RETRIES": 2, "RETRY_S": 2.0}.items():
        monkeypatch.setattr(pipeline.store.object_store, name, value)


@pytest.fixture
def put(s3):
    assert s3.url  # its environment comes first

    def put(file, key=None):
        key = key or f"logs/car/2023-11-14/{file.name}"
        with Bucket(BUCKET).replacing(PurePosixPath(key)) as stream:
            stream.write(file.read_bytes())
        return log_at(f"s3://{BUCKET}/{key}")

    return put


def fetched(s3, work):
    before = s3.faults()["bytes_sent"]
    return work(), s3.faults()["bytes_sent"] - before


@pytest.mark.parametrize("container", ["mcap", "bag_lz4", "db3", "db3_zstd"])
def test_a_log_of_any_container_gives_what_the_file_gives(kit, tmp_path, put, run_ingest, s3, container):
    file = write(kit, tmp_path, container)
    file = next(file.glob("*.db3*")) if file.is_dir() else file
    local, rows = run_ingest(file, name="local")
    (result, frames), part = fetched(s3, lambda: run_ingest(put(file), name="remote"))
    assert (result.status, result.rows, result.kept) == (local.status, 4, local.kept)
    assert part < 5 * file.stat().st_size  # small reads share what was fetched ahead
    for frame, row in zip(frames, rows, strict=True):
        same_but_numbers(frame, row)


def test_of_a_long_log_only_the_bursts_are_fetched(kit, tmp_path, put, run_ingest, s3):
    file = long_drive(kit).mcap(tmp_path / "long.mcap", compression="NONE", chunk_size=200_000)
    log = put(file)
    (_, frames), part = fetched(s3, lambda: run_ingest(log, fleet=in_bursts(kit), name="remote"))
    rows = run_ingest(file, fleet=in_bursts(kit), name="local")[1]
    assert [f.stamp_ns for f in frames] == [r.stamp_ns for r in rows]
    np.testing.assert_array_equal(frames[-1].lidar_xyz_m, rows[-1].lidar_xyz_m)
    assert len(frames) >= BUDGET - 2
    # A fifth of the frames; half a second about each burst and the glances are much of a day as short as this.
    assert part < 0.7 * file.stat().st_size
    (result, _), nothing = fetched(s3, lambda: run_ingest(log, fleet=in_bursts(kit), name="remote"))
    assert (result.status, nothing) == ("cached", 0)


def test_what_cannot_be_read_where_it_lies_is_fetched_up_to_a_limit(kit, tmp_path, put, monkeypatch):
    monkeypatch.setattr(rosbag2_folder, "_MOST_FETCHED_BYTES", 1 << 10)
    with pytest.raises(LogError, match="use MCAP"):
        open_log(put(next(kit.Kit().drive().folder(tmp_path / "bag").glob("*.db3"))))


def test_another_content_is_another_log_and_the_same_is_the_same(kit, tmp_path, put):
    file = kit.Kit().drive().mcap(tmp_path / "a.mcap")
    first = content_identity(put(file))
    assert content_identity(put(file)) == first
    assert first.startswith("a.mcap:")
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    assert content_identity(put(file)) != first


def test_a_store_that_does_not_answer_fails_the_day_and_damages_nothing(kit, tmp_path, put, run_ingest, s3):
    log = put(kit.Kit().drive().mcap(tmp_path / "a.mcap"))
    known = RemoteLog(log.bucket, log.key, (log.stat().st_size, "tag"))
    s3.faults(fail=10**6)
    with pytest.raises(StorageError, match="s3://"):
        run_ingest(known)
    s3.faults(fail=0)
    assert run_ingest(known)[0].rows == 4


def test_a_log_that_is_not_there_is_a_usage_error(s3, run_ingest):
    assert s3.url
    with pytest.raises(ConfigError, match="no such file: s3://"):
        run_ingest(log_at(f"s3://{BUCKET}/logs/none.mcap"))


@pytest.mark.parametrize("place", ["gs://bucket/a.mcap", "s3://bucket", "s3:///a.mcap"])
def test_a_place_that_is_no_object_is_a_usage_error(place):
    with pytest.raises(ConfigError, match="nor s3://BUCKET/KEY"):
        log_at(place)


def test_a_pattern_finds_the_vehicle_days_of_a_bucket(tmp_path, put):
    file = tmp_path / "x.mcap"
    file.write_bytes(b"x")
    for key in ("a/2026-03-02/1.mcap", "a/2026-03-02/2.bag", "a/2026-03-03/1.mcap", "b c/2026-03-02/1.mcap"):
        put(file, f"raw/{key}")
    for key in ("a/2026-03-02/notes.txt", "a/2026-13-02/1.mcap", "a/1.mcap"):
        put(file, f"raw/{key}")
    days = find_vehicle_days(f"s3://{BUCKET}/raw/{{vehicle}}/{{day}}/*")
    found = {(d.partition.vehicle, d.partition.day): [log.name for log in d.logs] for d in days}
    assert found == {
        ("a", "2026-03-02"): ["1.mcap", "2.bag"],
        ("b c", "2026-03-02"): ["1.mcap"],
        ("a", "2026-03-03"): ["1.mcap"],
    }
    one = find_vehicle_days(f"s3://{BUCKET}/raw/{{vehicle}}/{{day}}/[!2].mcap", "2026-03-03", "2026-03-03")
    assert [str(log) for log in one[0].logs] == [f"s3://{BUCKET}/raw/a/2026-03-03/1.mcap"]
    with pytest.raises(ConfigError, match="no log matches"):
        find_vehicle_days(f"s3://{BUCKET}/none/{{vehicle}}/{{day}}/*")
