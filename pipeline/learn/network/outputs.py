"""Outputs of networks, and the heads that all of them share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from pipeline.learn.sample.grid import PAIRS
from pipeline.objective.differentiable.projection import exp_so3, pose, pose_of_euler_angles

__all__ = ["PAIRS", "ClassEvidence", "CoreOutputs", "Heads", "Predictions", "pose_of_twist"]

_ANGLE_UNIT_RAD, _SHIFT_UNIT_M = 0.0175, 0.05  # heads put out numbers of the order of one
# Log variance of an untrained network: 0.3 deg and 5 cm.
_LOG_VARIANCE = (-10.5, -10.5, -10.5, -6.0, -6.0, -6.0)


@dataclass(frozen=True, eq=False)
class ClassEvidence:
    """Matching evidence of camera and lidar, with gradients to both encoders: points, then marks."""

    maps: Float[Tensor, "B K H W"]  # log-likelihood of classes, and of boundaries and paint if matched
    probability: Float[Tensor, "B N K"]  # of each point's classes
    worth: Float[Tensor, "B N"]
    # Of CoreOutputs: in the optical frame at the guess; of Predictions: in the lidar frame.
    points_m: Float[Tensor, "B N 3"]


@dataclass(frozen=True, eq=False)
class CoreOutputs:
    """Outputs of the exported graph; rows of corrections are PAIRS, identity for pairs not estimated.

    `log_variance` is of a left twist of each transform (rotation vector [rad], translation [m]). Logits serve
    distillation: camera and lidar per cell of the grid (None in `concat` and in pairs without that sensor),
    radar per detection.
    """

    corrections: Float[Tensor, "B 3 4 4"]
    log_variance: Float[Tensor, "B 3 6"]
    # Of K classes, and whether the cell is seen.
    camera_log_likelihood: Float[Tensor, "B L H W"] | None = None
    camera_logits: Float[Tensor, "B K H W"] | None = None
    lidar_logits: Float[Tensor, "B K H W"] | None = None
    radar_logits: Float[Tensor, "B M K"] | None = None
    evidence: ClassEvidence | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Predictions(CoreOutputs):
    """Outputs with the corrected extrinsics; `lidar_index` is the lidar point shown by each cell, or -1."""

    T_camera_lidar: Float[Tensor, "B 4 4"]
    T_camera_radar: Float[Tensor, "B 4 4"]
    T_lidar_radar: Float[Tensor, "B 4 4"]
    lidar_index: Int64[Tensor, "B HW"]


class Heads(nn.Module):
    """One head per pair: 3 Euler angles and 3 translations, and the logarithm of their variances."""

    unit: Tensor
    start: Tensor

    def __init__(self, features: int, pairs: tuple[str, ...], std: float) -> None:
        super().__init__()
        self.layers = nn.ModuleDict({pair: nn.Linear(features, 12) for pair in pairs})
        for layer in self.layers.values():
            assert isinstance(layer, nn.Linear)
            nn.init.normal_(layer.weight, std=std)
            nn.init.zeros_(layer.bias)
        unit = [_ANGLE_UNIT_RAD] * 3 + [_SHIFT_UNIT_M] * 3
        self.register_buffer("unit", torch.tensor(unit), persistent=False)
        self.register_buffer("start", torch.tensor(_LOG_VARIANCE), persistent=False)

    def forward(
        self, features: Float[Tensor, "B F"], bases: dict[str, Tensor], log_variances: dict[str, Tensor]
    ) -> tuple[Float[Tensor, "B 3 4 4"], Float[Tensor, "B 3 6"]]:
        """Corrections and log variances of all PAIRS: changes of those found so far, if there are any."""
        corrections, spreads = [], []
        for pair in PAIRS:
            correction = torch.eye(4, device=features.device).expand(len(features), 4, 4)
            spread = log_variances.get(pair, self.start.expand(len(features), 6))
            if pair in self.layers:
                raw = self.layers[pair](features)
                step = raw[:, :6] * self.unit
                correction, spread = pose_of_euler_angles(step[:, :3], step[:, 3:]), spread + raw[:, 6:]
            corrections.append(correction @ bases[pair] if pair in bases else correction)
            spreads.append(spread)
        return torch.stack(corrections, 1), torch.stack(spreads, 1)


def pose_of_twist(twist: Float[Tensor, "B 6"]) -> Float[Tensor, "B 4 4"]:
    """Rotation vector and translation to a transform; the translation comes after the rotation."""
    return pose(exp_so3(twist[:, :3]), twist[:, 3:])
