"""The networks: from sensor data and a guess to corrected extrinsics and their log variances.

`matching` computes correspondences explicitly and learns the appearance of classes, the sharpness of
evidence, and residuals. `concat` is the paper's: encode, concatenate, fuse, regress. Both exist for all pairs
(joint) or one pair.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from pipeline.learn.network.concat_network import ConcatCore
from pipeline.learn.network.inputs import NetworkInputs
from pipeline.learn.network.matching_network import MatchingCore
from pipeline.learn.network.outputs import CoreOutputs, Predictions
from pipeline.learn.network.views import RenderedView, render
from pipeline.learn.sample.layout import NetworkConfig
from pipeline.objective.differentiable.poses import inverse, transform_points

__all__ = ["CalibrationNetwork", "NetworkConfig", "build_network", "compose", "turns_only"]


class CalibrationNetwork(nn.Module):
    """One network of either architecture: renders at the guess, computes, applies the corrections."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.core: MatchingCore | ConcatCore
        if config.architecture == "matching":
            self.core = MatchingCore(
                config.grid,
                config.estimated,
                config.width,
                config.hidden,
                config.camera_channels,
                config.marks,
            )
        else:
            self.core = ConcatCore(config.grid, config.estimated, config.width, config.hidden)

    def forward(self, inputs: NetworkInputs) -> Predictions:
        """One pass."""
        view, index = self._render(inputs)
        return self._predictions(inputs, self.core(view), index)

    def encode(self, inputs: NetworkInputs) -> Predictions:
        """Class logits alone, at the guess: training signal of the encoders of `matching`."""
        assert isinstance(self.core, MatchingCore)
        view, index = self._render(inputs)
        return self._predictions(inputs, self.core.encode(view), index)

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
            turned = replace(outputs, corrections=turns_only(outputs.corrections.detach()))
            guess = self._predictions(inputs, turned, index)
            inputs = replace(
                inputs,
                T_camera_lidar=guess.T_camera_lidar,
                T_camera_radar=guess.T_camera_radar,
                T_lidar_radar=guess.T_lidar_radar,
            )
        return found

    def _render(self, inputs: NetworkInputs) -> tuple[RenderedView, Int64[Tensor, "B HW"]]:
        return render(inputs, self.config.grid, classes=self.config.takes_classes)

    def _predictions(
        self, inputs: NetworkInputs, outputs: CoreOutputs, index: Int64[Tensor, "B HW"]
    ) -> Predictions:
        T_camera_lidar, T_camera_radar, T_lidar_radar = compose(
            outputs.corrections, inputs.T_camera_lidar, inputs.T_camera_radar, inputs.T_lidar_radar,
            composed=self.config.composed,
        )  # fmt: skip
        evidence = outputs.evidence
        if evidence is not None:
            points_m = transform_points(inverse(inputs.T_camera_lidar), evidence.points_m)
            evidence = replace(evidence, points_m=points_m)
        return Predictions(
            T_camera_lidar,
            T_camera_radar,
            T_lidar_radar,
            outputs.log_variance,
            outputs.camera_logits,
            outputs.lidar_logits,
            outputs.radar_logits,
            index,
            evidence,
        )


def turns_only(corrections: Float[Tensor, "B 3 4 4"]) -> Float[Tensor, "B 3 4 4"]:
    """The corrections without their shifts."""
    turned = corrections.clone()
    turned[..., :3, 3] = 0.0
    return turned


def compose(
    corrections: Float[Tensor, "B 3 4 4"],
    T_camera_lidar: Float[Tensor, "B 4 4"],
    T_camera_radar: Float[Tensor, "B 4 4"],
    T_lidar_radar: Float[Tensor, "B 4 4"],
    *,
    composed: bool,
) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B 4 4"], Float[Tensor, "B 4 4"]]:
    """Corrected transforms (camera-lidar, camera-radar, lidar-radar).

    With `composed` the camera-radar correction is applied to the product of the other two instead of to the
    guess: radar is matched to the lidar six times better than to the image.
    """
    camera_lidar = corrections[:, 0] @ T_camera_lidar
    lidar_radar = corrections[:, 2] @ T_lidar_radar
    base = camera_lidar @ lidar_radar if composed else T_camera_radar
    return camera_lidar, corrections[:, 1] @ base, lidar_radar


def build_network(config: NetworkConfig, seed: int = 0) -> CalibrationNetwork:
    """A fresh network; the same seed gives the same weights, independent of torch's generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return CalibrationNetwork(config)
