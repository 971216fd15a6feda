"""Exported networks in onnxruntime: which files, one frame at a guess, a frame prepared for them. No torch.

A pass renders at the guess, computes and corrects. The part of the graph that depends on the camera alone is
computed once (`split_graph`).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import onnx
import onnx.shape_inference
import onnx.utils
import onnxruntime
from jaxtyping import Float
from onnxruntime.capi.onnxruntime_pybind11_state import InvalidArgument

from pipeline.core.config import FleetConfig, LearnConfig, PrepareConfig
from pipeline.core.errors import ConfigError, ModelError
from pipeline.learn.infer.asking import FrameAnswer
from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.joint_day import Evidence
from pipeline.learn.infer.radar_evidence import RadarEvidence
from pipeline.learn.sample.frame_sample import About, class_likelihood, sensor_row
from pipeline.learn.sample.grid import EVIDENCE, Grid, NetworkConfig
from pipeline.learn.sample.rendering import FrameSensors, frame_sensors, object_points, render_frame
from pipeline.learn.sample.weights import WEIGHTS, listed_weights
from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Prior
from pipeline.rig.se3 import inverse, transform_points
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import TrainingRow

__all__ = ["SHIPPED", "UNFIT", "OnnxNetwork", "model_files", "models_key", "open_networks", "split_graph"]

UNFIT = "Not fit for use"  # so begins the limit of a network whose training was never validated
SHIPPED = Path(__file__).parent.parent / "models"
_NOBODY = About("", "", "", "", "", "")
_ANSWERS = ["corrections", "log_variance"]


def model_files(method: str, fleet: FleetConfig) -> dict[str, Path]:
    """Files of a method's networks by pairs: those of fleet.toml, else the shipped ones.

    The shipped network with classes comes first, unless fleet.toml selects images alone.

    Raises:
        ConfigError: a file is missing; the message has the key that names another.
    """
    config = fleet.learn
    named: dict[str, str | None] = {"joint": config.model}
    if method != "joint-ssl":
        named = {pair: config.pairwise_models.get(pair) for pair in PAIRS}  # type: ignore[call-overload]
    shipped = SHIPPED / ("joint.onnx" if config.camera == "image" else "joint_classes.onnx")
    files = {}
    for name, given in named.items():
        key = "learn.model" if name == "joint" else f"learn.pairwise_models.{name}"
        if given is None and name != "joint":
            raise ConfigError(
                str(fleet.file), key, "no such network is shipped; train one with `boresight train`"
            )
        files[name] = shipped if given is None else fleet.path_of(given)
        if not files[name].is_file():
            problem = f"{files[name]} does not exist; train one with `boresight train`"
            raise ConfigError(str(fleet.file), key, problem)
    return files


def models_key(files: Mapping[str, Path]) -> str:
    """Hash of the files' contents, for work keys."""
    digests = [hashlib.sha256(files[name].read_bytes()).hexdigest() for name in sorted(files)]
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]


def open_networks(
    files: Mapping[str, Path], config: LearnConfig, prepare: PrepareConfig
) -> list[OnnxNetwork]:
    """The networks, loaded; together they estimate each pair once.

    Raises:
        ModelError: a file is no network, or estimates another pair than its name.
    """
    networks = [OnnxNetwork(path, config, prepare) for path in files.values()]
    for (name, path), network in zip(files.items(), networks, strict=True):
        wanted = PAIRS if name == "joint" else (name,)
        if set(network.pairs) != set(wanted):
            raise ModelError(str(path), f"estimates {', '.join(network.pairs)}, not {', '.join(wanted)}")
    return networks


