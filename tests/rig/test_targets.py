"""The paper's error at corner reflectors, from truth and from picks."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.rig.se3 import changed, inverse, transform_points
from pipeline.rig.targets import (
    DEFAULT_TARGETS,
    Picks,
    PickUncertainty,
    error_sigma_at_picks,
    errors_at_targets,
    errors_of_picks,
    loop_errors,
)
from schemas.calibrations import PAIRS
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR, TRUTH, turned


@pytest.mark.parametrize(
    ("pair", "yaw_axis", "pitch_axis"),
    [("camera_lidar", 1, 0), ("camera_radar", 1, 0), ("lidar_radar", 2, 1)],
)
def test_a_turn_shows_as_its_angle_and_a_shift_ahead_as_range(pair, yaw_axis, pitch_axis):
    yawed = errors_at_targets(pair, turned(TRUTH[pair], yaw_axis, 0.5), TRUTH[pair])
    assert np.degrees(yawed[0]) == pytest.approx(0.5, abs=0.03)
    assert np.degrees(yawed[1]) < 0.05
    pitched = errors_at_targets(pair, turned(TRUTH[pair], pitch_axis, 0.5), TRUTH[pair])
    assert np.degrees(pitched[1]) == pytest.approx(0.5, abs=0.03)
    ahead = changed(TRUTH[pair], 0.2 * np.eye(6)[3])
    if pair == "lidar_radar":
        assert errors_at_targets(pair, ahead, TRUTH[pair])[2] == pytest.approx(0.2, abs=0.005)


def test_the_loop_of_consistent_transforms_is_closed_and_an_open_one_shows_its_angle():
    np.testing.assert_allclose(loop_errors(TRUTH), 0, atol=1e-12)
    opened = TRUTH | {"lidar_radar": turned(T_LIDAR_RADAR, 2, 0.3)}
    assert np.degrees(loop_errors(opened)[0]) == pytest.approx(0.3, abs=0.02)


def picks_of(shift_px=(0.0, 0.0)):
    lidar = DEFAULT_TARGETS
    pixels = CAMERA.project(transform_points(T_CAMERA_LIDAR, lidar))[0] + np.array(shift_px)
    return Picks(pixels, lidar, transform_points(inverse(T_LIDAR_RADAR), lidar), CAMERA)


@pytest.mark.parametrize("pair", PAIRS)
def test_picks_of_the_truth_show_no_error_and_pixel_deviations_become_angles(pair):
    error = errors_of_picks(pair, TRUTH[pair], picks_of())
    assert np.degrees(np.nanmax(error[:2])) < 1e-6
    assert np.isnan(error[2]) == (pair != "lidar_radar")
    error = errors_of_picks("camera_lidar", T_CAMERA_LIDAR, picks_of(shift_px=(5.0, 0.0)))
    assert error[0] == pytest.approx(5 / 500, rel=0.1)  # off-axis pixels span a little less
    assert np.degrees(error[1]) < 0.03


def uncertain_picks(pixel=0.0, lidar=0.0, radar=0.0):
    sizes = zip((2, 3, 3), (pixel, lidar, radar), strict=True)
    uncertainty = PickUncertainty(*(np.full((3, n), sd) for n, sd in sizes))
    return replace(picks_of(), spread=uncertainty, sigma=uncertainty), uncertainty


@pytest.mark.parametrize("pair", PAIRS)
def test_the_truths_own_sigma_is_the_scatter_that_its_picks_make(pair):
    picks, uncertainty = uncertain_picks(0.8, 0.03, 0.1)
    rng = np.random.default_rng(4)
    of_each = []
    for k in range(3):
        pixels, lidar, radar = (
            at[k] + sd[k] * rng.standard_normal((20_000, len(at[k])))
            for at, sd in (
                (picks.pixels, uncertainty.pixels),
                (picks.lidar_m, uncertainty.lidar_m),
                (picks.radar_m, uncertainty.radar_m),
            )
        )
        # The mean absolute value of a normal variable is sqrt(2 / pi) of its sigma.
        of_each.append(
            errors_of_picks(pair, TRUTH[pair], Picks(pixels, lidar, radar, CAMERA)) * np.sqrt(np.pi / 2)
        )
    expected = np.sqrt(np.mean(np.square(of_each), axis=0))
    found = error_sigma_at_picks(pair, TRUTH[pair], picks, uncertainty)
    wanted = slice(3 if pair == "lidar_radar" else 2)
    np.testing.assert_allclose(found[wanted], expected[wanted], rtol=0.03)
