"""A lake in a bucket: what holds for a folder holds there, also while the store answers 503, late or not at all."""

import os
import subprocess
import sys
from pathlib import Path

import duckdb
import numpy as np
import polars as pl
import pytest
from deltalake import DeltaTable

import pipeline.store.object_store
from pipeline.core.errors import ConfigError, DamagedError
from pipeline.store.commits import assert_records, commit_records
from pipeline.store.current import current_records
from pipeline.store.delta import tidy_table
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import last_day, read_records
from pipeline.store.row_groups import read_columns, read_group, row_groups
from pipeline.store.tables import read_manifest, read_rows, write_partition
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.makers.s3_server import BUCKET, running
from tests.makers.table_rows import make_row, same
from tests.makers.whole_tables import FRAMES, WholeFrame

REPO = Path(__file__).resolve().parents[2]
DAY = Partition("bus 7%", "2026-03-02")  # a name that must be quoted


@pytest.fixture(scope="module")
def server():
    with running() as s3:
        yield s3


@pytest.fixture
def s3(server, monkeypatch):
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(pipeline.store.object_store, "REQUEST_S", 2.0)
    pipeline.store.object_store._client.cache_clear()
    server.faults(fail=0, stall=0)
    yield server
    pipeline.store.object_store._client.cache_clear()


@pytest.fixture
def lake(s3, request):
    assert s3.url  # its environment comes first
    return Lake.at(f"s3://{BUCKET}/lakes/{abs(hash(request.node.name))}")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def record(rng, key, vehicle="car", day="2026-03-02", pair=PAIRS[0]):
    values = {"recorded_at": "", "asserted_at": "", "method": "joint"}
    return make_row("calibrations", rng, vehicle=vehicle, day=day, pair=pair, work_key=key, **values)


def write(lake, rows, key="k1", partition=DAY):
    with write_partition(lake, FRAMES, partition, key, "0.1", ["in"]) as writer:
        for first in range(0, len(rows), 2):
            writer.append(rows[first : first + 2])
        writer.describe(kept={"frames": len(rows)}, rejected={})


def read(lake, **choice):
    return read_records(lake, CALIBRATIONS, CalibrationRecord, **choice)


def objects(lake):
    return sorted(str(p) for p in lake.files.find(lake.root, "**/*"))


def test_partitions_are_written_whole_found_and_read_by_row_and_column(lake, rng):
    assert not lake.exists()
    assert read_manifest(lake, FRAMES, DAY) is None
    rows = [make_row("frames", rng, frame_index=i, free=300) for i in range(5)]
    write(lake, rows)
    write(lake, rows[:1], partition=Partition("car", "2026-03-03"))
    assert lake.exists()
    assert all(same(a, b) for a, b in zip(rows, read_rows(lake, FRAMES, DAY, WholeFrame), strict=True))
    assert read_manifest(lake, FRAMES, DAY).rows == 5
    assert lake.partitions("frames") == [DAY, Partition("car", "2026-03-03")]
    assert lake.partitions("frames", vehicle="car") == [Partition("car", "2026-03-03")]
    assert lake.partitions("frames", day="2026-03-02") == [DAY]
    assert read_columns(lake, FRAMES, DAY, ["frame_index"]) == {"frame_index": [0, 1, 2, 3, 4]}
    groups = row_groups(lake, FRAMES, DAY)
    assert [g.rows for g in groups] == [2, 2, 1]
    assert [f.frame_index for f in read_group(lake, FRAMES, groups[1], WholeFrame)] == [2, 3]
    write(lake, rows[:2], key="k2")
    assert read_manifest(lake, FRAMES, DAY).work_key == "k2"


def test_an_error_while_writing_leaves_the_old_partition_and_nothing_else(lake, rng):
    write(lake, [make_row("frames", rng)])
    before = objects(lake)
    with pytest.raises(RuntimeError), write_partition(lake, FRAMES, DAY, "k2", "0") as writer:
        writer.append([make_row("frames", rng)])
        raise RuntimeError
    assert read_manifest(lake, FRAMES, DAY).work_key == "k1"
    assert objects(lake) == before


def test_only_what_is_asked_for_is_fetched(lake, rng):
    write(lake, [make_row("frames", rng, image=rng.bytes(3 << 20)) for _ in range(8)])
    fetched = []
    real = pipeline.store.object_store._Reader.readinto

    def counting(self, buffer):
        fetched.append(real(self, buffer))
        return fetched[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.store.object_store._Reader, "readinto", counting)
        read_columns(lake, FRAMES, DAY, ["frame_index"])
    assert sum(fetched) < 8 << 20  # of 24 MiB


def test_a_damaged_partition_is_named_and_set_aside(lake, rng):
    write(lake, [make_row("frames", rng)])
    path = lake.file("frames", DAY)
    with lake.files.replacing(path) as stream:
        stream.write(b"PAR1 no more")
    with pytest.raises(DamagedError) as caught:
        read_manifest(lake, FRAMES, DAY)
    lake.set_aside(caught.value.path)
    assert read_manifest(lake, FRAMES, DAY) is None
    assert lake.partitions("frames") == []


