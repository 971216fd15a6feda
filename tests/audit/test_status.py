"""The status of a vehicle: what the rule in its docstring says, chart by chart."""

from dataclasses import replace

import pytest

from pipeline.audit.status import decide_status
from schemas.calibrations import DOF_NAMES, FRAMES_OF_PAIR, PAIRS
from schemas.drift import DriftFinding, status_of

WATCHED = {("camera_lidar", "rx"), ("camera_lidar", "ry"), ("lidar_radar", "rz")}


def charts(**changes):
    """Rows of a vehicle: GREEN on the charts that a night on the road determines, UNKNOWN on the others."""
    rows = {}
    for pair in PAIRS:
        for dof in DOF_NAMES:
            status = "GREEN" if (pair, dof) in WATCHED else "UNKNOWN"
            rows[pair, dof] = DriftFinding(
                vehicle="v",
                day="2026-03-09",
                method="joint",
                pair=pair,
                parent_frame=FRAMES_OF_PAIR[pair][0],
                child_frame=FRAMES_OF_PAIR[pair][1],
                dof=dof,
                status=status,
                reason="no change",
                days_used=9,
                limit=0.002,
            )
    for name, fields in changes.items():
        pair, dof = name.rsplit("_", 1)
        rows[pair, dof] = replace(rows[pair, dof], **fields)
    return list(rows.values())


def alarm(status, **fields):
    change = {"start_day": "2026-03-05", "kind": "step", "statistic": 9.0, "threshold": 4.0}
    return {"status": status, "reason": "why"} | change | fields


def test_a_vehicle_is_green_although_charts_of_what_the_road_does_not_determine_say_unknown():
    found = decide_status(charts())
    assert (found.status, found.sensor, found.since) == ("GREEN", None, None)
    assert found.reason == "no sensor moved (3 of 18 charts would show a change that matters)"


@pytest.mark.parametrize("missing", sorted(WATCHED))
def test_a_chart_on_which_a_turn_could_hide_makes_the_vehicle_unknown_and_names_the_sensor(missing):
    found = decide_status(charts(**{"_".join(missing): {"status": "UNKNOWN", "reason": "what could hide"}}))
    assert found.status == "UNKNOWN"
    assert ("radar" if missing[0] == "lidar_radar" else "camera or lidar") in found.reason
    assert f"{missing[0]} {missing[1]}: what could hide" in found.reason


def test_radar_yaw_may_be_watched_from_the_camera_instead():
    found = decide_status(charts(lidar_radar_rz={"status": "UNKNOWN"}, camera_radar_ry={"status": "GREEN"}))
    assert found.status == "GREEN"


def test_one_red_chart_is_enough_and_yellow_is_less_than_red():
    assert decide_status(charts(camera_lidar_tz=alarm("YELLOW"))).status == "YELLOW"
    both = charts(camera_lidar_tz=alarm("YELLOW", statistic=90.0), lidar_radar_rz=alarm("RED"))
    assert decide_status(both).status == "RED"


def test_sensor_day_and_reason_are_those_of_the_clearest_alarm():
    found = decide_status(
        charts(
            camera_lidar_rx=alarm("YELLOW", moved_sensor="camera", statistic=90.0),
            lidar_radar_rz=alarm("RED", moved_sensor="radar", start_day="2026-03-06"),
            lidar_radar_tx=alarm("RED", moved_sensor="radar", start_day="2026-03-07", statistic=5.0),
            camera_radar_ry=alarm("RED", statistic=50.0),
        )
    )
    assert (found.sensor, found.since) == ("radar", "2026-03-06")
    assert found.reason == "the radar moved on 2026-03-06: why"


def test_a_change_of_no_clear_sensor_names_none():
    found = decide_status(charts(lidar_radar_rz=alarm("RED", kind="slow drift")))
    assert (found.status, found.sensor) == ("RED", None)
    assert found.reason == "something changed on 2026-03-05: why"


def test_one_day_is_too_little_data():
    rows = [replace(f, status="UNKNOWN", days_used=1) for f in charts()]
    assert decide_status(rows).reason.startswith("too little data")
    assert decide_status([]).status == "UNKNOWN"
    assert status_of([]).reason == "no audit yet"
