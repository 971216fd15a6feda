"""The stage: frames in, observations out; faults are counted, and the same work is not done twice."""

from dataclasses import replace
from itertools import count

import cv2
import numpy as np
import pytest

from pipeline.core.config import FleetConfig
from pipeline.perceive.labels import VOID_ID
from pipeline.perceive.stage import WITHOUT_ROWS
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of, perceived
from schemas.calibrations import SENSORS
from schemas.observations import STEP_BELOW, STEP_RIGHT, WITHOUT_LABELS
from tests.makers.fleet_files import THREE_SENSORS
from tests.makers.lakes import write_frames
from tests.makers.stages import perceive_day

DAY = Partition("car-1", "2026-03-02")
COUNT = count()
NONE = np.zeros(0, np.float32)


def fleet(rig=THREE_SENSORS, **perceive):
    values = {"rigs": {"default": rig}, "vehicles": {"car-1": {}}, "perceive": perceive}
    return FleetConfig.model_validate({"fleet": {"name": "made"}} | values)


def stage(lake, frames=None, config=None):
    """What the stage makes of frames, or of those of before: its result and its rows."""
    if frames is not None:
        write_frames(lake, DAY, frames, key=f"frames {next(COUNT)}")
    result = perceive_day(DAY, config or fleet(), lake)
    return result, list(observations_of(lake, DAY))


@pytest.fixture
def lake(tmp_path):
    return Lake.at(tmp_path / "lake")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, made_frame):
    """Result and rows of a drive of five frames."""
    return stage(Lake.at(tmp_path_factory.mktemp("whole")), [made_frame(i) for i in range(5)])


def changed(made_frame, count=5, **fields):
    return [replace(made_frame(i), **fields) for i in range(count)]


def test_a_days_frames_become_observations(whole):
    result, rows = whole
    assert (result.stage, result.status, result.rows, result.rejected) == ("perceive", "done", 5, {})
    assert [o.frame_index for o in rows] == [0, 1, 2, 3, 4]
    for k, o in enumerate(rows, start=1):
        assert o.ground_plane[3] == pytest.approx(1.7, abs=0.05)
        assert o.ego_speed_mps == pytest.approx(8.0, abs=0.1)
        assert o.road_user_classes == ["car", "person"]
        assert len(o.lidar_map_xyz_m) == len(o.lidar_map_is_ground) == len(o.lidar_map_cluster)
        assert o.lidar_map_cluster.max() < len(o.lidar_cluster_centre_m)
        assert len(o.lidar_edge_xyz_m) > 0
        # The driving car is one lidar object, one radar cluster and one track.
        car = np.array([14.1, 0.0, -0.8])
        assert np.min(np.linalg.norm(o.lidar_cluster_centre_m - car, axis=1)) < 0.3
        assert np.all(o.radar_drivable_range_m > 3)
        assert (o.radar_track_id.tolist(), o.radar_track_age.tolist()) == ([0], [k])
    assert rows[-1].radar_track_velocity_mps[0] == pytest.approx([5.0, 0.0, 0.0], abs=0.5)


