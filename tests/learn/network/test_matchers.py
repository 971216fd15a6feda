"""The oracle: true classes and no training must find known turns, and nothing where there is nothing to find."""

from functools import lru_cache

import numpy as np
import pytest
import torch

from pipeline.learn.network.class_matcher import NEUTRAL, ClassMatcher
from pipeline.learn.network.least_squares import angular_jacobian, small_rotation_vector, spherical_jacobian
from pipeline.learn.network.matching_network import MatchingCore
from pipeline.learn.network.occupancy_matcher import OccupancyMatcher, _away, _kernel
from pipeline.learn.network.outputs import pose_of_twist
from pipeline.learn.sample.grid import Grid, NetworkConfig, grid_rays
from pipeline.rig.se3 import camera_direction_angles, exp_se3, exp_so3, to_spherical

GRID = Grid()


@lru_cache
def street(seed=0):
    """Directions of a fine grid, their range and class: objects of ten classes before a far wall of one class."""
    rng = np.random.default_rng(seed)
    rays = grid_rays(GRID.finer(2))
    azimuth, elevation = np.moveaxis(np.degrees(camera_direction_angles(rays)), -1, 0)
    kind, distance = np.full(azimuth.shape, 2), np.full(azimuth.shape, 45.0)
    kind[elevation < -3], distance[elevation < -3] = 0, 25.0
    for _ in range(30):
        a, e = rng.uniform(-36, 36), rng.uniform(-8, 5)
        w, h = rng.uniform(1, 4, 2)
        inside = (np.abs(azimuth - a) < w) & (np.abs(elevation - e) < h)
        nearer = inside & (distance > (d := rng.uniform(6, 40)))
        kind[nearer], distance[nearer] = rng.integers(3, 10), d
    return rays, kind, distance


@lru_cache
def observed():
    """Likelihood maps of the camera, and 1500 lidar points in the optical frame with one-hot classes."""
    rays, kind, distance = street()
    cells = (
        kind.reshape(GRID.height, 2, GRID.width, 2).transpose(0, 2, 1, 3).reshape(GRID.height, GRID.width, 4)
    )
    share = np.stack([(cells == k).mean(-1) for k in range(10)])
    likelihood = torch.log(torch.tensor(share * 0.9 + 0.01, dtype=torch.float32))[None]
    rng = np.random.default_rng(1)
    picked = rng.choice(kind.size, 1500, replace=False)
    points = (rays * distance[..., None]).reshape(-1, 3)[picked]
    classes = torch.nn.functional.one_hot(torch.tensor(kind.ravel()[picked]), 10).float()[None]
    return likelihood, torch.tensor(points, dtype=torch.float32)[None], classes


def matched(T, passes=3, grid_matcher=None):
    """Twists in degrees and metres that are left after some passes from points moved by T."""
    likelihood, points, classes = observed()
    matcher = grid_matcher or ClassMatcher(GRID)
    T = torch.tensor(T, dtype=torch.float32)[None]
    with torch.no_grad():
        for _ in range(passes):
            moved = points @ T[0, :3, :3].T + T[0, :3, 3]
            found = matcher(likelihood, moved, classes, torch.ones(1, points.shape[1]))
            T = pose_of_twist(found.twist) @ T
    return np.degrees(small_rotation_vector(T[:, :3, :3])[0].numpy()), T[0, :3, 3].numpy(), found


def test_perfect_semantics_at_the_right_place_ask_for_no_turn():
    # Half a cell would be 0.2 deg: the error that looks like slow learning.
    turn, shift, _ = matched(np.eye(4), passes=1)
    assert np.abs(turn).max() < 0.05
    assert np.abs(shift).max() < 0.02


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle_deg", [-3.0, 0.7, 5.0])
def test_a_known_turn_about_each_axis_is_undone(axis, angle_deg):
    omega = np.zeros(3)
    omega[axis] = np.radians(angle_deg)
    T = np.eye(4)
    T[:3, :3] = exp_so3(omega)
    turn, _, _ = matched(T)
    assert np.abs(turn).max() < 0.12


