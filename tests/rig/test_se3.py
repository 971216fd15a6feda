"""Laws of SE(3), covariances against Monte Carlo, spherical coordinates, and static transforms along a tree."""

from itertools import product
from types import SimpleNamespace as Space

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pipeline.rig import se3
from pipeline.rig.se3 import (
    camera_direction_angles,
    change_between,
    change_covariance,
    exp_se3,
    from_spherical,
    inverse,
    spherical_jacobian,
    to_quaternion,
    to_spherical,
    wrap_angle,
)
from pipeline.rig.transform_tree import TransformTree

finite = st.floats(-3.0, 3.0)
batches = st.sampled_from([(), (1,), (4,), (2, 3), (0,)])

# Angles where series, quaternion branches and the wrap at pi can go wrong.
angles = st.one_of(
    st.floats(0.0, np.pi - 1e-3),
    st.sampled_from(
        [0.0, 1e-12, 1e-9, 1e-6, 0.999e-3, 1e-3, 1.001e-3, 0.1, np.pi / 2, np.pi - 1e-4, np.pi - 1e-7]
    ),
)


@st.composite
def rotation_vectors(draw, shape=None):
    shape = draw(batches) if shape is None else shape
    axis = draw(hnp.arrays(np.float64, (*shape, 3), elements=finite))
    norm = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = np.where(norm > 1e-3, axis / np.where(norm > 1e-3, norm, 1), [1.0, 0, 0])
    return axis * draw(hnp.arrays(np.float64, (*shape, 1), elements=angles))


@st.composite
def twists(draw, shape=None):
    phi = draw(rotation_vectors(shape))
    return np.concatenate([phi, draw(hnp.arrays(np.float64, phi.shape, elements=st.floats(-50, 50)))], -1)


def close(a, b, atol=1e-10):
    np.testing.assert_allclose(a, b, atol=atol, rtol=1e-9)


@given(twists(shape=()), twists(shape=()), twists(shape=()))
def test_transforms_form_a_group(a, b, c):
    A, B, C = se3.exp_se3(a), se3.exp_se3(b), se3.exp_se3(c)
    close((A @ B) @ C, A @ (B @ C), 1e-9)
    close(A @ se3.inverse(A), np.eye(4))
    close(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), 1e-9)
    close(A @ np.eye(4), A)


@given(rotation_vectors(shape=()))
def test_log_so3_of_half_a_turn_is_one_of_the_two_answers(phi):
    norm = np.linalg.norm(phi)
    axis = phi / norm if norm > 0 else np.array([0, 0, 1.0])
    found = se3.log_so3(se3.exp_so3(np.pi * axis))
    assert abs(np.linalg.norm(found) - np.pi) < 1e-7
    assert abs(abs(found @ axis) - np.pi) < 1e-7


@given(twists())
def test_log_se3_inverts_exp(xi):
    np.testing.assert_allclose(se3.log_se3(se3.exp_se3(xi)), xi, atol=2e-6, rtol=1e-7)


@given(twists(shape=()))
def test_exp_se3_is_the_matrix_exponential(xi):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.hat(xi[:3]), xi[3:]
    close(se3.exp_se3(xi), expm(generator), 1e-9)


@given(rotation_vectors(), st.floats(-10, 10))
def test_quaternions_round_trip_with_w_first_and_not_negative(phi, x):
    T = se3.from_rotation_translation(se3.exp_so3(phi), np.full(phi.shape, x))
    q = se3.to_quaternion(T)
    assert np.all(q[..., 0] >= 0)
    close(np.linalg.norm(q, axis=-1), np.ones(phi.shape[:-1]), 1e-12)
    close(se3.from_quaternion(3.0 * q, T[..., :3, 3]), T, 1e-12)
    scipy_xyzw = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(*phi.shape[:-1], 4)
    same = np.abs(np.sum(q * scipy_xyzw[..., [3, 0, 1, 2]], -1))
    close(same, np.ones(phi.shape[:-1]), 1e-12)


def covariance(rng, rotation_rad, translation_m):
    A = rng.normal(size=(6, 6)) @ np.diag(rng.uniform(0.3, 1, 6))
    scale = np.array([rotation_rad] * 3 + [translation_m] * 3)
    C = A @ A.T
    C /= np.sqrt(np.outer(np.diag(C), np.diag(C)))
    return C * np.outer(scale, scale)


def sample_covariance(T_mean, T_samples):
    return np.cov(se3.log_se3(T_samples @ se3.inverse(T_mean)).T)


def whitened(C, C_expected):
    """C in the units of what was expected: the identity where they agree."""
    L = np.linalg.inv(np.linalg.cholesky(C_expected))
    return L @ C @ L.T


