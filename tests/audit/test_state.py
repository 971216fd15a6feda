"""What a vehicle should load, by the commands: the days since a sensor moved, and its prior without any."""

import datetime as dt
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jobs.service import service
from jobs.state import state
from pipeline.core.config import FleetConfig
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from schemas.states import StateRow
from tests.makers.lakes import write_records

KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])


def _write(lake: Lake, records: list[CalibrationRecord], maker: ModuleType) -> None:
    commit_records(lake, CALIBRATIONS, records)
    commit_records(lake, POSES, maker.poses_of(records))


def _states(lake: Lake) -> dict[str, StateRow]:
    semantics = {"source": "topics", "labels": "/l", "detections": "/d"}
    rig = {"camera": {"image": "/i", "info": "/c", "semantics": semantics}}
    rig |= {"lidar": {"points": "/p"}, "radar": {"points": "/r"}}
    fleet = {"fleet": {"name": "test"}, "rigs": {"default": rig}, "vehicles": {"v": {}}}
    task = Task(FleetConfig.model_validate(fleet), lake, Window())
    AUDIT.run(task)
    return {row.sensor or row.pair: row for row in STATE.run(task).records}


def _day(k: int) -> str:
    return (dt.date(2026, 3, 1) + dt.timedelta(days=k)).isoformat()


def test_a_state_rests_on_the_accepted_days_since_the_last_change(tmp_path: Path, maker: ModuleType) -> None:
    lake, rng = Lake.at(tmp_path), np.random.default_rng(5)
    status = {3: "held", 17: "held", 18: "refused"}
    records = maker.vehicle_records(
        "v", 22, rng, motion=lambda d: {"radar": KNOCK} if d > 12 else {},
        status=lambda d: status.get(d, "accepted"),
    )  # fmt: skip
    common = np.diag([1e-4] * 3 + [5e-3] * 3) ** 2
    records = [r if r.covariance is None else replace(r, common_covariance=common) for r in records]
    _write(lake, records, maker)
    states = _states(lake)
    assert (
        states["radar"].days == states["lidar_radar"].days == [_day(k) for k in (13, 14, 15, 16, 19, 20, 21)]
    )
    assert "since 2026-03-14: radar moved" in states["radar"].reason
    assert len(states["camera"].days) == len(states["camera_lidar"].days) == 19
    assert states["camera_lidar"].since is None
    assert states["camera_lidar"].determined == states["camera"].determined == ["azimuth", "elevation"]
    event = ServiceEvent(vehicle="v", day=_day(21), sensor="all", kind="repair", note="", work_key="k")
    write_records(lake, SERVICE_EVENTS, [event], "k")
    states = _states(lake)
    others = [s for name, s in states.items() if name != "lidar"]
    assert {(s.status, tuple(s.days), tuple(s.determined)) for s in others} == {("prior", (), ())}
    assert "no usable day after the repair of all sensors on 2026-03-22" in states["radar"].reason
    for pair, T in (("camera_lidar", maker.T_CAMERA_LIDAR), ("lidar_radar", maker.T_LIDAR_RADAR)):
        np.testing.assert_allclose(transform_of(states[pair]), T, atol=1e-12)


@pytest.mark.parametrize(("kind", "by"), [("repair", ""), ("re-alignment", " by its own software")])
def test_a_service_event_and_the_state_after_it_are_commands(
    kind: str, by: str, tmp_path: Path, maker: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    lake = Lake.at(tmp_path)
    _write(lake, maker.vehicle_records("v", 6, np.random.default_rng(6)), maker)
    for day in (_day(2), _day(3)):
        assert service(lake=str(tmp_path), vehicle="v", day=day, kind=kind, sensor="radar") == 0
    _states(lake)
    capsys.readouterr()
    assert state(lake=str(tmp_path), vehicle="v", json=True) == 0
    found = {row["sensor"] or row["pair"]: row for row in json.loads(capsys.readouterr().out)}
    assert found["lidar_radar"]["days"] == [_day(4), _day(5)]
    assert f"{kind} of the radar{by} on 2026-03-04" in found["lidar_radar"]["reason"]
    assert len(found["camera_lidar"]["days"]) == 6
    assert found["camera_lidar"]["in_words"].startswith("used: pitch, yaw, roll")
    assert np.shape(found["camera_lidar"]["T"]) == (4, 4)
    assert state(lake=str(tmp_path)) == 0
    assert "certified" in capsys.readouterr().out
