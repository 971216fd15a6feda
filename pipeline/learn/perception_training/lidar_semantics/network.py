"""The network: a few convolutions over the range image, wide along the rings; its export in RangeNet++'s convention."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pipeline.learn.perception_training.exporter import export_model
from pipeline.learn.perception_training.lidar_semantics.labels import LABELS
from pipeline.learn.perception_training.lidar_semantics.samples import Normal, SweepLayout

__all__ = ["LIMITS", "NAME", "SweepNetwork", "build_sweep_network", "export_sweeps"]

NAME = "lidar_semantics"
PURPOSE = "classes of lidar points (paper, section 4.2): lidar.semantics of a rig"
LIMITS = (
    "Learned from the camera's classes through a calibration, with the errors of both.",
    "Thin objects were learned from their middles only; objects outside the camera's view were not learned.",
    "Valid for the lidars, roads and weather of its samples only; remission must be logged as by these lidars.",
)
_CHANNELS = 5
_DILATIONS = ((1, 1), (1, 2), (2, 4), (1, 1))  # rows, columns


class SweepNetwork(nn.Module):
    """Normalised range image to logits of the 20 labels: 60 k parameters at width 16. Even numbers of columns."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.first = nn.Conv2d(_CHANNELS, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=(1, 2), padding=1)
        self.blocks = nn.ModuleList(
            nn.Conv2d(2 * width, 2 * width, 3, padding=d, dilation=d) for d in _DILATIONS
        )
        self.up = nn.Conv2d(3 * width, width, 3, padding=1)
        self.last = nn.Conv2d(width, len(LABELS), 1)

    def forward(self, image: Float[Tensor, "B 5 H W"]) -> Float[Tensor, "B L H W"]:
        """Logits."""
        fine = torch.relu(self.first(image))
        x = torch.relu(self.down(fine))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        x = functional.interpolate(x, scale_factor=(1.0, 2.0), mode="nearest")
        logits: Tensor = self.last(torch.relu(self.up(torch.cat([fine, x], dim=1))))
        return logits


def build_sweep_network(width: int, seed: int) -> SweepNetwork:
    """Fresh weights; the caller's random state stays as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SweepNetwork(width)


def export_sweeps(
    network: SweepNetwork, layout: SweepLayout, normal: Normal, folder: Path, card: dict[str, Any]
) -> Path:
    """Write lidar_semantics.onnx, .toml, .json and .md into a folder; returns the manifest."""
    about = {"purpose": PURPOSE, "command": "boresight train-lidar-semantics", **card, "limits": LIMITS}
    example, names = torch.zeros(1, 5, *layout.size), ("points", "logits")
    return export_model(network.eval(), example, names, folder, NAME, _manifest(layout, normal), about)


def _manifest(layout: SweepLayout, normal: Normal) -> str:
    image = {
        "size": list(layout.size), "fov_up_deg": layout.fov_up_deg, "fov_down_deg": layout.fov_down_deg,
        "mean": list(normal.mean), "std": list(normal.std), "empty": "zero",
    }  # fmt: skip
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in image.items())
    output = '[output]\nlayout = "logits"\nlabel_set = "semantickitti"\n'
    return f'task = "segment_points"\n\n[input]\n{lines}\n{output}'
