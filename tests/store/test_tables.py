import dataclasses
import json
import multiprocessing
import os
import socket
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import polars as pl
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import pipeline.store.delta
from pipeline.core.errors import ContractError, DamagedError, OtherVersionError
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.tables import (
    iterate_rows,
    read_manifest,
    read_rows,
    write_partition,
)
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.versions import CODE_VERSION, TABLES
from tests.makers.table_rows import ROW_TYPES, make_row, same
from tests.makers.whole_tables import FRAMES, WholeFrame

REPO = Path(__file__).resolve().parents[2]
DAY = Partition("car", "2026-03-02")


@pytest.fixture
def lake(tmp_path):
    return Lake.at(tmp_path / "lake")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def write(lake, rows, key="k1", schema=FRAMES, partition=DAY, group=2):
    with write_partition(lake, schema, partition, key, "0.1", ["in"]) as writer:
        for first in range(0, len(rows), group):
            writer.append(rows[first : first + group])
        writer.describe(kept={"frames": len(rows)}, rejected={"dark": 2}, note="x")


@pytest.mark.parametrize("table", ROW_TYPES)
@pytest.mark.parametrize("case", ["full", "nulls", "empty arrays"])
def test_rows_of_every_table_come_back_as_they_were(table, case, lake, rng):
    schema, row_type = ROW_TYPES[table]
    options = {"nulls": case == "nulls", "free": 0 if case == "empty arrays" else 5}
    rows = [make_row(table, rng, **options) for _ in range(5)]
    write(lake, rows, schema=schema)
    found = read_rows(lake, schema, DAY, row_type)
    assert len(found) == 5
    assert all(same(a, b) for a, b in zip(rows, found, strict=True))


def test_the_manifest_says_where_a_partition_comes_from(lake, rng):
    assert read_manifest(lake, FRAMES, DAY) is None
    write(lake, [make_row("frames", rng) for _ in range(3)])
    manifest = read_manifest(lake, FRAMES, DAY)
    assert (manifest.table, manifest.version, manifest.work_key) == ("frames", FRAMES.version, "k1")
    assert (manifest.rows, manifest.kept, manifest.rejected) == (3, {"frames": 3}, {"dark": 2})
    assert (manifest.inputs, manifest.extra) == (["in"], {"note": "x"})


def test_picked_rows_come_from_their_row_groups_alone(lake, rng):
    rows = [make_row("frames", rng, frame_index=i) for i in range(7)]
    write(lake, rows)
    chunks = list(iterate_rows(lake, FRAMES, DAY, WholeFrame, rows=[6, 0, 3]))
    assert [[r.frame_index for r in chunk] for chunk in chunks] == [[0], [3], [6]]


def test_an_error_while_writing_leaves_the_old_partition_and_nothing_else(lake, rng):
    write(lake, [make_row("frames", rng, frame_index=7)])
    with (
        pytest.raises(RuntimeError, match="sensor"),
        write_partition(lake, FRAMES, DAY, "k2", "0.1") as writer,
    ):
        writer.append([make_row("frames", rng)])
        raise RuntimeError("sensor")
    assert [r.frame_index for r in read_rows(lake, FRAMES, DAY, WholeFrame)] == [7]
    assert read_manifest(lake, FRAMES, DAY).work_key == "k1"
    assert [p.name for p in lake.folder("frames", DAY).iterdir()] == ["part-0.parquet"]


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [("camera_K", np.eye(4), "shape"), ("lidar_x_m", np.zeros((2, 2)), "shape"), ("log", None, "null")],
)
def test_a_row_that_breaks_its_contract_is_not_written(field, value, match, lake, rng):
    with (
        pytest.raises(ContractError, match=match),
        write_partition(lake, FRAMES, DAY, "k", "0.1") as writer,
    ):
        row = make_row("frames", rng)
        object.__setattr__(row, field, value)  # as code without a type check would
        writer.append([row])
    assert read_manifest(lake, FRAMES, DAY) is None


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("step", [1, -1])
def test_what_another_release_wrote_is_refused_with_file_version_and_release(table, step, lake, rng):
    schema, row_type = ROW_TYPES[table]
    other = dataclasses.replace(schema, version=schema.version + step)
    holds, reads = f"{table}.* holds {table}/{other.version}", f"this version reads {table}/{schema.version}"
    if schema.is_record_table:
        times = {"recorded_at": "", "asserted_at": ""}
        commit_records(lake, other, [make_row(table, rng, vehicle="v", day="2026-03-02", **times)])
        words = f"{holds}, written by boresight {CODE_VERSION}; {reads}: use that release, or a new lake$"
        for refused in (
            lambda: read_records(lake, schema, row_type),
            lambda: commit_records(lake, schema, [make_row(table, rng, **times)]),
        ):
            with pytest.raises(OtherVersionError, match=words):
                refused()
    else:
        write(lake, [make_row(table, rng)], schema=other)
        remedy = "use that release" if step > 0 else "make it anew"
        with pytest.raises(
            OtherVersionError, match=rf"{holds}, written by boresight 0\.1; {reads}: {remedy}$"
        ):
            read_rows(lake, schema, DAY, row_type)


