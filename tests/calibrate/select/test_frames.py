"""Which frames are chosen, which are held out, and what is said about the others."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.select.frames import MIN_FRAMES, missing_content, select_frames, unmet_conditions
from pipeline.core.config import SelectConfig
from schemas.calibrations import FRAMES_OF_PAIR, PAIRS, SENSORS
from schemas.faults import FAULTS
from tests.makers.solve_scenes import make_day

CONFIG = SelectConfig(frames=30)


@pytest.fixture(scope="module")
def day():
    return make_day(60, per_drive=20)


def test_every_condition_of_the_paper_is_named_when_it_is_missed(day):
    frame = day[0]
    assert unmet_conditions(frame, "camera_lidar", CONFIG) == []
    late = frame.stamp_ns + 6_000_000
    assert unmet_conditions(replace(frame, camera_stamp_ns=late), "camera_lidar", CONFIG) == ["sync"]
    assert unmet_conditions(replace(frame, sky_fraction=0.19), "camera_radar", CONFIG) == ["sky"]
    assert unmet_conditions(replace(frame, drivable_fraction=0.09), "lidar_radar", CONFIG) == ["drivable"]
    two = replace(frame, road_user_boxes_px=frame.road_user_boxes_px[:2])
    assert unmet_conditions(two, "camera_radar", CONFIG) == ["road_users"]
    two = replace(frame, radar_track_xyz_m=frame.radar_track_xyz_m[:2])
    assert unmet_conditions(two, "lidar_radar", CONFIG) == ["radar_clusters"]


def test_held_out_frames_are_no_neighbours_of_the_fit():
    day = make_day(160, step_s=0.2, per_drive=80)
    chosen = select_frames(day, CONFIG, paper=True)
    stamps = np.array([o.stamp_ns for o in day]) * 1e-9
    for pair in PAIRS:
        assert len(chosen.holdout[pair]) >= 10
        gaps = np.abs(stamps[chosen.fit[pair]][:, None] - stamps[chosen.holdout[pair]][None])
        assert gaps.min() >= 1.0


def edges_at(azimuth_deg, range_m, count=30):
    angle = np.radians(np.full(count, azimuth_deg) + np.linspace(-2, 2, count))
    return (range_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], -1)).astype(np.float32)


def test_frames_are_spread_over_the_day_and_of_each_stretch_the_one_that_adds_most_is_taken(day):
    """Every third frame shows what no other shows: it is taken, however many edges of the usual kind others have."""
    usual = [replace(o, lidar_edge_xyz_m=edges_at(0, 15, 300)) for o in day]
    rare = {
        i: replace(o, lidar_edge_xyz_m=edges_at((-25, 25, 15)[i % 9 // 3], 8))
        for i, o in enumerate(day)
        if i % 3 == 1
    }
    chosen = select_frames(
        [rare.get(i, o) for i, o in enumerate(usual)], SelectConfig(frames=15), paper=False
    )
    picked = chosen.fit["camera_lidar"]
    assert len(picked) == 15
    assert np.diff(picked).max() < 15
    assert np.mean([i in rare for i in picked]) > 0.6  # by chance a third
    assert any(i not in rare for i in picked)  # and one of the usual kind


def test_every_frame_is_used_or_counted_with_a_reason(day):
    late = [replace(o, camera_stamp_ns=0) if i % 10 == 0 else o for i, o in enumerate(day)]
    chosen = select_frames(late, CONFIG, paper=True)
    for pair in PAIRS:
        assert len(chosen.fit[pair]) + sum(chosen.rejected[pair].values()) == len(day)
    assert chosen.rejected["camera_lidar"]["sync"] == 6
    assert "sync" not in chosen.rejected["lidar_radar"]


def test_frames_are_left_out_of_a_pair_whose_captures_the_car_drove_too_far_between():
    """Two sensors of a large rig can lie on either side of the moment, as far from it as ingest lets each of them."""
    late_ns = 400_000_000  # of a trigger, the same all day
    day = [
        replace(o, camera_stamp_ns=o.stamp_ns + late_ns + apart_ns, radar_stamp_ns=o.stamp_ns - apart_ns)
        for i, o in enumerate(make_day(60, ego_speed_mps=20.0, ego_yaw_rate_radps=0.0))
        for apart_ns in [70_000_000 * (i % 10 == 0)]
    ]  # 2.5 m at 20 m/s take 125 ms
    chosen = select_frames(day, CONFIG, paper=False, sync_gate_s=None, motion_gate=(2.5, 0.03))
    assert chosen.rejected["camera_radar"]["sync"] == 6
    assert not any("sync" in chosen.rejected[pair] for pair in ("camera_lidar", "lidar_radar"))


def test_where_the_paper_leaves_too_few_frames_the_nearest_fill_up_and_the_record_says_so():
    day = [replace(o, sky_fraction=0.05 if i > 3 else 0.3) for i, o in enumerate(make_day(60))]
    chosen = select_frames(day, CONFIG, paper=True)
    assert chosen.passed["camera_lidar"] == 4
    assert len(chosen.fit["camera_lidar"]) == 30
    assert "hold for 4 frames" in chosen.notes["camera_lidar"][0]
    assert chosen.notes["lidar_radar"] == []


def test_what_the_drive_lacks_is_said_per_pair(day):
    for pair in PAIRS:
        assert not any("time offsets" in m or "road users in" in m for m in missing_content(day, pair))
    slow = [replace(o, ego_speed_mps=1.0, radar_has_elevation=False) for o in day]
    assert "time offsets" in missing_content(slow, "camera_lidar")[0]
    assert "no elevation" in missing_content(slow, "lidar_radar")[1]
    empty = [replace(o, radar_track_xyz_m=np.zeros((0, 3), np.float32)) for o in day]
    assert "drive in traffic: the radar hardly sees moving road users" in missing_content(
        empty, "lidar_radar"
    )


def test_parts_of_the_view_without_content_are_named(day):
    right_and_near = [
        replace(o, lidar_edge_xyz_m=np.concatenate([edges_at(-20, 15), edges_at(0, 8)])) for o in day
    ]
    lacks = "drive where there are poles, signs or cars (depth edges) left of 15 deg and beyond 40 m"
    assert f"{lacks}: the frames hardly show any" in missing_content(right_and_near, "camera_lidar")
    everywhere = [
        replace(o, lidar_edge_xyz_m=np.concatenate([edges_at(a, r) for a in (-25, 25) for r in (8, 50)]))
        for o in day
    ]
    assert not any("depth edges" in m for m in missing_content(everywhere, "camera_lidar"))
    blank = [replace(o, marking_xyz_m=np.zeros((0, 3), np.float32)) for o in everywhere]
    assert "drive where there are road markings: the frames show none" in missing_content(
        blank, "camera_lidar"
    )
    chosen = select_frames(right_and_near, CONFIG, paper=False)
    assert chosen.missing["camera_lidar"] == missing_content(
        [right_and_near[i] for i in chosen.fit["camera_lidar"]], "camera_lidar"
    )


def test_where_too_few_are_left_to_judge_all_frames_fit_and_none_judges():
    day = make_day(5)
    chosen = select_frames(day, CONFIG, paper=False)
    assert chosen.fit["camera_lidar"] == list(range(5))
    assert chosen.holdout["camera_lidar"] == []
    assert set(chosen.refused) == {"camera_radar", "lidar_radar"}
    assert select_frames(day[:4], CONFIG, paper=False).fit == {}


def test_a_pair_with_too_few_frames_is_refused_alone_with_its_reasons():
    day = [replace(o, radar_stamp_ns=0) if i >= 5 else o for i, o in enumerate(make_day(30))]
    chosen = select_frames(day, CONFIG, paper=True)
    assert set(chosen.fit) == set(chosen.holdout) == {"camera_lidar"}
    assert set(chosen.refused) == {"camera_radar", "lidar_radar"}
    reason = chosen.refused["camera_radar"].reason
    assert re.search(f"camera_radar has . of 30, needs {MIN_FRAMES}.*sync 25", reason)
    whole = select_frames(make_day(30), CONFIG, paper=True)
    assert chosen.fit["camera_lidar"] == whole.fit["camera_lidar"]


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_silent_sensor_costs_its_own_pairs_only_and_is_named(sensor):
    day = [
        replace(o, sensors=[s for s in SENSORS if s != sensor or i < 5]) for i, o in enumerate(make_day(30))
    ]
    chosen = select_frames(day, CONFIG, paper=False, absent={sensor: "nothing on /topic"})
    assert {pair for pair in PAIRS if sensor not in FRAMES_OF_PAIR[pair]} == set(chosen.fit)
    for pair, why in chosen.refused.items():
        assert sensor in FRAMES_OF_PAIR[pair]
        assert why.fault == "silent_sensor"
        assert f"the {sensor} is silent: 5 of 30 frames have it" in why.reason
        assert "(nothing on /topic)" in why.reason
        assert chosen.rejected[pair][f"no_{sensor}"] == 25


@pytest.mark.parametrize("frames", [5, 30])
def test_a_camera_that_nobody_labels_is_not_called_silent(frames):
    day = [replace(o, sensors=["lidar", "radar"]) for o in make_day(frames)]
    why = f"{FAULTS['no_labels']}, camera: name models"
    chosen = select_frames(day, CONFIG, paper=False, absent={"camera": why})
    for pair in ("camera_lidar", "camera_radar"):
        assert (chosen.refused[pair].reason, chosen.refused[pair].fault) == (why, "no_labels")
