"""A lake that kept records as files becomes one with record tables, once, whatever happens on the way."""

import json
import os

import numpy as np
import pyarrow.parquet as pq
import pytest

import pipeline.store.migration
from jobs.migrate import migrate
from pipeline.errors import ConfigError, ContractError
from pipeline.store.commits import commit_records
from pipeline.store.current import current_records
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.store.rows import to_table
from schemas.calibrations import CALIBRATIONS, PAIRS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from tests.makers.table_rows import make_row, same

NEW = {"recorded_at", "asserted_at"}


def write_old(lake, schema, rows, key, second):
    """A record file as releases 0.3 to 0.5 wrote it: named after its work key, current by its time."""
    folder = lake.folder(schema.name, Partition(rows[0].vehicle, rows[0].day))
    folder.mkdir(parents=True, exist_ok=True)
    table = to_table(rows, schema).drop_columns(sorted(NEW & {c.name for c in schema.columns}))
    manifest = {
        "table": schema.name,
        "version": 1,
        "work_key": key,
        "code_version": "0.5.0",
        "rows": len(rows),
    }
    path = folder / f"{key}.parquet"
    with pq.ParquetWriter(path, table.schema) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata({"boresight": json.dumps(manifest)})
    os.utime(path, ns=(0, (1_700_000_000 + second) * 10**9))
    return path


@pytest.fixture
def old(tmp_path):
    """Three vehicle-days, one calibrated by A, then B, then A again (its file written anew); and one audit."""
    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(0)
    common = {"method": "joint", "recorded_at": "", "asserted_at": ""}
    for vehicle, day, key, second in (
        ("car", "2026-03-02", "B", 20),
        ("car", "2026-03-02", "A", 30),
        ("car", "2026-04-01", "A2", 10),
        ("bus 7", "2026-03-02", "A3", 10),
    ):
        rows = [
            make_row("calibrations", rng, vehicle=vehicle, day=day, work_key=key, pair=pair, **common)
            for pair in PAIRS
        ]
        write_old(lake, CALIBRATIONS, rows, key, second)
    finding = make_row("drift", rng, vehicle="car", day="2026-04-01", work_key="D", **common)
    write_old(lake, DRIFT, [finding], "D", 40)
    return lake


def records(lake):
    return read_records(lake, CALIBRATIONS, CalibrationRecord)


def test_a_lake_of_an_older_release_names_the_command_in_place_of_reading_nothing(old):
    for call in (
        lambda: records(old),
        lambda: commit_records(old, DRIFT, [make_row("drift", np.random.default_rng())]),
    ):
        with pytest.raises(ContractError, match=r"boresight migrate --lake .*lake"):
            call()


def test_one_command_moves_every_record_and_keeps_what_was_current(old, capsys):
    assert migrate(lake=str(old)) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["status"], summary["files"]) == ("done", 5)
    assert summary["rows"] == {"calibrations": 12, "drift": 1}
    assert len(records(old)) == 12
    current = {(r.vehicle, r.day): r for r in current_records(records(old))}
    assert {key: r.work_key for key, r in current.items()} == {
        ("bus 7", "2026-03-02"): "A3", ("car", "2026-03-02"): "A", ("car", "2026-04-01"): "A2",
    }  # fmt: skip
    assert current["car", "2026-04-01"].recorded_at == "2023-11-14T22:13:30.000000Z"
    assert len(read_records(old, DRIFT, DriftFinding)) == 1
    assert not list(old.root.glob("*/vehicle=*"))
    assert migrate(lake=str(old)) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "cached"


@pytest.mark.parametrize("at", [1, 2, 3, 4, 5, 6, 7, 8])
def test_a_migration_that_is_stopped_anywhere_loses_nothing_and_goes_on(at, old, monkeypatch):
    expected = sorted((r.vehicle, r.day, r.pair, r.work_key) for r in all_old(old))
    monkeypatch.setattr(pipeline.store.migration, "_FILES_A_COMMIT", 1)
    steps = iter(range(100))

    def stopping(function):
        def step(*arguments, **named):
            if next(steps) == at:
                raise KeyboardInterrupt
            return function(*arguments, **named)

        return step

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pipeline.store.migration, "commit_records", stopping(commit_records))
        patch.setattr("pathlib.Path.unlink", stopping(type(old.root).unlink))
        migrate(lake=str(old))
    with pytest.raises(ContractError, match="migrate"):
        records(old)
        read_records(old, DRIFT, DriftFinding)
    migrate(lake=str(old))
    assert sorted((r.vehicle, r.day, r.pair, r.work_key) for r in records(old)) == expected
    assert len(read_records(old, DRIFT, DriftFinding)) == 1


def all_old(lake):
    from pipeline.store.rows import from_table

    for path in lake.root.glob("calibrations/vehicle=*/*/*.parquet"):
        yield from from_table(pq.ParquetFile(path).read(), CALIBRATIONS, CalibrationRecord)


def test_rows_come_through_as_they_were(old):
    before = {(r.work_key, r.pair): r for r in all_old(old)}
    migrate(lake=str(old))
    for row in records(old):
        was = before[row.work_key, row.pair]
        for name in NEW:
            object.__setattr__(was, name, getattr(row, name))
        assert same(was, row)


def test_a_damaged_file_is_set_aside_and_named(old, capsys):
    path = next(old.root.glob("calibrations/vehicle=bus*/*/A3.parquet"))
    path.write_bytes(path.read_bytes()[:100])
    assert migrate(lake=str(old)) == 0
    [named] = json.loads(capsys.readouterr().out)["damaged"]
    assert "A3.parquet" in named
    assert len(records(old)) == 9
    assert len(list(old.root.glob("calibrations/_damaged/*A3.parquet"))) == 1


def test_a_folder_that_is_not_there_and_a_file_of_another_version_are_named(old, tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        migrate(lake=str(tmp_path / "lkae"))
    path = next(old.root.glob("calibrations/vehicle=bus*/*/A3.parquet"))
    table = pq.ParquetFile(path).read().replace_schema_metadata(None)
    pq.write_table(table, path)
    with pytest.raises(
        ContractError, match=r"holds None/None, a migration reads calibrations/1 and calibrations/2"
    ):
        migrate(lake=str(old))
