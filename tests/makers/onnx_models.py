"""Tiny real ONNX graphs whose answers are known: built with onnx's helper, run by onnxruntime."""

import hashlib
import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def save_graph(path, nodes, inputs, outputs, constants):
    """A checked graph of nodes and named constants."""
    graph = helper.make_graph(
        nodes, "made", inputs, outputs, [numpy_helper.from_array(v, k) for k, v in constants.items()]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def save_segmenter(path, size, stride, colours, classes=150):
    """Logits at 1/stride of the input: how near the mean colour is to each class's colour; further ones have none."""
    rows, columns = size
    colours = [*colours, *[[9.0, 9.0, 9.0]] * (classes - len(colours))]
    small = [1, len(colours), rows // stride, columns // stride]
    weights = 2 * np.array(colours, np.float32)[:, :, None, None]
    bias = -np.sum(np.array(colours, np.float32) ** 2, axis=1)
    nodes = [
        helper.make_node(
            "AveragePool", ["image"], ["small"], kernel_shape=[stride] * 2, strides=[stride] * 2
        ),
        helper.make_node("Conv", ["small", "weights", "bias"], ["logits"]),
    ]
    save_graph(
        path, nodes,
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, rows, columns])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, small)],
        {"weights": weights, "bias": bias},
    )  # fmt: skip


def save_constant(path, output, size=(96, 160)):
    """A model that answers `output` to every image (plus zero times the image's mean)."""
    shape = [1, 3, *size]
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["answer", "nothing"], ["output"]),
    ]
    save_graph(
        path, nodes,
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, list(output.shape))],
        {"answer": output.astype(np.float32), "zero": np.zeros((), np.float32)},
    )  # fmt: skip


def write_manifest(path, model, task, given, output):
    """A manifest for a model file beside it."""
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    lines = [f'path = "{model.name}"', f'sha256 = "{digest}"', f'task = "{task}"']
    for section, values in (("input", given), ("output", output)):
        lines += [f"[{section}]", *(f"{k} = {json.dumps(v)}" for k, v in values.items())]
    path.write_text("\n".join(lines) + "\n")
    return path
