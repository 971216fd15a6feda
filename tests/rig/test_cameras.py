import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.rig.cameras import Camera

# Coefficients as calibrations of car cameras give them; a barrel that folds over far outside the image.
DISTORTIONS = {
    "none": ("plumb_bob", []),
    "plumb_bob": ("plumb_bob", [-0.32, 0.12, 1e-3, -5e-4, -0.02]),
    "plumb_bob_4": ("plumb_bob", [0.05, -0.02, -2e-3, 1e-3]),
    "rational": ("rational_polynomial", [2.3, 0.9, 3e-4, -2e-4, 0.03, 2.7, 1.6, 0.19]),
    "f_theta": ("equidistant", []),
    "fisheye": ("equidistant", [0.03, -0.012, 0.004, -0.001]),
}


def camera(name, width=1824, height=940):
    model, D = DISTORTIONS[name]
    f = 900.0
    K = np.array([[f, 0, width / 2 + 7.3], [0, 1.02 * f, height / 2 - 4.1], [0, 0, 1]])
    return Camera(model, K, np.array(D), width, height)


every_camera = pytest.mark.parametrize("name", DISTORTIONS)
distorted = pytest.mark.parametrize("name", [n for n, (_, D) in DISTORTIONS.items() if D])
pixels = hnp.arrays(np.float64, (7, 2), elements=st.floats(0, 1)).map(lambda u: u * [1823, 939])


@every_camera
def test_rays_of_pixels_project_back_onto_them_at_any_depth(name):
    cam = camera(name)

    @given(pixels, st.floats(0.5, 200))
    def law(uv, depth):
        rays = cam.unproject(uv)
        seen = np.isfinite(rays).all(-1)
        assert seen.all() or name == "plumb_bob"  # a strong barrel has no ray for the outermost corners
        np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=-1), 1, atol=1e-12)
        back, valid = cam.project(rays[seen] * depth)
        assert valid.all()
        np.testing.assert_allclose(back, uv[seen], atol=1e-6)

    law()


@every_camera
def test_projection_agrees_with_opencv(name):
    cam = camera(name)
    points = np.random.default_rng(1).uniform([-4, -2, 5], [4, 2, 30], (50, 3))
    zero = np.zeros(3)
    if cam.model == "equidistant":
        D = np.zeros(4) if not len(cam.D) else cam.D
        expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, cam.K, D)[0][:, 0]
    else:
        expected = cv2.projectPoints(points, zero, zero, cam.K, cam.D)[0][:, 0]
    np.testing.assert_allclose(cam.project(points)[0], expected, atol=1e-6)


@every_camera
def test_points_behind_the_camera_are_not_seen_or_are_beyond_the_image(name):
    cam = camera(name)
    behind = np.random.default_rng(3).uniform([-20, -20, -40], [20, 20, -0.1], (300, 3))
    uv, valid = cam.project(behind)
    assert not (valid & cam.contains(uv)).any()
    assert np.isfinite(uv).all()


@distorted
def test_no_point_beyond_the_fold_appears_inside_the_image(name):
    cam = camera(name)
    # Walk outwards: where the model is valid, a larger angle lies farther from the centre.
    theta = np.linspace(0, min(cam.max_angle_rad * 1.5, 3.1), 500)
    points = 10 * np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    uv, valid = cam.project(points)
    assert not valid[theta > cam.max_angle_rad + 1e-9].any()
    radius = uv[valid, 0] - cam.centre_px[0]
    assert (np.diff(radius) > -1e-3 * np.abs(radius[1:])).all()


@pytest.mark.parametrize("name", ["f_theta", "fisheye"])
def test_the_fast_polynomial_stays_within_a_thousandth_of_a_pixel(name):
    cam = camera(name)
    coefficients, claimed_px = cam.fast_polynomial()
    assert claimed_px < 1e-3
    u, v = np.meshgrid(np.linspace(0, 1823, 60), np.linspace(0, 939, 40))
    uv = np.stack([u, v], -1)
    rays = cam.unproject(uv)
    k = np.polynomial.polynomial.polyval(rays[..., 2], coefficients)
    fast = k[..., None] * rays[..., :2] * cam.focal_px + cam.centre_px
    assert np.abs(fast - uv).max() < 1e-3


@every_camera
def test_a_scaled_camera_sees_the_same_rays(name):
    cam = camera(name)
    half = cam.scaled(0.5)
    assert (half.width_px, half.height_px) == (912, 470)
    uv = np.array([[500.0, 300.0], [912.0, 470.0], [1300.0, 700.0]])
    np.testing.assert_allclose(half.unproject((uv + 0.5) * 0.5 - 0.5), cam.unproject(uv), atol=1e-9)


def test_contains_counts_the_outer_half_of_border_pixels_and_respects_a_margin():
    cam = camera("none", 100, 50)
    uv = np.array([[-0.5, -0.5], [99.5, 49.5], [-0.6, 10], [99.6, 10], [50, 49.6], [4, 25], [5, 25]])
    np.testing.assert_array_equal(cam.contains(uv)[:5], [True, True, False, False, False])
    np.testing.assert_array_equal(cam.contains(uv, 5.0)[5:], [False, True])


@pytest.mark.parametrize(
    ("model", "K", "D", "match"),
    [
        ("omni", np.eye(3), [], "not one of"),
        ("equidistant", np.eye(3), [1, 2, 3, 4, 5], "coefficients"),
        ("plumb_bob", np.eye(3), [1, 2, 3], "coefficients"),
        ("plumb_bob", np.diag([0.0, 1, 1]), [], "focal"),
        ("plumb_bob", np.diag([np.nan, 1, 1]), [], "focal"),
    ],
)
def test_impossible_intrinsics_are_refused(model, K, D, match):
    with pytest.raises(ValueError, match=match):
        Camera(model, K, np.array(D), 10, 10)
