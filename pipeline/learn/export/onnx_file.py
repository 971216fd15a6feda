"""A trained network as one ONNX file, with its card inside and beside it as JSON and Markdown.

The graph is the part that depends on weights, from rendered sensors (`RenderedView`) to corrections. With output
`camera_log_likelihood`, a caller can cut it and encode the camera once for several refinements.
"""

from __future__ import annotations

import hashlib
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

from pipeline.core.errors import ConfigError
from pipeline.learn.infer.onnx_networks import UNFIT
from pipeline.learn.network.calibration_network import CalibrationNetwork, weight_places
from pipeline.learn.network.views import RenderedView
from pipeline.learn.sample.grid import (
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
from pipeline.learn.sample.weights import WEIGHTS
from pipeline.learn.train.loop import BEST, LAST, load_checkpoint, read_metrics
from schemas.training import GRID_CLASSES
from schemas.versions import CODE_VERSION

__all__ = ["card_of_run", "export_onnx", "trace_to_onnx", "write_card"]

_OPSET = 18
_LIMITS = (
    "Trained without ground truth: answers have the losses' biases, which averaging over a fleet does not reduce.",
    "Looks 38 deg to each side of the camera's axis; guesses within about 5 deg, best with 2 or 3 passes.",
    "A single frame determines rotations of camera-lidar best; translations stay close to their guess.",
    "Log variances describe the scatter between frames; they do not include errors common to all frames.",
    "Rigs, lenses or weather that are not in the data were not learned.",
)


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
    config = network.config
    metadata = {
        "network": json.dumps(asdict(config)), "architecture": config.architecture, "pairs": json.dumps(PAIRS),
        "classes": json.dumps(GRID_CLASSES), "grid": json.dumps(asdict(config.grid)),
        "code_version": CODE_VERSION, "card": json.dumps(card or {}, default=str),
        WEIGHTS: json.dumps(weight_places(network.state_dict(), model)),
    }  # fmt: skip
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.checker.check_model(model)
    onnx.save(model, str(unfinished))
    unfinished.replace(out)
    about = {
        "purpose": f"calibration from single frames ({config.pairs}): methods joint-ssl and pairwise-ssl",
        "command": "boresight train, boresight export onnx",
        "parameters": sum(p.numel() for p in network.parameters()), "architecture": config.architecture,
        "network": asdict(config), "classes": list(GRID_CLASSES), "code_version": CODE_VERSION,
    }  # fmt: skip
    write_card(out, about | (card or {}))
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
            graph, examples, str(path), dynamo=False, opset_version=_OPSET,
            input_names=list(inputs), output_names=list(outputs),
        )  # fmt: skip
    return onnx.load(str(path))


def card_of_run(folder: Path, notes: Path | None = None) -> dict[str, Any]:
    """The card of a run of `boresight train`.

    Args:
        notes: JSON object whose entries are placed first: measurements after training, and facts about the
            data.

    Raises:
        ContractError: no readable checkpoint.
        ConfigError: notes that are no JSON object.
    """
    best = (folder / BEST).exists()
    chosen, last = load_checkpoint(folder / (BEST if best else LAST)), load_checkpoint(folder / LAST)
    config = chosen["config"]
    reports = [r for r in read_metrics(folder) if r["step"] <= chosen["step"]]
    told = {name: value for report in reports for name, value in report.items()}
    unfit = []  # for weights that no held-out frames chose, or that are those of the start
    if not best:
        unfit = [f"{UNFIT}: not validated on held-out frames. `calibrate` holds all its results."]
    elif chosen["step"] == 0:
        unfit = [f"{UNFIT}: on held-out frames, training did not improve on the initial weights."]
    card = {
        "weights": f"of step {chosen['step']}, {'the best on held-out frames' if best else 'the last'}",
        "data": {"cell_deg": config["cell_deg"], "frames_per_step": config["batch_size"]},
        "seeds": [config["seed"]],
        "time": {"steps": last["step"], "minutes": round(last["trained_s"] / 60, 1)},
        "results": {n.removeprefix("validation/"): v for n, v in told.items() if n.startswith("validation/")},
        "limits": _LIMITS,
        "training": config,
    }
    card |= _notes(notes)
    return card | {"limits": [*unfit, *card["limits"]]}  # which no notes take away


def write_card(model: Path, card: dict[str, Any]) -> None:
    """Write the card next to the model's file as .json and .md, with size and sha256."""
    content = model.read_bytes()
    told = {"file": model.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    card = told | {key: value for key, value in card.items() if key not in told}
    model.with_suffix(".json").write_text(json.dumps(card, indent=2, default=str) + "\n")
    model.with_suffix(".md").write_text(_markdown(card))


def _markdown(card: dict[str, Any]) -> str:
    lines = [f"# Model card of {card['file']}", ""]
    for key, value in card.items():
        name = key.replace("_", " ")
        if isinstance(value, (dict, list, tuple)):
            rows = [f"{k}: {v}" for k, v in value.items()] if isinstance(value, dict) else value
            lines += [f"## {name}", "", *(f"- {row}" for row in rows), ""]
        else:
            lines += [f"- {name}: {value}", ""]
    return "\n".join(lines)


def _notes(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        notes = json.loads(path.read_text())
    except (OSError, ValueError) as err:
        raise ConfigError(str(path), "", f"no readable JSON: {err}") from err
    if not isinstance(notes, dict):
        raise ConfigError(str(path), "", "holds no JSON object")
    return notes
