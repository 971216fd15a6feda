"""The study of the basin: what counts as found, and that nothing lost or wrong is left unnamed."""

from tests.benchmarks.studies.basin import by_start, in_basin, summary
from tests.benchmarks.studies.days import SETS


def result(camera_az_deg, radar_az_deg, status="accepted"):
    def pair(az_deg):
        vouched = {"vouched_az": 1.0, "vouched_el": 0.0}
        known = [1] * 6
        return {
            "az_deg": az_deg,
            "el_deg": 0.1,
            "status": status,
            "observable": known,
            "diagnostics": vouched,
        }

    pairs = {
        "camera_lidar": pair(camera_az_deg),
        "camera_radar": pair(0.1),
        "lidar_radar": pair(radar_az_deg),
    }
    day = {"rig": "demo", "environment": "urban", "seed": 1, "fault": ""}
    return {"prior": ["hidden", 5.0, 0.05], "pairs": pairs, "day": day}


def test_a_radar_is_found_by_its_azimuth_and_a_camera_by_both_angles():
    measured = {"az_deg": 0.1, "el_deg": 0.9}
    assert in_basin("lidar_radar", measured)
    assert not in_basin("camera_lidar", measured)
    assert not in_basin("camera_lidar", {})  # refused


def test_what_is_lost_or_accepted_and_wrong_is_counted_and_named():
    text = summary([result(0.05, 0.05), result(3.0, 0.05), result(0.05, 4.0, "held")])
    assert "| 5 deg / 0.05 m, hidden | 3 |" in text
    assert "1 of 6 |" in text  # of the accepted records one is wrong; what was held is not wrong
    assert "camera_lidar 3.00/0.10 accepted" in text
    assert "lidar_radar 4.00/0.10 held" in text


def test_exact_starts_are_counted_by_size_and_frames_and_right_ends_in_doubt_are_told():
    found, doubted = result(0.05, 0.05), result(0.05, 0.05, "held")
    doubted["pairs"]["camera_lidar"]["reason"] = "another end of the search fits the frames as well"
    lost = result(3.0, 0.05)
    runs = [r | {"select": {"frames": frames}} for r, frames in ((found, 100), (doubted, 10), (lost, 10))]
    text = by_start(runs)
    assert "| 5 deg, 100 frames | 1 | 1/1 (100.0 %) | 1/1 (100.0 %) | 0/1 (0.0 %) | 0/1 (0.0 %) |" in text
    assert "| 5 deg, 10 frames | 2 | 1/2 (50.0 %) | 1/2 (50.0 %) | 1/2 (50.0 %) | 1/2 (50.0 %) |" in text
    assert "camera_lidar 3.00/0.10 accepted" in text


def test_no_seed_of_the_sets_is_used_twice():
    for name in ("basin", "basin-starts"):
        assert len({day.seed for day in SETS[name]}) == len(SETS[name])
