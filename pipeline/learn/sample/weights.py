"""The weights that an exported graph lists in its metadata: by name, as they were trained."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from onnx import numpy_helper

__all__ = ["WEIGHTS", "Place", "listed_weights"]

WEIGHTS = "weights"  # key of the metadata
Place = Mapping[
    str, Any
]  # initializer and whether it is transposed; or the values of what is folded into others


def listed_weights(model: onnx.ModelProto) -> dict[str, np.ndarray]:
    """Weights by name, values in order; KeyError if the file is older than 0.8.0 and lists none."""
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    held = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer}
    found = {}
    for name, place in json.loads(metadata[WEIGHTS]).items():
        values = np.array(place["values"], np.float32) if "values" in place else held[place["name"]]
        found[name] = values.T if place.get("turned") else values
    return found
