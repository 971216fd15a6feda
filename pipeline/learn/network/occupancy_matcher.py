"""Lidar and radar: radar detections against the density of lidar object points in azimuth, elevation and range.

Radar azimuth is precise and elevation noisy. The search therefore finds yaw first, then pitch (and roll, from
the change of pitch with azimuth), each by the likelihood of the detections under the lidar's kernel density.
A step of damped least squares over soft associations finishes all six degrees of freedom. A floor of the
likelihood bounds the cost of clutter.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.learn.network.least_squares import Match, damped_match, spherical_jacobian
from pipeline.objective.differentiable.projection import exp_so3

__all__ = ["OccupancyMatcher"]

# Steps stay well below the kernels' widths, between which densities are interpolated.
_REACH_DEG, _YAW_STEP_DEG, _PITCH_STEP_DEG = 8.0, 0.4, 0.5
_FIELD_DEG = (48.0, 28.0)  # azimuth and elevation to each side: what lidar and radar share ahead
_ROLLS_DEG = 1.5 * np.arange(-4, 5)
_HALF = float(np.sqrt(0.5))
# Kernels end at exp(-37) = 1e-16, which adds nothing to the floor: products of two of them with a density stay normal
# numbers. With subnormal ones a matrix product takes ten times as long.
_FARTHEST = 37.0


class OccupancyMatcher(nn.Module):
    """Widths of the kernels, floor and temperatures are learned; everything else is geometry."""

    yaws: Tensor
    pitches: Tensor
    rolls: Tensor

    def __init__(self, radar_features: int) -> None:
        super().__init__()
        degree = float(np.pi / 180)
        # Azimuth, elevation [rad], range [m]: the radar's noise and the lidar's gaps. Where training starts was tuned
        # on simulated days (tests/benchmarks/ssl_oracle.py of 5add1d1).
        self.log_width = nn.Parameter(torch.log(torch.tensor([0.5 * degree, 1.2 * degree, 0.35])))
        self.log_floor = nn.Parameter(torch.tensor(0.0))
        # exp: how many independent detections a frame's mean log-likelihood is worth.
        self.log_sharpness = nn.Parameter(torch.log(torch.tensor([100.0, 60.0])))
        self.log_prior_sigma = nn.Parameter(torch.log(torch.tensor([0.02, 0.02, 0.02, 0.03, 0.03, 0.03])))
        self.log_noise = nn.Parameter(torch.log(torch.tensor([2 * degree, 4 * degree, 1.0])))
        self.roll_sigma_rad = 2.0 * degree
        self.weigh = nn.Linear(radar_features, 1)
        nn.init.zeros_(self.weigh.weight)
        nn.init.zeros_(self.weigh.bias)
        self.register_buffer("yaws", _steps(_YAW_STEP_DEG), persistent=False)
        self.register_buffer("pitches", _steps(_PITCH_STEP_DEG), persistent=False)
        rolls = torch.tensor(_ROLLS_DEG * degree, dtype=torch.float32)
        self.register_buffer("rolls", rolls, persistent=False)

    @property
    def surface_size(self) -> int:
        """Length of `Match.surfaces`: over yaw, then over pitch."""
        return len(self.yaws) + len(self.pitches)

    def forward(
        self, radar_lidar: Float[Tensor, "B M 3"], radar_features: Float[Tensor, "B M 3"],
        radar_valid: Bool[Tensor, "B M"], has_elevation: Bool[Tensor, " B"], objects: Float[Tensor, "B L 3"],
        object_weight: Float[Tensor, "B L"],
    ) -> Match:  # fmt: skip
        """Find the turn (and shift) of the radar that fits best, in the lidar frame.

        Args:
            radar_lidar: detections seen through the guess, lidar frame [m].
            has_elevation: False where the radar measures none: then pitch and roll stay.
            objects: lidar points off the ground, lidar frame [m].
        """
        weight = torch.sigmoid(self.weigh(radar_features))[..., 0] * 2 * radar_valid.to(radar_lidar.dtype)
        total = weight.sum(1, keepdim=True).clamp(min=1e-3)
        tall = has_elevation.to(radar_lidar.dtype)[:, None]
        width = torch.exp(self.log_width)
        lidar, radar = _spherical(objects), _spherical(radar_lidar)
        density = object_weight * lidar[..., 2] ** 2 / 400.0  # beams thin out with the square of the range
        away_range = _away(lidar[..., 2], radar[..., 2], width[2])
        # Before pitch is known elevation is gated loosely; without elevation not at all.
        loose = torch.sqrt(width[1] ** 2 + (2.0 * np.pi / 180) ** 2)
        away_elevation = _away(lidar[..., 1] * tall, radar[..., 1] * tall, loose)
        yaw_logits = self._profile(
            away_range + away_elevation, density, lidar[..., 0], radar[..., 0], self.yaws, 0
        )
        yaw_surface = (yaw_logits * weight[..., None]).sum(1) / total * torch.exp(self.log_sharpness[0])
        yaw_posterior = torch.softmax(yaw_surface, -1)
        yaw = (yaw_posterior * self.yaws).sum(-1)
        azimuth = radar[..., 0] + yaw[:, None]
        away = away_range + _away(lidar[..., 0], azimuth, width[0])
        pitch_logits = self._profile(away, density, lidar[..., 1], radar[..., 1], self.pitches, 1)
        pitch_surface, up, roll = self._tilt(pitch_logits, azimuth, weight, total)
        # Elevation ahead grows by a turn about -y, elevation to the left by one about x.
        omega = torch.stack([roll * tall[:, 0], -up * tall[:, 0], yaw], -1)
        surfaces = torch.cat([torch.log_softmax(yaw_surface, -1), torch.log_softmax(pitch_surface, -1)], -1)
        return self._finish(radar_lidar, exp_so3(omega), weight, tall, lidar, density, surfaces)

    def _profile(
        self, away: Tensor, density: Tensor, lidar_angle: Tensor, radar_angle: Tensor, shifts: Tensor,
        axis: int,
    ) -> Tensor:  # fmt: skip
        """B M S: log-likelihood of each detection at each shift of one angle, `away` from the others (`_away`).

        The density is tabulated over absolute angles once (a matrix product) and looked up per detection.
        """
        step_deg = (_YAW_STEP_DEG, _PITCH_STEP_DEG)[axis]
        step, bins = float(np.radians(step_deg)), round(2 * _FIELD_DEG[axis] / step_deg)
        lowest = -bins / 2 * step
        centres = lowest + step * torch.arange(bins + 1, device=away.device)
        width = torch.exp(self.log_width[axis])
        table = _kernel(away) @ (_kernel(_away(centres, lidar_angle, width)) * density[..., None])
        at = ((radar_angle[..., None] + shifts - lowest) / step).clamp(0, bins - 1e-3)
        low = torch.floor(at)
        part = at - low
        below = torch.gather(table, 2, low.long())
        above = torch.gather(table, 2, low.long() + 1)
        return torch.log(torch.exp(self.log_floor) + below * (1 - part) + above * part)

    def _tilt(
        self, logits: Tensor, azimuth: Tensor, weight: Tensor, total: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Score over pitch, elevation shift ahead and roll, from the scores of sectors of azimuth."""
        edges = torch.tensor([-3.2, -10 * np.pi / 180, 10 * np.pi / 180, 3.2], device=logits.device)
        ahead = azimuth[:, None]
        inside = (ahead >= edges[:-1, None]) & (ahead < edges[1:, None])
        member = inside.to(weight.dtype) * weight[:, None]
        sectors = (member @ logits) / total[..., None]
        side = (member @ torch.sin(azimuth)[..., None])[..., 0] / member.sum(-1).clamp(min=1e-3)
        step = float(np.radians(_PITCH_STEP_DEG))
        place = torch.arange(len(self.pitches), device=logits.device, dtype=logits.dtype)
        at = place + (self.rolls[None, :, None] * side[:, None, :] / step)[..., None]
        blend = (1 - (at.clamp(0, len(self.pitches) - 1)[..., None] - place).abs()).clamp(min=0)
        frames, rolls, pitches = len(blend), len(self.rolls), len(self.pitches)
        # brgpq, bgq -> brp, as one product of matrices.
        blend = blend.permute(0, 1, 3, 2, 4).reshape(frames, rolls * pitches, -1)
        volume = (blend @ sectors.reshape(frames, -1, 1)).reshape(frames, rolls, pitches)
        volume = volume * torch.exp(self.log_sharpness[1])
        volume = volume - (self.rolls[:, None] / self.roll_sigma_rad) ** 2 / 2
        posterior = torch.softmax(volume.flatten(1), -1).reshape(frames, rolls, pitches)
        up = (posterior.sum(1) * self.pitches).sum(-1)
        roll = (posterior.sum(2) * self.rolls).sum(-1)
        return torch.logsumexp(volume, 1), up, roll

    def _finish(
        self, radar_lidar: Tensor, R: Tensor, weight: Tensor, tall: Tensor, lidar: Tensor, density: Tensor,
        surfaces: Tensor,
    ) -> Match:  # fmt: skip
        """One step of damped least squares from a rotation R towards the softly associated lidar points."""
        radar_lidar, one = radar_lidar @ R.transpose(1, 2), torch.ones_like(tall)
        radar = _spherical(radar_lidar)
        scale = torch.stack([one, tall, one], -1) / torch.exp(self.log_width)
        near, far = radar * scale, lidar * scale
        away_azimuth, away_elevation, away_range = (_away(far[..., i], near[..., i]) for i in range(3))
        # The mean gap is the mean place less the own one: a product, not another array of all pairs.
        summed = _kernel(away_azimuth + away_elevation + away_range) @ (
            torch.cat([lidar, torch.ones_like(lidar[..., :1])], -1) * density[..., None]
        )
        mass = summed[..., 3]
        mean = summed[..., :3] / mass.clamp(min=1e-6)[..., None] - radar
        mean = mean * (mass > 1e-6)[..., None].to(mean.dtype)
        inlier = mass / (mass + torch.exp(self.log_floor)) * weight
        precision = torch.exp(-2 * self.log_noise) * torch.cat([one, tall, one], -1)
        distance = radar[..., 2].clamp(min=0.5)
        J = spherical_jacobian(radar_lidar / distance[..., None], distance)
        information = inlier[..., None] * precision[:, None]
        return damped_match(J, information, information * mean, self.log_prior_sigma, R, surfaces)


def _away(columns: Tensor, rows: Tensor, width: Tensor | float = 1.0) -> Tensor:
    """B R C: half the squared distance of all pairs along one axis, in widths of the kernel."""
    # Scaled before pairing, and halved there too: operations on all pairs dominate the cost.
    scale = _HALF / width
    gap = (columns * scale)[..., None, :] - (rows * scale)[..., None]
    return gap * gap


def _kernel(away: Tensor) -> Tensor:
    return torch.exp(-away.clamp(max=_FARTHEST))


def _spherical(points: Tensor) -> Tensor:
    """Azimuth (left), elevation (up), range; by arctangents of quotients, x ahead."""
    x, y, z = points.unbind(-1)
    ahead = x.clamp(min=0.1)
    flat = torch.sqrt(ahead * ahead + y * y)
    return torch.stack([torch.atan(y / ahead), torch.atan(z / flat), torch.sqrt(flat * flat + z * z)], -1)


def _steps(step_deg: float) -> Tensor:
    """Shifts to both sides [rad]."""
    reach = round(_REACH_DEG / step_deg)
    return torch.arange(-reach, reach + 1) * float(np.radians(step_deg))
