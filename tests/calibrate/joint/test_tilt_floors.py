"""Roll and pitch of radars that look anywhere: the way a radar is turned changes axes, not what is known."""

import numpy as np
import pytest

from pipeline.calibrate.joint.lidar_radar.elevation_errors import (
    along_radar,
    following_tilt,
    radar_tilt_axes,
    tempered,
    tilt_of,
)
from pipeline.rig.se3 import exp_so3, from_rotation_translation

FLOOR = np.array([0.02, 0.004, 0.1])  # of the radar's own roll, pitch [rad] and z [m]


def looking(azimuth_deg, tilt=(0.0, 0.0)):
    R = exp_so3(np.array([0.0, 0.0, np.radians(azimuth_deg)])) @ exp_so3(np.array([*tilt, 0.0]))
    return from_rotation_translation(R, np.array([3.0, 0.5, -0.6]))


def equations(rng, frames=6, unknowns=3):
    A = rng.normal(size=(frames, unknowns, unknowns))
    return A @ np.swapaxes(A, 1, 2), rng.normal(size=(frames, unknowns))


@pytest.mark.parametrize("azimuth_deg", [0.0, 45.0, -45.0, 135.0])
def test_a_turned_radar_knows_as_much_about_its_own_axes(azimuth_deg):
    rng = np.random.default_rng(1)
    H_own, g_own = equations(rng)
    T = looking(azimuth_deg, tilt=(0.03, -0.02))
    axes = np.eye(3)
    axes[:2, :2] = radar_tilt_axes(T)
    expected, _ = tempered(H_own, g_own, np.diag(FLOOR**2))
    H, g = tempered(axes @ H_own @ axes.T, g_own @ axes.T, along_radar(T, FLOOR))
    found, _ = tilt_of(T, H.sum(0), g.sum(0))
    np.testing.assert_allclose(found, expected.sum(0), rtol=1e-9, atol=1e-9)


def test_the_weak_roll_of_a_corner_radar_is_not_its_roll_about_the_cars_axis():
    covariance = along_radar(looking(45.0), FLOOR)
    diagonal = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    across = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
    assert diagonal @ covariance @ diagonal == pytest.approx(FLOOR[0] ** 2)
    assert across @ covariance @ across == pytest.approx(FLOOR[1] ** 2)
    assert np.allclose(along_radar(looking(0.0), FLOOR), np.diag(FLOOR**2))


def test_what_is_solved_with_a_wrong_tilt_errs_as_a_solution_with_it_shows():
    rng = np.random.default_rng(2)
    H, _ = equations(rng, 1, 5)
    H, prior, truth = H[0] + np.eye(5), np.diag([0.1] * 5), rng.normal(size=5)
    given, follows = np.array([0, 3]), np.array([1, 2, 4])
    wrong = truth.copy()
    wrong[given] += [0.3, -0.2]
    # Minimum over `follows` of the cost about the truth (and of a prior about it), the given ones wrong.
    block = np.ix_(follows, follows)
    pull = H[np.ix_(follows, given)] @ (wrong - truth)[given]
    wrong[follows] = truth[follows] - np.linalg.solve((H + prior)[block], pull)
    error = np.zeros(5)
    error[given] = [0.3, -0.2]
    np.testing.assert_allclose(following_tilt(H, prior, follows, given) @ error, wrong - truth, atol=1e-12)
