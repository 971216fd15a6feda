"""Record tables: nothing doubles, nothing is lost, what is current is written down, damage costs its own rows only."""

import os
from dataclasses import replace
from functools import partial

import duckdb
import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable, WriterProperties

from pipeline.store import delta
from pipeline.store.commits import assert_records, commit_records
from pipeline.store.current import current_records
from pipeline.store.delta import Wanted, live_files, open_table, read_file, tidy_table
from pipeline.store.partitions import Lake
from pipeline.store.records import RecordIndex, last_day, read_columns, read_latest
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.makers.lakes import write_records
from tests.makers.table_rows import make_record, read_calibrations, same


def version(lake, table="calibrations"):
    return DeltaTable(str(lake.root / table)).version()


def data_files(lake):
    return sorted(lake.root.glob("calibrations/month=*/*.parquet"))


def test_after_the_night_small_files_are_put_together_and_every_row_stays(any_lake, rng):
    lake = any_lake
    assert read_calibrations(lake) == list(tidy_table(lake, CALIBRATIONS)) == []
    assert (last_day(lake, CALIBRATIONS), commit_records(lake, CALIBRATIONS, [])) == (None, 0)
    assert not lake.exists()  # not made by reading
    days = [f"2026-03-{i:02d}" for i in range(1, 10)]
    for day in days:
        commit_records(lake, CALIBRATIONS, [make_record(rng, day, day=day)])
    before = read_calibrations(lake)
    assert commit_records(lake, CALIBRATIONS, before) == 0
    assert last_day(lake, CALIBRATIONS) == days[-1]
    assert any("9 files are 1 now" in what for what in tidy_table(lake, CALIBRATIONS))
    assert all(same(a, b) for a, b in zip(before, read_calibrations(lake), strict=True))
    assert list(tidy_table(lake, CALIBRATIONS)) == []


def test_the_same_work_never_doubles_and_changes_no_byte(lake, rng):
    rows = [make_record(rng, "k1", pair=pair) for pair in PAIRS]
    assert commit_records(lake, CALIBRATIONS, rows + rows) == 3
    before = version(lake)
    assert commit_records(lake, CALIBRATIONS, rows) == 0
    assert assert_records(lake, CALIBRATIONS, rows) == 0
    assert version(lake) == before
    assert len(read_calibrations(lake)) == 3


def test_records_say_when_they_were_written_and_file_times_say_nothing(lake, rng):
    for seed, key in ((3, "c"), (1, "a"), (2, "b")):
        write_records(lake, CALIBRATIONS, [make_record(rng, "", seed=seed)], key)
    for age, path in enumerate(data_files(lake)):
        os.utime(path, ns=(0, 10**18 + age * 10**9))
    found = read_calibrations(lake)
    assert [r.seed for r in found] == [3, 1, 2]
    stamps = [r.recorded_at for r in found]
    assert stamps == sorted(set(stamps)) == [r.asserted_at for r in found]
    assert all(s.endswith("Z") and len(s) == 27 for s in stamps)


def test_configuration_a_then_b_then_a_again_leaves_a_current(lake, rng):
    a, b = make_record(rng, "A"), make_record(rng, "B")
    for row in (a, b):
        commit_records(lake, CALIBRATIONS, [row])
    assert [r.work_key for r in current_records(read_calibrations(lake))] == ["B"]
    recorded = read_calibrations(lake)[0]
    never = [make_record(rng, "C"), make_record(rng, "A", vehicle="bus")]  # nothing to assert
    assert assert_records(lake, CALIBRATIONS, [a, *never]) == 1
    assert [r.work_key for r in current_records(read_calibrations(lake))] == ["A"]
    again = read_calibrations(lake)[-1]
    assert len(read_calibrations(lake)) == 2
    assert (again.recorded_at, again.work_key) == (recorded.recorded_at, "A")
    assert again.asserted_at > recorded.asserted_at
    assert commit_records(lake, CALIBRATIONS, [b]) == 1  # to write it again is to assert it
    assert [r.work_key for r in current_records(read_calibrations(lake))] == ["B"]


def test_a_clock_that_was_in_the_future_does_not_keep_its_record_current(lake, rng):
    future = "2099-01-01T00:00:00.000000Z"
    commit_records(lake, CALIBRATIONS, [make_record(rng, "A", recorded_at=future, asserted_at=future)])
    commit_records(lake, CALIBRATIONS, [make_record(rng, "B")])
    assert [r.work_key for r in current_records(read_calibrations(lake))] == ["B"]


