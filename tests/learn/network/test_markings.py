"""Paint that both sensors see tells a turn, whatever gains and exposures; where one sees none it tells nothing."""

from functools import lru_cache

import numpy as np
import pytest
import torch

from pipeline.learn.network.matching_network import MatchingCore, log_markings
from pipeline.learn.network.outputs import pose_of_twist
from pipeline.learn.sample.grid import (
    LIDAR_CHANNELS,
    LIDAR_FEATURES,
    MARKED_POINTS,
    Grid,
    NetworkConfig,
    grid_rays,
)
from pipeline.learn.sample.rendering import mark_strength
from pipeline.rig.se3 import exp_so3

GRID = Grid()
INTENSITY, GROUND = (2 + LIDAR_FEATURES.index(name) for name in ("intensity", "ground"))


@lru_cache
def road():
    """A flat road with lines and a bar, 1.6 m below the camera: places of its cells, what is road, what is paint."""
    rays = grid_rays(GRID)
    down = rays[..., 1]
    scale = np.where(down > 0.03, 1.6 / np.maximum(down, 0.03), np.nan)
    points = rays * scale[..., None]
    x, z = points[..., 0], points[..., 2]
    lines = (np.abs(x - np.round((x - 1.75) / 3.5) * 3.5 - 1.75) < 0.15) & (np.abs(x) < 6)
    bars = (np.abs(x) < 6) & (np.abs(z - 14) < 0.4)
    return points, np.isfinite(scale) & (np.abs(x) < 12), lines | bars


def sweep(gain=1.0, offset=0.0):
    """A rendered sweep of every other row of the road."""
    points, ground, paint = road()
    grid = np.zeros((LIDAR_CHANNELS, GRID.height, GRID.width), np.float32)
    rows = np.zeros_like(ground)
    rows[::2] = True
    grid[0] = grid[GROUND] = ground & rows
    noise = np.random.default_rng(0).normal(0, 0.02, paint.shape)
    grid[INTENSITY] = (offset + gain * (0.3 + 0.5 * paint + noise)) * (ground & rows)
    return grid, torch.tensor(np.nan_to_num(points).reshape(-1, 3)).float()


def photograph(exposure=1.0):
    """Image and class likelihoods of the road."""
    _, ground, paint = road()
    grey = torch.tensor(exposure * np.where(ground, 0.3 + 0.4 * paint, 0.8)).float()
    camera = torch.cat([grey.expand(3, -1, -1), torch.ones(1, *grey.shape)])[None]
    likelihood = torch.full((1, 10, *grey.shape), float(np.log(0.01)))
    likelihood[0, 0][torch.tensor(ground)] = float(np.log(0.9))
    likelihood[0, 6][torch.tensor(~ground)] = float(np.log(0.9))
    return camera, likelihood


def turn_left_over(camera, likelihood, strength, points, turn):
    core = MatchingCore(NetworkConfig("matching", "camera_lidar", GRID, 8, 32, marks=True))
    weight, cell = torch.topk(torch.from_numpy(strength).flatten()[None], MARKED_POINTS, dim=1)
    R = turn
    with torch.no_grad():
        for _ in range(3):
            marks = (points[cell[0]] @ torch.tensor(R.T, dtype=torch.float32))[None]
            maps, share = core._with_marks(camera, likelihood, torch.zeros(1, 0, 10))
            found = core.lidar_matcher(maps, marks, share, weight)
            R = pose_of_twist(found.twist)[0, :3, :3].numpy() @ R
    return np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))


@pytest.mark.parametrize("turn_deg", [(0.8, -1.5, 0.0), (-1.2, 1.0, 0.5)])
def test_paint_alone_tells_a_turn(turn_deg):
    grid, points = sweep()
    left = turn_left_over(*photograph(), mark_strength(grid), points, exp_so3(np.radians(turn_deg)))
    assert left < GRID.cell_deg


def test_gain_offset_and_exposure_do_not_matter():
    np.testing.assert_allclose(mark_strength(sweep()[0]), mark_strength(sweep(0.4, 0.2)[0]), atol=0.02)
    bright, dark = (log_markings(*photograph(e))[0] for e in (1.0, 0.4))
    assert torch.allclose(bright, dark, atol=0.1)


def test_only_ground_that_stands_out_is_marked():
    grid, _ = sweep()
    strength = mark_strength(grid)
    _, ground, paint = road()
    assert strength[~ground].max() == 0
    assert strength[paint & (grid[0] > 0)].mean() > 0.8
    assert strength[~paint].mean() < 0.01


def test_a_sweep_without_reflectivity_and_an_image_without_road_tell_nothing():
    dark, _ = sweep(0.0)
    assert mark_strength(dark).max() == 0
    camera, likelihood = photograph()
    no_road = likelihood.roll(3, 1)
    assert log_markings(camera, likelihood)[1].item() == 1
    assert log_markings(camera, no_road)[1].item() == 0
