"""The state of an earlier day: the last accepted one before today, of this vehicle and method, damage aside."""

import pyarrow.parquet as pq
import pytest

from pipeline.calibrate.stage import accepted_before
from pipeline.rig.edges import EDGE_OF_PAIR
from pipeline.rig.se3 import to_quaternion
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.makers.lakes import write_records
from tests.makers.solve_scenes import T_CAMERA_LIDAR

CAMERA_LIDAR = EDGE_OF_PAIR["camera_lidar"]


def record(day, shift_m, status="accepted", method="joint", pair="camera_lidar"):
    qw, qx, qy, qz = (float(v) for v in to_quaternion(T_CAMERA_LIDAR))
    parent, child = pair.split("_")
    tx, ty, tz = (float(v) for v in T_CAMERA_LIDAR[:3, 3] + [shift_m, 0, 0])
    return CalibrationRecord(
        vehicle="v", day=day, method=method, pair=pair, parent_frame=parent, child_frame=child,
        status=status, reason="", work_key=f"{day}{method}{pair}{status}", code_version="0", seed=0,
        qw=qw, qx=qx, qy=qy, qz=qz, tx_m=tx, ty_m=ty, tz_m=tz,
    )  # fmt: skip


@pytest.fixture
def lake(tmp_path):
    lake = Lake.at(tmp_path)
    rows = [
        record("2026-03-01", 0.1),
        record("2026-03-02", 0.2, status="held"),
        record("2026-03-02", 0.3, pair="lidar_radar"),
        record("2026-03-03", 0.4, method="tracking"),
        record("2026-03-05", 0.5),
    ]
    for row in rows:
        write_records(lake, CALIBRATIONS, [row], row.work_key)
    return lake


def shift_of(lake, day, method="joint"):
    found = accepted_before(lake, Partition("v", day), method, CAMERA_LIDAR)
    return None if found is None else round(float(found[0, 3] - T_CAMERA_LIDAR[0, 3]), 6)


def test_the_last_accepted_camera_lidar_before_the_day_is_taken(lake):
    assert shift_of(lake, "2026-03-04") == 0.1  # the second was held, the third is another method's
    assert shift_of(lake, "2026-03-06") == 0.5
    assert shift_of(lake, "2026-03-05") == 0.1  # not the day's own
    assert shift_of(lake, "2026-03-04", "tracking") == 0.4


def test_a_vehicle_without_an_accepted_day_has_none(lake):
    assert shift_of(lake, "2026-03-01") is None
    assert accepted_before(lake, Partition("w", "2026-03-06"), "joint", CAMERA_LIDAR) is None


def test_a_damaged_record_of_another_day_costs_that_day_only(lake):
    days = {
        p: pq.read_table(p, columns=["day"], partitioning=None)
        for p in lake.root.glob("calibrations/*/*.parquet")
    }
    for path in (p for p, rows in days.items() if rows["day"][0].as_py() == "2026-03-05"):
        path.write_bytes(path.read_bytes()[:100])
    assert shift_of(lake, "2026-03-06") == 0.1
