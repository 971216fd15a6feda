"""The trained network as ONNX, with the manifest that fleet.toml names and a card."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn
from torch.jit._trace import TracerWarning

from pipeline.geometry.radar_grid import CHANNELS, SHAPE, grid_layout
from pipeline.learn.export.onnx_file import OPSET, card_markdown
from pipeline.learn.perception.radar_drivable.network import DrivableNetwork
from schemas.versions import CODE_VERSION

__all__ = ["LIMITS", "NAME", "export_drivable"]

NAME = "radar_drivable"
LIMITS = (
    "Learned from the lidar's drivable ground through each day's prior: it is wrong where lidar and prior are.",
    "Knows no more radars, roads and weathers than its samples show.",
    "Cells that no lidar saw taught nothing: free ranges far out are extrapolated.",
)


class _Graph(nn.Module):
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
    network.eval()
    folder.mkdir(parents=True, exist_ok=True)
    model, aside = folder / f"{NAME}.onnx", folder / f"{NAME}.part"
    with warnings.catch_warnings():
        # As for the calibration networks: the tracing exporter needs no further dependency.
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=TracerWarning)
        torch.onnx.export(
            _Graph(network), (torch.zeros(1, len(CHANNELS), *SHAPE),), str(aside), dynamo=False,
            opset_version=OPSET, input_names=["features"], output_names=["drivable"],
        )  # fmt: skip
    onnx.checker.check_model(onnx.load(str(aside)))
    aside.replace(model)
    plain = {"file": model.name, "bytes": model.stat().st_size, "code_version": CODE_VERSION, **card}
    plain["parameters"] = sum(p.numel() for p in network.parameters())
    plain["limits"] = list(LIMITS)
    (folder / f"{NAME}.json").write_text(json.dumps(plain, indent=2) + "\n")
    (folder / f"{NAME}.md").write_text(card_markdown(plain))
    manifest = folder / f"{NAME}.toml"
    manifest.write_text(_manifest(model))
    return manifest


def _manifest(model: Path) -> str:
    layout = "".join(f"{key} = {json.dumps(value)}\n" for key, value in grid_layout().items())
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    return f'path = "{model.name}"\nsha256 = "{digest}"\ntask = "{NAME}"\n\n[grid]\n{layout}'
