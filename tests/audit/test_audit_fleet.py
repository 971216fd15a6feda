"""The audit from table calibrations to table drift."""

import datetime as dt
from dataclasses import replace

import numpy as np
import pytest

from pipeline.audit.vehicle import judge_fleet
from pipeline.core.config import AuditConfig, FleetConfig
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT
from pipeline.rig.graph import pose_columns
from pipeline.rig.se3 import change_between, exp_so3, from_rotation_translation
from pipeline.store.commits import commit_records
from pipeline.store.current import current_drift, transform_of
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from tests.audit.fleet_records import days_of, vehicle_records
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.stages import audit_fleet

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])


def fleet_config(*vehicles):
    known = {"fleet": {"name": "test"}, "rigs": {"default": THREE_SENSORS}}
    return FleetConfig.model_validate(known | {"vehicles": {v: {} for v in vehicles}})


def day_name(k):
    return (dt.date(2026, 3, 1) + dt.timedelta(days=k)).isoformat()


def knocked(first, twist=KNOCK, sensor="radar"):
    """The motion of a sensor that is turned before a day."""
    return lambda d: {sensor: twist} if d >= first else {}


def write(lake, rows, suffix=""):
    commit_records(lake, CALIBRATIONS, [replace(r, work_key=r.work_key + suffix) for r in rows])


def audit(lake, *vehicles, last=None):
    return audit_fleet(lake, fleet_config(*vehicles), None, None if last is None else day_name(last))


def chart(findings, pair, dof, vehicle="v"):
    [found] = [f for f in findings if (f.vehicle, f.pair, f.dof) == (vehicle, pair, dof)]
    return found


def status(findings, vehicle="v"):
    row = next(f for f in findings if f.vehicle == vehicle)
    return row.vehicle_status, row.vehicle_sensor, row.vehicle_since


def test_a_knocked_radar_is_found_on_its_vehicle_sensor_and_day(lake):
    rng = np.random.default_rng(11)
    for vehicle, first in (("a", 99), ("b", 2), ("c", 99)):
        write(lake, vehicle_records(vehicle, 4, rng, motion=knocked(first)))
    findings = audit(lake, "a", "b", "c")
    assert len(findings) == 3 * 18
    assert {f.vehicle for f in findings if f.status in ("RED", "YELLOW")} == {"b"}
    red = [f for f in findings if f.status == "RED"]
    assert {(f.pair, f.dof) for f in red} >= {("lidar_radar", "rz"), ("camera_radar", "ry")}
    assert {(f.moved_sensor, f.start_day) for f in red} == {("radar", "2026-03-03")}
    yaw = chart(red, "lidar_radar", "rz", "b")
    assert yaw.magnitude == pytest.approx(np.radians(1.0), abs=4 * yaw.magnitude_sigma)
    assert yaw.moved_motion[2] == pytest.approx(np.radians(1.0), abs=4 * yaw.moved_motion_sigma[2])
    assert all(f.pair != "camera_lidar" for f in red)


@pytest.mark.slow
def test_a_vehicle_raises_no_more_false_alarms_than_its_budget():
    rng = np.random.default_rng(2)
    config = AuditConfig(false_alarms_per_1000_vehicle_days=200.0)  # 0.2 per audit: 120 audits can tell
    trials = 120
    fleet = [days_of(vehicle_records("v", 8, rng), config.held_sigma_factor) for _ in range(trials)]
    alarms = sum(any(v.change for v in verdict.charts.values()) for verdict in judge_fleet(fleet, config))
    assert 0 < alarms <= trials * 0.2 + 3 * np.sqrt(trials * 0.2 * 0.8)


def test_a_slow_drift_of_the_camera_is_told_from_a_knock(lake):
    rate = np.array([0, np.radians(0.03), 0, 0, 0, 0])
    drifting = lambda d: {"camera": rate * max(0, d - 4)}  # noqa: E731
    write(lake, vehicle_records("v", 20, np.random.default_rng(4), motion=drifting))
    yaw = chart(audit(lake, "v"), "camera_lidar", "ry")
    assert (yaw.status, yaw.kind, yaw.moved_sensor) == ("RED", "slow drift", "camera")


def test_refused_days_are_gaps_and_held_days_weigh_less(lake):
    statuses = {3: "held", 4: "refused", 8: "refused", 9: "refused"}
    of_day = lambda d: statuses.get(d, "accepted")  # noqa: E731
    write(lake, vehicle_records("v", 10, np.random.default_rng(5), motion=knocked(5), status=of_day))
    yaw = chart(audit(lake, "v"), "lidar_radar", "rz")
    assert (yaw.status, yaw.days_used, yaw.start_day) == ("RED", 7, "2026-03-06")
    assert (yaw.start_day_earliest, yaw.start_day_latest) == ("2026-03-05", "2026-03-06")
    assert yaw.reason.endswith("no estimate after 2026-03-08")


