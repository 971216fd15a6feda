"""Which three sensors a method works on, and the state of an earlier day."""

import pyarrow.parquet as pq
import pytest

from pipeline.calibrate.stage import accepted_before, three_sensors
from pipeline.core.config import FleetConfig
from pipeline.core.errors import SolveError
from pipeline.rig.graph import EDGE_OF_PAIR
from pipeline.rig.overlap import overlaps_of
from pipeline.rig.se3 import to_quaternion
from pipeline.store.partitions import Lake, Partition
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from tests.makers.lakes import write_records
from tests.makers.solve_scenes import T_CAMERA_LIDAR
from tests.rig.test_overlap import VAN, rig


def config(sensors=VAN, **keys):
    values = {"cameras": {}, "lidars": {}, "radars": {}} | keys
    for name, kind, *_ in sensors:
        camera = {"image": f"/{name}", "info": f"/{name}/info"}
        values[f"{kind}s"][name] = camera if kind == "camera" else {"points": f"/{name}"}
    return FleetConfig.model_validate({"fleet": {"name": "f"}, "rigs": {"van": values}}).rigs["van"]


def names(method, rig, overlaps):
    return {s.kind: s.name for s in three_sensors(method, rig, overlaps)}


def test_the_three_that_share_most_are_taken_unless_the_rig_names_others():
    overlaps = overlaps_of(*rig())
    assert names("tracking", config(), overlaps) == {"camera": "front", "lidar": "top", "radar": "ahead"}
    few = [s for s in VAN if s[0] in ("front", "top")]  # of which nothing is asked
    assert names("tracking", config(few), []) == {"camera": "front", "lidar": "top"}
    named = config(three=["left", "top", "fl"])
    assert names("tracking", named, overlaps) == {"camera": "left", "lidar": "top", "radar": "fl"}


def test_three_that_share_nothing_are_refused_in_one_sentence():
    with pytest.raises(
        SolveError,
        match=r"^method tracking works on .*: left, top and rr do not: name others as `three` of the rig$",
    ):
        three_sensors("tracking", config(three=["left", "top", "rr"]), overlaps_of(*rig()))
    blind = [s for s in VAN if s[1] != "camera"]
    with pytest.raises(SolveError, match="the rig has no such three"):
        three_sensors("tracking", config(blind), overlaps_of(*rig(blind)))


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
    assert shift_of(lake, "2026-03-01") is None
    assert accepted_before(lake, Partition("w", "2026-03-06"), "joint", CAMERA_LIDAR) is None


def test_a_damaged_record_of_another_day_costs_that_day_only(lake):
    for path in lake.root.glob("calibrations/*/*.parquet"):
        if pq.read_table(path, columns=["day"], partitioning=None)["day"][0].as_py() == "2026-03-05":
            path.write_bytes(path.read_bytes()[:100])
    assert shift_of(lake, "2026-03-06") == 0.1
