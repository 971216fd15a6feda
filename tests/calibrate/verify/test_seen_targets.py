"""Targets lie where both sensors of a pair see, so a rig that looks aside is certified like one that looks ahead."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.calibrate.verify.target_accuracy import seen_targets, unseen_failure, views_of
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, transform_points
from pipeline.rig.spherical import from_spherical, to_spherical
from pipeline.rig.targets import DEFAULT_TARGETS, target_sigmas
from schemas.calibrations import PAIRS
from tests.makers.radar_scenes import street_day
from tests.makers.solve_scenes import CAMERA, T_CAMERA_LIDAR, T_LIDAR_RADAR

ANGLES_DEG = np.degrees(to_spherical(DEFAULT_TARGETS)[:, :2])
# About the lidar's own axes: roll, pitch and yaw of .3, .1 and .05 deg, some centimetres.
COVARIANCE = np.diag([*np.radians([0.3, 0.1, 0.05]), 0.03, 0.02, 0.05]) ** 2


def turn(degrees, axis=2):
    return from_rotation_translation(exp_so3(np.radians(degrees) * np.eye(3)[axis]), np.zeros(3))


def around(azimuths_deg, elevations_deg=(-20.0, 10.0), seed=0):
    """Points of a sensor that sees these azimuths."""
    rng = np.random.default_rng(seed)
    low, high = np.radians(azimuths_deg)
    n = 4000
    return from_spherical(
        np.stack(
            [rng.uniform(low, high, n), np.radians(rng.uniform(*elevations_deg, n)), np.full(n, 20.0)], -1
        )
    ).astype(np.float32)


def day(lidar=(-180.0, 180.0), radar=(-50.0, 50.0)):
    columns = {"lidar_map_xyz_m": around(lidar), "radar_xyz_m": around(radar, (-5.0, 5.0), 1)}
    return [replace(o, **columns) for o in street_day(3)]


def prior(T_camera_lidar=T_CAMERA_LIDAR, T_lidar_radar=T_LIDAR_RADAR):
    return Prior(T_camera_lidar, T_lidar_radar, np.radians(2.0), 0.05)


def azimuths_deg(targets):
    return np.degrees(to_spherical(targets)[:, 0])


@pytest.mark.parametrize("pair", PAIRS)
def test_before_a_trio_that_looks_ahead_targets_are_where_they_were(pair):
    targets = seen_targets(pair, prior(), views_of(day()))
    found = to_spherical(targets)
    np.testing.assert_allclose(np.degrees(found[:, :2]), ANGLES_DEG, atol=3.0)
    np.testing.assert_allclose(found[:, 2], [15, 25, 40])


@pytest.mark.parametrize("degrees", [90, -90, 140])
def test_a_rig_turned_on_its_lidar_has_the_same_sigmas(degrees):
    """Camera and radar look to the left; what is known of the scene about the car turns with them."""
    R = turn(degrees)
    turned = prior(T_CAMERA_LIDAR @ inverse(R), R @ T_LIDAR_RADAR)
    views = views_of(day())
    for pair in PAIRS:
        ahead, aside = (seen_targets(pair, p, views) for p in (prior(), turned))
        expected = transform_points(R, ahead) if pair == "camera_lidar" else ahead
        np.testing.assert_allclose(aside, expected, atol=0.05)
        # A left perturbation turns with the parent, which is the lidar itself where the radar is its child.
        C = COVARIANCE
        if pair == "lidar_radar":
            A = np.kron(np.eye(2), R[:3, :3])
            C = A @ COVARIANCE @ A.T
        np.testing.assert_allclose(
            target_sigmas(pair, turned.of(pair), C, aside),
            target_sigmas(pair, prior().of(pair), COVARIANCE, ahead),
            rtol=0.01,
        )


def test_a_camera_to_the_left_is_not_certified_by_what_lies_ahead():
    """Turned aside, its pitch is a roll of what lies before the car: unsure by .6 deg there, it passed for sure."""
    aside = T_CAMERA_LIDAR @ inverse(turn(90))
    pitch = np.diag([np.radians(0.6), 0, 0, 0, 0, 0]) ** 2
    own = target_sigmas(
        "camera_lidar", aside, pitch, seen_targets("camera_lidar", prior(aside), views_of(day()))
    )
    ahead = target_sigmas("camera_lidar", aside, pitch)
    assert np.degrees(own[1]) == pytest.approx(0.6, abs=0.02)
    assert np.degrees(ahead[1]) < 0.2


def test_targets_stay_in_the_view_of_the_narrower_sensor():
    views = views_of(day(lidar=(20.0, 34.0)))
    targets = seen_targets("camera_lidar", prior(), views)
    assert (azimuths_deg(targets) > 19).all()
    assert (azimuths_deg(targets) < 35).all()
    assert views["lidar"](targets).all()
    uv, valid = CAMERA.project(transform_points(T_CAMERA_LIDAR, targets))
    assert valid.all()
    assert CAMERA.contains(uv).all()


def test_sensors_that_look_apart_have_no_targets_and_the_check_says_so():
    behind = prior(T_CAMERA_LIDAR @ inverse(turn(180)))
    views = views_of(day())
    assert seen_targets("camera_radar", behind, views) is None
    assert seen_targets("camera_lidar", behind, views) is not None
    assert "camera and radar see no direction in common" in unseen_failure("camera_radar").sentence
