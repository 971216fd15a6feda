"""The audit from table calibrations to table drift."""

import datetime as dt
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.audit.vehicle import judge_fleet
from pipeline.core.config import AuditConfig, FleetConfig
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT
from pipeline.rig.changes import change_between
from pipeline.rig.se3 import exp_so3, from_quaternion, from_rotation_translation, to_quaternion
from pipeline.store.commits import commit_records
from pipeline.store.current import current_drift
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from tests.makers.fleet_lakes import one_rig_fleet
from tests.makers.lakes import write_records
from tests.makers.stages import audit_fleet

NOTHING = np.zeros(6)
KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])


def _fleet(*vehicles: str) -> FleetConfig:
    semantics = {"source": "topics", "labels": "/l", "detections": "/d"}
    rig = {
        "camera": {"image": "/i", "info": "/c", "semantics": semantics},
        "lidar": {"points": "/p"},
        "radar": {"points": "/r"},
    }
    return FleetConfig.model_validate(
        {"fleet": {"name": "test"}, "rigs": {"default": rig}, "vehicles": {v: {} for v in vehicles}}
    )


def _write(lake: Lake, records: list[CalibrationRecord], suffix: str = "") -> None:
    commit_records(lake, CALIBRATIONS, [replace(r, work_key=r.work_key + suffix) for r in records])


def _alarms(findings: list[DriftFinding]) -> list[DriftFinding]:
    return [f for f in findings if f.status in ("RED", "YELLOW")]


def test_a_knocked_radar_is_found_on_its_vehicle_sensor_and_day(tmp_path: Path, maker: ModuleType) -> None:
    rng = np.random.default_rng(11)
    lake = Lake.at(tmp_path)
    for vehicle, motion in (("a", {}), ("b", {"radar": KNOCK}), ("c", {})):
        _write(lake, maker.vehicle_records(vehicle, 4, rng, motion=lambda d, m=motion: m if d > 1 else {}))
    findings = audit_fleet(lake, _fleet("a", "b", "c"), None, None, "joint")
    assert len(findings) == 3 * 18
    assert {f.vehicle for f in _alarms(findings)} == {"b"}
    red = [f for f in findings if f.status == "RED"]
    assert {(f.pair, f.dof) for f in red} >= {("lidar_radar", "rz"), ("camera_radar", "ry")}
    assert {f.moved_sensor for f in red} == {"radar"}
    assert {f.start_day for f in red} == {"2026-03-03"}
    yaw = next(f for f in red if (f.pair, f.dof) == ("lidar_radar", "rz"))
    assert yaw.magnitude == pytest.approx(np.radians(1.0), abs=4 * (yaw.magnitude_sigma or 0))
    assert yaw.moved_motion is not None
    assert yaw.moved_motion[2] == pytest.approx(np.radians(1.0), abs=4 * yaw.moved_motion_sigma[2])
    assert all(f.status != "RED" for f in findings if f.pair == "camera_lidar")


@pytest.mark.slow
def test_a_vehicle_raises_no_more_false_alarms_than_its_budget(maker: ModuleType) -> None:
    rng = np.random.default_rng(2)
    config = AuditConfig(false_alarms_per_1000_vehicle_days=200.0)  # 0.2 per audit: 120 audits can tell
    trials = 120
    fleet = [
        maker.days_of(maker.vehicle_records("v", 8, rng), config.held_sigma_factor) for _ in range(trials)
    ]
    alarms = sum(any(v.change for v in verdict.charts.values()) for verdict in judge_fleet(fleet, config))
    assert 0 < alarms <= trials * 0.2 + 3 * np.sqrt(trials * 0.2 * 0.8)


