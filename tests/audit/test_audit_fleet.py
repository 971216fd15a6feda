"""The audit from table calibrations to table drift."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.audit.estimates import days_of
from pipeline.audit.vehicle import judge_fleet
from pipeline.config import AuditConfig, FleetConfig
from pipeline.errors import ConfigError
from pipeline.store.current import current_drift
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_records, write_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.drift import DRIFT, DriftFinding
from tests.makers.stages import audit_fleet

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
    for vehicle, day in sorted({(r.vehicle, r.day) for r in records}):
        rows = [r for r in records if (r.vehicle, r.day) == (vehicle, day)]
        key = rows[0].work_key + suffix
        write_records(lake, CALIBRATIONS, Partition(vehicle, day), rows, key, "0.1.0")


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


def test_a_vehicle_raises_no_more_false_alarms_than_its_budget(maker: ModuleType) -> None:
    rng = np.random.default_rng(2)
    config = AuditConfig(false_alarms_per_1000_vehicle_days=200.0)  # 0.2 per audit: 120 audits can tell
    trials = 120
    fleet = [days_of(maker.vehicle_records("v", 8, rng), config.held_sigma_factor) for _ in range(trials)]
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
    assert "rests on days whose calibration was held" in yaw.reason


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