def test_parallax_tells_a_sideways_shift_from_a_turn():
    matcher = ClassMatcher(GRID)
    with torch.no_grad():
        matcher.log_prior_sigma[3:] = np.log(0.3)  # let translations move
    T = np.eye(4)
    T[0, 3] = 0.25
    _, shift, _ = matched(T, passes=4, grid_matcher=matcher)
    assert abs(shift[0]) < 0.12


def test_a_narrow_image_does_not_push_points_out_of_itself():
    # Twice the points that it sees lie beside it: were all classes alike there, the sweep would gain by leaving.
    likelihood, points, classes = observed()
    seen = torch.zeros(1, 1, GRID.height, GRID.width)
    seen[..., 20:50, 60:140] = 1
    doubtful = torch.log(torch.exp(likelihood) * 0.5 + 0.05)
    core = MatchingCore(NetworkConfig(pairs="camera_lidar", grid=GRID, width=8, hidden=32))
    view = torch.cat([torch.zeros(1, 3, *seen.shape[2:]), seen], 1)
    turned = points @ torch.tensor(exp_so3(np.radians([1.5, -2.0, 0.5])), dtype=torch.float32).T
    with torch.no_grad():
        known = core.camera_log_likelihood(view, doubtful)
        R = np.eye(3)
        for _ in range(3):
            moved = turned @ torch.tensor(R.T, dtype=torch.float32)
            found = core.lidar_matcher(known[:, :-1], moved, classes, core._worth(known, moved))
            R = pose_of_twist(found.twist)[0, :3, :3].numpy() @ R
    left = np.degrees(np.arccos((np.trace(R @ exp_so3(np.radians([1.5, -2.0, 0.5]))) - 1) / 2))
    assert left < 0.5


@pytest.mark.parametrize("apart_m", [0.1, 60.0])
def test_kernels_of_points_far_apart_are_no_subnormal_numbers(apart_m):
    """Ten times as long does a product of matrices take with them."""
    density = torch.tensor(0.1**2 / 400.0)  # of the nearest point there can be
    kernel = _kernel(_away(torch.tensor([5.0]), torch.tensor([5.0 + apart_m]), torch.tensor(0.35)))
    assert float(kernel * (kernel * density)) > torch.finfo(torch.float32).tiny
    assert float(kernel) == pytest.approx(np.exp(-0.5 * (apart_m / 0.35) ** 2), abs=1e-15, rel=1e-5)


def test_edges_find_the_boundaries_of_what_nobody_knows_the_class_of():
    borders_deg = np.array([-27.0, -16.0, -7.0, 3.0, 14.0, 22.0])
    azimuth = np.degrees(GRID.azimuth_rad())
    kind = torch.tensor(np.searchsorted(borders_deg, azimuth) % 10)
    maps = torch.log(torch.nn.functional.one_hot(kind, 10).float() * 0.9 + 0.01)
    maps = maps.T[None, :, None].expand(1, 10, GRID.height, GRID.width)
    rng = np.random.default_rng(0)
    a, e = np.radians(rng.choice(borders_deg + 0.0, 400)), np.radians(rng.uniform(-12, 8, 400))
    rays = np.stack([-np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)], -1)
    turn = exp_so3(np.radians([0.0, 2.5, 0.0]))
    points = torch.tensor(20 * rays @ turn.T, dtype=torch.float32)[None]
    core = MatchingCore(NetworkConfig("matching", "camera_lidar", GRID, 8, 32, takes_classes=True))
    nothing = torch.zeros(1, 400, 10)
    left = {}
    for edges in (0.0, 1.0):
        with torch.no_grad():
            table, classes = core._with_edges(maps, nothing, torch.full((1, 400, 1), edges))
            found = core.lidar_matcher(table, points, classes, torch.ones(1, 400))
        left[edges] = 2.5 + np.degrees(float(found.twist[0, 1]))  # upright boundaries tell azimuth alone
    assert left[0.0] > 1.0
    assert abs(left[1.0]) < 0.2


