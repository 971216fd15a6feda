"""A trained network of perception as ONNX, with the manifest that fleet.toml names, and a card."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import onnx
from torch import Tensor, nn

from pipeline.learn.export.model_card import write_card
from pipeline.learn.export.tracing import trace_to_onnx
from schemas.versions import CODE_VERSION

__all__ = ["export_model"]


def export_model(
    module: nn.Module,
    example: Tensor,
    names: tuple[str, str],
    folder: Path,
    name: str,
    manifest: str,
    card: dict[str, Any],
) -> Path:
    """Write NAME.onnx, NAME.toml (the manifest), NAME.json and NAME.md (the card); returns the manifest.

    `manifest` holds its entries after path and sha256: the task, and the layout of input and output.
    """
    folder.mkdir(parents=True, exist_ok=True)
    model, unfinished = folder / f"{name}.onnx", folder / f"{name}.part"
    onnx.checker.check_model(trace_to_onnx(module, (example,), unfinished, names[:1], names[1:]))
    unfinished.replace(model)
    parameters = sum(p.numel() for p in module.parameters())
    write_card(model, {"code_version": CODE_VERSION, "parameters": parameters, **card})
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    path = folder / f"{name}.toml"
    path.write_text(f'path = "{model.name}"\nsha256 = "{digest}"\n{manifest}')
    return path
