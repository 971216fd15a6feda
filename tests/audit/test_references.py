"""Fixed references that states keep: the same findings, without reading a vehicle's first days again."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.audit import history
from pipeline.audit.estimates import day_name as name_of
from pipeline.audit.references import read_kept
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.rig.graph import EDGE_OF_PAIR
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.service_events import ServiceEvent
from schemas.states import STATES, StateRow
from tests.audit.fleet_records import vehicle_records
from tests.audit.test_audit_fleet import KNOCK, day_name, fleet_config

CAMERA_LIDAR = EDGE_OF_PAIR["camera_lidar"]
DAYS = 60
LAST = DAYS - 1


def night_of(day):
    return f"{day}T23:00:00.000000Z"


@pytest.fixture
def bare(tmp_path):
    """A knocked vehicle, a good one that was held at times, two that joined one and two weeks ago; two months."""
    rng = np.random.default_rng(41)
    rows = vehicle_records("a", DAYS, rng, status=lambda d: "held" if d % 7 == 3 else "accepted")
    rows += vehicle_records("b", DAYS, rng, motion=lambda d: {"radar": KNOCK} if d > 50 else {})
    rows += [r for r in vehicle_records("c", DAYS, rng) if r.day >= day_name(54)]
    knocked = lambda d: {"radar": KNOCK} if d > 46 else {}  # noqa: E731
    rows += [r for r in vehicle_records("d", DAYS, rng, motion=knocked) if r.day >= day_name(44)]
    lake = Lake.at(tmp_path / "bare")
    commit_records(lake, CALIBRATIONS, [replace(r, recorded_at=night_of(r.day)) for r in rows])
    return lake


@pytest.fixture
def lake(tmp_path, bare):
    """The same, with the states of the night before."""
    STATE.run(Task(fleet_config(), bare, Window(None, day_name(LAST - 1))))
    lake, stamp = Lake.at(tmp_path / "kept"), night_of(day_name(LAST - 1))
    rows = read_records(bare, CALIBRATIONS, CalibrationRecord)
    commit_records(lake, CALIBRATIONS, [replace(r, asserted_at="") for r in rows])
    states = read_records(bare, STATES, StateRow)
    commit_records(lake, STATES, [replace(s, recorded_at=stamp, asserted_at=stamp) for s in states])
    return lake


def audited(lake):
    return AUDIT.run(Task(fleet_config(), lake, Window())).records


def kept(lake, events=(), count=10):
    return read_kept(lake, "joint", (day_name(LAST - 27), day_name(LAST)), {"a": events}, count)


def test_a_night_reads_its_window_alone_and_finds_what_it_would_find_from_the_first_days(
    lake, bare, tmp_path, monkeypatch
):
    expected, spans, real = audited(without_states(bare, tmp_path)), [], history.read_columns

    def spy(*arguments, first, last, **more):
        spans.append((first, last, more.get("vehicle")))
        return real(*arguments, first=first, last=last, **more)

    monkeypatch.setattr(history, "read_columns", spy)
    told = audited(lake)
    whole = {(first, last) for first, last, vehicle in spans if vehicle is None and last is not None}
    assert whole == {(day_name(LAST - 27), day_name(LAST))}
    assert {v for _, _, vehicle in spans for v in vehicle or ()} <= {"c"}  # which drove on few days
    assert {f.vehicle for f in told if f.status == "RED"} == {"b", "d"}
    for a, b in zip(expected, told, strict=True):
        for name in ("vehicle", "pair", "dof", "status", "reason", "start_day", "days_used"):
            assert getattr(a, name) == getattr(b, name)
        assert b.statistic == (None if a.statistic is None else pytest.approx(a.statistic, rel=1e-6))


def without_states(bare, tmp_path):
    lake = Lake.at(tmp_path / "without")
    commit_records(lake, CALIBRATIONS, read_records(bare, CALIBRATIONS, CalibrationRecord))
    return lake


def test_states_keep_the_first_accepted_days_and_from_the_tenth_on_what_they_make(lake):
    found = kept(lake)
    assert set(found) == {(v, edge) for v in "abcd" for edge in EDGE_OF_PAIR.values()}
    a, c, d = found["a", CAMERA_LIDAR], found["c", CAMERA_LIDAR], found["d", EDGE_OF_PAIR["lidar_radar"]]
    assert a.days == tuple(day_name(d) for d in range(12) if d % 7 != 3)
    assert [name_of(d) for d in a.reference.days] == list(a.days)
    assert (c.days, c.reference) == (tuple(day_name(d) for d in range(54, LAST)), None)
    assert [name_of(day) for day in d.reference.days] == [day_name(k) for k in (44, 45, 46)]  # until it moved


def test_what_is_kept_no_longer_counts_after_a_service_event_another_setting_or_another_record(lake):
    assert kept(lake, count=9) == {}
    event = ServiceEvent(vehicle="a", day=day_name(20), sensor="radar", kind="re-mount")
    assert {p for v, p in kept(lake, [event]) if v == "a"} == {CAMERA_LIDAR}  # not concerned
    whole = kept(lake)["d", CAMERA_LIDAR]
    for vehicle, day in (("a", day_name(2)), ("d", day_name(46))):
        old = next(iter(read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle, day=day)))
        commit_records(lake, CALIBRATIONS, [replace(old, work_key="again", recorded_at="", asserted_at="")])
    found = kept(lake)
    assert {v for v, _ in found} == {"b", "c", "d"}
    again = found["d", CAMERA_LIDAR]  # one of its own days, which are read anyway
    assert (again.days, again.reference, whole.reference is None) == (whole.days, None, False)


def test_the_states_of_every_night_keep_the_same_reference(lake):
    before = kept(lake)
    STATE.run(Task(fleet_config(), lake, Window()))
    after = read_kept(lake, "joint", (day_name(LAST - 27), day_name(LAST)), {}, 10)
    for key, own in before.items():
        assert after[key].days[: len(own.days)] == own.days
        if own.reference is not None:
            np.testing.assert_array_equal(after[key].reference.spread, own.reference.spread)
            np.testing.assert_allclose(after[key].reference.T, own.reference.T, atol=1e-15)
    assert len(after["c", CAMERA_LIDAR].days) == len(before["c", CAMERA_LIDAR].days) + 1
