"""The trained network as ONNX, with the manifest that fleet.toml names and a card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.geometry.radar_grid import CHANNELS, SHAPE, grid_layout
from pipeline.learn.perception.exporter import export_model
from pipeline.learn.perception.radar_drivable.network import DrivableNetwork

__all__ = ["LIMITS", "NAME", "export_drivable"]

NAME = "radar_drivable"
PURPOSE = "drivable area of a radar's scan (paper, section 4.2): radar.drivable of a rig"
LIMITS = (
    "Learned from the lidar's drivable ground through each day's prior: it is wrong where lidar and prior are.",
    "Knows no more radars, roads and weathers than its samples show.",
    "Cells that no lidar saw taught nothing: free ranges far out are extrapolated.",
)


class _Graph(nn.Module):
    """The network with probabilities in place of logits."""

    def __init__(self, network: DrivableNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor) -> Tensor:
        return torch.sigmoid(self.network(features))


def export_drivable(network: DrivableNetwork, folder: Path, card: dict[str, Any]) -> Path:
    """Write radar_drivable.onnx, .toml (the manifest), .json and .md (the card) into a folder.

    Returns:
        The manifest.
    """
    about = {"purpose": PURPOSE, "command": "boresight train-radar-drivable", **card, "limits": LIMITS}
    example, names = torch.zeros(1, len(CHANNELS), *SHAPE), ("features", "drivable")
    layout = "".join(f"{key} = {json.dumps(value)}\n" for key, value in grid_layout().items())
    manifest = f'task = "{NAME}"\n\n[grid]\n{layout}'
    return export_model(_Graph(network.eval()), example, names, folder, NAME, manifest, about)
