"""Single-frame inference with onnxruntime: render at the guess, compute, correct, up to three times. No torch.

No semantics are needed; networks with a class input use them if the frame has some. The part of the graph
that depends on the camera alone is computed once (`split_graph`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnx.shape_inference
import onnx.utils
import onnxruntime
from jaxtyping import Float

from pipeline.core.errors import ModelError
from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.frame_network import FrameAnswer
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.layout import EVIDENCE, PAIRS, NetworkConfig
from pipeline.learn.sample.rendering import FrameSensors, render_frame
from pipeline.rig.se3 import inverse, transform_points

__all__ = ["SingleFrameCalibrator", "config_from_metadata", "split_graph"]

_ANSWERS = ["corrections", "log_variance"]


class SingleFrameCalibrator:
    """A model file of `boresight export onnx`, loaded; raises ModelError if it is no such file."""

    def __init__(self, path: Path, threads: int = 1) -> None:
        try:
            model = onnx.load(str(path))
        except Exception as err:  # protobuf has its own exceptions, different by version
            raise ModelError(str(path), f"is no readable ONNX file: {err}") from err
        self.metadata = {entry.key: entry.value for entry in model.metadata_props}
        self.config = config_from_metadata(path, self.metadata)
        once, by_pass = split_graph(model, "camera", _ANSWERS)
        self._once = None if once is None else _session(once, threads)
        self._network = _session(by_pass, threads)
        self._evidence = _evidence_session(model, threads)
        self._channels = self.config.camera_channels
        self._inputs = {i.name for i in self._network.get_inputs()}

    @property
    def grid(self) -> Grid:
        """The grid that sensors must be resampled to."""
        return self.config.grid

    def estimate(
        self, sensors: FrameSensors, guess: Mapping[str, Float[np.ndarray, "4 4"]], iterations: int = 3
    ) -> list[FrameAnswer]:
        """Answers of each pass, rendered at the last rotation (`CalibrationNetwork.refine`).

        Args:
            guess: of every pair.
            iterations: passes; two for guesses within 3 deg, three beyond.
        """
        known = self._of_camera(sensors)
        found: list[FrameAnswer] = []
        for _ in range(iterations):
            camera_lidar, camera_radar, lidar_radar = (guess[pair] for pair in PAIRS)
            view = render_frame(
                sensors, camera_lidar, camera_radar, lidar_radar, self.grid, self._channels,
                marks=self.config.marks,
            )  # fmt: skip
            feed = {name: (view | known)[name] for name in self._inputs}
            corrections, log_variance = self._network.run(_ANSWERS, feed)
            step = corrections[0].astype(np.float64)
            variance = np.exp(np.clip(log_variance[0].astype(np.float64), -20.0, 5.0))
            answer, own = self._corrected(step, guess), self.config.estimated
            of_pair = dict(zip(PAIRS, variance, strict=True))
            found.append(FrameAnswer({p: answer[p] for p in own}, {p: of_pair[p] for p in own}))
            step[:, :3, 3] = 0.0
            guess = self._corrected(step, guess)
        return found

    def evidence(
        self, sensors: FrameSensors, T_camera_lidar: Float[np.ndarray, "4 4"]
    ) -> FrameEvidence | None:
        """Matching evidence, points chosen at a guess; None if the file has no such output."""
        if self._evidence is None:
            return None
        away = np.eye(4)  # of the radar, which has no part in it
        view = render_frame(
            sensors, T_camera_lidar, away, away, self.grid, self._channels, marks=self.config.marks
        )
        names = [i.name for i in self._evidence.get_inputs()]
        maps, probability, worth = self._evidence.run(EVIDENCE, {name: view[name] for name in names})
        points = np.concatenate([view["points_camera"][0], view["marks_camera"][0]])[: len(worth[0])]
        return FrameEvidence(
            self.grid,
            np.ascontiguousarray(maps[0].transpose(1, 2, 0)),
            transform_points(inverse(T_camera_lidar), points).astype(np.float32),
            probability[0],
            worth[0],
        )

    def _of_camera(self, sensors: FrameSensors) -> dict[str, np.ndarray]:
        """Outputs that depend on the camera alone, by name."""
        if self._once is None:
            return {}
        values = self._once.run(None, {"camera": sensors.camera_channels(self._channels)})
        return dict(zip((o.name for o in self._once.get_outputs()), values, strict=True))

    def _corrected(
        self, corrections: Float[np.ndarray, "3 4 4"], guess: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Corrected transforms by pair (as `calibration_network.compose`)."""
        camera_lidar = _rigid(corrections[0] @ guess["camera_lidar"])
        lidar_radar = _rigid(corrections[2] @ guess["lidar_radar"])
        base = camera_lidar @ lidar_radar if self.config.composed else guess["camera_radar"]
        found = (camera_lidar, _rigid(corrections[1] @ base), lidar_radar)
        return dict(zip(PAIRS, found, strict=True))


def config_from_metadata(path: Path, metadata: Mapping[str, str]) -> NetworkConfig:
    """Configuration that a file was built with; raises ModelError if its metadata lack it."""
    try:
        values = json.loads(metadata["network"])
        if tuple(json.loads(metadata["pairs"])) != PAIRS:
            raise ModelError(str(path), f"puts out pairs {metadata['pairs']}, not {PAIRS}")
        return NetworkConfig(**(values | {"grid": Grid(**values["grid"])}))
    except (KeyError, TypeError, ValueError) as err:
        raise ModelError(str(path), "was not written by `boresight export onnx`") from err


def _evidence_session(model: onnx.ModelProto, threads: int) -> onnxruntime.InferenceSession | None:
    """Session for the matching evidence; None for files without it (before 0.12)."""
    if not {o.name for o in model.graph.output}.issuperset(EVIDENCE):
        return None
    cut = onnx.utils.Extractor(onnx.shape_inference.infer_shapes(model, data_prop=True))
    return _session(cut.extract_model([i.name for i in model.graph.input], list(EVIDENCE)), threads)


def _session(model: onnx.ModelProto, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Spinning threads would occupy cores that other processes need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )


def _rigid(T: np.ndarray) -> np.ndarray:
    """The nearest rotation: single precision must not add up over passes."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = u @ vt
    return out


def split_graph(
    model: onnx.ModelProto, fixed: str, answers: Sequence[str]
) -> tuple[onnx.ModelProto | None, onnx.ModelProto]:
    """Two models that together compute `answers`: the part of input `fixed` alone (or None), the rest.

    Input `fixed` does not depend on the guess, and is the same in all passes. The cut is found from the graph, so it
    works on files of any version.
    """
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
