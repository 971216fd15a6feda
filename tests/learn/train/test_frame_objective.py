"""What training minimises: lowest at the truth, moved only along what is wrong, the same through a turned camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.learn.batches.batch import collate
from pipeline.learn.sample.frame_sample import stored_grid
from pipeline.learn.train.batch_loss import class_of_points, uncertainty_loss
from pipeline.learn.train.domain_randomisation import mirrored, random_guess, turned_view
from pipeline.learn.train.frame_objective import FrameObjective, at_lag, twist_between, weighted
from pipeline.learn.train.settings import AugmentConfig, LossConfig
from pipeline.objective.camera_lidar.points import moving_poses
from pipeline.objective.differentiable.projection import transform_points
from pipeline.rig import se3
from pipeline.store.partitions import Lake
from schemas.training import UNKNOWN_CLASS
from tests.accuracy.days import FIXED, make_day
from tests.makers.loss_landscapes import PAIRS, TOLERANCE, day_batch, minima
from tests.makers.simulated_days import simulated_day
from tests.makers.stages import calibrate_day
from tests.makers.torch_poses import exp_se3
from tests.makers.training_lakes import WIDE, sample_of

# One vehicle's prior is off by its own error, which only a fleet's median takes out.
DATA_ALONE = LossConfig(prior=0.0)


@pytest.fixture(scope="module")
def few():
    """Four frames of made scenes: quick tests do not wait for a day."""
    return collate([sample_of(seed, grid=WIDE) for seed in range(4)])


@pytest.mark.slow
def test_the_minimum_over_a_fleet_is_at_the_truth_in_all_that_it_determines(tmp_path):
    day = simulated_day(tmp_path, frames=32, environment="mixed")
    batch = day_batch(day.lake, day.partition, day.fleet_file, day.told)
    found = minima(batch, day.truth, DATA_ALONE)
    determined = {
        (pair, dof): found[pair][dof].offset
        for pair in PAIRS
        for dof in range(6)
        if found[pair][dof].determined(TOLERANCE[dof])
    }
    # Pitch, yaw and all shifts of the camera, yaw and sideways shift of the radar; the rest needs more frames.
    assert {("camera_lidar", dof) for dof in (1, 2, 3, 4, 5)} <= set(determined)
    assert {("lidar_radar", 2), ("lidar_radar", 4)} <= set(determined)
    far = {key: offset for key, offset in determined.items() if abs(offset) > TOLERANCE[key[1]]}
    assert far == {}
    yaw = found["camera_radar"][2]
    assert abs(yaw.offset) < 3 * yaw.error


@pytest.mark.slow
def test_the_loss_of_many_frames_is_least_where_joint_found_the_day(tmp_path):
    [fixed] = [fixed for fixed in FIXED if fixed.name == "real car"]
    if (made := make_day(fixed, tmp_path)) is None:
        pytest.skip("the recordings of the real car are not on this machine")
    partition, fleet = fixed.partition, made.day.fleet
    lake = Lake.at(tmp_path / "lake")
    calibrate_day(partition, fleet, lake)
    batch = day_batch(lake, partition, fleet.file)
    at = {pair: getattr(batch, f"T_{pair}")[0].double().numpy() for pair in PAIRS}
    found = minima(batch, at, LossConfig(), (1, 2))["camera_lidar"]  # pitch and yaw
    assert np.abs([minimum.offset for minimum in found]).max() < 0.03  # deg


def test_the_prior_pulls_with_the_same_small_force_however_far_away_and_rests_at_itself(few):
    objective, pull = FrameObjective(few), []
    for shift_m in (0.0, 0.1, 0.3):
        xi = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, shift_m], requires_grad=True)
        T = exp_se3(xi) @ few.T_lidar_radar
        terms = objective.terms(few.T_camera_lidar, few.T_camera_radar, T, ("lidar_radar",))
        (slope,) = torch.autograd.grad(terms["prior_lidar_radar"].mean(), xi)
        pull.append(slope[5].item())
    assert pull == pytest.approx([0.0, 5.0, 5.0], abs=0.05)  # a metre counts as five degrees


def test_every_term_is_finite_with_a_finite_gradient_even_at_absurd_poses(few):
    objective = FrameObjective(few)
    for size in (0.0, 0.1, 3.0):
        xi = (size * torch.randn(3, len(few), 6, generator=torch.Generator().manual_seed(0))).requires_grad_()
        given = few.T_camera_lidar, few.T_camera_radar, few.T_lidar_radar
        T = [exp_se3(x) @ t for x, t in zip(xi, given, strict=True)]
        terms = objective.terms(*T)
        assert {"edges", "tracks_camera", "static", "tracks_lidar", "loop"} <= set(terms)
        total = weighted(terms, LossConfig())
        assert total.shape == (len(few),)
        total.sum().backward()
        assert torch.isfinite(total).all()
        assert torch.isfinite(xi.grad).all()


def test_random_guesses_close_the_loop_and_stay_in_their_limits(few):
    config = AugmentConfig(rotation_deg=3.0, translation_m=0.1, small_share=0.5, view_deg=4.0)
    guess = random_guess(few, config, torch.Generator().manual_seed(1))
    np.testing.assert_allclose(guess.T_camera_lidar @ guess.T_lidar_radar, guess.T_camera_radar, atol=1e-5)
    moved = twist_between(guess.unturned(guess.T_camera_lidar), few.T_camera_lidar)
    largest_deg = np.degrees(moved[:, :3].norm(dim=1).max().item())
    assert 0.2 < largest_deg <= 3.01 * np.sqrt(3)
    lidar = se3.inverse(few.T_camera_lidar.numpy()) @ guess.unturned(guess.T_camera_lidar).numpy()
    np.testing.assert_allclose(lidar[0::2] @ lidar[1::2], [np.eye(4)] * 2, atol=1e-5)  # no side in two frames
    again = random_guess(few, config, torch.Generator().manual_seed(1))
    assert torch.equal(again.T_lidar_radar, guess.T_lidar_radar)
    none = AugmentConfig(rotation_deg=0, translation_m=0, view_deg=0)
    still = random_guess(few, none, torch.Generator().manual_seed(1))
    np.testing.assert_allclose(still.T_camera_lidar, few.T_camera_lidar, atol=1e-6)


def test_a_mirrored_frame_has_the_same_losses_and_classes_at_mirrored_poses(few):
    names = "ego_yaw_rate_radps", "camera_lag_s", "radar_lag_s"
    some = {name: torch.full((len(few),), 0.3) for name in names}
    few = replace(few, **some, ego_velocity_mps=torch.tensor([[9.0, 2.0, 0.0]] * len(few)))
    there = mirrored(few, torch.tensor([False, True] * 2))
    guess = random_guess(few, AugmentConfig(view_deg=0), torch.Generator().manual_seed(1))
    poses, opposite = ([getattr(guess, f"T_{pair}").clone() for pair in PAIRS] for _ in range(2))
    camera, other = torch.diag(torch.tensor([-1.0, 1, 1, 1])), torch.diag(torch.tensor([1.0, -1, 1, 1]))
    for T, left in zip(opposite, (camera, camera, other), strict=True):
        T[1::2] = left @ T[1::2] @ other
    found, expected = FrameObjective(there).terms(*opposite), FrameObjective(few).terms(*poses)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=2e-3, atol=2e-3, err_msg=name)
    assert same_class(few, poses[0], there, opposite[0]).min() > 0.999


def test_a_turned_view_shows_the_same_things_in_the_turned_directions(few):
    """The class under a lidar point is the same, seen by the camera or by the turned one through the turned pose."""
    R = torch.tensor(se3.exp_so3(np.radians([[2.0, -1.0, 3.0]] * len(few))), dtype=torch.float32)
    view = turned_view(few, R)
    T_turned = few.T_camera_lidar.clone()
    T_turned[:, :3] = R @ few.T_camera_lidar[:, :3]
    assert same_class(few, few.T_camera_lidar, view, T_turned).min() > 0.9  # the nearest of cells cut anew
    brightness = view.image.float().mean((1, 2, 3)) / few.image.float().mean((1, 2, 3))
    assert 0.7 < brightness.min() <= brightness.max() < 1.1
    untouched = turned_view(few, torch.eye(3).expand(len(few), 3, 3))
    assert torch.equal(untouched.image[:, :, 1:-1, 1:-1], few.image[:, :, 1:-1, 1:-1])


def same_class(a, T_a, b, T_b):
    """By frame, the share of the lidar's points with a class that have the same one in both batches."""
    grid = stored_grid(a.grid_seen.shape[1:], a.grid_step_deg)
    first, second = (
        class_of_points(s.grid_class, transform_points(T, s.lidar_xyz_m), s.lidar_valid, grid)
        for s, T in ((a, T_a), (b, T_b))
    )
    both = (first != UNKNOWN_CLASS) & (second != UNKNOWN_CLASS)
    assert both.sum(1).min() > 300
    return ((first == second) & both).sum(1) / both.sum(1)


