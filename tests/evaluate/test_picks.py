"""The reflector file: what it says, what it leaves open, what is found again in a recording."""

import json

import numpy as np
import pytest

from pipeline.core.errors import ConfigError
from pipeline.evaluate.recording import find_again, read_reflectors

CAMERA = {
    "model": "plumb_bob", "K": [[500, 0, 320], [0, 500, 160], [0, 0, 1]], "D": [], "width_px": 640,
    "height_px": 320,
}  # fmt: skip
AT = np.array([[15.0, -2.0, 0.1], [25.0, 3.0, 0.2]])


def content(**more):
    targets = [
        {
            "pixel": [300.0, 150.0], "lidar_m": at.tolist(), "radar_m": at.tolist(),
            "spread": {"pixel": [0.5, 0.5], "lidar_m": [0.02] * 3, "radar_m": [0.1, 0.1, 0.6]},
            "frames": {"pixel": 1, "lidar_m": 4, "radar_m": 144},
        }
        for at in AT
    ]  # fmt: skip
    return {"camera": CAMERA, "targets": targets} | more


def read(tmp_path, value):
    path = tmp_path / "picks.json"
    path.write_text(json.dumps(value))
    return read_reflectors(path)


def test_the_sigma_of_a_position_is_its_spread_over_the_root_of_the_frames(tmp_path):
    picks = read(tmp_path, content()).picks
    np.testing.assert_allclose(picks.sigma.pixels, 0.5)
    np.testing.assert_allclose(picks.sigma.lidar_m, 0.01)
    np.testing.assert_allclose(picks.sigma.radar_m, [[0.1 / 12, 0.1 / 12, 0.05]] * 2)
    np.testing.assert_allclose(picks.spread.radar_m, [[0.1, 0.1, 0.6]] * 2)


def test_a_file_judges_only_the_mounting_that_it_shows(tmp_path):
    named = read(tmp_path, content(vehicle="a", day="2026-03-02"))
    assert named.applies_to("a", "2026-03-02")
    assert not named.applies_to("a", "2026-03-03")
    assert not named.applies_to("b", "2026-03-02")
    assert read(tmp_path, content()).applies_to("b", "2026-03-03")


@pytest.mark.parametrize(
    "broken",
    [
        {"targets": []},
        {"targets": [{"pixel": [1, 2]}]},
        {"targets": [{"pixel": [1, 2], "lidar_m": [1, 2, 3], "radar_m": [1, 2, float("nan")]}]},
        {"targets": [{"pixel": [1, 2], "lidar_m": [1, 2, 3], "radar_m": [1, 2]}]},
        {"reflector": 3},
        {"camera": CAMERA | {"model": "pinhole"}},
    ],
)
def test_a_file_of_another_form_is_refused(tmp_path, broken):
    with pytest.raises(ConfigError):
        read(tmp_path, content(**broken))


def test_a_reflector_that_is_not_found_keeps_its_pick_and_the_source_says_which(tmp_path):
    rng = np.random.default_rng(7)
    file = read(tmp_path, content())
    seen = AT[0] + [0.3, 0.2, 0.4]
    radar = [(seen + rng.normal(0, 0.05, (1, 3)), np.array([60.0])) for _ in range(50)]
    again = find_again(file, None, radar, "the lot")
    np.testing.assert_allclose(again.picks.radar_m[0], seen, atol=0.05)
    np.testing.assert_array_equal(again.picks.radar_m[1], AT[1])
    np.testing.assert_array_equal(again.picks.lidar_m, AT)
    assert np.all(again.picks.sigma.radar_m[0] < 0.02)
    np.testing.assert_array_equal(again.picks.sigma.radar_m[1], file.picks.sigma.radar_m[1])
    assert again.sources[1] == "lidar: picked, mean of 4 / 4 frames; none was found in the lot"
    assert again.sources[2].startswith("radar: strongest echo found in the lot, reflectors 1 (")
    assert again.sources[2].endswith("; not found: 2, radar: picked, mean of 144 / 144 frames")