def test_a_slow_drift_of_the_camera_is_told_from_a_knock(tmp_path: Path, maker: ModuleType) -> None:
    rng = np.random.default_rng(4)
    lake = Lake.at(tmp_path)
    rate = np.array([0, np.radians(0.03), 0, 0, 0, 0])
    _write(lake, maker.vehicle_records("v", 20, rng, motion=lambda d: {"camera": rate * max(0, d - 4)}))
    red = [f for f in audit_fleet(lake, _fleet("v")) if f.status == "RED"]
    assert ("camera_lidar", "ry") in {(f.pair, f.dof) for f in red}
    yaw = next(f for f in red if (f.pair, f.dof) == ("camera_lidar", "ry"))
    assert (yaw.kind, yaw.moved_sensor) == ("slow drift", "camera")


def test_refused_days_are_gaps_and_held_days_weigh_less(tmp_path: Path, maker: ModuleType) -> None:
    rng = np.random.default_rng(5)
    lake = Lake.at(tmp_path)
    status = {3: "held", 4: "refused", 8: "refused"}
    _write(
        lake,
        maker.vehicle_records(
            "v",
            10,
            rng,
            motion=lambda d: {"radar": KNOCK} if d > 4 else {},
            status=lambda d: status.get(d, "accepted"),
        ),
    )
    findings = audit_fleet(lake, _fleet("v"))
    yaw = next(f for f in findings if (f.pair, f.dof) == ("lidar_radar", "rz"))
    assert (yaw.status, yaw.days_used) == ("RED", 8)
    assert (yaw.start_day_earliest, yaw.start_day_latest) == ("2026-03-05", "2026-03-06")
    assert yaw.start_day == "2026-03-06"


def test_a_knock_so_large_that_every_later_day_is_held_is_still_told(
    tmp_path: Path, maker: ModuleType
) -> None:
    rng = np.random.default_rng(15)
    lake = Lake.at(tmp_path)
    _write(
        lake,
        maker.vehicle_records(
            "v", 6, rng, motion=lambda d: {"radar": 8 * KNOCK} if d > 2 else {},
            status=lambda d: "held" if d > 2 else "accepted",
        ),
    )  # fmt: skip
    yaw = next(f for f in audit_fleet(lake, _fleet("v")) if (f.pair, f.dof) == ("lidar_radar", "rz"))
    assert (yaw.status, yaw.start_day, yaw.moved_sensor) == ("RED", "2026-03-04", "radar")
    assert "depends on days whose calibration was held" in yaw.reason


def test_a_vehicle_that_drives_on_without_estimates_says_so(tmp_path: Path, maker: ModuleType) -> None:
    lake = Lake.at(tmp_path)
    status = lambda d: "refused" if d > 3 else "accepted"  # noqa: E731
    _write(lake, maker.vehicle_records("v", 6, np.random.default_rng(16), status=status))
    reasons = {f.reason for f in audit_fleet(lake, _fleet("v"))}
    assert all(r.endswith("no estimate after 2026-03-04") for r in reasons)


