"""A trained network of perception as ONNX, with the manifest that fleet.toml names, and a card."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
from torch import Tensor, nn

from pipeline.learn.export.model_card import write_card
from pipeline.learn.export.tracing import trace_to_onnx
from schemas.versions import CODE_VERSION

__all__ = ["ExportedGraph", "export_model"]


@dataclass(frozen=True, eq=False)
class ExportedGraph:
    """What is traced: a module of one input and one output.

    Args:
        module: in evaluation mode.
        example: an input of the right shape.
        input_name: of the file's input.
        output_name: of the file's output.
    """

    module: nn.Module
    example: Tensor
    input_name: str
    output_name: str


def export_model(
    graph: ExportedGraph, folder: Path, name: str, manifest: str, card: dict[str, Any], limits: Sequence[str]
) -> Path:
    """Write NAME.onnx, NAME.toml (the manifest), NAME.json and NAME.md (the card) into a folder.

    Args:
        graph: what is exported.
        folder: made where it is missing.
        name: of all four files, without suffix.
        manifest: what the manifest says after path and sha256: the task, and the layout of input and output.
        card: what is known of data, training and results.
        limits: sentences for the card.

    Returns:
        The manifest.
    """
    folder.mkdir(parents=True, exist_ok=True)
    model, unfinished = folder / f"{name}.onnx", folder / f"{name}.part"
    traced = trace_to_onnx(
        graph.module, (graph.example,), unfinished, [graph.input_name], [graph.output_name]
    )
    onnx.checker.check_model(traced)
    unfinished.replace(model)
    plain = {"code_version": CODE_VERSION, **card}
    plain["parameters"] = sum(p.numel() for p in graph.module.parameters())
    plain["limits"] = list(limits)
    write_card(model, plain)
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    path = folder / f"{name}.toml"
    path.write_text(f'path = "{model.name}"\nsha256 = "{digest}"\n{manifest}')
    return path
