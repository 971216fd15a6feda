"""A graph cut in two: the part that depends on the camera alone, and the part that depends on the guess.

A frame is refined over several passes, and its image is the same in all of them. The cut is found from the
graph, so it works on files of any version.
"""

from __future__ import annotations

from collections.abc import Sequence

import onnx
import onnx.shape_inference
import onnx.utils

__all__ = ["split_graph"]


def split_graph(
    model: onnx.ModelProto, fixed: str, answers: Sequence[str]
) -> tuple[onnx.ModelProto | None, onnx.ModelProto]:
    """Two models that together compute `answers`: the part of input `fixed` alone (or None), the rest."""
    others = [i.name for i in model.graph.input if i.name != fixed]
    first, passed_on = _crossing(model.graph, fixed, others)
    cut = onnx.utils.Extractor(onnx.shape_inference.infer_shapes(model, data_prop=True))
    if not first:
        # A network of lidar and radar alone has no such input.
        return None, cut.extract_model([i.name for i in model.graph.input], list(answers))
    return cut.extract_model([fixed], passed_on), cut.extract_model([*passed_on, *others], list(answers))


def _crossing(graph: onnx.GraphProto, fixed: str, others: Sequence[str]) -> tuple[bool, list[str]]:
    """Whether anything can be computed beforehand, and which tensors pass from that part into the other."""
    early, late = {fixed}, set(others)
    crossing: dict[str, None] = {}
    for node in graph.node:
        if any(name in late for name in node.input):
            late.update(node.output)
            crossing.update(dict.fromkeys(name for name in node.input if name in early))
        elif any(name in early for name in node.input):
            early.update(node.output)
    return len(crossing) > 0 and fixed not in crossing, list(crossing)
