"""The networks: from sensor data and a guess to corrected extrinsics and their log variances.

`matching` computes correspondences explicitly and learns the appearance of classes, the sharpness of
evidence, and residuals. `concat` is the paper's: encode, concatenate, fuse, regress. Both exist for all pairs
(joint) or one pair.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from pipeline.learn.network.concat_network import ConcatCore
from pipeline.learn.network.matching_network import MatchingCore
from pipeline.learn.network.outputs import CoreOutputs, Predictions
from pipeline.learn.network.views import NetworkInputs, RenderedView, render
from pipeline.learn.sample.layout import NetworkConfig
from pipeline.objective.differentiable.poses import inverse, transform_points

__all__ = ["CalibrationNetwork", "build_network"]


class CalibrationNetwork(nn.Module):
    """One network of either architecture: renders at the guess, computes, applies the corrections."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.core = MatchingCore(config) if config.architecture == "matching" else ConcatCore(config)

    def refine(self, inputs: NetworkInputs, iterations: int) -> list[Predictions]:
        """Several passes with the same weights, each rendered at the last rotation; the camera is encoded once.

        Only rotations are handed on: one frame hardly determines a shift, and errors of shifts would add up
        over passes. Every answer holds the shift of its pass. Gradients do not flow from one pass into the
        one before.
        """
        found: list[Predictions] = []
        likelihood: Tensor | None = None
        logits: Tensor | None = None
        for _ in range(iterations):
            view, index = self._render(inputs)
            if isinstance(self.core, MatchingCore) and found:
                outputs = self.core.match(view, likelihood, logits)
            else:
                outputs = self.core(view)
                likelihood, logits = outputs.camera_log_likelihood, outputs.camera_logits
            found.append(self._predictions(inputs, outputs, index))
            turns = outputs.corrections.detach().clone()
            turns[..., :3, 3] = 0.0
            inputs = replace(inputs, **self._corrected(turns, inputs))
        return found

    def _render(self, inputs: NetworkInputs) -> tuple[RenderedView, Int64[Tensor, "B HW"]]:
        return render(inputs, self.config.grid, classes=self.config.takes_classes)

    def _predictions(
        self, inputs: NetworkInputs, outputs: CoreOutputs, index: Int64[Tensor, "B HW"]
    ) -> Predictions:
        evidence = outputs.evidence
        if evidence is not None:
            points_m = transform_points(inverse(inputs.T_camera_lidar), evidence.points_m)
            evidence = replace(evidence, points_m=points_m)
        poses = self._corrected(outputs.corrections, inputs)
        return Predictions(**vars(outputs) | {"evidence": evidence}, **poses, lidar_index=index)

    def _corrected(self, corrections: Float[Tensor, "B 3 4 4"], inputs: NetworkInputs) -> dict[str, Any]:
        """Corrected transforms (B 4 4) by the names of `NetworkInputs`.

        If the network composes, the camera-radar correction is applied to the product of the other two instead
        of to the guess: radar is matched to the lidar six times better than to the image.
        """
        T_camera_lidar = corrections[:, 0] @ inputs.T_camera_lidar
        T_lidar_radar = corrections[:, 2] @ inputs.T_lidar_radar
        base = T_camera_lidar @ T_lidar_radar if self.config.composed else inputs.T_camera_radar
        T_camera_radar = corrections[:, 1] @ base
        return {
            "T_camera_lidar": T_camera_lidar,
            "T_camera_radar": T_camera_radar,
            "T_lidar_radar": T_lidar_radar,
        }


def build_network(config: NetworkConfig, seed: int = 0) -> CalibrationNetwork:
    """A fresh network; the same seed gives the same weights, independent of torch's generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return CalibrationNetwork(config)
