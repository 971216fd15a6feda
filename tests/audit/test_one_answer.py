"""What the last audit said is what the tables hold, the commands print and the pages show."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jobs.service import service
from jobs.show import show
from jobs.terminal.vehicle_status import count_statuses
from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DriftFinding
from schemas.poses import POSES
from tests.makers.fleet_pages import write_fleet_page

KNOCK = {"radar": np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])}
SEMANTICS = {"source": "topics", "labels": "/l", "detections": "/d"}
RIG = {
    "camera": {"image": "/i", "info": "/c", "semantics": SEMANTICS},
    "lidar": {"points": "/p"},
    "radar": {"points": "/r"},
}


def fleet(*vehicles: str) -> FleetConfig:
    return FleetConfig.model_validate(
        {"fleet": {"name": "test"}, "rigs": {"default": RIG}, "vehicles": {v: {} for v in vehicles}}
    )


@pytest.fixture
def lake(tmp_path: Path, maker: ModuleType) -> Lake:
    """Twenty days of two vehicles; the radar of "v" is knocked on the eleventh."""
    lake, rng = Lake.at(tmp_path / "lake"), np.random.default_rng(22)
    knocked = maker.vehicle_records("v", 20, rng, motion=lambda d: KNOCK if d > 9 else {})
    commit_records(lake, CALIBRATIONS, knocked + maker.vehicle_records("w", 20, rng))
    return lake


def audit_of(lake: Lake, config: FleetConfig, first: str | None = None, last: str | None = None):
    task = Task(config, lake, Window(first, last))
    findings = list(AUDIT.run(task).records)
    STATE.run(task)
    return findings


def said_everywhere(
    lake: Lake, config: FleetConfig, findings: list[DriftFinding], capsys: pytest.CaptureFixture[str]
) -> dict[str, str]:
    """Status of each vehicle, once the audit's rows, the summary, the table and the page agree."""
    of_rows = {f.vehicle: f.vehicle_status for f in findings}
    capsys.readouterr()
    assert show("drift", lake=str(lake.root), current=True, json=True) == 0
    rows = json.loads(capsys.readouterr().out)
    in_table = {(r["vehicle"], r["pair"], r["dof"]): (r["status"], r["reason"], r["day"]) for r in rows}
    assert len(in_table) == len(rows)
    assert in_table == {(f.vehicle, f.pair, f.dof): (f.status, f.reason, f.day) for f in findings}
    assert {r["vehicle"]: r["vehicle_status"] for r in rows} == of_rows
    page = write_fleet_page(lake, config, lake.root / "fleet.html")
    on_page = dict(re.findall(r'<tr><td><a href="#charts-\w+">(\w+)</a></td><td class="status (\w+)">', page))
    assert on_page == of_rows
    assert {s: list(of_rows.values()).count(s) for s in count_statuses(findings)} == count_statuses(findings)
    return {vehicle: status or "" for vehicle, status in of_rows.items()}


def test_a_repaired_car_is_no_longer_red_anywhere_in_the_night_after_its_service(
    lake: Lake, capsys: pytest.CaptureFixture[str]
) -> None:
    config = fleet("v", "w")
    assert said_everywhere(lake, config, audit_of(lake, config), capsys) == {"v": "RED", "w": "GREEN"}
    assert service(lake=str(lake.root), vehicle="v", day="2026-03-15", kind="repair", sensor="radar") == 0
    assert said_everywhere(lake, config, audit_of(lake, config), capsys) == {"v": "GREEN", "w": "GREEN"}
    # The same audit again changes nothing, and an older answer does not come back.
    assert said_everywhere(lake, config, audit_of(lake, config), capsys)["v"] == "GREEN"


def test_another_window_and_other_vehicles_records_change_what_is_stored(
    lake: Lake, maker: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    others = [f"o{k}" for k in range(7)]
    config = fleet("v", "w", *others)
    red = audit_of(lake, config)
    assert said_everywhere(lake, config, red, capsys)["v"] == "RED"
    assert said_everywhere(lake, config, audit_of(lake, config, None, "2026-03-08"), capsys)["v"] == "GREEN"
    assert audit_of(lake, config, "2026-03-01", "2026-03-08") != red
    assert said_everywhere(lake, config, audit_of(lake, config), capsys)["v"] == "RED"
    # The same turn on the same day of most vehicles is no knock of one of them.
    rng = np.random.default_rng(5)
    alike = [maker.vehicle_records(v, 20, rng, motion=lambda d: KNOCK if d > 9 else {}) for v in others]
    commit_records(lake, CALIBRATIONS, [r for records in alike for r in records])
    assert said_everywhere(lake, config, audit_of(lake, config), capsys)["v"] == "GREEN"


def test_a_vehicle_whose_days_scatter_more_than_they_say_has_a_state_as_unsure_as_it_scatters(
    tmp_path: Path, maker: ModuleType
) -> None:
    sigma = {}
    common = np.diag([1e-5] * 3 + [1e-3] * 3) ** 2
    for noise in (1.0, 3.0):
        lake = Lake.at(tmp_path / str(noise))
        records = maker.vehicle_records("v", 40, np.random.default_rng(8), noise=noise)
        records = [replace(r, common_covariance=common) for r in records]
        commit_records(lake, CALIBRATIONS, records)
        commit_records(lake, POSES, maker.poses_of(records))
        AUDIT.run(Task(fleet("v"), lake, Window()))
        rows = STATE.run(Task(fleet("v"), lake, Window())).records
        sigma[noise] = {row.pair: np.degrees(row.azimuth_sigma_rad) for row in rows if row.sensor is None}
    # Tomorrow lies as far off as the days scatter: by three times what they state, of which the mean of 40 is free.
    for pair, stated in sigma[1.0].items():
        assert 1.8 < sigma[3.0][pair] / stated < 4.0, pair


def test_a_service_event_is_withdrawn_and_an_impossible_one_is_refused(
    lake: Lake, capsys: pytest.CaptureFixture[str]
) -> None:
    config, where = fleet("v", "w"), str(lake.root)
    event = {"lake": where, "vehicle": "v", "day": "2026-03-15", "kind": "repair", "sensor": "radar"}
    for wrong, words in (
        ({"vehicle": "vehicle-22"}, "the lake has no day of 'vehicle-22'; it has v, w"),
        ({"day": "2036-03-04"}, "2036-03-04 has not come yet"),
        ({"withdraw": True}, "no such event of v is noted; noted are: none"),
    ):
        with pytest.raises(ConfigError, match=re.escape(words)):
            service(**event | wrong)
    for noted, status in (({}, "GREEN"), ({"withdraw": True}, "RED"), ({}, "GREEN")):
        assert service(**event | noted) == 0
        assert said_everywhere(lake, config, audit_of(lake, config), capsys)["v"] == status
    assert show("service_events", lake=where, current=True, json=True) == 0
    assert [row["withdrawn"] for row in json.loads(capsys.readouterr().out)] == [False]