@pytest.mark.parametrize(
    ("table", "release"), [("calibrations", "0.11.0"), ("drift", r"\(release unknown\)")]
)
def test_a_record_table_that_does_not_name_its_release_has_it_in_its_rows_or_nowhere(
    table, release, lake, rng, monkeypatch
):
    schema, row_type = ROW_TYPES[table]
    of = {"vehicle": "v", "day": "2026-03-02", "recorded_at": "", "asserted_at": ""}
    told = {"code_version": "0.11.0"} if table == "calibrations" else {}
    with monkeypatch.context() as patch:  # as releases until 0.12 made tables
        patch.setattr(pipeline.store.delta, "_RELEASE", "unread")
        other = dataclasses.replace(schema, version=schema.version - 1)
        commit_records(lake, other, [make_row(table, rng, **of, **told)])
    with pytest.raises(OtherVersionError, match=f"written by boresight {release}; this version"):
        read_records(lake, schema, row_type)


def test_another_version_a_foreign_file_and_a_damaged_one_are_named(lake, rng):
    write(lake, [make_row("frames", rng)])
    path = lake.folder("frames", DAY) / "part-0.parquet"
    newer = replace(FRAMES, version=FRAMES.version + 1)
    with pytest.raises(ContractError, match=rf"part-0\.parquet.*frames/{FRAMES.version}.*anew"):
        read_rows(lake, newer, DAY, WholeFrame)
    whole = path.read_bytes()
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(ContractError, match="not written by Boresight"):
        read_rows(lake, FRAMES, DAY, WholeFrame)
    for damaged in (whole[: len(whole) // 2], b"", whole[:-8] + b"\xff" * 8):
        path.write_bytes(damaged)
        with pytest.raises(ContractError, match="damaged"):
            read_manifest(lake, FRAMES, DAY)
    with pytest.raises(ContractError, match="no partition for car on 2026-03-03"):
        read_rows(lake, FRAMES, Partition("car", "2026-03-03"), WholeFrame)


def test_damage_behind_a_whole_footer_is_named_as_damage(lake, rng):
    write(lake, [make_row("frames", rng, free=200) for _ in range(4)])
    path = lake.file("frames", DAY)
    whole = path.read_bytes()
    path.write_bytes(whole[:4] + bytes(len(whole) // 2) + whole[4 + len(whole) // 2 :])
    assert read_manifest(lake, FRAMES, DAY).rows == 4
    with pytest.raises(DamagedError, match=r"part-0\.parquet.*damaged"):
        read_rows(lake, FRAMES, DAY, WholeFrame)
    lake.set_aside(str(path))
    assert read_manifest(lake, FRAMES, DAY) is None
    assert lake.partitions("frames") == []


def test_files_can_be_read_by_whoever_the_umask_lets(lake, rng):
    write(lake, [make_row("frames", rng)])
    umask = os.umask(0)
    os.umask(umask)
    mode = (lake.folder("frames", DAY) / "part-0.parquet").stat().st_mode & 0o777
    assert mode == 0o666 & ~umask


# -- other engines ---------------------------------------------------------------------------------


def decode(blob, field):
    """What a reader without Boresight does: dtype and shape are in the field's metadata."""
    shape = [-1 if s == "N" else int(s) for s in field.metadata[b"shape"].decode().split(",")]
    return np.frombuffer(blob, field.metadata[b"dtype"].decode()).reshape(shape)


def test_duckdb_and_polars_read_the_lake_by_plain_glob(lake, rng):
    rows = {}
    for vehicle, day in (("car", "2026-03-02"), ("car", "2026-03-03"), ("bus 7", "2026-03-02")):
        rows[vehicle, day] = [make_row("frames", rng, frame_index=i) for i in range(3)]
        write(lake, rows[vehicle, day], partition=Partition(vehicle, day))
        # What a killed writer leaves must not be seen.
        (lake.folder("frames", Partition(vehicle, day)) / ".writing-x-1-y.tmp").write_bytes(b"half")
    pattern = f"{lake.root}/frames/*/*/*.parquet"
    table = f"read_parquet('{pattern}', hive_partitioning=true)"
    by_duckdb = duckdb.sql(f"select vehicle, day::varchar, frame_index, lidar_x_m from {table}").fetchall()
    frame = pl.scan_parquet(pattern, hive_partitioning=True)
    by_polars = (
        frame.select("vehicle", pl.col("day").cast(pl.String), "frame_index", "lidar_x_m").collect().rows()
    )
    field = FRAMES.arrow_schema().field("lidar_x_m")
    for found in (by_duckdb, by_polars):
        assert len(found) == 9
        for vehicle, day, index, blob in found:
            np.testing.assert_array_equal(decode(blob, field), rows[vehicle, day][index].lidar_x_m)


@pytest.mark.parametrize("name", [n for n, (schema, _) in ROW_TYPES.items() if not schema.is_record_table])
def test_duckdb_and_polars_read_every_table_of_partitions_by_plain_glob(name, lake, rng):
    schema, _ = ROW_TYPES[name]
    write(lake, [make_row(name, rng) for _ in range(3)], schema=schema)
    pattern = f"{lake.root}/{name}/*/*/*.parquet"
    sql = f"select count(*) from read_parquet('{pattern}', hive_partitioning=true)"
    assert duckdb.sql(sql).fetchall() == [(3,)]
    frame = pl.scan_parquet(pattern, hive_partitioning=True).collect()
    assert {c.name for c in schema.columns} <= set(frame.columns)
    assert frame.height == 3


# -- faults ------------------------------------------------------------------------------------------


def assert_whole(lake):
    """One generation in the partition, and all three rows of every commit of records."""
    manifest = read_manifest(lake, FRAMES, DAY)
    rows = read_rows(lake, FRAMES, DAY, WholeFrame)
    assert len(rows) == 12
    assert {f"key-{r.drive}" for r in rows} == {manifest.work_key}
    counts = Counter(r.work_key for r in read_records(lake, CALIBRATIONS, CalibrationRecord))
    assert set(counts.values()) == {3}
    assert lake.damage == []


@pytest.mark.slow
def test_a_writer_killed_at_any_moment_never_leaves_a_bad_read(lake, rng):
    server = subprocess.Popen(
        [sys.executable, "-m", "tests.store.writer_to_kill", str(lake.root)],
        cwd=REPO,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with server:
        assert server.stdout.readline() == "ready\n"
        generations = set()
        leftovers = kills = 0
        # On a busy machine a write takes longer: there, kills go on and come later until both kinds were seen.
        while kills < 60 or (min(len(generations), leftovers) <= 5 and kills < 600):
            delay = rng.uniform(0.0, 0.12 * (1 + kills // 60))
            kills += 1
            server.stdin.write(f"{delay}\n")
            server.stdin.flush()
            assert server.stdout.readline() == "killed\n"
            assert_whole(lake)
            generations.add(read_manifest(lake, FRAMES, DAY).work_key)
            leftovers += len(list(lake.folder("frames", DAY).glob("*.tmp")))
        server.stdin.close()
    assert len(generations) > 5  # kills came between complete writes,
    assert leftovers > 5  # and in the middle of some
    write(lake, [make_row("frames", rng)])
    assert not list(lake.folder("frames", DAY).glob("*.tmp"))


def write_many(root, name, times):
    lake, rng = Lake.at(root), np.random.default_rng(1)
    for i in range(times):
        rows = [make_row("frames", rng, free=500, log=f"{name}{i}", frame_index=j) for j in range(6)]
        write(lake, rows, key=f"{name}{i}")


def test_two_writers_on_one_partition_end_with_one_of_them_whole(lake):
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_many, args=(lake.root, name, 25)) for name in "ab"]
    for process in writers:
        process.start()
    while any(p.is_alive() for p in writers):
        manifest = read_manifest(lake, FRAMES, DAY)
        if manifest is not None:
            assert manifest.rows == 6
    assert [p.exitcode for p in writers] == [0, 0]
    rows = read_rows(lake, FRAMES, DAY, WholeFrame)
    assert len(rows) == 6
    assert {r.log for r in rows} == {read_manifest(lake, FRAMES, DAY).work_key}
    assert {r.log for r in rows} <= {"a24", "b24"}
    assert [p.name for p in lake.folder("frames", DAY).iterdir()] == ["part-0.parquet"]


def test_leftovers_go_when_their_writer_is_dead_or_a_day_has_passed(lake, rng):
    folder = lake.folder("frames", DAY)
    folder.mkdir(parents=True)
    host = socket.gethostname()
    dead = next(pid for pid in range(4_000_000, 3_000_000, -1) if not psutil.pid_exists(pid))
    names = {
        "dead": f".writing-{host}-{dead}-aa.tmp",
        "alive": f".writing-{host}-{os.getppid()}-bb.tmp",
        "elsewhere": ".writing-other-host-1-cc.tmp",
        "old": ".writing-other-host-1-dd.tmp",
    }
    for name in names.values():
        (folder / name).write_bytes(b"half")
    os.utime(folder / names["old"], (0, 0))
    write(lake, [make_row("frames", rng)])
    left = {key for key, name in names.items() if (folder / name).exists()}
    assert left == {"alive", "elsewhere"}


def test_the_footer_is_plain_json_that_other_tools_can_read(lake, rng):
    write(lake, [make_row("frames", rng)])
    raw = pq.read_metadata(lake.folder("frames", DAY) / "part-0.parquet").metadata[b"boresight"]
    assert json.loads(raw)["work_key"] == "k1"