class OnnxNetwork:
    """A file of `boresight export onnx`, loaded, as a `FrameNetwork`; raises ModelError if it is no such file."""

    def __init__(
        self, path: Path, learn: LearnConfig | None = None, prepare: PrepareConfig | None = None
    ) -> None:
        try:
            model = onnx.load(str(path))
        except Exception as err:  # protobuf has its own exceptions, different by version
            raise ModelError(str(path), f"is no readable ONNX file: {err}") from err
        self._path, self._learn = path, learn or LearnConfig()
        self.metadata = {entry.key: entry.value for entry in model.metadata_props}
        try:
            self.config = NetworkConfig.of_json(self.metadata["network"])
        except (KeyError, TypeError, ValueError) as err:
            raise ModelError(str(path), "was not written by `boresight export onnx`") from err
        self.pairs, self.composed = self.config.estimated, self.config.composed
        # Why its card does not allow it to be used (empty if it does), and the bias of all answers by pair.
        self.unfit, self.bias_sigma = _read_card(path, self.metadata.get("card", "{}"))
        self._prepare = _prepare_for(self.config.grid, prepare or PrepareConfig())
        model = onnx.shape_inference.infer_shapes(model, data_prop=True)  # once for all parts: it takes most
        once, by_pass = split_graph(model, "camera", _ANSWERS)
        self._learned = listed_weights(model) if WEIGHTS in self.metadata else {}
        threads = self._learn.threads
        self._once = None if once is None else _session(once, threads)
        self._network, self._evidence = _session(by_pass, threads), _evidence_session(model, threads)
        self._inputs = {i.name for i in self._network.get_inputs()}

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> FrameSensors:
        """The network's inputs from a frame; raises SampleRejectedError if it shows too little."""
        row, camera, classes = _row_of(frame, observation, prior, self._prepare), self._learn.camera, None
        if self.config.takes_classes and camera != "image" and observation.labels_png:
            classes = class_likelihood(labels_of(observation), camera_of(observation), self.config.grid)
        sensors = frame_sensors(row, self.config.grid, classes)
        return sensors if camera != "classes" or classes is None else sensors.without_image()

    def answer(self, sensors: FrameSensors, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms of the last pass; raises ModelError for inputs that this version does not render."""
        try:
            return self.estimate(sensors, guess, self._learn.iterations)[-1]
        except InvalidArgument as err:
            raise ModelError(str(self._path), f"was exported by another version: {err}") from err

    def estimate(
        self, sensors: FrameSensors, guess: Mapping[str, Float[np.ndarray, "4 4"]], iterations: int = 3
    ) -> list[FrameAnswer]:
        """Answers of each pass, rendered at the last rotation (`CalibrationNetwork.refine`).

        Args:
            guess: of every pair.
            iterations: passes; two for guesses within 3 deg, three beyond.
        """
        known: dict[str, np.ndarray] = {}
        if self._once is not None:
            camera = sensors.camera_channels(self.config.camera_channels)
            values = self._once.run(None, {"camera": camera})
            known = dict(zip((o.name for o in self._once.get_outputs()), values, strict=True))
        found: list[FrameAnswer] = []
        for _ in range(iterations):
            view = render_frame(sensors, guess, self.config) | known
            corrections, log_variance = self._network.run(
                _ANSWERS, {name: view[name] for name in self._inputs}
            )
            step = corrections[0].astype(np.float64)
            variance = np.exp(np.clip(log_variance[0].astype(np.float64), -20.0, 5.0))
            answer, of_pair = self._corrected(step, guess), dict(zip(PAIRS, variance, strict=True))
            found.append(FrameAnswer(*({p: values[p] for p in self.pairs} for values in (answer, of_pair))))
            step[:, :3, 3] = 0.0
            guess = self._corrected(step, guess)
        return found

    def evidence(
        self, pair: str, sensors: FrameSensors, T_camera_lidar: Float[np.ndarray, "4 4"]
    ) -> Evidence | None:
        """Matching evidence of a pair, lidar points chosen at a guess; None if the file does not have what it takes."""
        if pair == "lidar_radar":
            objects_m = object_points(sensors, T_camera_lidar, self.config.grid)
            return RadarEvidence.of(sensors, objects_m, self._learned)
        if self._evidence is None:
            return None
        no_radar = np.eye(4)  # which has no part in it
        guess = {"camera_lidar": T_camera_lidar, "camera_radar": no_radar, "lidar_radar": no_radar}
        view = render_frame(sensors, guess, self.config)
        names = [i.name for i in self._evidence.get_inputs()]
        maps, probability, worth = self._evidence.run(EVIDENCE, {name: view[name] for name in names})
        points = np.concatenate([view["points_camera"][0], view["marks_camera"][0]])[: len(worth[0])]
        return FrameEvidence(
            self.config.grid,
            np.ascontiguousarray(maps[0].transpose(1, 2, 0)),
            transform_points(inverse(T_camera_lidar), points).astype(np.float32),
            probability[0],
            worth[0],
        )

    def _corrected(
        self, corrections: Float[np.ndarray, "3 4 4"], guess: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Corrected transforms by pair (as `CalibrationNetwork._corrected`)."""
        camera_lidar = _rigid(corrections[0] @ guess["camera_lidar"])
        lidar_radar = _rigid(corrections[2] @ guess["lidar_radar"])
        base = camera_lidar @ lidar_radar if self.config.composed else guess["camera_radar"]
        found = (camera_lidar, _rigid(corrections[1] @ base), lidar_radar)
        return dict(zip(PAIRS, found, strict=True))


@lru_cache(maxsize=1)  # three pairwise networks use the same row
def _row_of(frame: Frame, observation: Observation, prior: Prior, config: PrepareConfig) -> TrainingRow:
    return sensor_row(frame, observation, prior, _NOBODY, config)


def _read_card(path: Path, text: str) -> tuple[str, dict[str, np.ndarray]]:
    """The limit that forbids its use, and `bias_sigma` by pair: three angles [deg to rad] and three shifts [m].

    Raises:
        ModelError: the card is unreadable.
    """
    try:
        card = json.loads(text)
        limits = [str(limit) for limit in card.get("limits", ())]
        found = {pair: np.array(v, np.float64) for pair, v in card.get("bias_sigma", {}).items()}
    except (AttributeError, TypeError, ValueError) as err:
        raise ModelError(str(path), f"bias_sigma of its card is unreadable: {err}") from err
    for pair, values in found.items():
        if pair not in PAIRS or values.shape != (6,) or not (np.isfinite(values) & (values >= 0)).all():
            problem = f"bias_sigma of its card: {pair} needs three degrees and three metres"
            raise ModelError(str(path), problem)
    unfit = next((limit for limit in limits if limit.startswith(UNFIT)), "")
    return unfit, {pair: np.append(np.radians(values[:3]), values[3:]) for pair, values in found.items()}


def _prepare_for(grid: Grid, config: PrepareConfig) -> PrepareConfig:
    """Samples on the smallest grid about the optical axis, 16 cells at a time, that contains the network's."""

    def side_deg(half_deg: float) -> float:
        return 16 * math.ceil(2 * half_deg / grid.cell_deg / 16 - 1e-9) * grid.cell_deg

    tallest = max(abs(grid.top_deg), abs(grid.bottom_deg))
    sides = {"width_deg": side_deg(grid.left_deg), "height_deg": side_deg(tallest)}
    own = config.grid.model_copy(update={"step_deg": grid.cell_deg, **sides})
    return config.model_copy(update={"grid": own})


def _evidence_session(model: onnx.ModelProto, threads: int) -> onnxruntime.InferenceSession | None:
    """Session for the matching evidence; None for files without it: of other pairs, `concat`, or before 0.12."""
    if not {o.name for o in model.graph.output}.issuperset(EVIDENCE):
        return None
    cut = onnx.utils.Extractor(model)
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

    The model has inferred shapes. Input `fixed` does not depend on the guess, and is the same in all passes. The cut
    is found from the graph, so it works on files of any version.
    """
    others = [i.name for i in model.graph.input if i.name != fixed]
    first, passed_on = _crossing(model.graph, fixed, others)
    cut = onnx.utils.Extractor(model)
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
