"""A vehicle's status is the audit's: the table, the pages, the terminal and `show` all say the same."""

import html
import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.text import Text

from jobs.cli import main
from jobs.show import show
from jobs.terminal.vehicle_status import count_statuses, moved_sensors, next_steps, status_lines
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import STATE
from pipeline.report.stage import write_day_page
from pipeline.store.commits import commit_records
from pipeline.store.current import current_drift
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding, next_step, status_of
from schemas.poses import POSES
from tests.audit.fleet_records import poses_of, vehicle_records
from tests.makers.fleet_pages import write_fleet_page
from tests.makers.stages import audit_fleet
from tests.report.test_pages import KNOCK, _config, _store

# The knock of "yellow" is seen on one day only; "unknown" drove too little; "blind" never saw its radar turn.
EXPECTED = {"red": "RED", "yellow": "YELLOW", "green": "GREEN", "unknown": "UNKNOWN", "blind": "UNKNOWN"}


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """An audited fleet with all four statuses."""
    lake, rng = Lake.at(tmp_path_factory.mktemp("statuses") / "lake"), np.random.default_rng(3)
    for vehicle, days, first in (("red", 6, 3), ("yellow", 6, 5), ("green", 6, 99), ("unknown", 2, 99)):
        motion = lambda d, first=first: {"radar": KNOCK} if d >= first else {}  # noqa: E731
        _store(lake, vehicle_records(vehicle, days, rng, motion=motion))
    blind = vehicle_records("blind", 6, rng)
    _store(lake, [replace(r, observable=[True, True, False, True, True, True]) if r.pair == "lidar_radar"
                  else replace(r, observable=[True, False, False, True, True, True]) if r.pair == "camera_radar"
                  else r for r in blind])  # fmt: skip
    audit_fleet(lake, _config())
    return lake


def stored(lake):
    findings = current_drift(read_records(lake, DRIFT, DriftFinding))
    return {v: [f for f in findings if f.vehicle == v] for v in EXPECTED}


def test_terminal_page_and_show_say_of_every_vehicle_what_the_table_says(lake, tmp_path, capsys):
    page = write_fleet_page(lake, _config(), tmp_path / "fleet.html")
    line = r'<tr><td><a href="#charts-\w+">(\w+)</a></td><td class="status (\w+)">'
    in_table = dict(re.findall(line, page))
    on_charts = dict(re.findall(r'id="charts-(\w+)".*?<span class="pill (\w+)">', page))
    rows = [f for own in stored(lake).values() for f in own]
    told = [Text.from_markup(line).plain.split() for line in status_lines(rows)]
    on_terminal = {words[1]: words[0] for words in told}
    assert show("drift", lake=str(lake.root), current=True, json=True) == 0
    shown = {r["vehicle"]: r["vehicle_status"] for r in json.loads(capsys.readouterr().out)}
    on_days = {}
    for vehicle in EXPECTED:
        day = write_day_page(lake, Partition(vehicle, "2026-03-02"), _config(), tmp_path / "day.html")
        on_days[vehicle] = re.search(r'<span class="pill (\w+)">\1</span>', day.read_text())[1]
    for said in (in_table, on_charts, on_terminal, shown, on_days):
        assert said == EXPECTED


def test_the_summary_counts_vehicles_and_names_each_moved_sensor_once(lake):
    rows = [f for own in stored(lake).values() for f in own]
    assert count_statuses(rows) == {"RED": 1, "YELLOW": 1, "UNKNOWN": 2, "GREEN": 1}
    assert {"vehicle": "red", "sensor": "radar", "since": "2026-03-04"} in moved_sensors(rows)
    assert len({m["vehicle"] for m in moved_sensors(rows)}) == len(moved_sensors(rows))


