"""The torch losses against the compiled ones on perceived rows, their gradients against differences; poses, loop.

Static detections, also beyond the lidar's limits: streets drawn by hand (`tests.makers.radar_scenes`) with posts that
stand out of the lidar's view at the top, so that a share of detections counts by azimuth and range alone.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.objective.camera_lidar.edges import edge_residuals
from pipeline.objective.camera_lidar.score import Alignments, prepare_terms
from pipeline.objective.differentiable.paper import (
    camera_radar_tensors,
    folded_tensors,
    lidar_radar_tensors,
    padded,
)
from pipeline.objective.differentiable.projection import (
    camera_projection,
    euler_angles,
    inverse,
    loop_loss,
    pose_of_euler_angles,
    transform_points,
)
from pipeline.objective.differentiable.static import StaticFrames, static_cost, tells_elevation
from pipeline.objective.differentiable.terms import edge_residuals_px
from pipeline.objective.paper import classes
from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.classes import fold_frames, frame_costs
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
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
from pipeline.rig.day_prior import read_prior
from pipeline.store.partitions import Lake, Partition
from tests.makers.radar_scenes import T_LIDAR_RADAR, street_day
from tests.makers.simulated_days import perceived, simulated_day
from tests.makers.torch_poses import exp_se3
from tests.objective.test_kernels import CAMERAS, PENALTY, cloud, poses, smooth_cost

PAIRS = ("camera_lidar", "camera_radar", "lidar_radar")
MARGIN_RAD = np.radians(3.0)
PARITY = 1e-3
ALL = 10**6  # thin nothing out
TRUSTED_RAD = np.array([-0.2, 0.12])  # a lidar that sees less upwards than the radar does


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Six frames of the demo rig, and poses near the true ones."""
    day = simulated_day(tmp_path_factory.mktemp("day"), frames=6)
    return day.observations, day.truth


@pytest.fixture(scope="module")
def real(real_logs, tmp_path_factory):
    """Six frames of the real day, and poses near the logs' own calibration."""
    folder = tmp_path_factory.mktemp("real")
    log = real_logs / "astyx-1_2019-01-14_00.mcap"
    fleet = folder / "fleet.toml"
    text = (Path(__file__).parent.parent / "end_to_end" / "astyx.toml").read_text()
    fleet.write_text(f"{text}\n[ingest]\nmax_frames = 6\n")
    day = perceived(fleet, Lake.at(folder / "lake"), Partition("astyx-1", "2019-01-14"), [log], folder)
    prior = read_prior(day.observations, day.fleet, "astyx-1")
    return day.observations, {pair: prior.of(pair) for pair in PAIRS}


def test_parity_on_a_simulated_day(simulated):
    check_paper_losses(*simulated)
    check_edges(*simulated)
    rows, truth = simulated
    check_static(rows[:2], truth["lidar_radar"], thin=4)


@pytest.mark.slow
@pytest.mark.real_logs
def test_parity_on_the_real_day(real):
    check_paper_losses(*real)
    check_edges(*real)
    rows, truth = real
    check_static(rows[:2], truth["lidar_radar"], thin=10)


def near(T, count, seed):
    """Poses about T: a degree and some centimetres away."""
    rng = np.random.default_rng(seed)
    return se3.exp_se3(rng.normal(size=(count, 6)) * np.array([0.02] * 3 + [0.08] * 3)) @ T


def value_and_gradient(loss, T):
    """Loss of each pose and frame, and d(sum over frames)/d(left twist) of each pose, by autograd in float64."""
    twist = torch.zeros(len(T), 6, dtype=torch.float64, requires_grad=True)
    values = loss(exp_se3(twist)[:, None] @ torch.tensor(T)[:, None])
    values.sum().backward()
    return values.detach().numpy(), twist.grad.numpy()


def by_differences(function, T, h=2e-5):
    """d(sum of function over frames)/d(left twist) by central differences."""
    steps = se3.exp_se3(np.concatenate([np.eye(6), -np.eye(6)]) * h)
    values = np.stack([function(steps @ t).sum(1) for t in T])
    return (values[:, :6] - values[:, 6:]) / (2 * h)