def test_blind_cameras_move_nothing_and_leave_the_prior_s_variance():
    likelihood, points, classes = observed()
    matcher = ClassMatcher(GRID)
    with torch.no_grad():
        found = matcher(torch.full_like(likelihood, NEUTRAL), points, classes, torch.ones(1, points.shape[1]))
        none = matcher(likelihood, points, classes, torch.zeros(1, points.shape[1]))
    for match in (found, none):
        assert match.twist.abs().max() < 1e-4
        assert match.variance[0].numpy() == pytest.approx(
            np.exp(2 * matcher.log_prior_sigma.detach().numpy()), rel=0.02
        )


def radar_scene(seed=0, elevation_deg=1.0):
    """Boxes of lidar points and radar detections on them, with noise and clutter; lidar frame."""
    rng = np.random.default_rng(seed)
    centres = np.stack([rng.uniform(8, 50, 25), rng.uniform(-0.5, 0.5, 25), rng.uniform(-1.5, 1, 25)], -1)
    centres[:, 1] *= centres[:, 0]
    objects = (centres[:, None] + rng.uniform(-0.5, 0.5, (25, 40, 3)) * [0.3, 1.5, 1.2]).reshape(-1, 3)
    polar = to_spherical(centres[rng.integers(0, 25, 120)])
    polar += rng.normal(0, 1, (120, 3)) * [np.radians(0.4), np.radians(elevation_deg), 0.1]
    clutter = np.stack([rng.uniform(-0.5, 0.5, 40), rng.uniform(-0.2, 0.2, 40), rng.uniform(5, 60, 40)], -1)
    a, e, r = np.concatenate([polar, clutter]).T
    radar = np.stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)], -1)
    return torch.tensor(objects, dtype=torch.float32)[None], radar


def radar_left(xi, seed=0, *, elevation=True, passes=3):
    objects, radar = radar_scene(seed)
    T = torch.tensor(exp_se3(np.asarray(xi, float)), dtype=torch.float32)[None]
    radar = torch.tensor(radar, dtype=torch.float32)[None]
    matcher = OccupancyMatcher(3)
    real = torch.ones(1, radar.shape[1], dtype=torch.bool)
    with torch.no_grad():
        for _ in range(passes):
            moved = radar @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
            found = matcher(
                moved, torch.zeros_like(moved), real, torch.tensor([elevation]), objects,
                torch.ones(1, objects.shape[1]),
            )  # fmt: skip
            T = pose_of_twist(found.twist) @ T
    return np.degrees(small_rotation_vector(T[:, :3, :3])[0].numpy()), T[0, :3, 3].numpy(), found


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (0, 0, 4), (0, -3, 0), (2, 2, -3), (0, 3, 5)])
def test_radar_finds_the_lidar_s_objects_again(turn_deg):
    left, shift, _ = radar_left([*np.radians(turn_deg), 0.03, -0.03, 0.0])
    assert abs(left[2]) < 0.3
    assert abs(left[1]) < 0.6
    assert np.abs(shift).max() < 0.15


def test_a_radar_without_elevation_turns_about_the_upright_axis_alone():
    left, _, found = radar_left(np.radians([1.0, 2.0, 3.0, 0, 0, 0]), elevation=False, passes=1)
    assert abs(left[2]) < 0.4
    assert left[:2] == pytest.approx([1.0, 2.0], abs=0.2)
    # Nothing was learned of roll and pitch: their variance is the prior's.
    assert found.variance[0, :2].sqrt().numpy() == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("jacobian", "angles", "scale"),
    [(angular_jacobian, camera_direction_angles, "inverse"), (spherical_jacobian, to_spherical, "range")],
)
def test_jacobians_agree_with_differences(jacobian, angles, scale):
    rng = np.random.default_rng(1)
    points = rng.uniform(-2, 2, (7, 3)) + [[12, 0, 0], [0, 0, 12]][scale == "inverse"]
    distance = np.linalg.norm(points, axis=1)
    J = jacobian(
        torch.tensor(points / distance[:, None])[None],
        torch.tensor(1 / distance if scale == "inverse" else distance)[None],
    )[0].numpy()
    h = 1e-6
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = h
        up, down = exp_se3(xi), exp_se3(-xi)
        difference = angles(points @ up[:3, :3].T + up[:3, 3]) - angles(points @ down[:3, :3].T + down[:3, 3])
        assert J[..., k] == pytest.approx(difference / (2 * h), abs=1e-6)
