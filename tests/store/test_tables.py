"""Tables of partitions, in a folder and in a bucket: whole or not at all, by row and column, for other engines too."""

import json
import multiprocessing
import os
import socket
from dataclasses import replace

import duckdb
import numpy as np
import polars as pl
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.core.errors import ContractError, DamagedError, OtherVersionError
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Partition
from pipeline.store.records import read_records
from pipeline.store.tables import (
    iterate_rows,
    read_columns,
    read_group,
    read_manifest,
    read_rows,
    row_groups,
    write_partition,
)
from schemas.versions import CODE_VERSION, TABLES
from tests.makers.table_rows import ROW_TYPES, make_row, same
from tests.makers.whole_tables import FRAMES, WholeFrame

DAY = Partition("bus 7%", "2026-03-02")  # a name that must be quoted


def write(lake, rows, key="k1", schema=FRAMES, partition=DAY, group=2):
    with write_partition(lake, schema, partition, key, ["in"]) as writer:
        for first in range(0, len(rows), group):
            writer.append(rows[first : first + group])
        writer.describe(kept={"frames": len(rows)}, rejected={"dark": 2}, note="x")


def read(lake, partition=DAY):
    return read_rows(lake, FRAMES, partition, WholeFrame)


def contents(lake):
    found = {}
    for path in lake.files.find(lake.root, "**/*.*"):
        with lake.files.opened(path) as stream:
            found[str(path)] = stream.read()
    return found


@pytest.mark.parametrize("table", ROW_TYPES)
@pytest.mark.parametrize("case", ["full", "nulls", "empty arrays"])
def test_rows_of_every_table_come_back_as_they_were(table, case, lake, rng):
    schema, row_type = ROW_TYPES[table]
    options = {"nulls": case == "nulls", "free": 0 if case == "empty arrays" else 5}
    if schema.is_record_table:
        of = [{"vehicle": "car", "day": f"2026-0{i}-02", "work_key": str(i)} for i in (1, 2, 3)]
        rows = [make_row(table, rng, **options, **values) for values in of]
        commit_records(lake, schema, rows)
        found = read_records(lake, schema, row_type)
    else:
        rows = [make_row(table, rng, **options) for _ in range(5)]
        write(lake, rows, schema=schema)
        found = read_rows(lake, schema, DAY, row_type)
    assert all(same(a, b) for a, b in zip(rows, found, strict=True))


def test_partitions_are_written_whole_found_and_read_by_row_and_column(any_lake, rng):
    lake, other = any_lake, Partition("car", "2026-03-03")
    assert not lake.exists()
    assert read_manifest(lake, FRAMES, DAY) is None
    with pytest.raises(ContractError, match="no partition for bus 7% on 2026-03-02"):
        read(lake)
    rows = [make_row("frames", rng, frame_index=i, free=300) for i in range(5)]
    write(lake, rows)
    write(lake, rows[:1], partition=other)
    assert lake.exists()
    assert all(same(a, b) for a, b in zip(rows, read(lake), strict=True))
    manifest = read_manifest(lake, FRAMES, DAY)
    assert (manifest.table, manifest.version, manifest.work_key) == ("frames", FRAMES.version, "k1")
    assert (manifest.rows, manifest.kept, manifest.rejected) == (5, {"frames": 5}, {"dark": 2})
    assert (manifest.inputs, manifest.extra) == (["in"], {"note": "x"})
    assert lake.partitions("frames") == [DAY, other]
    assert read_columns(lake, FRAMES, DAY, ["frame_index"]) == {"frame_index": [0, 1, 2, 3, 4]}
    groups = row_groups(lake, FRAMES, DAY)
    assert [g.rows for g in groups] == [2, 2, 1]
    assert [f.frame_index for f in read_group(lake, FRAMES, groups[1], WholeFrame)] == [2, 3]
    chunks = list(iterate_rows(lake, FRAMES, DAY, WholeFrame, rows=[4, 0, 3]))
    assert [[r.frame_index for r in chunk] for chunk in chunks] == [[0], [3], [4]]
    write(lake, rows[:2], key="k2")
    assert read_manifest(lake, FRAMES, DAY).work_key == "k2"


def test_an_error_while_writing_leaves_the_old_partition_and_nothing_else(any_lake, rng):
    write(any_lake, [make_row("frames", rng, frame_index=7)])
    before = contents(any_lake)
    assert len(before) == 1
    with pytest.raises(RuntimeError), write_partition(any_lake, FRAMES, DAY, "k2") as writer:
        writer.append([make_row("frames", rng)])
        raise RuntimeError
    assert contents(any_lake) == before


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [("camera_K", np.eye(4), "shape"), ("lidar_x_m", np.zeros((2, 2)), "shape"), ("log", None, "null")],
)
def test_a_row_that_breaks_its_contract_is_not_written(field, value, match, lake, rng):
    row = make_row("frames", rng)
    object.__setattr__(row, field, value)  # as code without a type check would
    with pytest.raises(ContractError, match=match):
        write(lake, [row])
    assert read_manifest(lake, FRAMES, DAY) is None


