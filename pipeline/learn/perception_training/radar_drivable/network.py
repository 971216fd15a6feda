"""The network and its export: convolutions over the polar grid, long in range and narrow in azimuth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.learn.perception_training.exporter import export_model
from pipeline.rig.radar_grid import CHANNELS, SHAPE, grid_layout

__all__ = ["LIMITS", "NAME", "DrivableNetwork", "build_drivable_network", "export_drivable"]

NAME = "radar_drivable"
PURPOSE = "drivable area of a radar's scan (paper, section 4.2): radar.drivable of a rig"
LIMITS = (
    "Learned from the lidar's drivable ground through each day's prior, with the errors of both.",
    "Valid for the radars, roads and weather of its samples only.",
    "Cells without lidar returns were not used in training: large free ranges are extrapolated.",
)
_DILATIONS = ((1, 1), (1, 2), (2, 4), (2, 8), (1, 1))  # directions, ranges


class DrivableNetwork(nn.Module):
    """Features to the logit that a cell is drivable: 27 k parameters at width 24."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.first = nn.Conv2d(len(CHANNELS), width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in _DILATIONS)
        self.last = nn.Conv2d(width, 1, 1)

    def forward(self, features: Float[Tensor, "B C A R"]) -> Float[Tensor, "B A R"]:
        """Logits."""
        x = torch.relu(self.first(features))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        logits: Tensor = self.last(x)[:, 0]
        return logits


def build_drivable_network(width: int, seed: int) -> DrivableNetwork:
    """New weights; the caller's random state is not changed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return DrivableNetwork(width)


class _Graph(nn.Module):
    """The network with probabilities in place of logits."""

    def __init__(self, network: DrivableNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor) -> Tensor:
        return torch.sigmoid(self.network(features))


def export_drivable(network: DrivableNetwork, folder: Path, card: dict[str, Any]) -> Path:
    """Write radar_drivable.onnx, .toml, .json and .md into a folder; returns the manifest."""
    about = {"purpose": PURPOSE, "command": "boresight train-radar-drivable", **card, "limits": LIMITS}
    example, names = torch.zeros(1, len(CHANNELS), *SHAPE), ("features", "drivable")
    layout = "".join(f"{key} = {json.dumps(value)}\n" for key, value in grid_layout().items())
    manifest = f'task = "{NAME}"\n\n[grid]\n{layout}'
    return export_model(_Graph(network.eval()), example, names, folder, NAME, manifest, about)
