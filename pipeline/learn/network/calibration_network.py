"""The networks: from sensor data and a guess to corrected extrinsics and their log variances.

`matching` computes correspondences explicitly and learns the appearance of classes, the sharpness of
evidence, and residuals. `concat` is the paper's: encode, concatenate, fuse, regress. Both exist for all pairs
(joint) or one pair.

An exported file is the start of further training: shipped networks exist only in this form. A graph holds weights
under numbers, transposed or folded into others. The file's metadata map them; the few small ones that are folded are
stored there.

Source: paper, figure 6 and "SSL-based method"; layer sizes are not given there and are chosen here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from jaxtyping import Float
from onnx import numpy_helper
from torch import Tensor, nn

from pipeline.core.errors import ModelError
from pipeline.learn.network.encoders import convolution, standardised
from pipeline.learn.network.matching_network import MatchingCore
from pipeline.learn.network.outputs import CoreOutputs, Heads, Predictions
from pipeline.learn.network.views import NetworkInputs, RenderedView, render
from pipeline.learn.sample.grid import CAMERA_CHANNELS, LIDAR_CHANNELS, PAIRS, RADAR_CHANNELS, NetworkConfig
from pipeline.learn.sample.weights import Place, listed_weights
from pipeline.objective.differentiable.projection import inverse, transform_points
from schemas.training import GRID_CLASSES

__all__ = ["CalibrationNetwork", "ConcatCore", "build_network", "network_of_file", "weight_places"]

_CHANNELS = {"camera": CAMERA_CHANNELS, "lidar": LIDAR_CHANNELS, "radar": RADAR_CHANNELS}
_STD = 1e-2  # heads start near no correction


class ConcatCore(nn.Module):
    """Network on one rendered view, for the sensors of its pairs."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        grid, pairs, width = config.grid, config.estimated, config.width
        channels = {name: _CHANNELS[name] for name in _CHANNELS if any(name in pair for pair in pairs)}
        self.encoders = nn.ModuleDict({name: _encoder(c, width) for name, c in channels.items()})
        self.fusion = nn.Sequential(
            nn.Conv2d(4 * width * len(channels), 6 * width, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(6 * width, 6 * width, 3, 2, 1), nn.ReLU(),
        )  # fmt: skip
        # Where something is must survive: averages over 2 x 4 regions, as a product that every exporter knows.
        rows, columns = -(-grid.height // 64), -(-grid.width // 64)
        one_hot = torch.eye(rows * columns).reshape(-1, 1, rows, columns)
        regions = nn.functional.adaptive_avg_pool2d(one_hot, (2, 4)).flatten(1)
        self.register_buffer("regions", regions, persistent=False)
        self.last = nn.Sequential(nn.Linear(6 * width * 8, config.hidden), nn.ReLU())
        self.heads = Heads(config.hidden, pairs, _STD)

    def forward(self, view: RenderedView) -> CoreOutputs:
        """Corrections and log variances from the sensors' grids at the current guess."""
        grids = {"camera": standardised(view.camera), "lidar": view.lidar_grid, "radar": view.radar_grid}
        maps = self.fusion(torch.cat([encoder(grids[name]) for name, encoder in self.encoders.items()], 1))
        return CoreOutputs(*self.heads(self.last((maps.flatten(2) @ self.regions).flatten(1)), {}, {}))


def _encoder(channels: int, width: int) -> nn.Sequential:
    sizes = pairwise((channels, width, 2 * width, 3 * width, 4 * width))
    return nn.Sequential(*(layer for inputs, outputs in sizes for layer in convolution(inputs, outputs, 2)))


class CalibrationNetwork(nn.Module):
    """One network of either architecture: renders at the guess, computes, applies the corrections."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.core = MatchingCore(config) if config.architecture == "matching" else ConcatCore(config)

    def refine(self, inputs: NetworkInputs, iterations: int) -> list[Predictions]:
        """Several passes with the same weights, each rendered at the last rotation; the camera is encoded once.

        Only rotations are handed on: one frame hardly determines a shift, and errors of shifts would add up
        over passes. Every answer holds the shift of its pass. Gradients do not flow from one pass into the
        one before.
        """
        found: list[Predictions] = []
        likelihood: Tensor | None = None
        logits: Tensor | None = None
        for _ in range(iterations):
            view, index = render(inputs, self.config.grid, classes=self.config.takes_classes)
            if isinstance(self.core, MatchingCore) and found:
                outputs = self.core.match(view, likelihood, logits)
            else:
                outputs = self.core(view)
                likelihood, logits = outputs.camera_log_likelihood, outputs.camera_logits
            evidence = outputs.evidence
            if evidence is not None:
                points_m = transform_points(inverse(inputs.T_camera_lidar), evidence.points_m)
                evidence = replace(evidence, points_m=points_m)
            poses = self._corrected(outputs.corrections, inputs)
            found.append(Predictions(**vars(outputs) | {"evidence": evidence}, **poses, lidar_index=index))
            turns = outputs.corrections.detach().clone()
            turns[..., :3, 3] = 0.0
            inputs = replace(inputs, **self._corrected(turns, inputs))
        return found

    def _corrected(self, corrections: Float[Tensor, "B 3 4 4"], inputs: NetworkInputs) -> dict[str, Any]:
        """Corrected transforms (B 4 4) by the names of `NetworkInputs`.

        If the network composes, the camera-radar correction is applied to the product of the other two instead
        of to the guess: radar is matched to the lidar six times better than to the image.
        """
        T_camera_lidar = corrections[:, 0] @ inputs.T_camera_lidar
        T_lidar_radar = corrections[:, 2] @ inputs.T_lidar_radar
        base = T_camera_lidar @ T_lidar_radar if self.config.composed else inputs.T_camera_radar
        T_camera_radar = corrections[:, 1] @ base
        poses = (T_camera_lidar, T_camera_radar, T_lidar_radar)
        return {f"T_{pair}": T for pair, T in zip(PAIRS, poses, strict=True)}


def build_network(config: NetworkConfig, seed: int = 0) -> CalibrationNetwork:
    """A fresh network; the same seed gives the same weights, independent of torch's generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return CalibrationNetwork(config)


def weight_places(state: Mapping[str, Tensor], model: onnx.ModelProto) -> dict[str, Place]:
    """Location of each weight in the graph: initializer and whether it is transposed; or its values."""
    lying: dict[bytes, Place] = {}
    for initializer in model.graph.initializer:
        values = numpy_helper.to_array(initializer)
        if values.ndim == 2:
            lying[_digest(values.T)] = {"name": initializer.name, "turned": True}
        lying[_digest(values)] = {"name": initializer.name, "turned": False}
    found: dict[str, Place] = {}
    for name, weight in state.items():
        values = weight.detach().cpu().numpy()
        found[name] = lying.get(_digest(values)) or {"values": values.ravel().tolist()}
    return found


def network_of_file(path: Path) -> CalibrationNetwork:
    """The network of a file of `boresight export onnx`, on the CPU.

    Raises:
        ModelError: the file is older than 0.8.0, or its network has other classes.
    """
    try:
        model = onnx.load(str(path))
        metadata = {entry.key: entry.value for entry in model.metadata_props}
        listed = listed_weights(model)
        config = NetworkConfig.of_json(metadata["network"])
    except Exception as err:  # protobuf has its own exceptions, different by version
        raise ModelError(str(path), "does not list its weights, so training cannot continue from it") from err
    if (classes := json.loads(metadata.get("classes", "[]"))) != list(GRID_CLASSES):
        problem = f"its classes are {', '.join(classes)}, those of table training {', '.join(GRID_CLASSES)}"
        raise ModelError(str(path), problem)
    network = CalibrationNetwork(config)
    state = network.state_dict()
    state |= {name: torch.tensor(listed[name].reshape(tuple(w.shape))) for name, w in state.items()}
    network.load_state_dict(state)
    return network.eval()


def _digest(values: np.ndarray) -> bytes:
    """Hash of the numbers in order: shapes of equal weights differ by axes of length one only."""
    return np.ascontiguousarray(values, np.float32).tobytes()
