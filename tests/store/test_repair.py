"""A damaged log costs no row that a data file holds: readers go on without it, and a repair makes another."""

import json
import os
import shutil

import numpy as np
import pytest

from jobs.upkeep import repair
from pipeline.core.errors import DamagedLogError
from pipeline.store.commits import assert_records, commit_records
from pipeline.store.delta import live_files, open_table, tidy_table
from pipeline.store.partitions import Lake
from pipeline.store.repair import repair_table
from schemas.calibrations import CALIBRATIONS
from tests.makers.table_rows import make_record, read_calibrations, same

DAYS = [f"2026-03-{d:02d}" for d in range(1, 6)]


def fill(lake):
    """Five commits and an assertion, which replaced the first file."""
    rng = np.random.default_rng(0)
    for i, day in enumerate(DAYS):
        commit_records(lake, CALIBRATIONS, [make_record(rng, f"key-{i}", day=day)])
    commit_records(lake, CALIBRATIONS, [make_record(rng, "other", day=DAYS[0])])
    assert_records(lake, CALIBRATIONS, [r for r in read_calibrations(lake) if r.work_key == "key-0"])
    return lake


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    return fill(Lake.at(tmp_path_factory.mktemp("filled") / "lake"))


@pytest.fixture(params=["folder", pytest.param("bucket", marks=pytest.mark.slow)])
def written(request, filled, lake):
    """A lake of its own of five commits and an assertion."""
    if request.param == "bucket":
        return fill(request.getfixturevalue("bucket_lake"))
    shutil.copytree(filled.root, lake.root)
    return lake


def entry(lake, number):
    return lake.root / "calibrations/_delta_log" / f"{number:020d}.json"


def spoil(lake, path, how):
    if how == "gone":
        lake.files.delete(path)
        return
    with lake.files.opened(path) as stream:
        whole = stream.read()
    with lake.files.replacing(path) as stream:
        stream.write({"zero": b"", "cut": whole[:-200], "garbled": os.urandom(500)}[how])


@pytest.mark.parametrize(("how", "number"), [("zero", 2), ("cut", 7), ("garbled", 2), ("gone", 3)])
def test_a_damaged_entry_is_named_passed_over_by_readers_and_repaired_without_loss(how, number, written):
    lake, whole = written, read_calibrations(written)
    spoil(lake, entry(lake, number), how)
    with pytest.raises(DamagedLogError, match=r"calibrations: its log is damaged .*boresight repair --lake"):
        open_table(lake, CALIBRATIONS)
    found = Lake.at(str(lake))
    assert all(same(a, b) for a, b in zip(read_calibrations(found), whole, strict=True))
    assert "its log is damaged" in found.damage[0]
    with pytest.raises(DamagedLogError):
        commit_records(lake, CALIBRATIONS, [make_record(np.random.default_rng(1), "new")])
    done = repair_table(lake, CALIBRATIONS)
    assert done.found
    assert done.lost == []
    healed = Lake.at(str(lake))
    assert all(same(a, b) for a, b in zip(read_calibrations(healed), whole, strict=True))
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
def test_lost_files_are_named_by_their_vehicles_and_days(how, log, written):
    lake = written
    path = data_file(lake, DAYS[3])
    spoil(lake, path, how)
    if log == "damaged":
        spoil(lake, entry(lake, 7), "garbled")
    reader = Lake.at(str(lake))
    assert {r.day for r in read_calibrations(reader)} == {*DAYS} - {DAYS[3]}
    assert [lost.may_be_of("car") for lost in reader.lost] == [True] * (log == "whole" or how == "cut")
    done = repair_table(lake, CALIBRATIONS)
    [lost] = done.lost
    assert path.name in lost
    assert f"vehicles car to car, days {DAYS[3]} to {DAYS[3]}" in lost
    healed = Lake.at(str(lake))
    assert {r.day for r in read_calibrations(healed)} == {*DAYS} - {DAYS[3]}
    assert healed.damage == healed.lost == []


def test_rows_of_a_commit_that_the_log_lost_without_a_trace_come_back(written):
    lake, whole = written, read_calibrations(written)
    lake.files.delete(entry(lake, 7))  # the assertion, and with it the file that took over its rows
    assert [r.asserted_at for r in read_calibrations(lake)] != [r.asserted_at for r in whole]
    assert repair_table(lake, CALIBRATIONS).files == 1
    assert all(same(a, b) for a, b in zip(read_calibrations(lake), whole, strict=True))


def test_what_a_lost_file_had_replaced_gives_its_rows_back(written):
    lake, whole = written, {r.work_key for r in read_calibrations(written)}
    lake.files.delete(data_file(lake, DAYS[0]))  # the assertion's, of an older row
    assert {r.work_key for r in read_calibrations(lake)} == whole - {"key-0"}
    assert len(repair_table(lake, CALIBRATIONS).lost) == 1
    assert {r.work_key for r in read_calibrations(lake)} == whole


def test_the_command_names_what_it_found_and_what_is_lost(lake, filled, capsys):
    shutil.copytree(filled.root, lake.root)
    assert repair(lake=str(lake)) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "cached"
    path = data_file(lake, DAYS[1])
    path.unlink()
    entry(lake, 5).write_bytes(b"")
    assert repair(lake=str(lake)) == 3
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "done"
    assert "5.json of no bytes" in told["found"]["calibrations"]
    assert path.name in told["lost"]["calibrations"][0]
    assert repair(lake=str(lake)) == 0
