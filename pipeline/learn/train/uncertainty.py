"""Scatter of single frames' answers about their day's reference, from which networks learn their variance."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.objective.differentiable.poses import inverse

__all__ = ["twist_between", "uncertainty_loss"]

_LOG_VARIANCE = (-18.0, 2.0)  # sigmas of 0.1 mrad to 3 m: what lies beyond has no gradient


def twist_between(
    T_a: Float[Tensor, "*batch 4 4"], T_b: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """Rotation vector [rad] and translation [m] of T_a T_b^-1, for angles well below pi."""
    delta = T_a @ inverse(T_b)
    R = delta[..., :3, :3]
    skew = (
        torch.stack(
            [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
        )
        / 2
    )
    sine = skew.norm(dim=-1, keepdim=True)
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    small = sine < 1e-6
    scale = torch.where(small, torch.ones_like(sine), torch.atan2(sine, cosine) / sine.clamp_min(1e-6))
    return torch.cat([scale * skew, delta[..., :3, 3]], -1)


def uncertainty_loss(
    log_variance: Float[Tensor, "B 3 6"], scatter: Float[Tensor, "B 3 6"]
) -> Float[Tensor, ""]:
    """Negative log-likelihood of the scatter; only the variances learn from it, because the scatter has no gradient."""
    bounded = log_variance.clamp(*_LOG_VARIANCE)
    return 0.5 * (scatter.square() * torch.exp(-bounded) + bounded).mean()
