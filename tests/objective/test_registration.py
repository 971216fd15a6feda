"""Static radar detections against the lidar map: Jacobians, gradient, basin, what elevation and sigmas mean."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.objective.radar.registration import (
    SIGMA_START,
    RegistrationFrames,
    normal_equations,
    registration_frames,
)
from pipeline.objective.radar.registration_neighbours import _angle
from pipeline.rig.se3 import exp_se3, inverse, to_spherical, transform_points
from tests.makers.radar_scenes import DT_S, SIGMA, T_LIDAR_RADAR, street_day
from tests.objective import plain_numpy

RADAR = np.array([12.0, -4.0, 1.1])
VELOCITY = np.array([9.0, -0.4, 0.2])
YAW_RATE = 0.3
GAP_S = 0.004


def one_pair(lidar_point):
    """A single detection and a single lidar point."""
    return RegistrationFrames(
        RADAR[None], np.array([0, 1]), lidar_point[None], np.array([0, 1]), np.zeros((1, 4)), np.array([False]),
        np.array([True]), VELOCITY[None], np.array([YAW_RATE]), np.array([GAP_S]), np.array([0]),
    )  # fmt: skip


def seen_by_radar(T, tau, lidar_point):
    """The model written down plainly: where a static lidar point appears to a radar that looks tau later."""
    q = transform_points(inverse(T), lidar_point)
    return to_spherical(q - (VELOCITY + np.cross([0, 0, YAW_RATE], q)) * tau)


def matching_lidar_point(tau):
    A = np.eye(3) - tau * np.array([[0, -YAW_RATE, 0], [YAW_RATE, 0, 0], [0, 0, 0]])
    return transform_points(T_LIDAR_RADAR, np.linalg.solve(A, RADAR + VELOCITY * tau))


def test_jacobian_agrees_with_central_differences():
    dt, tau = 0.03, 0.03 + GAP_S
    point = matching_lidar_point(tau)
    assert np.allclose(seen_by_radar(T_LIDAR_RADAR, tau, point), to_spherical(RADAR))

    def seen(step):
        return seen_by_radar(exp_se3(step[:6]) @ T_LIDAR_RADAR, tau + step[6], point)

    of_range_bias = [[0.0], [0.0], [1.0]]
    J = np.hstack([plain_numpy.central_differences(seen, 7), of_range_bias]) / SIGMA_START[:, None]
    N = normal_equations(one_pair(point), T_LIDAR_RADAR, dt, SIGMA_START, 0.0, outlier=1e-12)
    scale = np.abs(J).max()
    assert np.allclose(N.H[0, 0], J[[0, 2]].T @ J[[0, 2]], atol=3e-4 * scale**2)
    assert np.allclose(N.H[1, 0], J[1:2].T @ J[1:2], atol=3e-4 * scale**2)


def test_gradient_agrees_with_differences_of_the_cost():
    tau = GAP_S
    frames = one_pair(matching_lidar_point(tau))
    T = exp_se3(np.array([0.004, 0.006, -0.003, 0.05, -0.04, 0.02])) @ T_LIDAR_RADAR

    def at(step):
        return normal_equations(frames, exp_se3(step) @ T, 0.0, SIGMA_START, 0.0, outlier=0.3)

    gradient = at(np.zeros(6)).g[:, 0].sum(0)
    slopes = plain_numpy.central_differences(lambda step: at(step).cost[0], 6)
    # J stands at the detection, not at the lidar point: a per cent at these offsets.
    assert gradient[:6] == pytest.approx(slopes, rel=0.03, abs=0.02 * np.abs(gradient).max())


def test_the_cost_is_least_at_the_truth():
    frames = registration_frames(street_day(12), T_LIDAR_RADAR, np.random.default_rng(0))

    def cost(T, dt=DT_S):
        return normal_equations(frames, T, dt, SIGMA, 0.0, 0.2).cost.mean()

    def moved(axis, size):
        xi = np.zeros(6)
        xi[axis] = size
        return exp_se3(xi) @ T_LIDAR_RADAR

    best = cost(T_LIDAR_RADAR)
    for axis, size in ((2, np.radians(0.3)), (3, 0.08), (4, 0.08)):
        assert cost(moved(axis, size)) > best
        assert cost(moved(axis, -size)) > best
    assert cost(T_LIDAR_RADAR, DT_S + 0.03) > best
    assert cost(T_LIDAR_RADAR, DT_S - 0.03) > best


def test_ground_bounces_are_recognised():
    day = street_day(10)
    mirrored = []
    for o in day:
        lidar = transform_points(T_LIDAR_RADAR, o.radar_xyz_m.astype(np.float64))
        bounce = (np.arange(len(lidar)) % 2 == 0) & (lidar[:, 2] > -0.5)
        lidar[bounce, 2] = 2 * -1.7 - lidar[bounce, 2]
        xyz = transform_points(inverse(T_LIDAR_RADAR), lidar)
        mirrored.append(replace(o, radar_xyz_m=xyz.astype(np.float32)))
    shares = []
    for observations in (day, mirrored):
        frames = registration_frames(observations, T_LIDAR_RADAR, np.random.default_rng(0))
        shares.append(normal_equations(frames, T_LIDAR_RADAR, DT_S, SIGMA, 0.12, 0.2).bounced)
    assert shares[1] > 3 * shares[0] + 0.03


@pytest.mark.parametrize("widen", [0.2, 1.0, 4.0])
def test_every_lidar_point_in_reach_takes_part(widen):
    """Against every pair of detection and point in plain NumPy, at sigmas sharper and wider than the cells."""
    frames = registration_frames(street_day(3), T_LIDAR_RADAR, np.random.default_rng(0))
    about = (T_LIDAR_RADAR, 0.04, widen * SIGMA_START, 0.12, 0.2)
    ours, plain = normal_equations(frames, *about), plain_numpy.registration(frames, *about)
    for a, b in zip((ours.H, ours.g, ours.information, ours.cost), plain, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())
    turning = replace(frames, yaw_rate_radps=np.full(frames.count, YAW_RATE))
    cost = normal_equations(turning, *about).cost
    assert np.abs(cost - ours.cost).max() > 1e-3
    np.testing.assert_allclose(cost, plain_numpy.registration(turning, *about)[3], atol=1e-7)


def test_angles_by_a_polynomial_are_those_of_atan2():
    at = np.linspace(-1.7, 1.7, 201)
    found = [_angle.py_func(3 * np.sin(a), 3 * np.cos(a), 3.0) for a in at]
    np.testing.assert_allclose(found, at, atol=2e-11)
