"""Which frames are chosen, which are held out, and what is said about the others."""

import numpy as np
import pytest

from pipeline.config import SelectConfig
from pipeline.errors import SolveError
from pipeline.solve.select import MIN_FRAMES, hold_out, missing_content, select_frames, unmet_conditions
from schemas.calibrations import PAIRS
from tests.solve_scenes import make_day

CONFIG = SelectConfig(frames=30)


@pytest.fixture(scope="module")
def day():
    return make_day(60, per_drive=20)


def test_every_condition_of_the_paper_is_named_when_it_is_missed(day):
    frame = day[0]
    assert unmet_conditions(frame, "camera_lidar", CONFIG) == []
    late = frame.stamp_ns + 6_000_000
    assert unmet_conditions(make_changed(frame, camera_stamp_ns=late), "camera_lidar", CONFIG) == ["sync"]
    assert unmet_conditions(make_changed(frame, sky_fraction=0.19), "camera_radar", CONFIG) == ["sky"]
    assert unmet_conditions(make_changed(frame, drivable_fraction=0.09), "lidar_radar", CONFIG) == [
        "drivable"
    ]
    two = make_changed(frame, road_user_boxes_px=frame.road_user_boxes_px[:2])
    assert unmet_conditions(two, "camera_radar", CONFIG) == ["road_users"]
    two = make_changed(frame, radar_track_xyz_m=frame.radar_track_xyz_m[:2])
    assert unmet_conditions(two, "lidar_radar", CONFIG) == ["radar_clusters"]


def test_conditions_of_a_sensor_that_is_not_in_the_pair_do_not_count(day):
    dark = make_changed(day[0], sky_fraction=0.0, road_user_boxes_px=np.zeros((0, 4), np.float32))
    assert unmet_conditions(dark, "lidar_radar", CONFIG) == []
    no_radar = make_changed(day[0], radar_track_xyz_m=np.zeros((0, 3), np.float32), radar_stamp_ns=0)
    assert unmet_conditions(no_radar, "camera_lidar", CONFIG) == []


def test_held_out_frames_are_no_neighbours_of_the_fit():
    day = make_day(160, step_s=0.2, per_drive=80)
    chosen = select_frames(day, CONFIG, paper=True)
    stamps = np.array([o.stamp_ns for o in day]) * 1e-9
    for pair in PAIRS:
        assert len(chosen.holdout[pair]) >= 10
        gaps = np.abs(stamps[chosen.fit[pair]][:, None] - stamps[chosen.holdout[pair]][None])
        assert gaps.min() >= 1.0


def test_both_parts_reach_over_the_whole_day(day):
    held = np.array([h is True for h in hold_out(day, 0.2)])
    assert 0.1 < held.mean() < 0.35
    assert held[:30].any()
    assert held[30:].any()


def test_a_short_day_still_holds_a_block_out():
    assert any(h is True for h in hold_out(make_day(12, per_drive=12), 0.2))


def test_frames_are_spread_over_the_day_and_the_richest_of_each_stretch_is_taken(day):
    rich = {
        i: make_changed(o, lidar_edge_xyz_m=np.zeros((500, 3), np.float32))
        for i, o in enumerate(day)
        if i % 3 == 1
    }
    mixed = [rich.get(i, o) for i, o in enumerate(day)]
    chosen = select_frames(mixed, SelectConfig(frames=15), paper=False).fit["camera_lidar"]
    assert len(chosen) == 15
    assert np.diff(chosen).max() < 15
    assert np.mean([i in rich for i in chosen]) > 0.9


def test_the_same_day_gives_the_same_frames(day):
    assert select_frames(day, CONFIG, paper=True) == select_frames(day, CONFIG, paper=True)


def test_every_frame_is_used_or_counted_with_a_reason(day):
    late = [make_changed(o, camera_stamp_ns=0) if i % 10 == 0 else o for i, o in enumerate(day)]
    chosen = select_frames(late, CONFIG, paper=True)
    for pair in PAIRS:
        assert len(chosen.fit[pair]) + sum(chosen.rejected[pair].values()) == len(day)
    assert chosen.rejected["camera_lidar"]["sync"] == 6
    assert "sync" not in chosen.rejected["lidar_radar"]


def test_where_the_paper_leaves_too_few_frames_the_nearest_fill_up_and_the_record_says_so():
    day = [make_changed(o, sky_fraction=0.05 if i > 3 else 0.3) for i, o in enumerate(make_day(60))]
    chosen = select_frames(day, CONFIG, paper=True)
    assert chosen.passed["camera_lidar"] == 4
    assert len(chosen.fit["camera_lidar"]) == 30
    assert "hold for 4 frames" in chosen.notes["camera_lidar"][0]
    assert chosen.notes["lidar_radar"] == []


def test_what_the_drive_lacks_is_said_per_pair(day):
    assert all(missing_content(day, pair) == [] for pair in PAIRS)
    slow = [make_changed(o, ego_speed_mps=1.0, radar_has_elevation=False) for o in day]
    assert "time offsets" in missing_content(slow, "camera_lidar")[0]
    assert "no elevation" in missing_content(slow, "lidar_radar")[1]
    empty = [make_changed(o, radar_track_xyz_m=np.zeros((0, 3), np.float32)) for o in day]
    assert missing_content(empty, "lidar_radar") == ["hardly any moving road users for the radar"]


def test_too_few_frames_are_an_error_that_names_the_pair_and_the_reasons():
    day = [make_changed(o, radar_stamp_ns=0) if i >= 5 else o for i, o in enumerate(make_day(30))]
    with pytest.raises(SolveError, match=f"camera_radar has . of 30, needs {MIN_FRAMES}.*sync 25"):
        select_frames(day, CONFIG, paper=True)


def make_changed(observation, **changes):
    from dataclasses import replace

    return replace(observation, **changes)
