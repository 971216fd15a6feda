"""The picture file: a still shows both states; a moving one begins at the prior and ends at the result."""

import cv2
import numpy as np
import pytest

from pipeline.core.errors import ConfigError
from pipeline.report.overlays import front_view, lidar_window
from pipeline.report.pictures import between, write_picture
from pipeline.rig.se3 import inverse, rotation_angle_rad
from tests.report.test_pictures import GOOD, HEIGHT, WIDTH, _scene, _turned

LABELS = ("prior", "calibrated")


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_each_pair_turns_by_the_share_of_its_whole_turn(share):
    before, state = _turned(4.0), between(_turned(4.0), GOOD, share)
    for name in ("T_camera_lidar", "T_lidar_radar"):
        turned = np.degrees(rotation_angle_rad(getattr(state, name) @ inverse(getattr(before, name))))
        assert turned == pytest.approx(4.0 * share, abs=1e-6)
    np.testing.assert_allclose(between(before, GOOD, 1.0).T_camera_radar, GOOD.T_camera_radar, atol=1e-12)


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_browser_s_formats_are_written_and_play_for_ever(tmp_path, suffix):
    path = write_picture(tmp_path / "new" / f"sweep{suffix}", _scene(), _turned(3.0), GOOD, LABELS)
    played, animation = cv2.imreadanimation(str(path))
    assert played
    assert animation.loop_count == 0
    assert len(animation.frames) == len(animation.durations) > 10
    assert animation.durations[0] > animation.durations[1] < animation.durations[-1]
    first, last = animation.frames[0].astype(int), animation.frames[-1].astype(int)
    assert first.shape[1] <= 1000
    assert np.abs(first - last).max() > 100  # the dots lie elsewhere


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_still_is_the_page_s_front_view(tmp_path, suffix):
    path = write_picture(tmp_path / f"still{suffix}", _scene(), _turned(3.0), GOOD, LABELS)
    drawn = front_view(_scene(), _turned(3.0), GOOD, LABELS).astype(int)
    assert np.abs(cv2.imread(str(path)) - drawn).mean() < 3.0  # what JPEG loses


def test_the_window_holds_what_the_lidar_sees():
    window = lidar_window(_scene(), GOOD)
    assert window.size_px[0] <= WIDTH
    assert window.centre_px == pytest.approx((WIDTH / 2, HEIGHT / 2), abs=40)
    narrow = _scene()
    near = np.abs(narrow.frame.lidar_y_m) < 3.0
    for name in ("lidar_x_m", "lidar_y_m", "lidar_z_m"):
        object.__setattr__(narrow.frame, name, getattr(narrow.frame, name)[near])
    assert lidar_window(narrow, GOOD).size_px[0] < 0.5 * window.size_px[0]


def test_another_format_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match="sweep"):
        write_picture(tmp_path / "sweep.mp4", _scene(), GOOD, GOOD, LABELS)
