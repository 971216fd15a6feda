"""The weights of an exported file, as the start of further training: shipped networks exist only in this form.

A graph holds weights under numbers, transposed or folded into others. The file's metadata map them; the few
small ones that are folded are stored there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor

from pipeline.core.errors import ModelError
from pipeline.learn.network.calibration_network import CalibrationNetwork
from pipeline.learn.sample.layout import NetworkConfig
from schemas.training import GRID_CLASSES

__all__ = ["WEIGHTS", "network_of_file", "weight_places"]

WEIGHTS = "weights"  # key of the metadata
Place = Mapping[str, Any]


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
        places: dict[str, Place] = json.loads(metadata[WEIGHTS])
        config = NetworkConfig.of_json(metadata["network"])
    except Exception as err:  # protobuf has its own exceptions, different by version
        raise ModelError(str(path), "does not list its weights, so training cannot continue from it") from err
    if (classes := json.loads(metadata.get("classes", "[]"))) != list(GRID_CLASSES):
        problem = f"its classes are {', '.join(classes)}, those of table training {', '.join(GRID_CLASSES)}"
        raise ModelError(str(path), problem)
    held = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer}
    network = CalibrationNetwork(config)
    state = network.state_dict()
    for name, weight in state.items():
        place = places[name]
        found = np.array(place["values"], np.float32) if "values" in place else held[place["name"]]
        state[name] = torch.tensor((found.T if place.get("turned") else found).reshape(tuple(weight.shape)))
    network.load_state_dict(state)
    return network.eval()


def _digest(values: np.ndarray) -> bytes:
    """Hash of the numbers in order: shapes of equal weights differ by axes of length one only."""
    return np.ascontiguousarray(values, np.float32).tobytes()
