"""What a vehicle should load, by the commands: the days since a sensor moved, and its prior without any."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from jobs.service import service
from jobs.show import show
from jobs.state import state
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, STATE
from pipeline.export.lake import pairs_of
from pipeline.store.commits import commit_records
from pipeline.store.corrections import read_sign_offs
from pipeline.store.current import transform_of
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.poses import POSES
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from tests.audit.fleet_records import T_CAMERA_LIDAR, T_LIDAR_RADAR, poses_of, vehicle_records
from tests.audit.test_audit_fleet import day_name, fleet_config, knocked


def write(lake, records, common=None):
    if common is not None:
        records = [r if r.covariance is None else replace(r, common_covariance=common) for r in records]
    commit_records(lake, CALIBRATIONS, records)
    commit_records(lake, POSES, poses_of(records))


def states_of(lake):
    """Rows by sensor, or by pair, after an audit."""
    task = Task(fleet_config("v"), lake, Window())
    AUDIT.run(task)
    return {row.sensor or row.pair: row for row in STATE.run(task).records}


def test_a_state_rests_on_the_accepted_days_since_the_last_change(lake):
    status = {3: "held", 17: "held", 18: "refused"}
    of_day = lambda d: status.get(d, "accepted")  # noqa: E731
    records = vehicle_records("v", 22, np.random.default_rng(5), motion=knocked(13), status=of_day)
    write(lake, records, np.diag([1e-4] * 3 + [5e-3] * 3) ** 2)
    states = states_of(lake)
    days = [day_name(k) for k in (13, 14, 15, 16, 19, 20, 21)]
    assert states["radar"].days == states["lidar_radar"].days == days
    assert "since 2026-03-14: radar moved" in states["radar"].reason
    assert len(states["camera"].days) == len(states["camera_lidar"].days) == 19
    assert states["camera_lidar"].since is None
    assert states["camera_lidar"].determined == states["camera"].determined == ["azimuth", "elevation"]
    event = ServiceEvent(vehicle="v", day=day_name(21), sensor="all", kind="repair", note="", work_key="k")
    commit_records(lake, SERVICE_EVENTS, [event])
    states = states_of(lake)
    others = [s for name, s in states.items() if name != "lidar"]
    assert {(s.status, tuple(s.days), tuple(s.determined)) for s in others} == {("prior", (), ())}
    assert "no usable day after the repair of all sensors on 2026-03-22" in states["radar"].reason
    for pair, T in (("camera_lidar", T_CAMERA_LIDAR), ("lidar_radar", T_LIDAR_RADAR)):
        np.testing.assert_allclose(transform_of(states[pair]), T, atol=1e-12)


def test_a_vehicle_whose_days_scatter_more_than_they_say_has_a_state_as_unsure_as_it_scatters(tmp_path):
    sigma = {}
    for noise in (1.0, 3.0):
        lake = Lake.at(tmp_path / str(noise))
        records = vehicle_records("v", 40, np.random.default_rng(8), noise=noise)
        write(lake, records, np.diag([1e-5] * 3 + [1e-3] * 3) ** 2)
        sigma[noise] = {n: s.azimuth_sigma_rad for n, s in states_of(lake).items() if s.sensor is None}
    # Tomorrow lies as far off as the days scatter: by three times what they state, of which the mean of 40 is free.
    for pair, stated in sigma[1.0].items():
        assert 1.8 < sigma[3.0][pair] / stated < 4.0, pair


@pytest.mark.parametrize(("kind", "by"), [("repair", ""), ("re-alignment", " by its own software")])
def test_a_service_event_and_the_state_after_it_are_commands(kind, by, lake, capsys):
    write(lake, vehicle_records("v", 6, np.random.default_rng(6)))
    for day in (day_name(2), day_name(3)):
        assert service(lake=str(lake.root), vehicle="v", day=day, kind=kind, sensor="radar") == 0
    states_of(lake)
    capsys.readouterr()
    assert state(lake=str(lake.root), vehicle="v", json=True) == 0
    found = {row["sensor"] or row["pair"]: row for row in json.loads(capsys.readouterr().out)}
    assert found["lidar_radar"]["days"] == [day_name(4), day_name(5)]
    assert f"{kind} of the radar{by} on 2026-03-04" in found["lidar_radar"]["reason"]
    assert len(found["camera_lidar"]["days"]) == 6
    assert found["camera_lidar"]["in_words"].startswith("used: pitch, yaw, roll")
    assert np.shape(found["camera_lidar"]["T"]) == (4, 4)
    assert state(lake=str(lake.root)) == 0
    assert "certified" in capsys.readouterr().out


def test_a_state_is_signed_off_and_rolled_back_and_every_step_stays_recorded(lake, capsys):
    where, records = str(lake.root), vehicle_records("v", 12, np.random.default_rng(6))
    of_day = {}
    for days in (6, 12):
        write(lake, [r for r in records if r.day < day_name(days)])
        of_day[days] = transform_of(states_of(lake)["radar"])
        if days == 6:
            with pytest.raises(ConfigError, match="no state of v is signed off"):
                state(lake=where, vehicle="v", previous=True)
        assert state(lake=where, vehicle="v", sign_off="anna") == 0
    assert not np.allclose(of_day[6], of_day[12], atol=1e-6)

    def signed():
        found = pairs_of(lake, "v", None, "joint", is_signed=True)
        return next(pair.T for edge, pair in found.items() if edge.kind == "lidar_radar")

    assert np.array_equal(signed(), of_day[12])
    assert state(lake=where, vehicle="v", previous=True, sign_off="ben", note="roll back") == 0
    assert np.array_equal(signed(), of_day[6])
    assert state(lake=where, vehicle="v", sign_off="anna") == 0  # the same state a second time
    assert np.array_equal(signed(), of_day[12])
    kept = [(s.signed_by, s.day, s.note) for s in read_sign_offs(lake, "joint")]
    first, last = day_name(5), day_name(11)
    notes = [("anna", first, ""), ("anna", last, ""), ("ben", first, "roll back"), ("anna", last, "")]
    assert kept == notes
    capsys.readouterr()
    assert state(lake=where, json=True) == 0
    assert {row["signed_by"] for row in json.loads(capsys.readouterr().out)} == {"anna"}
    for wrong in ({"sign_off": "anna"}, {"vehicle": "v", "sign_off": " "}):
        with pytest.raises(ConfigError):
            state(lake=where, **wrong)


def test_a_service_event_is_withdrawn_and_an_impossible_one_is_refused(lake, capsys):
    records = vehicle_records("v", 20, np.random.default_rng(22), motion=knocked(10))
    commit_records(lake, CALIBRATIONS, records)
    where = str(lake.root)
    event = {"lake": where, "vehicle": "v", "day": "2026-03-15", "kind": "repair", "sensor": "radar"}
    for wrong, words in (
        ({"vehicle": "vehicle-22"}, "the lake has no day of 'vehicle-22'; it has v"),
        ({"day": "2036-03-04"}, "2036-03-04 is in the future"),
        ({"withdraw": True}, "v has no such event; it has: none"),
        ({"sensor": "left"}, "v has no 'left'; its records are about camera, lidar, radar"),
    ):
        with pytest.raises(ConfigError, match=re.escape(words)):
            service(**event | wrong)
    for noted, status in (({}, "GREEN"), ({"withdraw": True}, "RED"), ({}, "GREEN")):
        assert service(**event | noted) == 0
        found = AUDIT.run(Task(fleet_config("v"), lake, Window())).records
        assert {f.vehicle_status for f in found} == {status}
    capsys.readouterr()
    assert show("service_events", lake=where, current=True, json=True) == 0
    assert [row["withdrawn"] for row in json.loads(capsys.readouterr().out)] == [False]
