"""Time offsets in pictures: what stands still lies where it is, at any speed, in any turn, with either offset wrong."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.report.residuals import TimeOffsets, as_stamped, frame_residuals, time_offsets_of
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, transform_points
from schemas.calibrations import PAIRS
from tests.makers.table_rows import make_record
from tests.report.test_pictures import GOOD, T_CL, T_LR, _scene

POSTS_MAP = np.array([[20.0, 2.0, 0.0], [35.0, -6.0, 1.0], [12.0, 5.0, -1.0]])


def _driving(speed_mps, yaw_rate_radps):
    stamps = dict.fromkeys(("stamp_ns", "camera_stamp_ns", "radar_stamp_ns"), 1_700_000_000_000_000_000)
    ego = {"ego_speed_mps": speed_mps, "ego_yaw_rate_radps": yaw_rate_radps}
    return replace(_scene().observation, **stamps, **ego)


def _seen_by_lidar(t_s, speed_mps, yaw_rate_radps):
    """The posts in lidar coordinates at a time of the lidar's clock, on a circle."""
    yaw = yaw_rate_radps * t_s
    arc = t_s if yaw_rate_radps == 0 else np.sin(yaw) / yaw_rate_radps
    side = 0.0 if yaw_rate_radps == 0 else (1 - np.cos(yaw)) / yaw_rate_radps
    T_map_lidar = from_rotation_translation(
        exp_so3(np.array([0.0, 0.0, yaw])), np.array([speed_mps * arc, speed_mps * side, 0.0])
    )
    return transform_points(inverse(T_map_lidar), POSTS_MAP)


@pytest.mark.parametrize(("speed_mps", "yaw_rate_radps"), [(20.0, 0.0), (8.0, 0.3), (-3.0, 0.1), (0.0, 0.0)])
@pytest.mark.parametrize("offset_s", [0.04, -0.03])
def test_a_standing_post_lies_on_itself_in_image_and_sweep(speed_mps, yaw_rate_radps, offset_s):
    """All three carry the stamp 0. stamp_camera = stamp_lidar + dt: the image is of the lidar's time -dt, and the
    sweep is of the radar's time -dt, so that the radar looks at the lidar's time +dt."""
    state = as_stamped(GOOD, _driving(speed_mps, yaw_rate_radps), TimeOffsets(offset_s, offset_s))
    sweep = _seen_by_lidar(0.0, speed_mps, yaw_rate_radps)
    in_image = transform_points(T_CL, _seen_by_lidar(-offset_s, speed_mps, yaw_rate_radps))
    np.testing.assert_allclose(transform_points(state.T_camera_lidar, sweep), in_image, atol=5e-3)
    in_scan = transform_points(inverse(T_LR), _seen_by_lidar(offset_s, speed_mps, yaw_rate_radps))
    np.testing.assert_allclose(transform_points(state.T_lidar_radar, in_scan), sweep, atol=5e-3)


def test_gaps_of_the_frame_s_own_stamps_are_bridged_as_offsets_are():
    """An image stamped as much later as its clock is off, and a scan as much earlier, were taken with the sweep."""
    frame = _driving(20.0, 0.2)
    now = frame.stamp_ns
    together = replace(frame, camera_stamp_ns=now + 40_000_000, radar_stamp_ns=now - 30_000_000)
    state = as_stamped(GOOD, together, TimeOffsets(0.04, 0.03))
    np.testing.assert_allclose(state.T_camera_lidar, GOOD.T_camera_lidar, atol=1e-9)
    np.testing.assert_allclose(state.T_lidar_radar, GOOD.T_lidar_radar, atol=1e-9)
    same = as_stamped(GOOD, frame, TimeOffsets(-0.04, -0.03))
    right = as_stamped(GOOD, together, TimeOffsets(0.0, 0.0))
    np.testing.assert_allclose(right.T_camera_lidar, same.T_camera_lidar, atol=1e-9)
    np.testing.assert_allclose(right.T_lidar_radar, same.T_lidar_radar, atol=1e-9)


def test_without_offsets_or_speed_nothing_moves():
    for observation, offsets in (
        (_driving(20.0, 0.2), TimeOffsets()),
        (_driving(None, None), TimeOffsets(0.05, 0.05)),
    ):
        state = as_stamped(GOOD, observation, offsets)
        np.testing.assert_allclose(state.T_camera_lidar, GOOD.T_camera_lidar, atol=1e-12)
        np.testing.assert_allclose(state.T_lidar_radar, GOOD.T_lidar_radar, atol=1e-12)


def test_edges_meet_their_silhouettes_again_once_the_offset_is_known():
    still = _driving(20.0, 0.0)
    later = np.array([2.0, 0.0, 0.0], np.float32)  # the sweep is a tenth of a second after the image
    late = replace(still, lidar_edge_xyz_m=still.lidar_edge_xyz_m - later)
    without, with_clock = frame_residuals([late], (GOOD, GOOD), (TimeOffsets(), TimeOffsets(0.1)))
    assert with_clock["camera_lidar"][0] > 90 > without["camera_lidar"][0]


def test_a_run_gives_the_offsets_that_it_estimated_and_says_them():
    offsets_s, rng = dict(zip(PAIRS, (0.0281, None, None), strict=True)), np.random.default_rng(0)
    run = {pair: make_record(rng, "key", pair=pair, time_offset_s=s) for pair, s in offsets_s.items()}
    assert time_offsets_of(run) == TimeOffsets(0.0281, None)
    assert time_offsets_of(run).in_words() == "camera +28 ms"
    assert TimeOffsets().in_words() == ""
