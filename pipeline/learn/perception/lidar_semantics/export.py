"""The trained network as ONNX in RangeNet++'s convention, with the manifest that fleet.toml names and a card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from pipeline.learn.perception.exporter import export_model
from pipeline.learn.perception.lidar_semantics.network import SweepNetwork
from pipeline.learn.perception.lidar_semantics.samples import SweepLayout
from pipeline.learn.perception.lidar_semantics.training import Normal

__all__ = ["LIMITS", "NAME", "export_sweeps"]

NAME = "lidar_semantics"
PURPOSE = "classes of lidar points (paper, section 4.2): lidar.semantics of a rig"
LIMITS = (
    "Learned from the camera's classes through a calibration: it is wrong where either is.",
    "Thin things are taught by their middles only; what the camera never saw, by nothing.",
    "Knows no more lidars, roads and weathers than its samples show; remission is taken as these lidars log it.",
)


def export_sweeps(
    network: SweepNetwork, layout: SweepLayout, normal: Normal, folder: Path, card: dict[str, Any]
) -> Path:
    """Write lidar_semantics.onnx, .toml (the manifest), .json and .md (the card) into a folder.

    Returns:
        The manifest.
    """
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
