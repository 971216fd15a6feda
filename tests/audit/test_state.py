"""What a vehicle should load: its error falls with the days as its sigma says."""

import datetime as dt
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jobs.service import service
from jobs.state import state
from pipeline.audit.state import DayEstimate, fuse
from pipeline.config import FleetConfig
from pipeline.geometry.se3 import exp_se3, inverse, log_se3
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, STATE
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from schemas.states import StateRow
from tests.makers.lakes import write_records

VARYING = np.diag([1e-3, 2e-3, 5e-4, 0.01, 0.02, 0.03]) ** 2
COMMON = np.diag([5e-4, 4e-3, 1e-4, 0.02, 0.01, 0.05]) ** 2
KNOCK = np.array([0.0, 0.0, np.radians(1.0), 0.0, 0.03, 0.0])


def _days(count: int, rng: np.random.Generator, phi: float = 0.0) -> tuple[list[DayEstimate], np.ndarray]:
    """Days of one vehicle, and its true pose."""
    T = exp_se3(rng.normal(size=6))
    shared = rng.multivariate_normal(np.zeros(6), COMMON)
    e = rng.normal(size=(count, 6))
    for k in range(1, count):
        e[k] = phi * e[k - 1] + np.sqrt(1 - phi**2) * e[k]
    errors = e @ np.sqrt(VARYING) + shared
    seen = np.ones(6, bool)
    return [
        DayEstimate(f"2026-03-{k + 1:02d}", exp_se3(x) @ T, VARYING + COMMON, COMMON, seen)
        for k, x in enumerate(errors)
    ], T


@pytest.mark.parametrize(("days", "phi"), [(1, 0.0), (4, 0.0), (20, 0.0), (20, 0.6)])
def test_the_error_of_a_state_falls_with_its_days_as_its_sigma_says(days: int, phi: float) -> None:
    rng = np.random.default_rng(days)
    normalised, sigmas = [], []
    for _ in range(150):
        estimates, T = _days(days, rng, phi)
        found = fuse(estimates, autocorrelation=phi)
        assert found is not None
        error = log_se3(found.T @ inverse(T))
        normalised.append(error @ np.linalg.solve(found.covariance, error))
        sigmas.append(np.sqrt(np.diag(found.covariance)))
    assert np.mean(normalised) == pytest.approx(
        6, abs=0.95
    )  # chi-squared with 6 degrees of freedom, 4 sigmas
    alone = np.sqrt(np.diag(VARYING + COMMON))
    floor = np.sqrt(np.diag(COMMON))
    mean = np.mean(sigmas, axis=0)
    assert np.all(mean <= alone * 1.001)
    assert np.all(mean >= floor)
    if (days, phi) == (20, 0.0):
        np.testing.assert_allclose(mean, np.sqrt(np.diag(VARYING / 20 + COMMON)), rtol=0.03)


def test_no_day_makes_no_state_and_a_day_far_from_the_others_does_not_count() -> None:
    assert fuse([]) is None
    estimates, T = _days(7, np.random.default_rng(3))
    estimates[4] = replace(estimates[4], T=exp_se3(np.array([0, 0, 0.1, 0, 0, 0])) @ estimates[4].T)
    found = fuse(estimates)
    assert found is not None
    assert found.left_out == ("2026-03-05",)
    error = log_se3(found.T @ inverse(T)) / np.sqrt(np.diag(found.covariance))
    assert np.abs(error).max() < 4


def test_a_day_does_not_weigh_where_it_determined_nothing() -> None:
    estimates, _ = _days(6, np.random.default_rng(4))
    blind = np.array([True, False, True, True, True, True])
    prior = VARYING + COMMON
    prior[1, 1] = 0.04**2
    off = exp_se3(np.array([0, 0.04, 0, 0, 0, 0])) @ estimates[5].T
    common = prior.copy()  # what rests on the prior is the same every day
    common[[0, 2, 3, 4, 5], [0, 2, 3, 4, 5]] = np.diag(COMMON)[[0, 2, 3, 4, 5]]
    estimates[5] = DayEstimate("2026-03-06", off, prior, common, blind)
    five, six = fuse(estimates[:5]), fuse(estimates)
    assert five is not None
    assert six is not None
    assert abs(log_se3(six.T @ inverse(five.T))[1]) < 5e-4
    assert np.sqrt(six.covariance[1, 1]) == pytest.approx(np.sqrt(five.covariance[1, 1]), rel=0.1)


def _write(lake: Lake, records: list[CalibrationRecord], suffix: str = "") -> None:
    commit_records(lake, CALIBRATIONS, [replace(r, work_key=r.work_key + suffix) for r in records])


def _states(lake: Lake) -> dict[str, StateRow]:
    semantics = {"source": "topics", "labels": "/l", "detections": "/d"}
    rig = {"camera": {"image": "/i", "info": "/c", "semantics": semantics}}
    rig |= {"lidar": {"points": "/p"}, "radar": {"points": "/r"}}
    fleet = {"fleet": {"name": "test"}, "rigs": {"default": rig}, "vehicles": {"v": {}}}
    task = Task(FleetConfig.model_validate(fleet), lake, Window())
    AUDIT.run(task)
    return {row.pair: row for row in STATE.run(task).records}


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
    _write(lake, records)
    states = _states(lake)
    assert states["lidar_radar"].days == [_day(k) for k in (13, 14, 15, 16, 19, 20, 21)]
    assert "a change that the audit found since 2026-03-14" in states["lidar_radar"].reason
    assert len(states["camera_lidar"].days) == 19
    assert states["camera_lidar"].since is None
    assert states["camera_lidar"].determined == ["azimuth", "elevation"]
    event = ServiceEvent(vehicle="v", day=_day(21), sensor="all", kind="repair", note="", work_key="k")
    write_records(lake, SERVICE_EVENTS, [event], "k")
    states = _states(lake)
    assert {(s.status, tuple(s.days)) for s in states.values()} == {("none", ())}
    assert "no accepted day after the repair of all sensors on 2026-03-22" in states["lidar_radar"].reason


@pytest.mark.parametrize(("kind", "by"), [("repair", ""), ("re-alignment", " by its own software")])
def test_a_service_event_and_the_state_after_it_are_commands(
    kind: str, by: str, tmp_path: Path, maker: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    lake = Lake.at(tmp_path)
    _write(lake, maker.vehicle_records("v", 6, np.random.default_rng(6)))
    for day in (_day(2), _day(3)):
        assert service(lake=str(tmp_path), vehicle="v", day=day, kind=kind, sensor="radar") == 0
    _states(lake)
    capsys.readouterr()
    assert state(lake=str(tmp_path), vehicle="v", json=True) == 0
    found = {row["pair"]: row for row in json.loads(capsys.readouterr().out)}
    assert found["lidar_radar"]["days"] == [_day(4), _day(5)]
    assert f"{kind} of the radar{by} on 2026-03-04" in found["lidar_radar"]["reason"]
    assert len(found["camera_lidar"]["days"]) == 6
    assert np.shape(found["camera_lidar"]["T"]) == (4, 4)
    assert state(lake=str(tmp_path)) == 0
    assert "certified" in capsys.readouterr().out