# -- other releases, damage --------------------------------------------------------------------------


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("step", [1, -1])
def test_what_another_release_wrote_is_refused_with_file_version_and_release(table, step, lake, rng):
    schema, row_type = ROW_TYPES[table]
    other = replace(schema, version=schema.version + step)
    holds, reads = f"{table}.* holds {table}/{other.version}", f"this version reads {table}/{schema.version}"
    if schema.is_record_table:
        times = {"recorded_at": "", "asserted_at": ""}
        commit_records(lake, other, [make_row(table, rng, vehicle="v", day="2026-03-02", **times)])
        release, remedy = CODE_VERSION, "use that release, or a new lake"
        refused = [
            lambda: read_records(lake, schema, row_type),
            lambda: commit_records(lake, schema, [make_row(table, rng, **times)]),
        ]
    else:
        write(lake, [make_row(table, rng)], schema=other)
        release, remedy = CODE_VERSION, "use that release" if step > 0 else "make it anew"
        refused = [lambda: read_rows(lake, schema, DAY, row_type)]
    for call in refused:
        with pytest.raises(
            OtherVersionError, match=rf"{holds}, written by boresight {release}; {reads}: {remedy}$"
        ):
            call()


@pytest.mark.parametrize("how", ["cut", "empty", "bad end", "foreign", "no more"])
def test_a_foreign_file_and_a_damaged_one_are_named_and_set_aside(how, any_lake, rng):
    lake = any_lake
    write(lake, [make_row("frames", rng)])
    [(name, whole)] = contents(lake).items()
    foreign = pa.BufferOutputStream()
    pq.write_table(pa.table({"a": [1]}), foreign)
    bad = {
        "cut": whole[: len(whole) // 2], "empty": b"", "bad end": whole[:-8] + b"\xff" * 8,
        "foreign": foreign.getvalue().to_pybytes(), "no more": b"PAR1 no more",
    }[how]  # fmt: skip
    with lake.files.replacing(lake.file("frames", DAY)) as stream:
        stream.write(bad)
    match = "not written by Boresight" if how == "foreign" else r"part-0\.parquet.*damaged"
    with pytest.raises(ContractError, match=match) as caught:
        read_manifest(lake, FRAMES, DAY)
    assert how == "foreign" or caught.value.path == name
    lake.set_aside(name)
    assert read_manifest(lake, FRAMES, DAY) is None
    assert lake.partitions("frames") == []


def test_damage_behind_a_whole_footer_is_named_as_damage(lake, rng):
    write(lake, [make_row("frames", rng, free=200) for _ in range(4)])
    path = lake.file("frames", DAY)
    whole = path.read_bytes()
    path.write_bytes(whole[:4] + bytes(len(whole) // 2) + whole[4 + len(whole) // 2 :])
    assert read_manifest(lake, FRAMES, DAY).rows == 4
    with pytest.raises(DamagedError, match=r"part-0\.parquet.*damaged"):
        read(lake)


# -- other programs and writers ----------------------------------------------------------------------


def test_other_engines_read_the_lake_by_plain_glob_and_whoever_the_umask_lets(lake, rng):
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
    asked = frame.select("vehicle", pl.col("day").cast(pl.String), "frame_index", "lidar_x_m")
    # dtype and shape are in the field's metadata
    about = FRAMES.arrow_schema().field("lidar_x_m").metadata
    shape = [-1 if s == "N" else int(s) for s in about[b"shape"].decode().split(",")]
    for found in (by_duckdb, asked.collect().rows()):
        assert len(found) == 9
        for vehicle, day, index, blob in found:
            decoded = np.frombuffer(blob, about[b"dtype"].decode()).reshape(shape)
            np.testing.assert_array_equal(decoded, rows[vehicle, day][index].lidar_x_m)
    path = lake.file("frames", Partition("car", "2026-03-02"))
    assert json.loads(pq.read_metadata(path).metadata[b"boresight"])["work_key"] == "k1"
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def write_many(lake, name, times):
    rng = np.random.default_rng(1)
    for i in range(times):
        rows = [make_row("frames", rng, free=500, log=f"{name}{i}", frame_index=j) for j in range(6)]
        write(lake, rows, key=f"{name}{i}")


def test_two_writers_on_one_partition_end_with_one_of_them_whole(lake):
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_many, args=(lake, name, 10)) for name in "ab"]
    for process in writers:
        process.start()
    while any(p.is_alive() for p in writers):
        manifest = read_manifest(lake, FRAMES, DAY)
        if manifest is not None:
            assert manifest.rows == 6
    assert [p.exitcode for p in writers] == [0, 0]
    logs = [r.log for r in read(lake)]
    assert logs == [read_manifest(lake, FRAMES, DAY).work_key] * 6
    assert logs[0] in ("a9", "b9")
    assert [p.name for p in lake.folder("frames", DAY).iterdir()] == ["part-0.parquet"]


def test_leftovers_go_when_their_writer_is_dead_or_a_day_has_passed(lake, rng):
    folder = lake.folder("frames", DAY)
    folder.mkdir(parents=True)
    host = socket.gethostname()
    dead = next(pid for pid in range(4_000_000, 3_000_000, -1) if not psutil.pid_exists(pid))
    written_by = {
        "dead": f"{host}-{dead}", "alive": f"{host}-{os.getppid()}", "elsewhere": "other-host-1", "old": "o-1",
    }  # fmt: skip
    files = {key: folder / f".writing-{name}-aa.tmp" for key, name in written_by.items()}
    for path in files.values():
        path.write_bytes(b"half")
    os.utime(files["old"], (0, 0))
    write(lake, [make_row("frames", rng)])
    assert {key for key, path in files.items() if path.exists()} == {"alive", "elsewhere"}
