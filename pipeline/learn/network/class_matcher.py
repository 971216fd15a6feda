"""The pose at which classified points fit an image of class likelihoods best: correlation, coarse to fine.

Every point looks up the log-likelihood of its classes around its cell. The sum over points is a surface over
shifts. Strips of azimuth see a roll as shifts of opposite sign in elevation; near and far points see a
translation as different shifts. Rotations are found level by level and applied to the points, so no map is
warped and a point's position within its cell counts.

Source: the cost volume is from LCCNet (Lv et al. 2021); the search over class likelihoods is new here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.network.least_squares import Match, angular_jacobian, damped_match
from pipeline.learn.network.views import grid_cells, sphere
from pipeline.learn.sample.grid import Grid
from pipeline.objective.differentiable.projection import exp_so3

__all__ = ["FLOOR", "NEUTRAL", "ClassMatcher"]

NEUTRAL = float(np.log(0.1))  # log-likelihood of any of ten classes where the camera sees nothing
FLOOR = -5.0  # a confident mistake of the camera costs no more than this
_STRIPS = 6
_NEAR_FAR_M = 18.0  # about the median range of what a car's lidar meets; parallax differs by most across it


@dataclass(frozen=True)
class _Level:
    """One resolution of the search: `reach` cells of `cell_deg` to each side, `rolls` steps of roll to each side."""

    factor: int  # cells of the grid per cell of this level
    reach: int
    rolls: int


def _levels_for(grid: Grid) -> tuple[_Level, ...]:
    """Cells of 1.6 deg (+- 8 deg), 0.8 deg (+- 3.2), 0.4 deg (+- 1.2) and 0.2 deg (+- 0.6) where the grid has them."""
    wanted = ((1.6, 5, 1), (0.8, 4, 3), (0.4, 3, 3), (0.2, 3, 3))
    found = [(round(cell / grid.cell_deg), reach, rolls) for cell, reach, rolls in wanted]
    return tuple(_Level(*level) for level in found if level[0] >= 1)


class ClassMatcher(nn.Module):
    """Rotates points until their classes match the camera's; a few temperatures and sigmas are learned."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        self.grid = grid
        self.levels = _levels_for(grid)
        # exp: how many independent observations a frame's mean log-likelihood is worth; 150 by the oracle's spread.
        self.log_sharpness = nn.Parameter(torch.full((len(self.levels),), float(np.log(150.0))))
        # Prior sigmas of the last step: rotation [rad] and translation [m].
        self.log_prior_sigma = nn.Parameter(torch.log(torch.tensor([0.01] * 3 + [0.03] * 3)))
        self.log_error_floor = nn.Parameter(torch.tensor(float(np.log(0.001))))  # [rad] of a group's shift

    @property
    def surface_size(self) -> int:
        """Length of `Match.surfaces`."""
        return 2 * _STRIPS * (2 * self.levels[-1].reach + 1) ** 2

    def forward(
        self, log_likelihood: Float[Tensor, "B K H W"], points_camera: Float[Tensor, "B N 3"],
        probability: Float[Tensor, "B N K"], weight: Float[Tensor, "B N"],
    ) -> Match:  # fmt: skip
        """Find the turn (and shift) of the points that fits best, in the optical frame; surfaces of the last level.

        Args:
            log_likelihood: of each class in the camera's cells, NEUTRAL where it sees nothing.
            weight: of each point, 0 = absent.
        """
        R = torch.eye(3, device=points_camera.device).expand(len(points_camera), 3, 3)
        maps = self._pyramid(log_likelihood)
        for level, table, log_sharpness in zip(self.levels, maps, self.log_sharpness, strict=True):
            # Large cells need no dense points: every other one, as they come in an even irregular order.
            stride = 1 if level is self.levels[-1] else 2
            turned = points_camera[:, ::stride] @ R.transpose(1, 2)
            angles = sphere(turned)
            cells = grid_cells(angles, self.grid)
            groups = self._groups(angles, cells, weight[:, ::stride])
            by_group = self._scores(table, level, cells, probability[:, ::stride], groups)
            sums = _sums(groups, turned)
            sharpness = torch.exp(log_sharpness) / sums[..., -1].sum(-1).clamp(min=1e-3)
            directions, _ = _centres(sums[:, :_STRIPS] + sums[:, _STRIPS:])
            strip_scores = by_group[:, :_STRIPS] + by_group[:, _STRIPS:]
            omega = self._turn(level, strip_scores, directions, sharpness)
            R = exp_so3(omega) @ R
        return self._finish(by_group, _centres(sums), sharpness, omega, R)

    def _pyramid(self, log_likelihood: Tensor) -> list[Tensor]:
        """Maps per level, padded by the reach of a border point, classes last: of a cell and the next."""
        maps = []
        for level in self.levels:
            pooled = log_likelihood
            if level.factor > 1:
                pooled = torch.log(F.avg_pool2d(torch.exp(log_likelihood), level.factor).clamp(min=1e-6))
            pad = level.reach + 1
            table = F.pad(pooled.clamp(min=FLOOR), (pad, pad, pad, pad), value=NEUTRAL).permute(0, 2, 3, 1)
            # Behind the last column comes itself: what lies beyond is looked up with weight zero only.
            following = torch.cat([table[:, :, 1:], table[:, :, -1:]], 2)
            maps.append(torch.cat([table, following], -1))
        return maps

    def _groups(self, angles: Tensor, cells: tuple[Tensor, Tensor], weight: Tensor) -> Tensor:
        """B 12 N: weights of points by strip of azimuth, near ones first."""
        row, column = cells
        strip = torch.floor(column / (self.grid.width / _STRIPS))
        strips = torch.arange(_STRIPS, device=strip.device, dtype=strip.dtype)[:, None]
        member = (strip[:, None] == strips).to(weight.dtype)
        inside = ((row >= 0) & (row <= self.grid.height)).to(weight.dtype) * weight
        near = (angles[..., 2] < _NEAR_FAR_M).to(weight.dtype) * inside
        return torch.cat([member * near[:, None], member * (inside - near)[:, None]], 1)

    def _scores(
        self, table: Tensor, level: _Level, places: tuple[Tensor, Tensor], probability: Tensor,
        groups: Tensor,
    ) -> Tensor:  # fmt: skip
        """B 12 S S: expected log-likelihood of each group at shifts of whole cells (rows down, columns right)."""
        # Lengths as plain numbers, not read off tensors: an exporter that traces would compute those in the graph.
        frames, pad = len(table), level.reach + 1
        rows, columns = (cells // level.factor + 2 * pad for cells in (self.grid.height, self.grid.width))
        # Minus one half: values stand at the centres of cells.
        row = (places[0] / level.factor - 0.5).clamp(-1.0, rows - 2.0 * pad)
        column = (places[1] / level.factor - 0.5).clamp(-1.0, columns - 2.0 * pad)
        first_row, first_column = torch.floor(row), torch.floor(column)
        offsets = torch.arange(-level.reach, level.reach + 2, device=table.device) + pad
        at_row = (first_row.long()[..., None] + offsets).clamp(0, rows - 1) * columns
        at_column = (first_column.long()[..., None] + offsets[::2]).clamp(0, columns - 1)
        frame = torch.arange(frames, device=table.device)[:, None, None] * (rows * columns)
        index = (at_row + frame)[..., :, None] + at_column[..., None, :]
        # Two cells' classes per lookup: contiguous, where an elementwise gather would be ten times slower.
        picked = F.embedding(index.flatten(2), table.flatten(0, 2))
        picked = picked.reshape(frames, -1, 4 * pad * pad, int(probability.shape[-1]))
        value = (picked @ probability[..., None]).squeeze(-1)
        # Groups are summed at the four corners, and shifted onto each other then: points outnumber groups.
        a, b = (row - first_row)[:, None], (column - first_column)[:, None]
        above, below = groups * (1 - a), groups * a
        corners = torch.cat([above * (1 - b), above * b, below * (1 - b), below * b], 1) @ value
        side = 2 * pad
        corner = corners.reshape(frames, 4, -1, side, side)
        return (
            corner[:, 0, :, :-1, :-1] + corner[:, 1, :, :-1, 1:]
            + corner[:, 2, :, 1:, :-1] + corner[:, 3, :, 1:, 1:]
        )  # fmt: skip

    def _turn(self, level: _Level, strips: Tensor, directions: Tensor, sharpness: Tensor) -> Tensor:
        """Rotation vector by soft-argmax over roll, elevation and azimuth shifts; all strips vote together."""
        cell = float(np.radians(self.grid.cell_deg * level.factor))
        size = 2 * level.reach + 1
        steps = torch.arange(-level.rolls, level.rolls + 1, device=strips.device, dtype=strips.dtype)
        roll = steps * 2 * cell  # about one cell at the outer strips, which look 32 deg to the side
        place = torch.arange(size, device=strips.device, dtype=strips.dtype)
        # A roll lifts what is to the left: rows grow downwards.
        lifted = roll[None, :, None] * -directions[:, None, :, 0] / cell
        at = (place - lifted[..., None]).clamp(0, size - 1)
        blend = (1 - (at[..., None] - place).abs()).clamp(min=0)  # B R G S S: hat functions
        frames, rolls = len(blend), len(steps)
        # brgpq, bgqy -> brpy, as one product of matrices.
        blend = blend.permute(0, 1, 3, 2, 4).reshape(frames, rolls * size, -1)
        volume = (blend @ strips.reshape(frames, -1, size)).reshape(frames, rolls * size * size)
        posterior = torch.softmax(volume * sharpness[:, None], -1).reshape(frames, rolls, size, size)
        shift = (place - level.reach) * cell
        up = -(posterior.sum((1, 3)) * shift).sum(-1)
        left = -(posterior.sum((1, 2)) * shift).sum(-1)
        about_axis = (posterior.sum((2, 3)) * roll).sum(-1)
        # Elevation grows by a turn about x (right), azimuth to the left by one about -y (down).
        return torch.stack([up, -left, about_axis], -1)

    def _finish(
        self, by_group: Tensor, centre: tuple[Tensor, Tensor], sharpness: Tensor, omega: Tensor, R: Tensor
    ) -> Match:
        """Least squares over the groups' shifts: the remaining rotation, and the translation by parallax."""
        level = self.levels[-1]
        cell = float(np.radians(self.grid.cell_deg * level.factor))
        size = 2 * level.reach + 1
        log_posterior = torch.log_softmax((by_group * sharpness[:, None, None, None]).flatten(2), -1)
        log_posterior = log_posterior.reshape(by_group.shape)
        posterior = torch.exp(log_posterior)
        shift = (torch.arange(size, device=R.device, dtype=R.dtype) - level.reach) * cell
        # Azimuth by columns, elevation by rows.
        marginals = torch.stack([posterior.sum(2), posterior.sum(3)], 2)
        mean = (marginals * shift).sum(-1)
        spread = (marginals * (shift * shift)).sum(-1) - mean * mean + torch.exp(2 * self.log_error_floor)
        # The window itself is a prior with its width; a flat surface must have no information.
        window = float((shift * shift).mean()) + torch.exp(2 * self.log_error_floor)
        information = (1 / spread - 1 / window).clamp(min=0)
        J = angular_jacobian(*centre)
        turned = (J[..., :3] @ omega[:, None, :, None])[..., 0]
        gradient = -mean / spread - information * turned
        return damped_match(J, information, gradient, self.log_prior_sigma, R, log_posterior.flatten(1))


def _sums(groups: Tensor, points: Tensor) -> Tensor:
    """Sums over each group of directions (3), inverse ranges and weights: B G 5."""
    inverse = 1 / points.norm(dim=-1, keepdim=True).clamp(min=0.5)
    return groups @ torch.cat([points * inverse, inverse, torch.ones_like(inverse)], -1)


def _centres(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Mean direction and mean inverse range of each group; empty groups look ahead."""
    nobody = torch.tensor([0.0, 0.0, 1.0, 0.05], device=sums.device)
    mean = (sums[..., :4] + 1e-3 * nobody) / (sums[..., 4:] + 1e-3)
    direction = mean[..., :3]
    return direction / direction.norm(dim=-1, keepdim=True), mean[..., 3]
