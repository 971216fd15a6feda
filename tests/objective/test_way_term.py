"""The car's way as a term of training: the residual of the optimiser's, right in gradient, silent where unknown."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.objective.differentiable.poses import exp_se3
from pipeline.objective.differentiable.way import way_cost
from pipeline.objective.radar.travel import pitch_residuals, travel_directions
from tests.makers.doppler_streets import T_LIDAR_RADAR, day_of, turned


@pytest.fixture(scope="module")
def travel():
    return travel_directions(day_of(9, 8, noise_deg=0.5), T_LIDAR_RADAR, 0.0)


def cost_at(T, travel, sigma_rad=None):
    sigma_rad = travel.sigma_rad if sigma_rad is None else sigma_rad
    told = (torch.tensor(v) for v in (travel.velocity_mps, sigma_rad, travel.slope))
    return way_cost(torch.as_tensor(T)[None], *told)


def test_it_is_the_residual_of_the_optimiser_but_for_rounding(travel):
    exact = replace(travel, sigma_rad=np.full(travel.count, 1e-9))
    for pitch_deg in (-3.0, 0.7, 2.0):
        T = turned(T_LIDAR_RADAR, np.radians(pitch_deg))
        residual_deg = np.degrees(np.abs(pitch_residuals(exact, T)[0]))
        np.testing.assert_allclose(cost_at(T, exact), residual_deg, atol=0.051)


def test_the_least_cost_over_frames_lies_at_the_radars_true_pitch(travel):
    pitches_deg = np.linspace(-3, 3, 61)
    costs = [cost_at(turned(T_LIDAR_RADAR, np.radians(p)), travel).mean().item() for p in pitches_deg]
    assert abs(pitches_deg[int(np.argmin(costs))]) < 0.3
    assert costs[0] > costs[10] > min(costs)


def test_the_gradient_is_that_of_differences(travel):
    T = torch.tensor(turned(T_LIDAR_RADAR, 0.03))
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(cost_at(exp_se3(xi) @ T, travel).sum(), xi)
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-6
        ahead, behind = (cost_at(exp_se3(s * step) @ T, travel).sum().item() for s in (1, -1))
        assert gradient[k].item() == pytest.approx((ahead - behind) / 2e-6, abs=1e-4)
    assert abs(gradient[1]) > 100  # degrees per radian and frame
    assert (gradient[3:] == 0).all()


def test_frames_that_know_no_way_cost_nothing_and_pull_nowhere(travel):
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    nothing = replace(travel, velocity_mps=np.zeros_like(travel.velocity_mps))
    cost = cost_at(exp_se3(xi) @ torch.tensor(T_LIDAR_RADAR), nothing, np.zeros(travel.count))
    cost.sum().backward()
    assert (cost == 0).all()
    assert (xi.grad == 0).all()


def test_scans_that_know_it_badly_count_less(travel):
    T = turned(T_LIDAR_RADAR, 0.03)
    sure, unsure = (cost_at(T, travel, np.full(travel.count, np.radians(s))) for s in (0.1, 3.0))
    np.testing.assert_allclose(unsure / sure, (1.01 / 10) ** 0.5, rtol=1e-6)
