import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.rig.spherical import (
    camera_direction_angles,
    from_spherical,
    spherical_jacobian,
    to_spherical,
    wrap_angle,
)

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
