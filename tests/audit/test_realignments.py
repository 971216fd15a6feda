"""Radars that align themselves: a step of their own estimate begins charts anew and blames no mount."""

import datetime as dt
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jobs.cli import main
from pipeline.config import FleetConfig
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.current import current_events
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT, DriftFinding
from schemas.radar_alignments import RADAR_ALIGNMENTS, RadarAlignment
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from schemas.states import STATES

SEMANTICS = {"source": "topics", "labels": "/l", "detections": "/d"}
RIG = {
    "camera": {"image": "/i", "info": "/c", "semantics": SEMANTICS},
    "lidar": {"points": "/p"},
    "radar": {"points": "/r", "alignment": "/radar/status"},
}
FLEET = FleetConfig.model_validate({"fleet": {"name": "f"}, "rigs": {"default": RIG}, "vehicles": {"v": {}}})
FIRST_DAY = dt.date(2026, 3, 1)
STEP = 8  # the first day with it
TO_THE_LEFT = np.radians([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])


def day_name(k: int) -> str:
    return (FIRST_DAY + dt.timedelta(days=k)).isoformat()


def stated(k: int, azimuth_deg: float, scatter_deg: float = 0.01, **values: object) -> RadarAlignment:
    known = {
        "azimuth_rad": float(np.radians(azimuth_deg)), "azimuth_sigma_rad": 1e-3, "messages": 300,
        "azimuth_scatter_rad": float(np.radians(scatter_deg)), "sign_is_published": True,
    }  # fmt: skip
    about = {
        "vehicle": "v",
        "day": day_name(k),
        "method": "joint",
        "sensor": "radar",
        "topics": ["/radar/status"],
    }
    return RadarAlignment(**about, first_stamp_ns=1, last_stamp_ns=2, work_key=f"{k}", **known | values)


def lake_of(
    path: Path,
    maker: ModuleType,
    turn: np.ndarray,
    azimuth_deg: Callable[[int], float] | None,
    *,
    days: int = 16,
    seed: int = 3,
) -> Lake:
    """A vehicle whose radar turns on one day, as edges see it, and states its own azimuth."""
    lake, rng = Lake.at(path / "lake"), np.random.default_rng(seed)
    motion = lambda day: {"radar": turn} if day >= STEP else {}  # noqa: E731
    commit_records(lake, CALIBRATIONS, maker.vehicle_records("v", days, rng, motion=motion))
    if azimuth_deg is not None:
        commit_records(lake, RADAR_ALIGNMENTS, [stated(k, azimuth_deg(k)) for k in range(days)])
    return lake


def audit(lake: Lake, night: int) -> list[DriftFinding]:
    outcome = AUDIT.run(Task(FLEET, lake, Window(None, day_name(night))))
    return DRIFT.rows_among(outcome.records)


def events_of(lake: Lake) -> list[ServiceEvent]:
    return current_events(read_records(lake, SERVICE_EVENTS, ServiceEvent))


def told(azimuth_deg: float) -> Callable[[int], float]:
    return lambda day: azimuth_deg if day >= STEP else 0.0


def test_a_re_alignment_is_found_the_same_night_and_blamed_on_the_radars_software(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -TO_THE_LEFT, told(0.3))
    assert {f.vehicle_status for f in audit(lake, STEP - 1)} == {"GREEN"}
    findings = audit(lake, STEP)
    assert not [f for f in findings if f.status in ("RED", "YELLOW")]
    assert "by its own software" in findings[0].vehicle_reason
    (event,) = events_of(lake)
    assert (event.kind, event.sensor, event.day) == ("re-alignment", "radar", day_name(STEP - 1))
    assert event.note.startswith(f"{day_name(STEP)}: +0.30 deg in azimuth; its edges turned by -0.")
    remarks = {f.pair for f in findings if "own software" in f.reason}
    assert remarks == {"camera_radar", "lidar_radar"}


@pytest.mark.parametrize("seed", range(3, 9))
def test_no_night_after_it_blames_a_mount(tmp_path, maker, seed):
    lake = lake_of(tmp_path, maker, -TO_THE_LEFT, told(0.3), seed=seed)
    nights = [audit(lake, night) for night in range(STEP, 16)]
    assert not [f for findings in nights for f in findings if f.status == "RED"]
    assert {f.vehicle_status for f in nights[-1]} == {"GREEN"}
    assert len(events_of(lake)) == 1


def test_without_its_messages_it_is_charted_as_a_turn_of_the_radar(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -2 * TO_THE_LEFT, None, days=24)
    findings = audit(lake, 23)
    assert {(f.vehicle_status, f.vehicle_sensor) for f in findings} == {("RED", "radar")}
    assert events_of(lake) == []