def test_records_are_committed_once_asserted_compacted_and_healed(lake, rng):
    assert read(lake) == []
    for i in range(10):
        commit_records(lake, CALIBRATIONS, [record(rng, f"k{i}", day=f"2026-03-{i + 1:02d}")])
    rows = read(lake)
    assert commit_records(lake, CALIBRATIONS, rows) == 0
    assert last_day(lake, CALIBRATIONS) == "2026-03-10"
    commit_records(lake, CALIBRATIONS, [record(rng, "B", day="2026-03-02")])
    assert assert_records(lake, CALIBRATIONS, [rows[1]]) == 1
    assert [r.work_key for r in current_records(read(lake, day="2026-03-02"))] == ["k1"]
    assert any("files are" in what for what in tidy_table(lake, CALIBRATIONS))
    assert len(read(lake)) == 11
    [path] = [p for p in objects(lake) if "zstd.parquet" in p and "month" in p][-1:]
    for name in [p for p in objects(lake) if p.endswith(".parquet")]:
        with lake.files.replacing(type(lake.root)(name)) as stream:
            stream.write(b"no table")
    assert read(lake) == []
    assert any(path.split("/")[-1] in what or "parquet" in what for what in lake.damage)
    commit_records(lake, CALIBRATIONS, rows)
    assert len(read(Lake.at(str(lake)))) == 10


def test_other_engines_read_the_bucket_by_the_documented_lines(lake, rng):
    commit_records(lake, CALIBRATIONS, [record(rng, "k")])
    where = lake.table("calibrations")
    records = DeltaTable(where).to_pyarrow_table()  # noqa: F841 - DuckDB finds it by its name
    assert duckdb.sql("select vehicle, pair from records").fetchall() == [("car", PAIRS[0])]
    assert pl.scan_delta(where).select("vehicle").collect()["vehicle"].to_list() == ["car"]


@pytest.mark.parametrize(
    "fault",
    [
        {"fail": 6},
        {"stall": 2, "stall_s": 3.0},
        {"fail": 40, "every": 3},
        {"mix": ["500", "lost"], "every": 4},
    ],
)
def test_answers_of_5xx_late_ones_and_lost_ones_are_asked_for_again(fault, lake, rng, s3):
    rows = [make_row("frames", rng, frame_index=i) for i in range(3)]
    before = s3.faults(**fault)
    write(lake, rows)
    commit_records(lake, CALIBRATIONS, [record(rng, "k", pair=pair) for pair in PAIRS])
    assert len(read_rows(lake, FRAMES, DAY, WholeFrame)) == 3
    assert len(read(lake)) == 3
    after = s3.faults(fail=0, stall=0)
    assert sum(after[kind] - before[kind] for kind in ("failed", "stalled", "lost")) > 1
    assert lake.damage == []


def test_a_store_that_is_down_is_an_error_and_never_damage(lake, rng, s3, monkeypatch):
    write(lake, [make_row("frames", rng)])
    commit_records(lake, CALIBRATIONS, [record(rng, "k")])
    monkeypatch.setattr(pipeline.store.object_store, "RETRIES", 1)
    pipeline.store.object_store._client.cache_clear()
    s3.faults(fail=10_000)
    for call in (
        lambda: read_manifest(lake, FRAMES, DAY),
        lambda: read(lake),
        lambda: commit_records(lake, CALIBRATIONS, [record(rng, "k2")]),
        lambda: write(lake, [make_row("frames", rng)], key="k2"),
    ):
        with pytest.raises(OSError, match="s3://") as caught:
            call()
        assert caught.value.errno is None or caught.value.errno > 0
    s3.faults(fail=0)
    assert lake.damage == []
    assert [r.work_key for r in read(lake)] == ["k"]
    assert read_manifest(lake, FRAMES, DAY).work_key == "k1"


def test_a_bucket_of_the_same_name_in_another_store_is_another_one(lake, rng, monkeypatch):
    write(lake, [make_row("frames", rng)])
    with running() as other:
        monkeypatch.setenv("AWS_ENDPOINT_URL", other.environment["AWS_ENDPOINT_URL"])
        assert read_manifest(lake, FRAMES, DAY) is None


_COMMITS = """
import sys, numpy as np
from pipeline.store.partitions import Lake
from pipeline.store.commits import commit_records
from schemas.calibrations import CALIBRATIONS
from tests.store.test_object_store import record
lake, rng, name = Lake.at(sys.argv[1]), np.random.default_rng(0), sys.argv[2]
for i in range(4):
    commit_records(lake, CALIBRATIONS, [record(rng, f"{name}{i}"), record(rng, "shared", vehicle="bus")])
"""


@pytest.mark.slow
def test_two_writers_at_once_both_get_their_records_in(lake):
    environment = os.environ | {"PYTHONPATH": str(REPO)}
    commands = [[sys.executable, "-c", _COMMITS, str(lake), name] for name in "ab"]
    writers = [subprocess.Popen(command, env=environment) for command in commands]
    assert [w.wait(120) for w in writers] == [0, 0]
    assert sorted(r.work_key for r in read(lake, vehicle="car")) == sorted(
        f"{n}{i}" for n in "ab" for i in range(4)
    )
    assert [r.work_key for r in read(lake, vehicle="bus")] == ["shared"]


@pytest.mark.parametrize("place", ["s3://", "s3://bucket", "gs://bucket/lake"])
def test_a_place_that_is_no_folder_and_no_prefix_of_a_bucket_is_a_usage_error(place):
    with pytest.raises(ConfigError, match=r"s3://BUCKET/PREFIX"):
        Lake.at(place)


def test_what_works_on_folders_only_says_so():
    with pytest.raises(ConfigError, match="is not a folder"):
        _ = Lake.at(f"s3://{BUCKET}/lake").local_root