def test_what_no_day_determined_is_unknown_and_so_is_a_vehicle_without_records(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake = Lake.at(tmp_path)
    _write(lake, maker.vehicle_records("v", 6, np.random.default_rng(6), unobservable=(0, 5)))
    findings = audit_fleet(lake, _fleet("v", "parked"))
    unseen = [f for f in findings if f.vehicle == "v" and f.dof in ("rx", "tz")]
    assert {(f.status, f.days_used) for f in unseen} == {("UNKNOWN", 0)}
    parked = [f for f in findings if f.vehicle == "parked"]
    assert {f.status for f in parked} == {"UNKNOWN"}
    assert {f.reason for f in parked} == {"no record in the window"}


def test_the_last_record_of_a_day_counts_and_drift_is_append_only(tmp_path: Path, maker: ModuleType) -> None:
    lake = Lake.at(tmp_path)
    records = maker.vehicle_records("v", 4, np.random.default_rng(7))
    rng = np.random.default_rng(8)
    _write(lake, maker.vehicle_records("v", 4, rng, motion=lambda d: {"radar": KNOCK * d}))
    assert _alarms(audit_fleet(lake, _fleet("v")))
    _write(lake, records, suffix="-again")
    findings = audit_fleet(lake, _fleet("v"))
    assert not _alarms(findings)
    table = read_records(lake, DRIFT, DriftFinding, vehicle="v")
    assert len(table) in (18, 36)  # the same work key is the same row, another one adds rows
    assert [f.status for f in current_drift(table)] == [f.status for f in sorted(findings, key=_key)]


def _key(f: DriftFinding) -> tuple[str, str, str, str]:
    return f.vehicle, f.method, f.pair, f.dof


def test_the_same_audit_writes_nothing_again(tmp_path: Path, maker: ModuleType) -> None:
    lake = Lake.at(tmp_path)
    _write(lake, maker.vehicle_records("v", 4, np.random.default_rng(9)))
    first = audit_fleet(lake, _fleet("v"))
    log = sorted((tmp_path / "drift" / "_delta_log").iterdir())
    second = audit_fleet(lake, _fleet("v"))
    assert first == second
    assert sorted((tmp_path / "drift" / "_delta_log").iterdir()) == log
    assert len(read_records(lake, DRIFT, DriftFinding)) == 18


def test_an_impossible_window_names_its_key(tmp_path: Path, maker: ModuleType) -> None:
    lake = Lake.at(tmp_path)
    assert audit_fleet(lake, _fleet("v")) == []
    _write(lake, maker.vehicle_records("v", 3, np.random.default_rng(1)))
    with pytest.raises(ConfigError, match="from"):
        audit_fleet(lake, _fleet("v"), "2026-03-09", "2026-03-01")
    with pytest.raises(ConfigError, match="yesterday"):
        audit_fleet(lake, _fleet("v"), None, "yesterday")


def _status(findings: list[DriftFinding], vehicle: str = "v") -> tuple[str | None, str | None, str | None]:
    row = next(f for f in findings if f.vehicle == vehicle)
    return row.vehicle_status, row.vehicle_sensor, row.vehicle_since


def _day(k: int) -> str:
    return (dt.date(2026, 3, 1) + dt.timedelta(days=k)).isoformat()


def _service(lake: Lake, day: int, sensor: str = "radar", vehicle: str = "v") -> None:
    event = ServiceEvent(
        vehicle=vehicle,
        day=_day(day),
        sensor=sensor,
        kind="repair",
        note="",
        work_key=f"{vehicle}-{day}-{sensor}",
    )
    write_records(lake, SERVICE_EVENTS, [event], event.work_key)


def test_a_vehicle_that_was_never_repaired_stays_red_when_its_window_holds_nothing_else(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake = Lake.at(tmp_path)
    rng = np.random.default_rng(21)
    _write(lake, maker.vehicle_records("v", 60, rng, motion=lambda d: {"radar": KNOCK} if d > 14 else {}))
    for last in (17, 32, 45, 59):
        assert _status(audit_fleet(lake, _fleet("v"), None, _day(last))) == ("RED", "radar", _day(15)), last


def test_a_repaired_vehicle_is_green_within_five_nights_with_a_service_event_and_without(
    tmp_path: Path, maker: ModuleType
) -> None:
    # Re-mounted elsewhere: only the event tells that this is where the radar belongs now.
    elsewhere = -2 * KNOCK
    for name, after in (("told", elsewhere), ("back", NOTHING)):
        lake, rng = Lake.at(tmp_path / name), np.random.default_rng(22)
        motion = lambda d, a=after: {"radar": KNOCK if 10 < d < 20 else a if d >= 20 else NOTHING}  # noqa: E731
        _write(lake, maker.vehicle_records("v", 30, rng, motion=motion))
        if name == "told":
            assert _status(audit_fleet(lake, _fleet("v"), None, _day(29)))[0] == "RED"
            _service(lake, 19)
        assert _status(audit_fleet(lake, _fleet("v"), None, _day(18)))[:2] == ("RED", "radar")
        assert _status(audit_fleet(lake, _fleet("v"), None, _day(24)))[0] == "GREEN", name
        findings = audit_fleet(lake, _fleet("v"), None, _day(29))
        yaw = next(f for f in findings if (f.pair, f.dof) == ("lidar_radar", "rz"))
        assert ("since the repair of the radar on 2026-03-20" in yaw.reason) == (name == "told")
        camera = next(f for f in findings if (f.pair, f.dof) == ("camera_lidar", "ry"))
        assert (camera.days_used, camera.status) == (30, "GREEN")  # of other sensors, nothing begins anew


def test_a_change_of_most_vehicles_on_one_day_is_told_from_that_of_one(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(23)
    release = {"camera": np.array([0, np.radians(0.3), 0, 0, 0, 0])}
    for k in range(8):
        both = release | ({"radar": KNOCK} if k == 3 else {})
        _write(lake, maker.vehicle_records(f"v{k}", 16, rng, motion=lambda d, m=both: m if d > 9 else {}))
    findings = audit_fleet(lake, _fleet(*(f"v{k}" for k in range(8))))
    statuses = {f"v{k}": _status(findings, f"v{k}")[0] for k in range(8)}
    assert statuses.pop("v3") == "RED"
    assert set(statuses.values()) == {"GREEN"}
    assert _status(findings, "v3")[1:] == ("radar", _day(10))
    yaw = next(f for f in findings if (f.vehicle, f.pair, f.dof) == ("v0", "camera_lidar", "ry"))
    assert "without what 8 of 8 vehicles show since 2026-03-11" in yaw.reason


def test_a_record_of_a_day_to_come_and_one_of_nonsense_are_named_and_left_out(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(24)
    records = maker.vehicle_records("v", 8, rng)
    _write(lake, records + maker.vehicle_records("w", 8, rng))
    whole = [f.status for f in audit_fleet(lake, _fleet("v", "w"))]
    wrong = np.full((6, 6), np.nan)
    spoiled = [replace(records[0], day="2099-01-01", work_key="k1"), replace(records[6], covariance=wrong)]
    spoiled.append(replace(records[3], status="odd"))
    _write(lake, spoiled, suffix="-again")
    outcome = AUDIT.run(Task(_fleet("v", "w"), lake, Window()))
    assert "v 2099-01-01 camera_lidar is of a day that has not come yet" in outcome.reason
    assert f"v {records[6].day} camera_lidar holds no covariance" in outcome.reason
    assert f"v {records[3].day} {records[3].pair} is of a pair or has a status" in outcome.reason
    assert {f.day for f in outcome.records} == {_day(7)}
    assert sum(a == f.status for a, f in zip(whole, outcome.records, strict=True)) >= 34


def test_a_knocked_vehicle_that_stands_still_for_weeks_stays_red(tmp_path: Path, maker: ModuleType) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(31)
    _write(lake, maker.vehicle_records("parked", 20, rng, motion=lambda d: {"radar": KNOCK} if d > 9 else {}))
    _write(lake, maker.vehicle_records("daily", 80, rng))
    for last in (30, 47, 79):  # its last day leaves the window on day 47
        findings = audit_fleet(lake, _fleet("parked", "daily"), None, _day(last))
        assert _status(findings, "parked") == ("RED", "radar", _day(10)), last
        assert _status(findings, "daily")[0] == "GREEN"


def test_a_vehicle_that_drives_rarely_takes_nobody_s_reference_away(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(32)
    _write(lake, maker.vehicle_records("v", 60, rng, motion=lambda d: {"radar": KNOCK} if d > 14 else {}))
    _write(lake, maker.vehicle_records("rare", 60, rng)[-3:])
    for last in (17, 32, 45, 59):
        findings = audit_fleet(lake, _fleet("v", "rare"), None, _day(last))
        assert _status(findings) == ("RED", "radar", _day(15)), last
        assert _status(findings, "rare")[0] == "UNKNOWN"


def test_a_vehicle_that_drives_weekly_and_one_after_months_have_sensible_statuses(
    tmp_path: Path, maker: ModuleType
) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(25)
    weekly = maker.vehicle_records("v", 64, rng, motion=lambda d: {"radar": KNOCK} if d > 49 else {})
    _write(lake, [r for r in weekly if int(r.work_key.split("-")[1]) % 7 == 0])
    assert _status(audit_fleet(lake, _fleet("v"), None, _day(49)))[0] == "GREEN"
    assert _status(audit_fleet(lake, _fleet("v"), None, _day(63))) == ("RED", "radar", _day(56))
    lake = Lake.at(tmp_path / "gap")
    days = maker.vehicle_records("v", 124, rng, motion=lambda d: {"radar": KNOCK} if d > 60 else {})
    _write(lake, [r for r in days if not 10 < int(r.work_key.split("-")[1]) < 120])
    assert _status(audit_fleet(lake, _fleet("v"), None, _day(10)))[0] == "GREEN"
    assert _status(audit_fleet(lake, _fleet("v"), None, _day(123)))[:2] == ("RED", "radar")


@pytest.mark.parametrize("since", [0.0, 0.5])
def test_a_knock_within_a_day_is_found_on_that_day(tmp_path: Path, maker: ModuleType, since: float) -> None:
    """The record of the day lies between its two places; the charts take what its last part says."""
    lake = Lake.at(tmp_path)
    before, after = (
        maker.vehicle_records("a", 8, np.random.default_rng(11), motion=lambda d, m=m: m if d >= 4 else {})
        for m in ({}, {"radar": KNOCK})
    )
    records = [b if b.day < "2026-03-05" else a for b, a in zip(before, after, strict=True)]
    for k, (b, a) in enumerate(zip(before, after, strict=True)):
        if b.day != "2026-03-05" or b.pair == "camera_lidar":
            continue
        T_b, T_a = (
            from_quaternion(np.array([r.qw, r.qx, r.qy, r.qz]), np.array([r.tx_m, r.ty_m, r.tz_m]))
            for r in (b, a)
        )
        half = since * change_between(T_b, T_a)
        T = from_rotation_translation(exp_so3(half[:3]) @ T_b[:3, :3], T_b[:3, 3] + half[3:])
        q = to_quaternion(T)
        sigma = np.full(6, 1e-4)
        half_days = np.array([[change_between(T, T_b), sigma], [change_between(T, T_a), sigma]])
        records[k] = replace(
            b, status="held", reason="yaw turned within the day", faults=["moved_in_day"], half_days=half_days,
            qw=q[0], qx=q[1], qy=q[2], qz=q[3], tx_m=T[0, 3], ty_m=T[1, 3], tz_m=T[2, 3],
        )  # fmt: skip
    _write(lake, records)
    red = [f for f in audit_fleet(lake, _fleet("a"), None, None, "joint") if f.status == "RED"]
    assert {f.moved_sensor for f in red} == {"radar"}
    assert {f.start_day for f in red} == {"2026-03-05"}


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_step_of_a_whole_line_is_one_event_and_one_of_half_of_it_is_taken_from_nobody(
    tmp_path: Path, maker: ModuleType, share: float
) -> None:
    rng, vehicles = np.random.default_rng(31), [f"v{k:02d}" for k in range(10)]
    knock = {"radar": np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.0, 0.0])}
    lake, moved = Lake.at(tmp_path), vehicles[: int(share * len(vehicles))]
    for vehicle in vehicles:
        motion = (lambda d: knock if d > 9 else {}) if vehicle in moved else (lambda _: {})
        commit_records(lake, CALIBRATIONS, maker.vehicle_records(vehicle, 20, rng, motion=motion))
    found = {f.vehicle: f.vehicle_status for f in audit_fleet(lake, one_rig_fleet())}
    expected = {v: "RED" if v in moved and share < 1 else "GREEN" for v in vehicles}
    assert found == expected
