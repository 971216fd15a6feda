"""Radar pitch from the car's way: Doppler in radar axes against the road in lidar axes, on streets of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.objective.radar.travel import pitch_equations, pitch_residuals, travel_directions
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from tests.makers.doppler_streets import T_LIDAR_RADAR, day_of, turned
from tests.objective.plain_numpy import central_differences


def pitch_error(day, T=T_LIDAR_RADAR):
    """By how much the day would turn the true pose, and its sigma [rad]."""
    travel = travel_directions(day, T, 0.0)
    pitch = 0.0
    for _ in range(8):
        H, g, _ = pitch_equations(travel, turned(T, pitch), len(day))
        pitch -= g[:, 1].sum() / H[:, 1, 1].sum()
    return pitch, H[:, 1, 1].sum() ** -0.5


def test_the_jacobian_is_that_of_differences():
    travel = travel_directions(day_of(1, 6), T_LIDAR_RADAR, 0.0)
    _, J = pitch_residuals(travel, T_LIDAR_RADAR)

    def residuals(step):
        R = exp_so3(step) @ T_LIDAR_RADAR[:3, :3]
        return pitch_residuals(travel, from_rotation_translation(R, np.zeros(3)))[0]

    np.testing.assert_allclose(J, central_differences(residuals, 3), atol=1e-6)


@pytest.mark.parametrize("noise_deg", [0.5, 4.0])
def test_noisy_elevations_do_not_bias_pitch(noise_deg):
    errors = np.array([pitch_error(day_of(seed, noise_deg=noise_deg)) for seed in range(6)])
    assert abs(np.degrees(errors[:, 0].mean())) < 0.12
    assert np.sqrt(np.mean((errors[:, 0] / errors[:, 1]) ** 2)) < 1.8


def test_bounce_off_the_road_stays_within_the_sigma():
    # One detection in six came or went by way of the road.
    errors = np.array([pitch_error(day_of(seed, noise_deg=2.0, mirrored=0.08)) for seed in range(6)])
    assert abs(np.degrees(errors[:, 0].mean())) < 0.3
    assert np.sqrt(np.mean((errors[:, 0] / errors[:, 1]) ** 2)) < 1.8


def test_a_radar_that_looks_to_the_corner_knows_its_pitch_as_well():
    T = from_rotation_translation(
        exp_so3(np.array([0.0, 0.0, 0.8])) @ T_LIDAR_RADAR[:3, :3], T_LIDAR_RADAR[:3, 3]
    )
    error, sigma = pitch_error(day_of(6, T=T), T)
    assert abs(error) < 3 * sigma
    assert np.degrees(sigma) < 0.3


def test_standing_cars_flat_radars_and_streets_without_ground_say_nothing():
    [o] = day_of(7, 1)
    blind = replace(o, lidar_map_is_ground=np.zeros_like(o.lidar_map_is_ground))
    flat = replace(o, radar_has_elevation=False)
    lost = replace(o, radar_velocity_mps=None)
    [standing] = day_of(7, 1, speed=1.0)
    assert travel_directions([o], T_LIDAR_RADAR, 0.0).count == 1
    travel = travel_directions([blind, flat, lost, standing], T_LIDAR_RADAR, 0.0)
    assert travel.count == 0
    H, g, scatter = pitch_equations(travel, T_LIDAR_RADAR, 4)
    assert not H.any()
    assert not g.any()
    assert np.isnan(scatter)
