"""Exported networks for a vehicle-day: which files, and frames prepared for them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnxruntime.capi.onnxruntime_pybind11_state import InvalidArgument

from pipeline.core.config import FleetConfig, LearnConfig, PrepareConfig
from pipeline.core.errors import ConfigError, ModelError
from pipeline.learn.infer.class_evidence import FrameEvidence
from pipeline.learn.infer.frame_network import FrameAnswer
from pipeline.learn.infer.single_frame import SingleFrameCalibrator
from pipeline.learn.sample.camera_maps import class_likelihood
from pipeline.learn.sample.frame_sample import About, sensor_row
from pipeline.learn.sample.grid import Grid
from pipeline.learn.sample.rendering import FrameSensors, frame_sensors
from pipeline.objective.paper.classes import labels_of
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Prior
from schemas.calibrations import PAIRS
from schemas.frames import Frame
from schemas.observations import Observation
from schemas.training import TrainingRow

__all__ = ["SHIPPED", "UNFIT", "OnnxNetwork", "model_files", "models_key", "open_networks"]

UNFIT = "Not fit for use"  # so begins the limit of a network whose training was never validated
SHIPPED = Path(__file__).parent.parent / "models"
_NOBODY = About("", "", "", "", "", "")


def model_files(method: str, fleet: FleetConfig) -> dict[str, Path]:
    """Files of a method's networks by pairs: those of fleet.toml, else the shipped ones.

    The shipped network with classes comes first, unless fleet.toml selects images alone.

    Raises:
        ConfigError: a file is missing; the message has the key that names another.
    """
    config = fleet.learn
    if method == "joint-ssl":
        named: Mapping[str, str | None] = {"joint": config.model}
        keys = {"joint": "learn.model"}
    else:
        named = {pair: config.pairwise_models.get(pair) for pair in PAIRS}  # type: ignore[call-overload]
        keys = {pair: f"learn.pairwise_models.{pair}" for pair in PAIRS}
    files = {}
    for name, given in named.items():
        files[name] = _shipped(name, config) if given is None else fleet.path_of(given)
        if not files[name].is_file():
            said = f"{files[name]} does not exist" if given else "no such network is shipped"
            raise ConfigError(str(fleet.file), keys[name], f"{said}; train one with `boresight train`")
    return files


def _shipped(name: str, config: LearnConfig) -> Path:
    with_classes = SHIPPED / f"{name}_classes.onnx"
    return with_classes if config.camera != "image" and with_classes.is_file() else SHIPPED / f"{name}.onnx"


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
    rows = _LastRow()
    networks = [OnnxNetwork(path, config, prepare, rows) for path in files.values()]
    for (name, path), network in zip(files.items(), networks, strict=True):
        wanted = PAIRS if name == "joint" else (name,)
        if set(network.pairs) != set(wanted):
            raise ModelError(str(path), f"estimates {', '.join(network.pairs)}, not {', '.join(wanted)}")
    return networks


class OnnxNetwork:
    """One file as a `FrameNetwork`."""

    def __init__(self, path: Path, config: LearnConfig, prepare: PrepareConfig, rows: _LastRow) -> None:
        self._path, self._calibrator = path, SingleFrameCalibrator(path, config.threads)
        self._iterations, self._camera, self._rows = config.iterations, config.camera, rows
        self._prepare = _prepare_for(self._calibrator.grid, prepare)
        self._bias_sigma = _bias_of_card(path, self._calibrator.metadata.get("card", "{}"))

    @property
    def unfit(self) -> str:
        """Why its card does not allow it to be used; empty if it does."""
        limits = json.loads(self._calibrator.metadata.get("card", "{}")).get("limits", ())
        return next((str(limit) for limit in limits if str(limit).startswith(UNFIT)), "")

    @property
    def bias_sigma(self) -> Mapping[str, np.ndarray]:
        """Sigma of the bias that all answers share, (bearing rotation [rad], translation [m]), by the file's card."""
        return self._bias_sigma

    @property
    def pairs(self) -> tuple[str, ...]:
        """Pairs that it estimates."""
        return self._calibrator.config.estimated

    @property
    def composed(self) -> bool:
        """Whether it composes camera_radar of the other two pairs before it corrects it."""
        return self._calibrator.config.composed

    def sensors(self, frame: Frame, observation: Observation, prior: Prior) -> FrameSensors:
        """The network's inputs from a frame; raises SampleRejectedError if it shows too little."""
        row = self._rows.of(frame, observation, prior, self._prepare)
        classes, sees = None, self._camera != "classes"
        if self._calibrator.config.takes_classes and self._camera != "image" and observation.labels_png:
            grid = self._calibrator.grid
            classes = class_likelihood(labels_of(observation), camera_of(observation), grid)
        sensors = frame_sensors(row, self._calibrator.grid, classes)
        return sensors if sees or classes is None else sensors.without_image()

    def evidence(self, sensors: FrameSensors, T_camera_lidar: np.ndarray) -> FrameEvidence | None:
        """Matching evidence of camera and lidar; None if the file has no such output."""
        return self._calibrator.evidence(sensors, T_camera_lidar)

    def answer(self, sensors: FrameSensors, guess: Mapping[str, np.ndarray]) -> FrameAnswer:
        """Transforms of the last pass; raises ModelError for inputs that this version does not render."""
        try:
            return self._calibrator.estimate(sensors, guess, self._iterations)[-1]
        except InvalidArgument as err:
            raise ModelError(str(self._path), f"was exported by another version: {err}") from err


@dataclass(eq=False)
class _LastRow:
    """The last frame's row: three pairwise networks use the same one."""

    key: tuple[int, int, PrepareConfig] | None = None
    row: TrainingRow | None = None

    def of(self, frame: Frame, observation: Observation, prior: Prior, config: PrepareConfig) -> TrainingRow:
        key = (frame.frame_index, frame.stamp_ns, config)
        if self.row is None or self.key != key:
            self.row = sensor_row(frame, observation, prior, _NOBODY, config)
            self.key = key
        return self.row


def _bias_of_card(path: Path, card: str) -> dict[str, np.ndarray]:
    """`bias_sigma` of a card: by pair, three angles [deg] and three shifts [m]; else ModelError."""
    try:
        given = json.loads(card).get("bias_sigma", {})
        found = {pair: np.array(values, np.float64) for pair, values in given.items()}
    except (AttributeError, TypeError, ValueError) as err:
        raise ModelError(str(path), f"bias_sigma of its card is unreadable: {err}") from err
    for pair, values in found.items():
        if pair not in PAIRS or values.shape != (6,) or not (np.isfinite(values) & (values >= 0)).all():
            raise ModelError(
                str(path), f"bias_sigma of its card: {pair} needs three degrees and three metres"
            )
    return {pair: np.append(np.radians(values[:3]), values[3:]) for pair, values in found.items()}


def _prepare_for(grid: Grid, config: PrepareConfig) -> PrepareConfig:
    """Samples on the smallest grid about the optical axis, 16 cells at a time, that contains the network's."""

    def side_deg(half_deg: float) -> float:
        return 16 * math.ceil(2 * half_deg / grid.cell_deg / 16 - 1e-9) * grid.cell_deg

    tallest = max(abs(grid.top_deg), abs(grid.bottom_deg))
    sides = {"width_deg": side_deg(grid.left_deg), "height_deg": side_deg(tallest)}
    own = config.grid.model_copy(update={"step_deg": grid.cell_deg, **sides})
    return config.model_copy(update={"grid": own})