def assert_slope(loss, T, gradient, h=1e-9):
    """The gradient is the slope of the loss itself: so near that hardly a point changes its cell of the map."""

    def value(poses):
        return loss(torch.tensor(poses)[:, None]).numpy()

    assert_close(gradient, by_differences(value, T, h))


def assert_close(ours, kernel, relative=1e-3):
    assert np.abs(kernel).max() > 1e-3  # it compares something
    np.testing.assert_allclose(ours, kernel, rtol=0, atol=relative * np.abs(kernel).max())


def check_paper_losses(rows, truth):
    T = {pair: near(truth[pair], 4, seed) for seed, pair in enumerate(PAIRS)}

    loss = camera_lidar_loss(rows, truth["camera_lidar"], MARGIN_RAD)
    ours = folded_tensors(loss.frames, torch.float64)
    value, gradient = value_and_gradient(ours.frame_losses, T["camera_lidar"])
    assert_close(value, loss.frame_losses(T["camera_lidar"]))
    assert_slope(ours.frame_losses, T["camera_lidar"], gradient)

    loss = camera_radar_loss(rows, truth["camera_radar"], MARGIN_RAD)
    ours = camera_radar_tensors(loss, torch.float64)
    value, gradient = value_and_gradient(ours.frame_losses, T["camera_radar"])
    assert_close(value, loss.frame_losses(T["camera_radar"]))
    assert_slope(ours.frame_losses, T["camera_radar"], gradient)

    loss = lidar_radar_loss(rows)
    ours = lidar_radar_tensors(loss, torch.float64)
    value, gradient = value_and_gradient(ours.frame_losses, T["lidar_radar"])
    assert_close(value, loss.frame_losses(T["lidar_radar"]))
    # Not against differences of the kernel: it adds in float32, and the wide step which that needs goes round the
    # corners of the bilinear map.
    assert_slope(ours.frame_losses, T["lidar_radar"], gradient)


def check_edges(rows, truth):
    """Residuals of the depth jumps are the compiled ones, and move against the projected jump along their axis."""
    terms = prepare_terms(rows, truth["camera_lidar"], np.zeros((len(rows), 3)), reach_rad=0.1)
    e, T = terms.edges, near(truth["camera_lidar"], 3, 7)
    points, present = padded(np.split(e.xyz_m, e.start[1:-1]), torch.float64)
    side = torch.zeros(present.shape, dtype=torch.int64)
    side[present] = torch.tensor(e.side.astype(np.int64))
    projection = camera_projection([terms.maps.camera] * len(rows), torch.float64)
    still = np.zeros((len(e.xyz_m), 2), np.float32)
    for t, at in zip(T, terms.poses(Alignments(T, np.zeros(len(T)), np.ones(len(T)))), strict=True):
        kernel = edge_residuals(terms.camera, terms.maps.offsets, e, at, np.float32(1.0), still)
        uv, valid = projection.project(transform_points(torch.tensor(t), points))
        uv.requires_grad_()
        residual, found = edge_residuals_px(torch.tensor(terms.maps.offsets), uv, valid & present, side)
        ours, has = residual.detach()[present].numpy(), found[present].numpy()
        expected = np.isfinite(kernel) & (kernel < 127)
        assert expected.sum() > 100
        assert np.mean(has != expected) < 2e-3  # jumps between two pixels, rounded either way
        both = has & expected
        assert np.mean(np.abs(ours[both] - kernel[both]) > 0.03) < 2e-3
        (slope,) = torch.autograd.grad(residual[found].sum(), uv)
        along = slope.gather(-1, (side >= 2).long()[..., None])[..., 0]
        torch.testing.assert_close(along, -found.double())
        assert torch.count_nonzero(slope) == found.sum()


