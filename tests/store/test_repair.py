"""A damaged log costs no row that a data file holds: readers go on without it, and a repair makes another."""

import json
import os

import numpy as np
import pytest

import pipeline.store.object_store
from pipeline.core.errors import DamagedLogError
from pipeline.store.commits import assert_records, commit_records
from pipeline.store.delta import live_files, open_table, tidy_table
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from pipeline.store.repair import repair_table
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from tests.makers.s3_server import BUCKET, running
from tests.makers.table_rows import make_row, same

DAYS = [f"2026-03-{d:02d}" for d in range(1, 6)]


@pytest.fixture(scope="module")
def server():
    with running() as s3:
        yield s3


@pytest.fixture(params=["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def lake(request, tmp_path, monkeypatch):
    """Five commits and an assertion, which replaced the first file."""
    if request.param == "bucket":
        for name, value in request.getfixturevalue("server").environment.items():
            monkeypatch.setenv(name, value)
        pipeline.store.object_store._client.cache_clear()
    place = (
        tmp_path / "lake" if request.param == "folder" else f"s3://{BUCKET}/{abs(hash(request.node.name))}"
    )
    lake, rng = Lake.at(place), np.random.default_rng(0)
    for i, day in enumerate(DAYS):
        commit_records(lake, CALIBRATIONS, [row_of(rng, day, f"key-{i}")])
    commit_records(lake, CALIBRATIONS, [row_of(rng, DAYS[0], "other")])
    assert_records(lake, CALIBRATIONS, [r for r in read(lake) if r.work_key == "key-0"])
    yield lake
    pipeline.store.object_store._client.cache_clear()


def row_of(rng, day, key):
    values = {"recorded_at": "", "asserted_at": "", "method": "joint", "pair": PAIRS[0]}
    return make_row("calibrations", rng, vehicle="car", day=day, work_key=key, **values)


def read(lake):
    return read_records(lake, CALIBRATIONS, CalibrationRecord)


def entry(lake, number):
    return lake.root / "calibrations/_delta_log" / f"{number:020d}.json"


def spoil(lake, path, how):
    with lake.files.opened(path) as stream:
        whole = stream.read()
    with lake.files.replacing(path) as stream:
        stream.write({"zero": b"", "cut": whole[:-200], "garbled": os.urandom(500)}[how])


@pytest.mark.parametrize("number", [2, 7])
@pytest.mark.parametrize("how", ["zero", "cut", "garbled", "gone"])
def test_a_damaged_entry_is_named_passed_over_by_readers_and_repaired_without_loss(how, number, lake):
    whole = read(lake)
    if how == "gone":
        number = 3  # of the last one that is gone nothing is left to say so
        lake.files.delete(entry(lake, number))
    else:
        spoil(lake, entry(lake, number), how)
    with pytest.raises(DamagedLogError, match=r"calibrations: its log is damaged .*boresight repair --lake"):
        open_table(lake, CALIBRATIONS)
    found = Lake.at(str(lake))
    assert all(same(a, b) for a, b in zip(read(found), whole, strict=True))
    assert "its log is damaged" in found.damage[0]
    with pytest.raises(DamagedLogError):
        commit_records(lake, CALIBRATIONS, [row_of(np.random.default_rng(1), DAYS[0], "new")])
    done = repair_table(lake, CALIBRATIONS)
    assert done.found
    assert done.lost == []
    healed = Lake.at(str(lake))
    assert all(same(a, b) for a, b in zip(read(healed), whole, strict=True))
    assert healed.damage == []
    assert list(tidy_table(healed, CALIBRATIONS)) == []
    again = repair_table(healed, CALIBRATIONS)
    assert (again.found, again.files, again.lost) == ("", 0, [])


def data_file(lake, day):
    """The live file that holds the last rows of a day."""
    files = [f for f in live_files(open_table(lake, CALIBRATIONS)) if f.days[0] <= day <= f.days[1]]
    return lake.record_file("calibrations", max(files, key=lambda f: f.written_s).name)


@pytest.mark.parametrize("log", ["whole", "damaged"])
@pytest.mark.parametrize("how", ["gone", "cut"])
def test_lost_files_are_named_by_their_vehicles_and_days(how, log, lake):
    path = data_file(lake, DAYS[3])
    if how == "gone":
        lake.files.delete(path)
    else:
        spoil(lake, path, how)
    if log == "damaged":
        spoil(lake, entry(lake, 7), "garbled")
    reader = Lake.at(str(lake))
    assert {r.day for r in read(reader)} == {*DAYS} - {DAYS[3]}
    assert [lost.may_be_of("car") for lost in reader.lost] == [True] * (log == "whole" or how == "cut")
    done = repair_table(lake, CALIBRATIONS)
    [lost] = done.lost
    assert path.name in lost
    assert f"vehicles car to car, days {DAYS[3]} to {DAYS[3]}" in lost
    healed = Lake.at(str(lake))
    assert {r.day for r in read(healed)} == {*DAYS} - {DAYS[3]}
    assert healed.damage == healed.lost == []


def test_rows_of_a_commit_that_the_log_lost_without_a_trace_come_back(lake):
    whole = read(lake)
    lake.files.delete(entry(lake, 7))  # the assertion, and with it the file that took over its rows
    assert [r.asserted_at for r in read(lake)] != [r.asserted_at for r in whole]
    assert repair_table(lake, CALIBRATIONS).files == 1
    assert all(same(a, b) for a, b in zip(read(lake), whole, strict=True))


def test_what_a_lost_file_had_replaced_gives_its_rows_back(lake):
    whole = {r.work_key for r in read(lake)}
    lake.files.delete(data_file(lake, DAYS[0]))  # the assertion's, of an older row
    assert {r.work_key for r in read(lake)} == whole - {"key-0"}
    assert len(repair_table(lake, CALIBRATIONS).lost) == 1
    assert {r.work_key for r in read(lake)} == whole


def test_the_command_names_what_it_found_and_what_is_lost(tmp_path, capsys):
    from jobs.repair import repair

    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(0)
    for i, day in enumerate(DAYS):
        commit_records(lake, CALIBRATIONS, [row_of(rng, day, f"key-{i}")])
    assert repair(lake=str(lake)) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "cached"
    path = data_file(lake, DAYS[1])
    path.unlink()
    entry(lake, 5).write_bytes(b"")
    assert repair(lake=str(lake)) == 3
    said = json.loads(capsys.readouterr().out)
    assert said["status"] == "done"
    assert "5.json of no bytes" in said["found"]["calibrations"]
    assert path.name in said["lost"]["calibrations"][0]
    assert repair(lake=str(lake)) == 0