def test_a_knock_that_the_radar_notices_too_stays_a_knock(tmp_path, maker):
    lake = lake_of(tmp_path, maker, 2 * TO_THE_LEFT, told(0.6), days=24)
    findings = [audit(lake, night) for night in (*range(STEP, 11), 23)][-1]
    assert events_of(lake) == []
    assert {(f.vehicle_status, f.vehicle_sensor) for f in findings} == {("RED", "radar")}
    assert [f for f in findings if "own estimate changed otherwise" in f.reason and "+0.60 deg" in f.reason]


def test_a_knock_larger_than_the_radar_corrects_stays_a_knock(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -7 * TO_THE_LEFT, told(0.3))
    assert {f.vehicle_sensor for f in audit(lake, 12)} == {"radar"}
    assert events_of(lake) == []


def test_where_no_maker_publishes_the_sign_either_is_taken(tmp_path, maker):
    lake = lake_of(tmp_path, maker, TO_THE_LEFT, None)
    rows = [stated(k, told(0.3)(k), sign_is_published=False) for k in range(16)]
    commit_records(lake, RADAR_ALIGNMENTS, rows)
    audit(lake, STEP)
    assert len(events_of(lake)) == 1


def test_an_estimate_that_only_wanders_begins_nothing_anew(tmp_path, maker):
    azimuth_deg = np.random.default_rng(7).normal(0, 0.06, 16)
    lake = lake_of(tmp_path, maker, np.zeros(6), lambda day: float(azimuth_deg[day]))
    for night in range(16):
        audit(lake, night)
    assert events_of(lake) == []


def test_a_slow_re_alignment_counts_once_it_is_half_of_what_matters(tmp_path, maker):
    lake = lake_of(tmp_path, maker, np.zeros(6), lambda day: 0.01 * day, days=16)
    for night in range(16):
        audit(lake, night)
    assert [e.day for e in events_of(lake)] == [day_name(12)]  # 0.13 deg on the day after, 0.125 matter


def test_a_step_within_the_day_leaves_the_day_to_neither_side(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -TO_THE_LEFT, None)
    rows = [stated(k, told(0.3)(k)) for k in range(16)]
    rows[STEP] = stated(STEP, 0.3, azimuth_step_rad=float(np.radians(0.3)), step_stamp_ns=2)
    commit_records(lake, RADAR_ALIGNMENTS, rows)
    audit(lake, STEP)
    (event,) = events_of(lake)
    assert event.day == day_name(STEP)


def test_a_re_alignment_that_somebody_withdraws_is_not_noted_again(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -2 * TO_THE_LEFT, told(0.6), days=24)
    audit(lake, STEP)
    about = ["--vehicle", "v", "--day", day_name(STEP - 1), "--sensor", "radar", "--kind", "re-alignment"]
    assert main(["service", "--lake", str(tmp_path / "lake"), *about, "--withdraw"]) == 0
    findings = [audit(lake, night) for night in (STEP, STEP + 1, 23)][-1]
    assert events_of(lake) == []
    assert {f.vehicle_sensor for f in findings} == {"radar"}


def test_the_state_begins_anew_with_it(tmp_path, maker):
    lake = lake_of(tmp_path, maker, -TO_THE_LEFT, told(0.3))
    audit(lake, 12)
    STATE.run(Task(FLEET, lake, Window(None, day_name(12))))
    rows = read_records(lake, STATES, STATES.row_type)
    since = {r.pair: (r.since, "own software" in r.reason) for r in rows if r.pair != "pose"}
    assert since["lidar_radar"] == (day_name(STEP), True)
    assert since["camera_lidar"] == (None, False)


def test_the_summary_of_the_night_names_it_once(tmp_path, maker, capsys):
    lake_of(tmp_path, maker, -TO_THE_LEFT, told(0.3))
    points = '[rigs.default.lidar]\npoints = "/p"\n[rigs.default.radar]\npoints = "/r"\nalignment = "/s"\n'
    (tmp_path / "fleet.toml").write_text(f'[fleet]\nname = "f"\n{points}[vehicles.v]\n')
    where = ["--fleet", str(tmp_path / "fleet.toml"), "--lake", str(tmp_path / "lake")]
    named = []
    for night in (STEP - 1, STEP, STEP + 1):
        main(["audit", *where, "--to", day_name(night)])
        named.append(json.loads(capsys.readouterr().out.splitlines()[-1]).get("realigned", []))
    assert [[(e["vehicle"], e["sensor"]) for e in of] for of in named] == [[], [("v", "radar")], []]
    assert named[1][0]["what"].startswith(f"{day_name(STEP)}: +0.30 deg in azimuth")
