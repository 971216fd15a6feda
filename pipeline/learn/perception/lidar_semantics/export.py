"""The trained network as ONNX in RangeNet++'s convention, with the manifest that fleet.toml names and a card."""

from __future__ import annotations

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from torch.jit._trace import TracerWarning

from pipeline.learn.export.onnx_file import OPSET, card_markdown
from pipeline.learn.perception.lidar_semantics.network import SweepNetwork
from pipeline.learn.perception.lidar_semantics.samples import SweepLayout
from pipeline.learn.perception.lidar_semantics.training import Normal
from schemas.versions import CODE_VERSION

__all__ = ["LIMITS", "NAME", "export_sweeps"]

NAME = "lidar_semantics"
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
    network.eval()
    folder.mkdir(parents=True, exist_ok=True)
    model, aside = folder / f"{NAME}.onnx", folder / f"{NAME}.part"
    with warnings.catch_warnings():
        # As for the calibration networks: the tracing exporter needs no further dependency.
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=TracerWarning)
        torch.onnx.export(
            network, (torch.zeros(1, 5, *layout.size),), str(aside), dynamo=False, opset_version=OPSET,
            input_names=["points"], output_names=["logits"],
        )  # fmt: skip
    onnx.checker.check_model(onnx.load(str(aside)))
    aside.replace(model)
    plain = {"file": model.name, "bytes": model.stat().st_size, "code_version": CODE_VERSION, **card}
    plain["parameters"] = sum(p.numel() for p in network.parameters())
    plain["limits"] = list(LIMITS)
    (folder / f"{NAME}.json").write_text(json.dumps(plain, indent=2) + "\n")
    (folder / f"{NAME}.md").write_text(card_markdown(plain))
    manifest = folder / f"{NAME}.toml"
    manifest.write_text(_manifest(model, layout, normal))
    return manifest


def _manifest(model: Path, layout: SweepLayout, normal: Normal) -> str:
    image = {
        "size": list(layout.size), "fov_up_deg": layout.fov_up_deg, "fov_down_deg": layout.fov_down_deg,
        "mean": list(normal.mean), "std": list(normal.std), "empty": "zero",
    }  # fmt: skip
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in image.items())
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    head = f'path = "{model.name}"\nsha256 = "{digest}"\ntask = "segment_points"\n'
    return f'{head}\n[input]\n{lines}\n[output]\nlayout = "logits"\nlabel_set = "semantickitti"\n'
