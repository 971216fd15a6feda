"""A torch module as an ONNX file, by torch's tracing exporter."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.jit._trace import TracerWarning

__all__ = ["OPSET", "trace_to_onnx"]

OPSET = 18


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