def test_composed_covariances_agree_with_monte_carlo():
    rng = np.random.default_rng(0)
    T_a_b, T_b_c = se3.exp_se3(rng.normal(size=6) * [1, 1, 1, 2, 2, 2]), se3.exp_se3(rng.normal(size=6))
    cov_a_b, cov_b_c = covariance(rng, 0.01, 0.02), covariance(rng, 0.02, 0.01)
    n = 40_000  # spread of an estimated variance: sqrt(2/n) = 0.7 %
    A = se3.exp_se3(rng.multivariate_normal(np.zeros(6), cov_a_b, n)) @ T_a_b
    B = se3.exp_se3(rng.multivariate_normal(np.zeros(6), cov_b_c, n)) @ T_b_c
    composed = se3.compose_covariance(T_a_b, cov_a_b, cov_b_c)
    np.testing.assert_allclose(
        whitened(sample_covariance(T_a_b @ T_b_c, A @ B), composed), np.eye(6), atol=0.05
    )


@settings(max_examples=30)
@given(twists(shape=()), hnp.arrays(np.float64, 3, elements=st.floats(-30, 30)))
def test_left_perturbation_of_a_point_has_the_derivative_that_conventions_state(xi, point):
    T = se3.exp_se3(xi)
    moved = se3.transform_points(T, point)
    J = np.concatenate([-se3.hat(moved), np.eye(3)], 1)
    step = 1e-6
    for i in range(6):
        delta = np.eye(6)[i] * step
        ahead = se3.transform_points(se3.exp_se3(delta) @ T, point)
        back = se3.transform_points(se3.exp_se3(-delta) @ T, point)
        np.testing.assert_allclose((ahead - back) / (2 * step), J[:, i], atol=1e-5)


def test_covariance_of_a_change_agrees_with_monte_carlo():
    rng = np.random.default_rng(4)
    T, C = se3.exp_se3(rng.normal(size=6)), covariance(rng, 0.01, 0.01)
    samples = se3.exp_se3(rng.multivariate_normal(np.zeros(6), C, 20_000)) @ T
    found = np.cov(np.array([change_between(T, S) for S in samples]).T)
    np.testing.assert_allclose(whitened(found, change_covariance(T, C)), np.eye(6), atol=0.06)


shapes = st.sampled_from([(3,), (4, 3), (2, 3, 3), (0, 3)])
points = shapes.flatmap(lambda s: hnp.arrays(np.float64, s, elements=st.floats(-200, 200)))


@given(points)
def test_spherical_round_trip(xyz):
    np.testing.assert_allclose(from_spherical(to_spherical(xyz)), xyz, atol=1e-9)


def test_azimuth_grows_to_the_left_and_elevation_upwards():
    left, up, back = to_spherical(np.array([[1.0, 1, 0], [1, 0, 1], [-2, 0, 0]]))
    np.testing.assert_allclose(left, [np.pi / 4, 0, np.sqrt(2)])
    np.testing.assert_allclose(up, [0, np.pi / 4, np.sqrt(2)])
    np.testing.assert_allclose(back, [np.pi, 0, 2])
    np.testing.assert_array_equal(to_spherical(np.zeros(3)), np.zeros(3))


def test_camera_angles_have_the_signs_of_the_other_sensors():
    # optical frame: x right, y down, z forward
    left, up = camera_direction_angles(np.array([[-1.0, 0, 1], [0, -1, 1]]))
    np.testing.assert_allclose(left, [np.pi / 4, 0])
    np.testing.assert_allclose(up, [0, np.pi / 4])


def test_spherical_jacobian_agrees_with_central_differences():
    xyz = np.random.default_rng(0).uniform(-30, 30, (60, 3))
    xyz = xyz[np.hypot(xyz[:, 0], xyz[:, 1]) > 1]
    J, step = spherical_jacobian(xyz), 1e-5
    for i in range(3):
        d = np.eye(3)[i] * step
        difference = to_spherical(xyz + d) - to_spherical(xyz - d)
        difference[:, 0] = wrap_angle(difference[:, 0])
        np.testing.assert_allclose(J[..., i], difference / (2 * step), atol=1e-6)


def test_transforms_are_found_along_the_tree_in_both_directions():
    rng = np.random.default_rng(1)
    parents = {
        "base": "map", "kit": "base", "camera": "kit", "lidar": "kit", "radar": "base", "island": "alone",
    }  # fmt: skip
    T_map = {"map": np.eye(4), "alone": np.eye(4)}
    tree = TransformTree()
    for child, parent in parents.items():
        T = exp_se3(rng.normal(size=6))
        T_map[child] = T_map[parent] @ T
        assert tree.add(f"/{parent}", child, tuple(to_quaternion(T)), tuple(T[:3, 3]))
    for a, b in product(("map", "base", "kit", "camera", "lidar", "radar"), repeat=2):
        np.testing.assert_allclose(tree.lookup(a, b), inverse(T_map[a]) @ T_map[b], atol=1e-12)
    assert tree.lookup("camera", "island") is None
    assert tree.lookup("camera", "nowhere") is None
    assert tree.lookup("", "camera") is None


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0)]
)
def test_what_is_no_rotation_is_not_taken(q):
    tree = TransformTree()
    assert not tree.add("a", "b", q, (0.0, 0.0, 0.0))
    assert tree.lookup("a", "b") is None
    moved = Space(rotation=Space(**dict(zip("wxyz", q, strict=True))), translation=Space(x=0.0, y=0.0, z=0.0))
    entry = Space(header=Space(frame_id="a"), child_frame_id="b", transform=moved)
    assert tree.add_message(Space(transforms=[entry])) == 1