def test_a_knock_so_large_that_every_later_day_is_held_is_still_told(lake):
    held = lambda d: "held" if d > 2 else "accepted"  # noqa: E731
    rng = np.random.default_rng(15)
    write(lake, vehicle_records("v", 6, rng, motion=knocked(3, 8 * KNOCK), status=held))
    yaw = chart(audit(lake, "v"), "lidar_radar", "rz")
    assert (yaw.status, yaw.start_day, yaw.moved_sensor) == ("RED", "2026-03-04", "radar")
    assert "depends on days whose calibration was held" in yaw.reason


def test_what_no_day_determined_is_unknown_and_so_is_a_vehicle_without_records(lake):
    assert audit(lake, "v") == []
    write(lake, vehicle_records("v", 6, np.random.default_rng(6), unobservable=(0, 5)))
    findings = audit(lake, "v", "parked")
    unseen = [f for f in findings if f.vehicle == "v" and f.dof in ("rx", "tz")]
    assert {(f.status, f.days_used) for f in unseen} == {("UNKNOWN", 0)}
    parked = {(f.status, f.days_used, f.days_needed) for f in findings if f.vehicle == "parked"}
    assert parked == {("UNKNOWN", 0, 3)}
    for window in (("2026-03-09", "2026-03-01"), (None, "yesterday")):
        with pytest.raises(ConfigError, match=window[1] if window[0] is None else "from"):
            audit_fleet(lake, fleet_config("v"), *window)


def test_the_last_record_of_a_day_counts_and_the_same_audit_writes_nothing_again(lake):
    creeping = lambda d: {"radar": KNOCK * d}  # noqa: E731
    write(lake, vehicle_records("v", 4, np.random.default_rng(8), motion=creeping))
    assert {"RED", "YELLOW"} & {f.status for f in audit(lake, "v")}
    write(lake, vehicle_records("v", 4, np.random.default_rng(7)), suffix="-again")
    findings = audit(lake, "v")
    assert not {"RED", "YELLOW"} & {f.status for f in findings}
    table = read_records(lake, DRIFT, DriftFinding, vehicle="v")
    assert len(table) in (18, 36)  # the same work key is the same row, another one adds rows
    key = lambda f: (f.vehicle, f.method, f.pair, f.dof)  # noqa: E731
    assert [f.status for f in current_drift(table)] == [f.status for f in sorted(findings, key=key)]
    log = sorted((lake.root / "drift" / "_delta_log").iterdir())
    assert audit(lake, "v") == findings
    assert sorted((lake.root / "drift" / "_delta_log").iterdir()) == log


def test_a_vehicle_that_was_never_repaired_stays_red_however_long_it_drives_stands_or_drives_rarely(lake):
    rng = np.random.default_rng(21)
    write(lake, vehicle_records("v", 60, rng, motion=knocked(15)))
    write(lake, vehicle_records("parked", 20, rng, motion=knocked(10)))
    write(lake, vehicle_records("rare", 60, rng)[-3:])
    for last in (17, 32, 45, 59):  # the last day of "parked" leaves the window on day 47
        findings = audit(lake, "v", "parked", "rare", last=last)
        assert status(findings) == ("RED", "radar", day_name(15)), last
        assert status(findings, "parked") == ("RED", "radar", day_name(10)), last
        assert status(findings, "rare")[0] == "UNKNOWN"


@pytest.mark.parametrize(("is_told", "after"), [(True, -2 * KNOCK), (False, np.zeros(6))])
def test_a_repaired_vehicle_is_green_within_five_nights_with_a_service_event_and_without(
    lake, is_told, after
):
    """Re-mounted elsewhere: only the event tells that this is where the radar belongs now."""
    motion = lambda d: {"radar": after if d >= 20 else KNOCK * (d > 10)}  # noqa: E731
    write(lake, vehicle_records("v", 30, np.random.default_rng(22), motion=motion))
    if is_told:
        assert status(audit(lake, "v", last=29))[0] == "RED"
        event = ServiceEvent(vehicle="v", day=day_name(19), sensor="radar", kind="repair", work_key="k")
        commit_records(lake, SERVICE_EVENTS, [event])
    assert status(audit(lake, "v", last=18))[:2] == ("RED", "radar")
    assert status(audit(lake, "v", last=24))[0] == "GREEN"
    findings = audit(lake, "v", last=29)
    reason = chart(findings, "lidar_radar", "rz").reason
    assert ("since the repair of the radar on 2026-03-20" in reason) == is_told
    camera = chart(findings, "camera_lidar", "ry")
    assert (camera.days_used, camera.status) == (30, "GREEN")  # of other sensors, nothing begins anew


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_change_of_most_vehicles_on_one_day_is_told_from_that_of_one_and_of_half_of_them(lake, share):
    rng = np.random.default_rng(23)
    release = {"camera": np.array([0, np.radians(0.3), 0, 0, 0, 0])}
    vehicles = [f"v{k}" for k in range(8)]
    days = 16 if share < 1 else 42  # the window's last weeks have the reference alone before the release
    for k, vehicle in enumerate(vehicles):
        both = (release if k < 8 * share else {}) | ({"radar": KNOCK} if k == 3 else {})
        write(lake, vehicle_records(vehicle, days, rng, motion=lambda d, m=both: m if d > 9 else {}))
    findings = audit(lake, *vehicles, last=15)
    of_release = "GREEN" if share == 1 else "RED"
    expected = {v: of_release if k < 8 * share else "GREEN" for k, v in enumerate(vehicles)} | {"v3": "RED"}
    assert {v: status(findings, v)[0] for v in vehicles} == expected
    if share == 1:
        later = audit(lake, *vehicles, last=days - 1)
        assert {v: status(later, v)[0] for v in vehicles} == expected
        assert status(findings, "v3")[1:] == ("radar", day_name(10))
        words = "less the change of 8 of 8 vehicles since 2026-03-11"
        assert words in chart(findings, "camera_lidar", "ry", "v0").reason


