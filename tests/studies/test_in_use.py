"""The study of `verify` counts what the command would answer."""

from tests.benchmarks.studies.in_use import answer_of_log, summary


def result(off_deg, camera="pass", radar="pass"):
    axes = {"azimuth": [camera, 0.0, 0.0, 1.0], "elevation": ["pass", 0.0, 0.0, 1.0]}
    of_radar = {"azimuth": [radar, 0.0, 0.0, 1.0], "elevation": ["inconclusive", 0.0, 0.0, 0.5]}
    pairs = {"camera_lidar": axes, "lidar_radar": of_radar, "camera_radar": of_radar}
    return {"prior": ["in use", off_deg, 0.0], "pairs": {pair: {"in_use": of} for pair, of in pairs.items()}}


def test_a_log_fails_where_an_axis_does_and_a_radar_may_leave_its_elevation_open():
    assert answer_of_log(result(0.0)) == "pass"
    assert answer_of_log(result(0.5, camera="fail")) == "fail"
    assert answer_of_log(result(0.0, radar="inconclusive")) == "inconclusive"
    assert answer_of_log({"prior": ["in use", 0.0, 0.0], "pairs": {}}) == "inconclusive"


def test_the_table_counts_right_and_wrong_calibrations_apart():
    table = summary([result(0.0), result(0.0, camera="inconclusive"), result(0.5, camera="fail")])
    assert "| camera_lidar | right | 2 | 1 (50.0%) | 0 (0.0%) | 1 (50.0%) |" in table
    assert "| the log | wrong | 1 | 0 (0.0%) | 1 (100.0%) | 0 (0.0%) |" in table
