"""Poses of a rig: transforms between any two sensors, and their covariances by the whole one."""

import numpy as np
import pytest

from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Sensor
from pipeline.rig.se3 import exp_se3, inverse, log_se3

NAMES = ("front", "corner")


@pytest.fixture
def poses():
    rng = np.random.default_rng(3)
    T = {"top": np.eye(4)} | {n: exp_se3(rng.normal(0, 0.7, 6)) for n in NAMES}
    root = rng.normal(0, 0.01, (12, 12))
    return Extrinsics(Sensor("top", "lidar"), T, NAMES, root @ root.T, 0.25 * root @ root.T)


def moved(poses, x):
    T = {n: exp_se3(x[6 * k : 6 * k + 6]) @ poses.T[n] for k, n in enumerate(poses.order)}
    return inverse(T.get("front", np.eye(4))) @ T["corner"], inverse(T["front"])


def test_the_jacobian_between_two_sensors_is_that_of_finite_differences(poses):
    for a, b, which in (("front", "corner", 0), ("front", "top", 1)):
        J, step = poses.jacobian_between(a, b), 1e-6
        for k in range(12):
            x = step * (np.arange(12) == k)
            plus, minus = (log_se3(moved(poses, s)[which] @ inverse(poses.between(a, b))) for s in (x, -x))
            np.testing.assert_allclose((plus - minus) / (2 * step), J[:, k], atol=1e-7)


def test_a_covariance_between_two_sensors_uses_what_they_share(poses):
    J = poses.jacobian_between("front", "corner")
    np.testing.assert_allclose(poses.covariance_between("front", "corner"), J @ poses.covariance @ J.T)
    quarter = poses.covariance_between("front", "corner", common=True)
    np.testing.assert_allclose(quarter, 0.25 * poses.covariance_between("front", "corner"))


def test_a_sensor_against_the_reference_has_its_own_rows(poses):
    np.testing.assert_allclose(poses.covariance_between("top", "front"), poses.covariance[:6, :6])
    np.testing.assert_array_equal(poses.between("top", "corner"), poses.T["corner"])