def test_a_record_of_a_day_to_come_and_one_of_nonsense_are_named_and_left_out(lake):
    rng = np.random.default_rng(24)
    records = vehicle_records("v", 8, rng)
    write(lake, records + vehicle_records("w", 8, rng))
    whole = [f.status for f in audit(lake, "v", "w")]
    beyond_one = records[9].covariance.copy()  # a correlation that is none
    beyond_one[0, 1] = beyond_one[1, 0] = 2 * np.sqrt(beyond_one[0, 0] * beyond_one[1, 1])
    spoiled = [
        replace(records[0], day="2099-01-01", work_key="k1"),
        replace(records[6], covariance=np.full((6, 6), np.nan)),
        replace(records[9], covariance=beyond_one),
        replace(records[3], status="odd"),
    ]
    write(lake, spoiled, suffix="-again")
    outcome = AUDIT.run(Task(fleet_config("v", "w"), lake, Window()))
    assert "v 2099-01-01 camera_lidar is of a day in the future" in outcome.reason
    for k in (6, 9):
        assert f"v {records[k].day} camera_lidar has no valid covariance" in outcome.reason
    assert f"v {records[3].day} {records[3].pair} has a pair or a status" in outcome.reason
    assert {f.day for f in outcome.records} == {day_name(7)}
    assert sum(a == f.status for a, f in zip(whole, outcome.records, strict=True)) >= 34


@pytest.mark.parametrize(
    ("days", "driven", "knock", "green", "red"),
    [(64, lambda d: d % 7 == 0, 50, 49, 63), (124, lambda d: not 10 < d < 120, 61, 10, 123)],
)
def test_a_vehicle_that_drives_weekly_and_one_after_months_have_sensible_statuses(
    lake, days, driven, knock, green, red
):
    rows = vehicle_records("v", days, np.random.default_rng(25), motion=knocked(knock))
    write(lake, [r for r in rows if driven(int(r.work_key.split("-")[1]))])
    assert status(audit(lake, "v", last=green))[0] == "GREEN"
    assert status(audit(lake, "v", last=red))[:2] == ("RED", "radar")


@pytest.mark.parametrize("since", [0.0, 0.5])
def test_a_knock_within_a_day_is_found_on_that_day(lake, since):
    """The record of the day lies between its two places; the charts take what its last part says."""
    before, after = (
        vehicle_records("v", 8, np.random.default_rng(11), motion=knocked(first)) for first in (99, 4)
    )
    records = [b if b.day < "2026-03-05" else a for b, a in zip(before, after, strict=True)]
    for k, (b, a) in enumerate(zip(before, after, strict=True)):
        if b.day != "2026-03-05" or b.pair == "camera_lidar":
            continue
        T_b, T_a = transform_of(b), transform_of(a)
        half = since * change_between(T_b, T_a)
        T = from_rotation_translation(exp_so3(half[:3]) @ T_b[:3, :3], T_b[:3, 3] + half[3:])
        sigma = np.full(6, 1e-4)
        half_days = np.array([[change_between(T, T_b), sigma], [change_between(T, T_a), sigma]])
        records[k] = replace(
            b, status="held", reason="yaw turned within the day", faults=["moved_in_day"], half_days=half_days,
            **pose_columns(T),
        )  # fmt: skip
    write(lake, records)
    red = [f for f in audit(lake, "v") if f.status == "RED"]
    assert {(f.moved_sensor, f.start_day) for f in red} == {("radar", "2026-03-05")}
