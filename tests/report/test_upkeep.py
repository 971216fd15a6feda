"""Pages of vehicle-days are kept up to date: each that is needed, none without need, wherever they are drawn."""

from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pytest

from pipeline.fleet.executor import OnWorkers
from pipeline.report import upkeep
from pipeline.report.stage import Pages, write_fleet_report
from pipeline.report.upkeep import one_by_one
from pipeline.store.commits import commit_records
from pipeline.store.files import LocalFiles
from pipeline.store.object_store import Bucket
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS
from tests.audit.fleet_records import vehicle_records
from tests.makers.s3_server import BUCKET
from tests.makers.stages import audit_fleet
from tests.report.test_pages import KNOCK, _config


@pytest.fixture
def drawn(monkeypatch):
    """Vehicle-days whose page was drawn since it was last emptied."""
    found, draw = [], upkeep._draw

    def watched(job, progress):
        found.append((job.partition.vehicle, job.partition.day))
        return draw(job, progress)

    monkeypatch.setattr(upkeep, "_draw", watched)
    return found


def report(lake, out, **given):
    audit_fleet(lake, _config())
    return write_fleet_report(lake, _config(), Pages(out, **given))


def days_of(vehicle, days, seed=5, **how):
    return vehicle_records(vehicle, days, np.random.default_rng(seed), **how)


def test_a_night_draws_its_own_days_and_those_that_a_moved_sensor_outdates(tmp_path, drawn):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "fleet.html"
    turns = lambda d: {"radar": KNOCK} if d > 6 else {}  # noqa: E731
    records = days_of("a", 12, motion=turns) + days_of("b", 12, seed=6)
    nights = sorted({r.day for r in records})
    commit_records(lake, CALIBRATIONS, [r for r in records if r.day < nights[4]])
    report(lake, out)
    for night in nights[4:7]:
        drawn.clear()
        commit_records(lake, CALIBRATIONS, [r for r in records if r.day == night])
        report(lake, out)
        # Whatever the audits say of charts (UNKNOWN, then GREEN, in other words every night), pages of days stay.
        assert sorted(drawn) == [("a", night), ("b", night)]
    for night in nights[7:]:
        drawn.clear()
        commit_records(lake, CALIBRATIONS, [r for r in records if r.day == night])
        report(lake, out)
        assert set(drawn) >= {("a", night), ("b", night)}
        if len(drawn) > 2:
            break
    assert {day for vehicle, day in drawn if vehicle == "a"} == set(nights[: nights.index(night) + 1])
    assert {day for vehicle, day in drawn if vehicle == "b"} == {night}
    assert "Not any more" in (tmp_path / "fleet_days" / nights[0] / "a.html").read_text()
    drawn.clear()
    report(lake, out)
    assert drawn == []


def test_a_vehicle_that_drives_rarely_has_a_page_for_every_day_of_its_charts(tmp_path, drawn):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "fleet.html"
    often = [r for r in days_of("daily", 100) if r.day > "2026-05-10"]
    weekly = [r for k, r in enumerate(days_of("weekly", 100, seed=6)) if k // 3 % 7 == 0]
    commit_records(lake, CALIBRATIONS, often + weekly)
    report(lake, out)
    assert {day for v, day in drawn if v == "weekly"} == {r.day for r in weekly}
    text = out.read_text()
    assert f'"{weekly[0].day}", "D"' in text  # linked from the vehicle's charts
    assert 'class="status GREEN"' in text.split(">weekly</a>")[1][:200]


def test_a_day_of_long_ago_has_a_page_when_a_night_ran_it(tmp_path, drawn):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "fleet.html"
    records = days_of("v", 60)
    commit_records(lake, CALIBRATIONS, records)
    report(lake, out)
    first = records[0].day
    assert ("v", first) not in drawn
    drawn.clear()
    gone = Partition("left", first)  # without a record: no page, and no trouble
    pages = report(lake, out, also=[Partition("v", first), gone])
    assert drawn == [("v", first)]
    assert tmp_path / "fleet_days" / first / "v.html" in pages


@pytest.mark.slow
def test_workers_draw_what_this_process_draws(tmp_path):
    lake = Lake.at(tmp_path / "lake")
    commit_records(lake, CALIBRATIONS, days_of("a", 2) + days_of("b", 2))
    here = report(lake, tmp_path / "here" / "fleet.html")
    told = []
    pages = Pages(tmp_path / "there" / "fleet.html", fan_out=OnWorkers("process", 2))
    there = write_fleet_report(
        lake, _config(), pages, progress=lambda done, total, _: told.append((done, total))
    )
    assert len(here) == len(there) == 5
    assert told[-1] == (4, 4)
    for a, b in zip(here, there, strict=True):
        assert a.read_bytes() == b.read_bytes(), a


def test_a_page_that_cannot_be_drawn_is_named_and_drawn_the_next_time(tmp_path, monkeypatch):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "fleet.html"
    commit_records(lake, CALIBRATIONS, days_of("a", 3) + days_of("b", 3))
    write, bad = upkeep.write_day_page, tmp_path / "fleet_days" / "2026-03-02" / "a.html"

    def fails(lake, partition, fleet, path, *args, **how):
        if path == bad:
            raise OSError(28, "No space left on device")
        return write(lake, partition, fleet, path, *args, **how)

    monkeypatch.setattr(upkeep, "write_day_page", fails)
    pages = report(lake, out, fan_out=OnWorkers("inline", 1))
    assert len(pages) == 1 + 5
    assert any("page of a 2026-03-02" in line and "No space" in line for line in lake.damage)
    assert f"fleet_days/{bad.parent.name}/a.html" not in out.read_text()
    monkeypatch.setattr(upkeep, "write_day_page", write)
    assert len(report(lake, out, fan_out=one_by_one)) == 1 + 6


@pytest.mark.slow
def test_a_lake_in_a_bucket_is_sent_no_page_that_it_has(s3, drawn):
    lake = Lake.at(f"s3://{BUCKET}/lake")
    out = PurePosixPath("lake/report/fleet.html")
    files = Bucket(BUCKET)
    commit_records(lake, CALIBRATIONS, days_of("a", 4) + days_of("b", 4))
    assert len(report(lake, out, files=files)) == 1 + 8
    assert len(drawn) == 8
    drawn.clear()
    before = s3.faults(fail=4, every=3)["failed"]
    pages = report(lake, out, files=files)
    assert (len(pages), drawn) == (1 + 8, [])
    assert s3.faults()["failed"] - before == 4
    assert {str(p) for p in files.find(out.parent, "**/*")} >= {str(p) for p in pages}
    files.delete(pages[3])
    report(lake, out, files=files)
    assert len(drawn) == 1


def test_pages_in_a_folder_leave_nothing_half_written(tmp_path):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "report" / "fleet.html"
    commit_records(lake, CALIBRATIONS, days_of("a", 3))
    pages = report(lake, out, files=LocalFiles())
    names = {p.relative_to(out.parent) for p in out.parent.rglob("*") if p.is_file()}
    assert {p.relative_to(out.parent) for p in pages} == {n for n in names if n.name != "drawn.json"}
    assert len(names) == 4 + 3


def test_records_of_days_to_come_hide_nobody_s_days(tmp_path):
    lake, out = Lake.at(tmp_path / "lake"), tmp_path / "fleet.html"
    records = days_of("v", 3)
    stray = [replace(r, vehicle="other", day="2099-01-01", work_key="stray") for r in records[:3]]
    commit_records(lake, CALIBRATIONS, records + stray)
    report(lake, out)
    text = out.read_text()
    assert "2026-03-03" in text
    assert "2099" not in text
