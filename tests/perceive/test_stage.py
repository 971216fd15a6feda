"""The stage: frames in, observations out; faults are counted, and the same work is not done twice."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError, ContractError
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


def fleet(**perceive):
    return FleetConfig.model_validate(
        {
            "fleet": {"name": "made"},
            "rigs": {"default": THREE_SENSORS},
            "vehicles": {"car-1": {}},
            "perceive": perceive,
        }
    )  # fmt: skip


def write(lake, frames, key="frames-key"):
    write_frames(lake, DAY, frames, key)


@pytest.fixture
def lake(tmp_path, made_frame):
    """A lake with one drive of five frames."""
    lake = Lake.at(tmp_path / "lake")
    write(lake, [made_frame(i) for i in range(5)])
    return lake


def rows(lake):
    return list(observations_of(lake, DAY))


def test_a_days_frames_become_observations(lake):
    result = perceive_day(DAY, fleet(), lake)
    assert (result.stage, result.status, result.rows, result.rejected) == ("perceive", "done", 5, {})
    observations = rows(lake)
    assert [o.frame_index for o in observations] == [0, 1, 2, 3, 4]
    for o in observations:
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


def test_the_car_ahead_is_one_track_through_the_drive(lake):
    perceive_day(DAY, fleet(), lake)
    tracked = [(o.radar_track_id.tolist(), o.radar_track_age.tolist()) for o in rows(lake)]
    assert tracked == [([0], [k]) for k in range(1, 6)]
    last = rows(lake)[-1]
    assert last.radar_track_velocity_mps[0] == pytest.approx([5.0, 0.0, 0.0], abs=0.5)


def test_a_radar_that_looks_back_still_drives_forwards(lake, made_frame):
    frame = made_frame(0)
    turned = replace(
        frame, radar_x_m=-frame.radar_x_m, radar_y_m=-frame.radar_y_m,
        priors={"lidar_radar": np.diag([-1.0, -1.0, 1.0, 1.0])},
    )  # fmt: skip
    write(lake, [turned], key="turned")
    perceive_day(DAY, fleet(), lake)
    [row] = rows(lake)
    assert row.radar_velocity_mps[0] == pytest.approx(-8.0, abs=0.1)
    assert row.ego_speed_mps == pytest.approx(8.0, abs=0.1)


def test_the_same_work_is_cached_and_other_work_is_not(lake, made_frame):
    first = perceive_day(DAY, fleet(), lake)
    again = perceive_day(DAY, fleet(), lake)
    assert (again.status, again.work_key, again.rows) == ("cached", first.work_key, 5)
    other = perceive_day(DAY, fleet(voxel_m=0.5), lake)
    assert other.status == "done"
    assert other.work_key != first.work_key
    write(lake, [made_frame(0)], key="other-key")
    assert perceive_day(DAY, fleet(voxel_m=0.5), lake).rows == 1


def test_the_same_frames_give_the_same_bytes(lake, tmp_path, made_frame):
    perceive_day(DAY, fleet(), lake)
    twin = Lake.at(tmp_path / "twin")
    write(twin, [made_frame(i) for i in range(5)])
    perceive_day(DAY, fleet(), twin)
    for a, b in zip(rows(lake), rows(twin), strict=True):
        assert a.labels_png == b.labels_png
        for name in ("lidar_map_xyz_m", "lidar_edge_xyz_m", "marking_z", "ground_plane", "radar_track_xyz_m"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_bad_frames_are_counted_by_reason_and_do_not_stop_the_day(lake, made_frame):
    frames = [made_frame(i) for i in range(8)]
    frames[1] = replace(frames[1], image=b"broken")
    frames[2] = replace(frames[2], labels_png=None)
    frames[3] = replace(frames[3], detection_boxes_px=None, detection_classes=None, detection_scores=None)
    frames[4] = replace(frames[4], **{f"lidar_{a}_m": np.full(6000, np.nan, np.float32) for a in "xyz"})
    frames[5] = replace(frames[5], camera_D=np.zeros(3))
    none = np.zeros(0, np.float32)
    frames[6] = replace(frames[6], radar_x_m=none, radar_y_m=none, radar_z_m=none, radar_range_rate_mps=none)
    write(lake, frames, key="faulty")
    result = perceive_day(DAY, fleet(), lake)
    assert result.status == "done"
    assert [o.frame_index for o in rows(lake)] == [0, 7]
    assert result.rejected == {
        "image_undecodable": 1, "labels_missing": 1, "detections_missing": 1, "lidar_points_too_few": 1,
        "camera_model_invalid": 1, "radar_points_too_few": 1,
    }  # fmt: skip
    assert perceived(lake, DAY).rejected == result.rejected


def test_points_that_are_not_numbers_are_left_out(lake, made_frame):
    frame = made_frame(0)
    x = frame.lidar_x_m.copy()
    x[::7] = np.nan
    write(lake, [replace(frame, lidar_x_m=x)], key="nan")
    perceive_day(DAY, fleet(), lake)
    assert np.isfinite(rows(lake)[0].lidar_map_xyz_m).all()


def test_points_of_a_deskewed_sweep_keep_their_times_and_those_as_logged_do_not(lake, made_frame):
    frame = made_frame(0)
    times = (frame.lidar_x_m * 1e-3).astype(np.float32)  # so that a point tells its own
    frames = [replace(made_frame(i), lidar_time_s=times, lidar_deskewed=i == 0) for i in range(2)]
    write(
        lake, [replace(f, radar_range_rate_mps=f.radar_range_rate_mps * np.nan) for f in frames], key="timed"
    )
    perceive_day(DAY, fleet(), lake)
    kept, as_logged = rows(lake)
    assert np.array_equal(kept.lidar_map_time_s, (kept.lidar_map_xyz_m[:, 0] * 1e-3).astype(np.float32))
    assert as_logged.lidar_map_time_s is None


def test_sweeps_without_rows_are_counted_and_still_show_edges(lake, made_frame):
    lasers = np.random.default_rng(0).integers(0, 6, len(made_frame(0).lidar_x_m)).astype(np.uint16)
    frames = [
        made_frame(0),
        replace(made_frame(1), lidar_ring=lasers),
        replace(made_frame(2), lidar_ring=lasers),
    ]
    write(lake, frames, key="rosette")
    result = perceive_day(DAY, fleet(), lake)
    assert (result.kept, result.rejected) == ({"frames": 3, WITHOUT_ROWS: 2}, {})
    assert all(len(o.lidar_edge_xyz_m) > 0 for o in rows(lake))


def test_sensors_that_say_little_are_enough(lake, made_frame):
    # No rings, no reflectivity, no power, no elevation: what many sensors log.
    frame = made_frame(0)
    bare = replace(
        frame, lidar_ring=None, lidar_intensity=None, radar_power_db=None,
        radar_z_m=np.zeros_like(frame.radar_z_m), radar_has_elevation=False,
    )  # fmt: skip
    write(lake, [bare], key="bare")
    assert perceive_day(DAY, fleet(), lake).rows == 1
    assert rows(lake)[0].marking_xyz_m.shape == (0, 3)
    assert len(rows(lake)[0].lidar_edge_xyz_m) > 0


def test_a_day_without_a_usable_frame_is_refused_and_leaves_no_stale_observations(lake, made_frame):
    perceive_day(DAY, fleet(), lake)
    unlabelled = [replace(made_frame(i), labels_png=None, sensors=["camera", "lidar"]) for i in range(3)]
    write(lake, unlabelled, key="unlabelled")
    for _ in range(2):
        result = perceive_day(DAY, fleet(), lake)
        assert result.status == "refused"
        assert "3 labels_missing" in result.reason
        assert rows(lake) == []


def test_a_day_without_labels_keeps_lidar_and_radar(lake, made_frame):
    perceive_day(DAY, fleet(), lake)
    whole = rows(lake)
    write(lake, [replace(made_frame(i), labels_png=None) for i in range(5)], key="unlabelled")
    result = perceive_day(DAY, fleet(), lake)
    assert (result.status, result.rejected) == ("done", {"without_camera_labels_missing": 5})
    for a, b in zip(rows(lake), whole, strict=True):
        assert a.sensors == ["lidar", "radar"]
        assert (a.labels_png, len(a.road_user_boxes_px), a.road_contrast_png) == (b"", 0, None)
        np.testing.assert_array_equal(a.lidar_edge_xyz_m, b.lidar_edge_xyz_m)
        np.testing.assert_array_equal(a.radar_track_xyz_m, b.radar_track_xyz_m)


def test_a_camera_without_semantics_shows_steps_of_brightness_and_is_told_how_to_have_labels(
    lake, made_frame
):
    perceive_day(DAY, fleet(), lake)
    whole, bare = rows(lake), fleet()
    rig = bare.rigs["default"]
    cameras = {"camera": rig.cameras["camera"].model_copy(update={"semantics": None})}
    bare = bare.model_copy(update={"rigs": {"default": rig.model_copy(update={"cameras": cameras})}})
    write(
        lake, [replace(made_frame(i), labels_png=None, detection_boxes_px=None) for i in range(5)], key="bare"
    )
    result = perceive_day(DAY, bare, lake)
    assert (result.status, result.rows, result.rejected) == ("done", 5, {})
    assert result.reason.startswith(f"camera: {WITHOUT_LABELS}")
    assert "[rigs.default.cameras.camera.semantics]" in result.reason
    assert "boresight models fetch" in result.reason
    for a, b in zip(rows(lake), whole, strict=True):
        assert (a.sensors, a.is_unlabelled, b.is_unlabelled) == (b.sensors, True, False)
        labels, steps = (
            cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
            for png in (a.labels_png, a.steps_png)
        )
        assert (labels.min(), labels.shape) == (VOID_ID, steps.shape)
        assert steps.max() <= STEP_RIGHT + STEP_BELOW
        assert (a.label_gradients, len(a.road_user_boxes_px)) == (None, 0)
        np.testing.assert_array_equal(a.lidar_edge_xyz_m, b.lidar_edge_xyz_m)


@pytest.mark.parametrize("sensor", SENSORS)
def test_what_a_missing_sensor_would_show_is_empty_and_the_others_are_perceived(lake, made_frame, sensor):
    perceive_day(DAY, fleet(), lake)
    whole, others = rows(lake), [s for s in SENSORS if s != sensor]
    none = np.zeros(0, np.float32)
    gone = {
        "camera": {"image": b"", "camera_model": "", "camera_K": np.full((3, 3), np.nan), "labels_png": None},
        "lidar": {f"lidar_{axis}_m": none for axis in "xyz"} | {"lidar_ring": None, "lidar_intensity": None},
        "radar": {f"radar_{axis}_m": none for axis in "xyz"} | {"radar_range_rate_mps": none},
    }[sensor]
    frames = [replace(made_frame(i), sensors=others, **gone) for i in range(5)]
    write(lake, frames, key=f"no {sensor}")
    result = perceive_day(DAY, fleet(), lake)
    assert (result.status, result.rows, result.rejected) == ("done", 5, {})
    for a, b in zip(rows(lake), whole, strict=True):
        assert a.sensors == others
        shown = {"camera": a.labels_png, "lidar": a.lidar_map_xyz_m, "radar": a.radar_xyz_m}
        was = {"camera": b.labels_png, "lidar": b.lidar_map_xyz_m, "radar": b.radar_xyz_m}
        assert len(shown.pop(sensor)) == 0
        assert all(np.array_equal(shown[s], was[s]) for s in shown)


def test_a_day_without_frames_and_an_unknown_vehicle_are_named(lake):
    with pytest.raises(ContractError, match="ingest"):
        perceive_day(Partition("car-1", "2026-03-03"), fleet(), lake)
    with pytest.raises(ConfigError, match="car-2"):
        perceive_day(Partition("car-2", DAY.day), fleet(), lake)


def test_progress_counts_every_frame(lake):
    seen = []
    perceive_day(DAY, fleet(), lake, progress=lambda done, total, what: seen.append((done, total, what)))
    assert seen == [(k, 5, "perceive") for k in range(1, 6)]
