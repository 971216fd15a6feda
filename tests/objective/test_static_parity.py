"""The torch term of static detections against the compiled registration: value and gradient, also beyond the limits.

Scenes: streets drawn by hand (`tests.makers.radar_scenes`) with posts that stand out of the lidar's view at the top, so
that a share of detections counts by azimuth and range alone; `test_differentiable` runs the same check
on perceived rows of the simulated rig and of the real one.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.objective.differentiable.paper import padded
from pipeline.objective.differentiable.poses import transform_points
from pipeline.objective.differentiable.static import StaticFrames, static_cost, tells_elevation
from pipeline.objective.radar.registration import (
    BOUNCE_PRIOR,
    RANGE_M,
    SIDE_RAD,
    SIGMA_START,
    VIEW_MARGIN_RAD,
    normal_equations,
    registration_frames,
)
from pipeline.rig import se3
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.torch_poses import exp_se3

PARITY = 1e-3
ALL = 10**6  # thin nothing out
TRUSTED_RAD = np.array([-0.2, 0.12])  # a lidar that sees less upwards than the radar does


def tensors(rows, limits_rad):
    """What the torch term takes, from what is perceived."""
    radar = padded([o.radar_xyz_m for o in rows], torch.float64)
    still = padded([np.tile(o.radar_motion[:, None] == 0, 3) for o in rows], torch.float64)[0][..., 0] > 0
    plane = [np.zeros(4) if o.ground_plane is None else o.ground_plane for o in rows]
    return (
        radar[0],
        radar[1] & still,
        *padded([o.lidar_map_xyz_m for o in rows], torch.float64),
        torch.tensor(np.array(plane, np.float64)),
        torch.tensor([bool(o.radar_has_elevation) for o in rows]),
        torch.tensor(limits_rad, dtype=torch.float64).expand(len(rows), 2),
    )


def cost_of(T, inputs, **how):
    """The torch term with all detections and points; whose elevation counts is asked at the same poses."""
    radar, present, lidar, lidar_present, plane, has_elevation, limits = inputs
    tells = tells_elevation(T, radar, has_elevation, limits)
    frames = StaticFrames(radar, present, lidar, lidar_present, plane, tells)
    return static_cost(T, frames, detections=ALL, points=ALL, **how)


def kernels_frames(rows, T, limits_rad):
    """The registration's own choice of detections and points, at no lag."""
    frames = registration_frames(rows, T, np.random.default_rng(0), radar_points=ALL)
    assert frames.count == len(rows)
    return replace(frames, stamp_gap_s=np.zeros(len(rows)), lidar_elevation_rad=np.array(limits_rad))


def kernel_costs(frames, T, **how):
    return np.stack([normal_equations(frames, t, 0.0, SIGMA_START, **how).cost for t in T])


def kernel_slopes(frames, T, h=1e-7, **how):
    """d(sum of costs over frames)/d(left twist), by central differences of the compiled value.

    Steps so small that no point enters or leaves a detection's three sigmas between them.
    """
    steps = se3.exp_se3(np.concatenate([np.eye(6), -np.eye(6)]) * h)
    values = np.stack([kernel_costs(frames, steps @ t, **how).sum(1) for t in T])
    return (values[:, :6] - values[:, 6:]) / (2 * h)


def torch_values(inputs, T, **how):
    """Costs of each pose and frame, and the same derivative by autograd."""
    twist = torch.zeros(len(T), 6, dtype=torch.float64, requires_grad=True)
    poses = exp_se3(twist)[:, None] @ torch.tensor(T)[:, None]
    values = cost_of(poses, inputs, **how)
    values.sum().backward()
    return values.detach().numpy(), twist.grad.numpy()


def beyond(inputs, T):
    """Share of the counting detections that lie beyond what the lidar tells of, by its own arithmetic."""
    radar, present, _, _, _, _, limits = inputs
    p = transform_points(torch.tensor(T), radar)
    angle = torch.atan2(p[..., 2], p[..., :2].norm(dim=-1))
    margin = VIEW_MARGIN_RAD + (0.25 * (limits[:, 1] - limits[:, 0])).clamp_max(2 * SIGMA_START[1])
    outside = (angle <= (limits[:, 0] + margin)[:, None]) | (angle >= (limits[:, 1] - margin)[:, None])
    over_ground, azimuth = radar[..., :2].norm(dim=-1), torch.atan2(radar[..., 1], radar[..., 0])
    counts = present & (over_ground > RANGE_M[0]) & (over_ground < RANGE_M[1]) & (azimuth.abs() < SIDE_RAD)
    return float((outside & counts).sum() / counts.sum())


def assert_close(ours, kernel, relative=PARITY):
    assert np.abs(kernel).max() > 1e-3  # it compares something
    np.testing.assert_allclose(ours, kernel, rtol=0, atol=relative * np.abs(kernel).max())


def check_static(rows, T_true, thin=1):
    """Value and gradient near the truth, under the day's own limits and under ones that cut detections off."""
    rng = np.random.default_rng(5)
    T = se3.exp_se3(rng.normal(size=(2, 6)) * np.array([0.01] * 3 + [0.08] * 3)) @ T_true
    rows = [replace(o, radar_xyz_m=o.radar_xyz_m[::thin], radar_motion=o.radar_motion[::thin]) for o in rows]
    own = registration_frames(rows, T_true, np.random.default_rng(0)).lidar_elevation_rad
    low, high = own
    for limits_rad, least in ((own, 0.0), ((0.5 * low, 0.5 * high), 0.02)):
        inputs = tensors(rows, limits_rad)
        assert beyond(inputs, T[0]) > least
        frames = kernels_frames(rows, T_true, limits_rad)
        value, gradient = torch_values(inputs, T)
        np.testing.assert_allclose(value, kernel_costs(frames, T, outlier=1.0), rtol=PARITY)
        assert_close(gradient, kernel_slopes(frames, T, outlier=1.0))


@pytest.fixture(scope="module")
def street():
    return street_day(3)


@pytest.mark.slow
def test_value_and_gradient_are_the_kernels_on_streets(street):
    check_static(street, T_LIDAR_RADAR)


@pytest.mark.parametrize(
    ("outlier", "bounce_prior", "elevation"),
    [(0.2, BOUNCE_PRIOR, True), (1.0, 0.0, True), (0.2, 0.12, False)],
)
def test_they_are_for_every_outlier_weight_with_and_without_bounce_and_elevation(
    outlier, bounce_prior, elevation
):
    rows = street_day(4, seed=3, elevation=elevation)
    T = se3.exp_se3(np.array([[0.004, 0.006, -0.003, 0.05, -0.04, 0.02]])) @ T_LIDAR_RADAR
    frames = kernels_frames(rows, T_LIDAR_RADAR, TRUSTED_RAD)
    how = {"outlier": outlier, "bounce_prior": bounce_prior}
    value, gradient = torch_values(tensors(rows, TRUSTED_RAD), T, **how)
    np.testing.assert_allclose(value, kernel_costs(frames, T, **how), rtol=PARITY)
    assert_close(gradient, kernel_slopes(frames, T, **how))
