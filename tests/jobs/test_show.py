"""`boresight show`, for people and as JSON and nothing else, and `boresight status`."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jobs.show import show
from jobs.status import status
from pipeline.rig.se3 import from_quaternion
from pipeline.store.commits import commit_records
from pipeline.store.partitions import Lake
from schemas.calibrations import CALIBRATIONS
from schemas.outcomes import OUTCOMES, OutcomeRow
from schemas.poses import POSES
from tests.audit.fleet_records import vehicle_records
from tests.makers.lakes import write_records
from tests.makers.table_rows import make_row


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


def test_faults_of_records_are_said_in_plain_words_by_show_and_status(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
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
    printed = capsys.readouterr().out
    assert words in printed
    assert "│ camera_lidar │" in printed
    assert status(lake=str(tmp_path)) == 0
    assert "shifted" in capsys.readouterr().out
    assert status(lake=str(tmp_path), json=True) == 0
    summary = json.loads(capsys.readouterr().out)  # and nothing else
    assert summary["method"] == "joint"
    assert [day["faults"] for day in summary["days"]] == [["labels_offset"]]


@pytest.fixture
def lake(tmp_path):
    """Two days of one vehicle, the first calibrated twice; the second refused."""
    rng = np.random.default_rng(1)
    for key in ("first", "second"):
        rows = vehicle_records("v", 1, rng)
        write_records(Lake.at(tmp_path), CALIBRATIONS, rows, key)
    rows = [r for r in vehicle_records("v", 2, rng, status=lambda _: "refused") if r.day == "2026-03-02"]
    write_records(Lake.at(tmp_path), CALIBRATIONS, rows, "third")
    return tmp_path


def test_json_has_every_column_and_the_transform_as_a_matrix(lake, capsys):
    assert show("calibrations", lake=str(lake), json=True) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 9
    for row in rows:
        assert set(row) == {c.name for c in CALIBRATIONS.columns} | {"T"}
        if row["status"] == "refused":
            assert row["T"] is None
            continue
        q, t = [row[f"q{k}"] for k in "wxyz"], [row[f"t{k}_m"] for k in "xyz"]
        np.testing.assert_allclose(row["T"], from_quaternion(np.array(q), np.array(t)), atol=1e-12)
        assert np.shape(row["covariance"]) == (6, 6)


def test_filters_choose_vehicle_day_and_method(lake, capsys):
    for kwargs, count in (
        ({"vehicle": "v", "day": "2026-03-01"}, 6),
        ({"vehicle": "v", "day": "2026-03-01", "current": True}, 3),
        ({"method": "tracking"}, 0),
        ({"vehicle": "w"}, 0),
    ):
        assert show("calibrations", lake=str(lake), json=True, **kwargs) == 0
        assert len(json.loads(capsys.readouterr().out)) == count


def test_a_lake_without_records_is_an_empty_list(tmp_path, capsys):
    for table in ("calibrations", "drift", "moments", "perceived"):
        assert show(table, lake=str(tmp_path), json=True) == 0
        assert json.loads(capsys.readouterr().out) == []
        assert show(table, lake=str(tmp_path)) == 0
        assert capsys.readouterr().out == f"{table}: no matching rows in {tmp_path}\n"
