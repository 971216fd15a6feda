"""`boresight show` and `boresight status` on tables that are not calibrations."""

import json
from dataclasses import replace

import numpy as np

from jobs.show import show
from jobs.status import status
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.poses import POSES
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from tests.audit.fleet_records import vehicle_records
from tests.makers.table_rows import make_row


def test_every_record_table_is_shown_for_people_and_for_machines(tmp_path, capsys):
    lake = Lake.at(tmp_path)
    of = {"vehicle": "car", "day": "2026-03-02"}
    refused = OutcomeRow(**of, stage="ingest", method="", status="refused", reason="no [radar]", work_key="k")
    commit_records(lake, OUTCOMES, [refused])
    commit_records(
        lake, SERVICE_EVENTS, [ServiceEvent(**of, sensor="radar", kind="repair", note="new bracket")]
    )
    for table, column, value in (
        ("outcomes", "reason", "no [radar]"),
        ("service_events", "note", "new bracket"),
    ):
        assert show(table, lake=str(tmp_path)) == 0
        assert value in capsys.readouterr().out
        assert show(table, lake=str(tmp_path), vehicle="car", json=True) == 0
        [row] = json.loads(capsys.readouterr().out)
        assert row[column] == value
        assert show(table, lake=str(tmp_path), vehicle="bus", json=True) == 0
        assert json.loads(capsys.readouterr().out) == []


def test_poses_are_shown_with_their_transform_and_the_current_one_alone_where_asked(tmp_path, capsys):
    rng = np.random.default_rng(0)
    quaternion = {"qw": 0.0, "qx": 0.0, "qy": 0.0, "qz": 1.0, "tx_m": 1.0, "ty_m": 2.0, "tz_m": 3.0}
    common = {"vehicle": "car", "day": "2026-03-02", "reference": "top", "recorded_at": "", "asserted_at": ""}
    for key, sensor in (("A", "front"), ("B", "front"), ("A", "left")):
        row = make_row("poses", rng, **common, sensor=sensor, work_key=key, method="joint", **quaternion)
        commit_records(Lake.at(tmp_path), POSES, [row])
    assert show("poses", lake=str(tmp_path), vehicle="car", day="2026-03-02", current=True, json=True) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(r["sensor"], r["work_key"]) for r in rows] == [("front", "B"), ("left", "A")]
    assert rows[0]["T"] == [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    asked = {"sensor", "reference", "covariance", "status", "reason", "determined", "dt_s", "edges"}
    assert asked | {"azimuth_sigma_rad", "elevation_sigma_rad"} <= rows[0].keys()
    assert show("poses", lake=str(tmp_path)) == 0
    assert "front" in capsys.readouterr().out


def test_faults_of_records_are_said_in_plain_words_by_show_and_status(tmp_path, capsys):
    rng = np.random.default_rng(1)
    held = [
        replace(r, status="held", faults=["labels_offset"] if r.pair == "camera_lidar" else [])
        for r in vehicle_records("car", 1, rng)
    ]
    lake = Lake.at(tmp_path)
    commit_records(lake, CALIBRATIONS, held)
    row = OutcomeRow(
        vehicle="car", day=held[0].day, stage="calibrate", method="joint", status="done",
        reason="sky beside roofs", work_key="k", kept={"held": 3},
        faults=["labels_offset"],
    )  # fmt: skip
    commit_records(lake, OUTCOMES, [row])
    words = "semantic labels are shifted"
    assert show("calibrations", lake=str(tmp_path)) == 0
    assert words in " ".join(capsys.readouterr().out.split())
    assert status(lake=str(tmp_path), json=True) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary["method"] == "joint"
    assert [day["faults"] for day in summary["days"]] == [["labels_offset"]]
