"""A trained network as one ONNX file, with its card inside.

The graph is the part that depends on weights: from rendered sensors to corrections (`RenderedView` names the
inputs). Compiled code renders outside it. `camera_log_likelihood` is an output, so that a caller can cut the
graph there and encode the camera once for several refinements (`infer/single_frame.py`).
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn
from torch.jit._trace import TracerWarning

from pipeline.learn.export.model_card import write_card
from pipeline.learn.network.calibration_network import CalibrationNetwork
from pipeline.learn.network.exported_weights import WEIGHTS, weight_places
from pipeline.learn.network.views import RenderedView
from pipeline.learn.sample.layout import (
    EVIDENCE,
    GRAPH_INPUTS,
    LIDAR_CHANNELS,
    LIKELIHOOD,
    MARKED_POINTS,
    MATCHED_POINTS,
    OBJECT_POINTS,
    PAIRS,
    RADAR_CHANNELS,
    RADAR_POINTS,
    NetworkConfig,
)  # fmt: skip
from schemas.training import GRID_CLASSES
from schemas.versions import CODE_VERSION

__all__ = ["OPSET", "export_onnx", "trace_to_onnx"]

OPSET = 18


class _Graph(nn.Module):
    """The core with tensors as arguments, as the exporter requires."""

    def __init__(self, network: CalibrationNetwork) -> None:
        super().__init__()
        self.core = network.core

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        outputs = self.core(RenderedView(*tensors))
        found: tuple[Tensor, ...] = (outputs.corrections, outputs.log_variance)
        if outputs.camera_log_likelihood is not None:
            found = (outputs.camera_log_likelihood, *found)
        evidence = outputs.evidence
        return found if evidence is None else (*found, evidence.maps, evidence.probability, evidence.worth)


def export_onnx(network: CalibrationNetwork, out: Path, card: dict[str, Any] | None = None) -> Path:
    """Write the network (batch 1) to `out`, and its card into the metadata and next to it (JSON, Markdown)."""
    network.eval()
    examples = _examples(network.config)
    graph = _Graph(network)
    with torch.no_grad():
        outputs = graph(*examples)
    answers = ["corrections", "log_variance"]
    names = {2: answers, 3: [LIKELIHOOD, *answers], 6: [LIKELIHOOD, *answers, *EVIDENCE]}[len(outputs)]
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_suffix(".part")
    model = trace_to_onnx(graph, examples, unfinished, GRAPH_INPUTS, names)
    _shorten_names(model, {*GRAPH_INPUTS, *names})
    metadata = _metadata(network.config, card or {})
    metadata[WEIGHTS] = json.dumps(weight_places(network.state_dict(), model))
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.checker.check_model(model)
    onnx.save(model, str(unfinished))
    unfinished.replace(out)
    write_card(out, _card_of(network, metadata, card or {}))
    return out


def _examples(config: NetworkConfig) -> tuple[Tensor, ...]:
    """Inputs of the right shapes, in the order of GRAPH_INPUTS."""
    cells = config.grid.height, config.grid.width
    grids = [torch.rand(1, c, *cells) for c in (config.camera_channels, LIDAR_CHANNELS, RADAR_CHANNELS)]

    def points(count: int) -> tuple[Tensor, Tensor]:
        return 10 + torch.rand(1, count, 3), torch.ones(1, count)

    radar, valid = points(RADAR_POINTS)
    return (
        *grids, *points(MATCHED_POINTS), *points(OBJECT_POINTS), radar, radar, radar, valid > 0,
        torch.ones(1, dtype=torch.bool), *points(MARKED_POINTS),
    )  # fmt: skip


def _shorten_names(model: onnx.ModelProto, kept: set[str]) -> None:
    """Number the inner tensors: module paths on thousands of small nodes are a fifth of the file."""
    numbers: dict[str, str] = {}

    def short(name: str) -> str:
        return name if not name or name in kept else numbers.setdefault(name, f"t{len(numbers)}")

    for node in model.graph.node:
        node.name = ""
        node.doc_string = ""
        for names in (node.input, node.output):
            for i, name in enumerate(names):
                names[i] = short(name)
    for initializer in model.graph.initializer:
        initializer.name = short(initializer.name)
    del model.graph.value_info[:]


def _metadata(config: NetworkConfig, card: dict[str, Any]) -> dict[str, str]:
    return {
        "network": json.dumps(asdict(config)),
        "architecture": config.architecture,
        "pairs": json.dumps(PAIRS),
        "classes": json.dumps(GRID_CLASSES),
        "grid": json.dumps(asdict(config.grid)),
        "code_version": CODE_VERSION,
        "card": json.dumps(card, default=str),
    }


def _card_of(network: CalibrationNetwork, metadata: dict[str, str], card: dict[str, Any]) -> dict[str, Any]:
    return {
        "purpose": f"calibration from single frames ({network.config.pairs}): methods joint-ssl and pairwise-ssl",
        "command": "boresight train, boresight export onnx",
        "parameters": sum(p.numel() for p in network.parameters()),
        "architecture": network.config.architecture,
        "network": json.loads(metadata["network"]),
        "classes": list(GRID_CLASSES),
        "code_version": CODE_VERSION,
        **card,
    }


def trace_to_onnx(
    graph: nn.Module, examples: tuple[Tensor, ...], path: Path, inputs: Sequence[str], outputs: Sequence[str]
) -> onnx.ModelProto:
    """Trace the graph on example inputs, write it to `path`, and read it back unchecked.

    Uses the tracing exporter, because torch's newer one needs onnxscript.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=TracerWarning)
        warnings.filterwarnings("ignore", message=".*Constant folding.*")
        torch.onnx.export(
            graph, examples, str(path), dynamo=False, opset_version=OPSET,
            input_names=list(inputs), output_names=list(outputs),
        )  # fmt: skip
    return onnx.load(str(path))