def test_an_edge_of_its_own_has_a_current_record_of_its_own(lake, rng):
    rear = make_record(rng, "A", parent_frame="rear", child_frame="top")
    commit_records(lake, CALIBRATIONS, [make_record(rng, "A"), rear])
    assert [r.parent_frame for r in current_records(read_calibrations(lake))] == ["camera", "rear"]


def test_a_reader_gets_the_window_the_vehicle_and_the_columns_that_it_asks_for(lake, rng, monkeypatch):
    rows = [
        make_record(rng, v + d, v, d) for v in ("a", "b") for d in ("2026-01-30", "2026-02-01", "2026-02-03")
    ]
    for row in rows:
        commit_records(lake, CALIBRATIONS, [row])
    opened = []
    real = delta.opened_parquet
    monkeypatch.setattr(delta, "opened_parquet", lambda *a: (opened.append(a), real(*a))[1])
    got = read_calibrations(lake, vehicle="a", first="2026-02-01", columns=("qw",))
    assert [(r.vehicle, r.day) for r in got] == [("a", "2026-02-01"), ("a", "2026-02-03")]
    assert len(opened) == 2  # files of other days and vehicles are not opened
    assert [r.qw for r in got] == [r.qw for r in rows[1:3]]
    assert got[0].covariance is None
    assert got[0].diagnostics == {}
    assert [r.day for r in read_calibrations(lake, day="2026-02-01")] == ["2026-02-01"] * 2
    assert len(read_calibrations(lake, last="2026-01-31")) == 2
    assert read_calibrations(lake, vehicle="c") == []
    assert last_day(lake, CALIBRATIONS) == "2026-02-03"


def test_of_a_month_in_one_file_only_the_row_groups_of_the_days_asked_for_are_read(lake, rng, monkeypatch):
    monkeypatch.setattr(delta, "_WRITER", WriterProperties(max_row_group_size=2))
    days = [f"2026-01-{d:02d}" for d in range(1, 11)]
    for day in days:
        commit_records(lake, CALIBRATIONS, [make_record(rng, v + day, v, day) for v in ("a", "b")])
    assert any("are 1 now" in told for told in tidy_table(lake, CALIBRATIONS))
    [file] = live_files(open_table(lake, CALIBRATIONS))
    columns = ["vehicle", "day"]
    assert read_file(lake, CALIBRATIONS, file.name, columns).num_rows == 20
    for wanted, expected in ((Wanted(None, days[3], days[4]), days[3:5]), (Wanted(None, days[9]), days[9:])):
        found = read_file(lake, CALIBRATIONS, file.name, columns, wanted)
        assert set(found["day"].to_pylist()) == set(expected)
    mapped = read_file(lake, CALIBRATIONS, file.name, ["day", "diagnostics.x"])
    assert (mapped.num_rows, lake.damage) == (20, [])
    assert read_file(lake, CALIBRATIONS, file.name, columns, Wanted(frozenset({"c"}))).num_rows == 0
    assert [r.day for r in read_calibrations(lake, vehicle={"a", "c"}, last=days[1])] == days[:2]


def test_one_value_of_a_column_of_maps_is_read_as_a_column(lake, rng):
    told = [{}, {"x": 1.5, "y": 2.0}, {"y": 3.0}, {}, {"x": 4.0}]
    days = [f"2026-01-{k + 1:02d}" for k in range(5)]
    rows = [make_record(rng, day, "a", day, diagnostics=d) for day, d in zip(days, told, strict=True)]
    commit_records(lake, CALIBRATIONS, rows[:2])
    commit_records(lake, CALIBRATIONS, rows[2:])
    asked = ["diagnostics.x", "diagnostics.none", "status"]
    found = read_columns(lake, CALIBRATIONS, asked, first=None, last=None).sort_by("day")
    assert found["diagnostics.x"].to_pylist() == [d.get("x") for d in told]
    assert found["diagnostics.none"].to_pylist() == [None] * 5
    asked = ["diagnostics", "diagnostics.y"]
    both = read_columns(lake, CALIBRATIONS, asked, first=None, last=None).sort_by("day")
    assert both["diagnostics.y"].to_pylist() == [d.get("y") for d in told]
    assert [dict(m) for m in both["diagnostics"].to_pylist()] == told