def test_the_loss_of_a_variance_is_least_at_the_scatter_s_own():
    scatter = 0.01 * torch.randn(4000, 3, 6, generator=torch.Generator().manual_seed(0))
    losses = [uncertainty_loss(torch.full((4000, 3, 6), 2 * np.log(s)), scatter) for s in (0.005, 0.01, 0.02)]
    assert losses[1] < min(losses[0], losses[2])


def test_points_are_carried_to_the_image_s_time_as_joint_carries_them(few):
    some = torch.rand(len(few), 1, generator=torch.Generator().manual_seed(0))
    velocity = torch.tensor([12.0, -0.8, 0.0]) * some
    moving = {"ego_velocity_mps": velocity, "ego_yaw_rate_radps": some[:, 0] - 0.5}
    points, dt_s = 20 * torch.rand(len(few), 50, 3), np.array([0.08])
    gap_s = np.linspace(-0.02, 0.03, len(few))
    lagged = at_lag(replace(few, **moving), points, torch.tensor(gap_s - dt_s).float())
    T, (v, turn) = few.T_camera_lidar[:1].double().numpy(), (m.double().numpy() for m in moving.values())
    R, t = (np.ascontiguousarray(part) for part in (T[:, :3, :3], T[:, :3, 3]))
    rows = moving_poses(R, t, dt_s, gap_s, v, turn)[0].reshape(-1, 3, 4)
    expected = np.einsum("fij,fnj->fni", rows[:, :, :3], points.numpy()) + rows[:, None, :, 3]
    np.testing.assert_allclose(transform_points(few.T_camera_lidar, lagged), expected, atol=1e-4)