def test_the_same_work_is_cached_other_work_is_not_and_the_same_frames_give_the_same_bytes(
    lake, made_frame, whole
):
    seen = []
    write_frames(lake, DAY, changed(made_frame), "frames-key")
    first = perceive_day(DAY, fleet(), lake, progress=lambda *told: seen.append(told))
    assert seen == [(k, 5, "frames") for k in range(1, 6)]
    for a, b in zip(observations_of(lake, DAY), whole[1], strict=True):
        assert a.labels_png == b.labels_png
        for name in ("lidar_map_xyz_m", "lidar_edge_xyz_m", "marking_z", "ground_plane", "radar_track_xyz_m"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    again, _ = stage(lake)
    assert (again.status, again.work_key, again.rows) == ("cached", first.work_key, 5)
    other, _ = stage(lake, config=fleet(voxel_m=0.5))
    assert other.status == "done"
    assert other.work_key != first.work_key
    assert stage(lake, [made_frame(0)], fleet(voxel_m=0.5))[0].rows == 1


def test_bad_frames_are_counted_by_reason_and_do_not_stop_the_day(lake, made_frame):
    faults = {
        "image_undecodable": {"image": b"broken"},
        "labels_missing": {"labels_png": None},
        "detections_missing": dict.fromkeys(f"detection_{k}" for k in ("boxes_px", "classes", "scores")),
        "lidar_points_too_few": {f"lidar_{a}_m": np.full(6000, np.nan, np.float32) for a in "xyz"},
        "camera_model_invalid": {"camera_D": np.zeros(3)},
        "radar_points_too_few": dict.fromkeys(
            [*(f"radar_{a}_m" for a in "xyz"), "radar_range_rate_mps"], NONE
        ),
    }
    frames = [replace(made_frame(i), **fault) for i, fault in enumerate([{}, *faults.values(), {}])]
    result, rows = stage(lake, frames)
    assert result.status == "done"
    assert [o.frame_index for o in rows] == [0, 7]
    assert result.rejected == dict.fromkeys(faults, 1)
    assert perceived(lake, DAY).rejected == result.rejected


def test_sweeps_without_rows_are_counted_and_still_show_edges(lake, made_frame):
    lasers = np.random.default_rng(0).integers(0, 6, len(made_frame(0).lidar_x_m)).astype(np.uint16)
    result, rows = stage(lake, [made_frame(0), *changed(made_frame, 3, lidar_ring=lasers)[1:]])
    assert (result.kept, result.rejected) == (
        {"frames": 3, WITHOUT_ROWS: 2, "camera_without_motion_no_earlier_image": 3},
        {},
    )
    assert all(len(o.lidar_edge_xyz_m) > 0 for o in rows)


def test_a_day_without_a_usable_frame_is_refused_and_leaves_no_stale_observations(lake, made_frame):
    stage(lake, [made_frame(0)])
    for frames in (changed(made_frame, 3, labels_png=None, sensors=["camera", "lidar"]), None):
        result, rows = stage(lake, frames)
        assert (result.status, rows) == ("refused", [])
        assert "3 labels_missing" in result.reason


def test_a_day_without_labels_keeps_lidar_and_radar(lake, made_frame, whole):
    result, rows = stage(lake, changed(made_frame, labels_png=None))
    assert (result.status, result.rejected) == ("done", {"without_camera_labels_missing": 5})
    for a, b in zip(rows, whole[1], strict=True):
        assert a.sensors == ["lidar", "radar"]
        assert (a.labels_png, len(a.road_user_boxes_px), a.road_contrast_png) == (b"", 0, None)
        np.testing.assert_array_equal(a.lidar_edge_xyz_m, b.lidar_edge_xyz_m)
        np.testing.assert_array_equal(a.radar_track_xyz_m, b.radar_track_xyz_m)


def test_a_camera_without_semantics_shows_steps_of_brightness_and_is_told_how_to_have_labels(
    lake, made_frame, whole
):
    bare = {"camera": {k: v for k, v in THREE_SENSORS["camera"].items() if k != "semantics"}}
    frames = changed(made_frame, labels_png=None, detection_boxes_px=None)
    result, rows = stage(lake, frames, fleet(THREE_SENSORS | bare))
    assert (result.status, result.rows, result.rejected) == ("done", 5, {})
    assert result.reason.startswith(f"camera: {WITHOUT_LABELS}")
    assert "[rigs.default.cameras.camera.semantics]" in result.reason
    assert "boresight models --fetch" in result.reason
    for a, b in zip(rows, whole[1], strict=True):
        assert (a.sensors, a.is_unlabelled, b.is_unlabelled) == (b.sensors, True, False)
        labels, steps = (
            cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
            for png in (a.labels_png, a.steps_png)
        )
        assert (labels.min(), labels.shape) == (VOID_ID, steps.shape)
        assert steps.max() <= STEP_RIGHT + STEP_BELOW
        assert (a.label_gradients, len(a.road_user_boxes_px)) == (None, 0)
        np.testing.assert_array_equal(a.lidar_edge_xyz_m, b.lidar_edge_xyz_m)


SHOWN_BY = {"camera": "labels_png", "lidar": "lidar_map_xyz_m", "radar": "radar_xyz_m"}


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_a_missing_sensor_would_show_is_empty_and_the_others_are_perceived(
    lake, made_frame, whole, sensor
):
    others = [s for s in SENSORS if s != sensor]
    gone = {
        "camera": {"image": b"", "camera_model": "", "camera_K": np.full((3, 3), np.nan), "labels_png": None},
        "lidar": {f"lidar_{axis}_m": NONE for axis in "xyz"} | {"lidar_ring": None, "lidar_intensity": None},
        "radar": {f"radar_{axis}_m": NONE for axis in "xyz"} | {"radar_range_rate_mps": NONE},
    }[sensor]
    result, rows = stage(lake, changed(made_frame, 2, sensors=others, **gone))
    assert (result.status, result.rows, result.rejected) == ("done", 2, {})
    for a, b in zip(rows, whole[1][:2], strict=True):
        assert a.sensors == others
        assert len(getattr(a, SHOWN_BY[sensor])) == 0
        assert all(np.array_equal(getattr(a, SHOWN_BY[s]), getattr(b, SHOWN_BY[s])) for s in others)
