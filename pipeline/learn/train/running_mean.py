"""Running mean of each vehicle-day's answers: the reference from which single frames learn their variance.

The variance that a network predicts for a frame should be that of single frames about their day's mean. A
bias common to all frames of a day is not part of it, and cannot be learned without truth.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.objective.differentiable.poses import exp_so3, inverse, pose

__all__ = ["DayMeans", "twist_between", "uncertainty_loss"]

_LOG_VARIANCE = (-18.0, 2.0)  # sigmas of 0.1 mrad to 3 m: what lies beyond has no gradient
_LEAST_ANSWERS = 8  # of a day that is known
_LEAST_SHARE = 0.02  # of the newest frame in the mean: networks change while they learn


def twist_between(
    T_a: Float[Tensor, "*batch 4 4"], T_b: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """Rotation vector [rad] and translation [m] of T_a T_b^-1, for angles well below pi; inverse of `_moved`."""
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


def _moved(twist: Float[Tensor, "*batch 6"], T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    return pose(exp_so3(twist[..., :3]), twist[..., 3:]) @ T


class DayMeans:
    """Running mean, by vehicle-day and pair, of the twists from the day's reference to the answers."""

    def __init__(self) -> None:
        self._mean: dict[str, Tensor] = {}
        self._count: dict[str, int] = {}

    def scatter(
        self,
        days: list[str],
        answers: Float[Tensor, "B 3 4 4"],
        references: Float[Tensor, "B 3 4 4"],
    ) -> Float[Tensor, "B 3 6"]:
        """Twist from each day's mean to each frame's answer, without gradient; then the answers join the mean."""
        twist = twist_between(answers.detach(), references).cpu()
        out, origin = torch.zeros_like(twist), torch.eye(4, dtype=twist.dtype).expand(3, 4, 4)
        for row, (day, value) in enumerate(zip(days, twist, strict=True)):
            mean = self._mean.get(day, value)
            out[row] = twist_between(_moved(value, origin), _moved(mean, origin))
        for day, value in zip(days, twist, strict=True):
            count = self._count.get(day, 0) + 1
            share = max(1.0 / count, _LEAST_SHARE)
            self._mean[day] = value if count == 1 else self._mean[day] + share * (value - self._mean[day])
            self._count[day] = count
        return out.to(answers.device)

    def known(self, days: list[str]) -> list[bool]:
        """Whether each day's mean has enough answers."""
        return [self._count.get(day, 0) >= _LEAST_ANSWERS for day in days]

    def pose(self, days: list[str], pair: int, references: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 4 4"]:
        """Each day's mean answer for a pair, or its reference without answers."""
        none = torch.zeros(3, 6)
        twist = torch.stack([self._mean.get(day, none)[pair] for day in days])
        return _moved(twist.to(references), references)

    def state_dict(self) -> dict[str, dict[str, Tensor] | dict[str, int]]:
        """For checkpoints."""
        return {"mean": dict(self._mean), "count": dict(self._count)}

    def load_state_dict(self, state: dict[str, dict[str, Tensor] | dict[str, int]]) -> None:
        """From checkpoints."""
        self._mean = {day: torch.as_tensor(mean) for day, mean in state["mean"].items()}
        self._count = {day: int(count) for day, count in state["count"].items()}


def uncertainty_loss(
    log_variance: Float[Tensor, "B 3 6"], scatter: Float[Tensor, "B 3 6"], known: Float[Tensor, " B"]
) -> Float[Tensor, ""]:
    """Negative log-likelihood of the scatter; only the variances learn from it, because the scatter has no gradient."""
    bounded = log_variance.clamp(*_LOG_VARIANCE)
    per_frame = 0.5 * (scatter.square() * torch.exp(-bounded) + bounded).mean((1, 2))
    return (per_frame * known).sum() / known.sum().clamp_min(1)