@pytest.mark.parametrize("name", CAMERAS)
def test_folded_maps_agree_with_the_kernel_for_every_camera_model(name):
    camera = CAMERAS[name]
    frames = fold_frames([cloud(1), cloud(2, 700)], [smooth_cost(3), smooth_cost(4)], [camera] * 2, PENALTY)
    ours = folded_tensors(frames, torch.float64)
    T = poses(4, 3, 0.01, 0.1)
    value, gradient = value_and_gradient(ours.frame_losses, T)
    assert_close(value, frame_costs(frames, T) / frames.counts)
    assert_slope(ours.frame_losses, T, gradient)


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_equals_the_camera_and_its_jacobian(name):
    camera = CAMERAS[name]
    points = np.concatenate([cloud(5), [[0.0, 0, 9.0], [0, 0, -9.0], [30.0, 0, 0.1]]])
    uv, valid = camera.project(points)
    ours, ok = camera_projection([camera], torch.float64).project(torch.tensor(points)[None])
    keep = valid & (points[:, 2] > 0.5)
    np.testing.assert_array_equal(ok[0].numpy()[points[:, 2] > 0.5], valid[points[:, 2] > 0.5])
    np.testing.assert_allclose(ours[0].numpy()[keep], uv[keep], atol=1e-9)
    at = torch.tensor(points[keep][None], requires_grad=True)
    camera_projection([camera], torch.float64).project(at)[0].sum().backward()
    assert torch.isfinite(at.grad).all()
    steps = 1e-5 * np.eye(3)[:, None]
    slopes = (camera.project(points[keep] + steps)[0] - camera.project(points[keep] - steps)[0]).sum(
        -1
    ) / 2e-5
    np.testing.assert_allclose(at.grad[0], slopes.T, atol=2e-4, rtol=1e-6)


def test_the_loop_loss_is_the_numpy_one_and_zero_where_the_three_agree():
    T = [se3.exp_se3(x) for x in np.random.default_rng(2).normal(size=(3, 7, 6)) * 0.3]
    ours = loop_loss(*(torch.tensor(t) for t in T))
    np.testing.assert_allclose(ours, classes.loop_loss(classes.loop_transform(*T)), atol=1e-12)
    closed = loop_loss(torch.tensor(T[0]), torch.tensor(T[1]), torch.tensor(T[0] @ T[1]))
    np.testing.assert_allclose(closed, 0, atol=1e-12)


def test_poses_equal_their_numpy_versions():
    rng = np.random.default_rng(1)
    xi = rng.normal(size=(50, 6)) * np.array([[1.0], [1e-3], [1e-5], [0.0], [0.3]]).repeat(10, 0)
    T = exp_se3(torch.tensor(xi))
    np.testing.assert_allclose(T, se3.exp_se3(xi), atol=1e-12)
    np.testing.assert_allclose(inverse(T), se3.inverse(se3.exp_se3(xi)), atol=1e-12)
    np.testing.assert_allclose(euler_angles(T), classes.euler_angles(se3.exp_se3(xi)), atol=1e-12)
    back = pose_of_euler_angles(euler_angles(T), T[:, :3, 3])
    np.testing.assert_allclose(back, T, atol=1e-12)


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


def check_costs(inputs, frames, T, **how):
    """Costs and slopes are the kernel's; steps are so small that no point enters or leaves between them."""
    value, gradient = value_and_gradient(lambda poses: cost_of(poses, inputs, **how), T)

    def kernel(poses):
        return np.stack([normal_equations(frames, t, 0.0, SIGMA_START, **how).cost for t in poses])

    np.testing.assert_allclose(value, kernel(T), rtol=PARITY)
    assert_close(gradient, by_differences(kernel, T, h=1e-7))


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
        check_costs(inputs, frames, T, outlier=1.0)


@pytest.mark.slow
def test_value_and_gradient_are_the_kernels_on_streets():
    check_static(street_day(3), T_LIDAR_RADAR)


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
    check_costs(tensors(rows, TRUSTED_RAD), frames, T, **how)