def test_an_index_gives_each_vehicle_day_what_reading_it_gives(lake, rng):
    for key in ("A", "B"):
        for vehicle in ("a", "b"):
            days = ("2026-01-30", "2026-02-01", "2026-02-03")
            commit_records(
                lake, CALIBRATIONS, [make_record(rng, key, vehicle, d, p) for d in days for p in PAIRS]
            )
    index = RecordIndex(lake, CALIBRATIONS, CalibrationRecord, "2026-01-31", "2026-02-28")
    for vehicle, day in (("a", "2026-02-01"), ("b", "2026-02-03")):
        expected = read_calibrations(lake, vehicle=vehicle, day=day)
        assert len(expected) == 6
        assert all(same(x, y) for x, y in zip(index.of(vehicle, day), expected, strict=True))
    assert index.of("a", "2026-01-30") == []
    assert index.of("c", "2026-02-01") == []
    assert RecordIndex(lake, CALIBRATIONS, CalibrationRecord, "9999-12-31", "0001-01-01").of("a", "b") == []


def test_the_last_day_of_each_vehicle_and_method_is_read_and_no_other(lake, rng):
    days = {
        ("a", "joint"): ("2026-01-30", "2026-02-01"),
        ("b", "joint"): ("2026-01-05",),
        ("a", "tracking"): ("2026-01-30",),
    }
    for (vehicle, method), of in days.items():
        rows = [replace(make_record(rng, "k", vehicle, d, p), method=method) for d in of for p in PAIRS]
        commit_records(lake, CALIBRATIONS, rows)
    latest = partial(
        read_latest, lake, CALIBRATIONS, CalibrationRecord, last="2026-03-31", columns=("status",)
    )
    found = latest(first="2026-01-01")
    assert {(r.vehicle, r.method, r.day) for r in found} == {(*key, of[-1]) for key, of in days.items()}
    assert len(found) == 9
    for first, vehicles in (("2026-01-06", {"a"}), ("2026-03-01", set())):
        assert {r.vehicle for r in latest(first=first)} == vehicles


# -- damage ------------------------------------------------------------------------------------------


def damage(path, how):
    whole = path.read_bytes()
    damaged = {
        "cut": whole[: len(whole) // 2],
        "empty": b"",
        "bits": whole[:4] + bytes(len(whole) - 500) + whole[-496:],
    }
    path.unlink() if how == "gone" else path.write_bytes(damaged[how])


@pytest.mark.parametrize("how", ["cut", "empty", "gone", "bits"])
def test_a_damaged_file_is_named_and_left_out_and_healed_when_its_work_is_done_again(how, lake, rng):
    bad, good = make_record(rng, "A"), make_record(rng, "B", vehicle="bus")
    for row in (bad, good):
        commit_records(lake, CALIBRATIONS, [row])
    of = lambda p: pq.read_table(p, columns=["vehicle"], partitioning=None)["vehicle"].to_pylist()  # noqa: E731
    [path] = [p for p in data_files(lake) if of(p) == ["car"]]
    damage(path, how)
    assert [r.vehicle for r in read_calibrations(lake)] == ["bus"]
    assert path.name in lake.damage[0]
    commit_records(lake, CALIBRATIONS, [bad])
    whole = Lake.at(lake.root)
    assert sorted(r.vehicle for r in read_calibrations(whole)) == ["bus", "car"]
    list(tidy_table(whole, CALIBRATIONS))
    fresh = Lake.at(lake.root)
    assert sorted(r.vehicle for r in read_calibrations(fresh)) == ["bus", "car"]
    assert fresh.damage == []
    assert how == "gone" or list(lake.root.glob("calibrations/_damaged/*"))


# -- other engines -----------------------------------------------------------------------------------


def test_duckdb_and_polars_read_records_by_the_documented_lines(any_lake, rng):
    row = make_record(rng, "A", status="held")
    commit_records(any_lake, CALIBRATIONS, [row])
    where = any_lake.table("calibrations")
    records = DeltaTable(where).to_pyarrow_table()  # noqa: F841 - DuckDB finds it by its name
    sql = "select vehicle, status, diagnostics['x'] from records where day >= '2026-03-01'"
    assert duckdb.sql(sql).fetchall() == [("car", "held", row.diagnostics["x"])]
    frame = pl.scan_delta(where).filter(pl.col("vehicle") == "car").select("status", "covariance").collect()
    assert frame["status"].to_list() == ["held"]
    about = CALIBRATIONS.arrow_schema().field("covariance").metadata
    shape = [int(s) for s in about[b"shape"].split(b",")]
    found = np.frombuffer(frame["covariance"][0], about[b"dtype"].decode()).reshape(shape)
    np.testing.assert_array_equal(found, row.covariance)