def test_a_red_vehicle_says_what_to_do_with_the_commands(lake, tmp_path, capsys):
    rows = [f for own in stored(lake).values() for f in own]
    steps = next_steps(rows, "my lake")
    assert [step.split(":")[0] for step in steps] == ["red", "yellow", "blind", "unknown"]
    assert "the mounting of the radar" in steps[0]
    command = "--vehicle red --day 2026-03-06 --kind repair --sensor radar"
    assert f"boresight service --lake 'my lake' {command}" in steps[0]
    assert "boresight export ros2 --lake 'my lake' --vehicle red --out tonight/red" in steps[0]
    page = write_fleet_page(lake, _config(), tmp_path / "fleet.html")
    assert f"boresight service --lake {lake.root} {command}" in page
    own = Lake.at(shutil.copytree(lake.root, tmp_path / "lake"))
    command = next_steps(rows, str(own.root))[0].split("`")[1]
    assert main(shlex.split(command)[1:]) == 0
    assert "run `boresight audit`, or wait for the next night" in capsys.readouterr().out
    assert main(["status", "--lake", str(own.root), "--vehicle", "red"]) == 0
    told = "repair of radar on 2026-03-06 is not audited yet: run `boresight audit`"
    assert told in capsys.readouterr().out
    assert status_of(stored(own)["red"]).status == "RED"
    audit_fleet(own, _config())
    assert status_of(stored(own)["red"]).status == "UNKNOWN"  # its charts begin anew
    assert next_step(stored(own)["red"], "L") == "red: drive until 3 more days are accepted."
    page = write_fleet_page(own, _config(), tmp_path / "after.html")
    assert '<td>red</td><td class="w">2026-03-06</td><td>radar</td><td>repair</td>' in page  # the list
    assert '"repair of the radar on 2026-03-06"' in page  # the charts


def _row(status, reason, **rest):
    """The row of a chart of a vehicle of this status."""
    return [DriftFinding(
        **{"vehicle": "v", "day": "2026-03-09", "method": "joint", "pair": "camera_lidar", "dof": "rx",
           "parent_frame": "camera", "child_frame": "lidar", "status": "UNKNOWN", "reason": reason, "limit": 0.1,
           "vehicle_status": status, "vehicle_reason": reason, "days_used": 4, **rest}
    )]  # fmt: skip


@pytest.mark.parametrize(
    ("row", "step"),
    [
        (_row("YELLOW", "one day", vehicle_days_needed=1), "tomorrow: `boresight status --lake L --vehicle v`."),
        (_row("YELLOW", "small", vehicle_sensor="camera", vehicle_since="2026-03-04"),
         "`boresight service --lake L --vehicle v --day 2026-03-04 --kind re-mount --sensor camera`"),
        (_row("UNKNOWN", "too few", vehicle_days_needed=2), "drive until 2 more days are accepted."),
        (_row("UNKNOWN", "too few", vehicle_days_needed=335), "drive other roads; 335 more"),
        (_row("UNKNOWN", "too few", vehicle_days_needed=1), "1 more day is accepted."),
        (_row("UNKNOWN", "no change; some of its records cannot be read"), "`boresight repair --lake L`"),
    ],
)  # fmt: skip
def test_a_vehicle_that_is_yellow_or_unknown_has_a_next_step(row, step):
    assert step in next_step(row, "L")


def test_a_green_vehicle_and_one_without_charts_need_no_step():
    assert next_step(_row("GREEN", "no sensor moved"), "L") == next_step([], "L") == ""


def test_each_command_of_the_next_steps_runs_as_it_is_printed(lake, tmp_path, monkeypatch, capsys):
    own = Lake.at(shutil.copytree(lake.root, tmp_path / "a lake"))
    records = read_records(own, CALIBRATIONS, CalibrationRecord)
    commit_records(own, POSES, poses_of(records))
    STATE.run(Task(_config(), own, Window()))
    monkeypatch.chdir(tmp_path)
    page = html.unescape(write_fleet_page(own, _config(), tmp_path / "fleet.html"))
    on_page = set(re.findall(r"`(boresight [^`]*)`", page))
    assert {c.split()[1] for c in on_page} == {"service", "export", "status"}
    for command in sorted(on_page):  # exports before the events that begin charts anew
        assert main(shlex.split(command)[1:]) in (0, 3), command
    assert sorted(p.name for p in (tmp_path / "tonight").iterdir()) == ["red"]
    assert "red" in capsys.readouterr().out
