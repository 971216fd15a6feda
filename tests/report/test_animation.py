"""The moving picture: begins at the prior, ends at the result, and goes straight from one to the other."""

import cv2
import numpy as np
import pytest

from pipeline.errors import ConfigError
from pipeline.geometry.se3 import inverse, rotation_angle_rad
from pipeline.report.animation import between, write_animation
from pipeline.report.overlays import lidar_window
from tests.report.test_pictures import GOOD, WIDTH, _scene, _turned


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_each_pair_turns_by_the_share_of_its_whole_turn(share):
    before = _turned(4.0)
    state = between(before, GOOD, share)
    for T, T_before in (
        (state.T_camera_lidar, before.T_camera_lidar),
        (state.T_lidar_radar, before.T_lidar_radar),
    ):
        turned = np.degrees(rotation_angle_rad(T @ inverse(T_before)))
        assert turned == pytest.approx(4.0 * share, abs=1e-6)
    np.testing.assert_allclose(between(before, GOOD, 1.0).T_camera_radar, GOOD.T_camera_radar, atol=1e-12)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_browser_s_formats_are_written_and_play_for_ever(tmp_path, suffix):
    path = write_animation(tmp_path / "new" / f"sweep{suffix}", _scene(), _turned(3.0), GOOD)
    played, animation = cv2.imreadanimation(str(path))
    assert played
    assert animation.loop_count == 0
    assert len(animation.frames) == len(animation.durations) > 10
    assert animation.durations[0] > animation.durations[1] < animation.durations[-1]
    first, last = animation.frames[0].astype(int), animation.frames[-1].astype(int)
    assert first.shape[1] <= 1000
    assert np.abs(first - last).max() > 100  # the dots lie elsewhere


def test_the_window_holds_what_the_lidar_sees():
    window = lidar_window(_scene(), GOOD)
    assert window.size_px[0] <= WIDTH
    narrow = _scene()
    near = np.abs(narrow.frame.lidar_y_m) < 3.0
    for name in ("lidar_x_m", "lidar_y_m", "lidar_z_m"):
        object.__setattr__(narrow.frame, name, getattr(narrow.frame, name)[near])
    assert lidar_window(narrow, GOOD).size_px[0] < 0.5 * window.size_px[0]


def test_another_format_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match="sweep"):
        write_animation(tmp_path / "sweep.mp4", _scene(), GOOD, GOOD)
