"""The status of a vehicle: what the rule in its docstring says, chart by chart."""

from dataclasses import replace

import pytest

from pipeline.audit.findings import decide_status
from schemas.calibrations import DOF_NAMES, FRAMES_OF_PAIR, PAIRS
from schemas.drift import DriftFinding, status_of

WATCHED = {("camera_lidar", "rx"), ("camera_lidar", "ry"), ("lidar_radar", "rz")}


def charts(**changes):
    """Rows of a vehicle: GREEN on the charts that a night on the road determines, UNKNOWN on the others."""
    same = {"vehicle": "v", "day": "2026-03-09", "method": "joint", "reason": "no change", "days_used": 9,
            "limit": 0.002}  # fmt: skip
    rows = {}
    for pair, (parent, child) in FRAMES_OF_PAIR.items():
        for dof in DOF_NAMES:
            status = "GREEN" if (pair, dof) in WATCHED else "UNKNOWN"
            about = {"pair": pair, "dof": dof, "parent_frame": parent, "child_frame": child, "status": status,
                     "days_needed": None if status == "GREEN" else 99}  # fmt: skip
            rows[f"{pair}_{dof}"] = DriftFinding(**same | about)
    assert len(rows) == 6 * len(PAIRS)
    return list((rows | {name: replace(rows[name], **fields) for name, fields in changes.items()}).values())


def alarm(status, **fields):
    change = {"start_day": "2026-03-05", "kind": "step", "statistic": 9.0, "threshold": 4.0}
    return {"status": status, "reason": "why"} | change | fields


UNSEEN = {"status": "UNKNOWN", "reason": "why not", "days_needed": 4}
CLEAREST = {
    "camera_lidar_rx": alarm("YELLOW", moved_sensor="camera", statistic=90.0),
    "lidar_radar_rz": alarm("RED", moved_sensor="radar", start_day="2026-03-06"),
    "lidar_radar_tx": alarm(
        "RED", moved_sensor="radar", start_day="2026-03-07", statistic=50.0, threshold=40.0
    ),
    "camera_radar_ry": alarm("RED", statistic=50.0),
}


@pytest.mark.parametrize(
    ("changes", "status", "sensor", "words"),
    [
        ({}, "GREEN", None, "no sensor moved: 3 of 18 charts exclude a change above the limit, enough"),
        ({"camera_lidar_rx": UNSEEN}, "UNKNOWN", None, "camera-lidar pitch: why not; 16 of 18 charts"),
        ({"camera_lidar_ry": UNSEEN}, "UNKNOWN", None, "whether camera or lidar turned"),
        ({"lidar_radar_rz": UNSEEN}, "UNKNOWN", None, "whether radar turned"),
        (
            {"camera_lidar_rx": UNSEEN, "lidar_radar_rz": UNSEEN}, "UNKNOWN", None,
            "whether camera or lidar and radar turned",
        ),
        (  # since a repair of the radar
            {"camera_lidar_rx": UNSEEN, "lidar_radar_rz": UNSEEN | {"days_used": 0}}, "UNKNOWN", None,
            "lidar-radar yaw: why not",
        ),
        # Radar yaw may be watched from the camera instead.
        ({"lidar_radar_rz": UNSEEN, "camera_radar_ry": {"status": "GREEN"}}, "GREEN", None, ""),
        ({"camera_lidar_tz": alarm("YELLOW")}, "YELLOW", None, "2026-03-05"),
        ({"camera_lidar_tz": alarm("YELLOW", statistic=90.0), "lidar_radar_rz": alarm("RED")}, "RED", None, ""),
        (CLEAREST, "RED", "radar", "the radar moved on 2026-03-06: why"),
    ],
)  # fmt: skip
def test_a_vehicle_is_as_its_clearest_alarm_and_green_where_every_turn_would_show(
    changes, status, sensor, words
):
    found = decide_status(charts(**changes))
    assert (found.status, found.sensor) == (status, sensor)
    assert words in found.reason
    assert (found.since is not None) == (status in ("RED", "YELLOW"))


@pytest.mark.parametrize(
    ("changes", "days"),
    [
        ({}, None),
        ({"camera_lidar_rx": UNSEEN}, 4),
        ({"camera_lidar_rx": UNSEEN, "camera_lidar_ry": UNSEEN | {"days_needed": 6}}, 6),  # both are needed
        ({"camera_lidar_rx": UNSEEN, "lidar_radar_rz": UNSEEN | {"days_needed": 7}}, 7),
        # The camera shows the radar's yaw first.
        ({"lidar_radar_rz": UNSEEN | {"days_needed": 7}, "camera_radar_ry": UNSEEN | {"days_needed": 2}}, 2),
        ({"lidar_radar_tz": UNSEEN}, None),  # GREEN depends on no height
        ({"camera_lidar_tz": alarm("YELLOW", days_needed=1)}, 1),
    ],
)
def test_a_vehicle_lacks_the_days_of_the_charts_that_its_status_depends_on(changes, days):
    assert decide_status(charts(**changes)).days_needed == days


def test_one_day_is_too_little_data():
    rows = [replace(f, status="UNKNOWN", days_used=1) for f in charts()]
    assert decide_status(rows).status == decide_status([]).status == "UNKNOWN"
    assert status_of([]).reason == "no audit yet"
