"""The paper's own loss for a batch: the objective of `joint-optimisation`, frame by frame, as training can descend it.

Table `training` holds maps in equal angles for this project's loss. The paper's is computed from table `observations`
instead, by the same preparation as the optimiser's: the numbers are those of `pipeline.objective.paper`, to rounding
(tests/learn/train/test_paper_objective.py). Frames are prepared on first use and kept, 0.5 MB each.

Source: paper, sections 4.3 (pairs), 4.4 (loop) and "Loss function" (L = L_P + L_G, all weights one).
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pipeline.config import SolveConfig
from pipeline.errors import ContractError
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.network.calibration_network import CalibrationNetwork
from pipeline.learn.network.concat_network import ConcatCore
from pipeline.learn.sample.layout import LIDAR_FEATURES, RADAR_FEATURES
from pipeline.objective.differentiable.paper import (
    CameraRadarTensors,
    FoldedTensors,
    LidarRadarTensors,
    camera_lidar_tensors,
    camera_radar_tensors,
    lidar_radar_tensors,
)
from pipeline.objective.differentiable.poses import loop_loss
from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation

__all__ = ["PaperFrame", "PaperFrames", "paper_frame", "with_paper_inputs"]

_KEPT = (
    4000  # frames: 2 GB; beyond, the day that was asked for longest ago is prepared anew when it is asked for
)
# What perception adds to the paper's inputs: a point's range, brightness and velocity stay.
_DERIVED = {"lidar": ("height", "edge", "ground"), "radar": ("moving",)}
_RENDERED = 2  # channels before the features: occupied, nearness


@dataclass(frozen=True, eq=False)
class _Folded:
    """Folded frames of one frame with their map as bytes: a quarter of the memory."""

    tensors: FoldedTensors  # its maps are empty
    bytes_: UInt8[Tensor, "1 H W"]
    step: float

    def unfolded(self) -> FoldedTensors:
        """The tensors with their map."""
        return replace(self.tensors, maps=self.bytes_.to(self.tensors.points.dtype) * self.step)


@dataclass(frozen=True, eq=False)
class PaperFrame:
    """The three pairwise losses of one frame, ready for any pose."""

    camera_lidar: _Folded
    camera_radar: CameraRadarTensors  # its detections' maps are empty
    detections: _Folded
    lidar_radar: LidarRadarTensors

    def loss(self, pair: str, T: Float[Tensor, "1 4 4"]) -> Float[Tensor, ""]:
        """One pair's loss at a pose."""
        if pair == "camera_lidar":
            return self.camera_lidar.unfolded().frame_losses(T)[0]
        if pair == "camera_radar":
            whole = replace(self.camera_radar, detections=self.detections.unfolded())
            return whole.frame_losses(T)[0]
        return self.lidar_radar.frame_losses(T)[0]


class PaperFrames:
    """Prepared frames of a lake's vehicle-days, those asked for last."""

    def __init__(self, lake: Lake) -> None:
        """Frames of a lake that has observations beside its table `training`."""
        self._lake = lake
        self._days: OrderedDict[Partition, dict[int, PaperFrame]] = OrderedDict()

    def terms(
        self,
        batch: TrainingBatch,
        T_camera_lidar: Float[Tensor, "B 4 4"],
        T_camera_radar: Float[Tensor, "B 4 4"],
        T_lidar_radar: Float[Tensor, "B 4 4"],
        pairs: tuple[str, ...],
    ) -> dict[str, Float[Tensor, " B"]]:
        """Every loss of the pairs, and of the loop where `joint` is among them; their sum is the paper's L.

        Raises:
            ContractError: a frame of the batch has no observation any more.
        """
        frames = [self._frame(batch, i) for i in range(len(batch))]
        poses = {"camera_lidar": T_camera_lidar, "camera_radar": T_camera_radar, "lidar_radar": T_lidar_radar}
        found = {}
        for pair, T in poses.items():
            if pair in pairs:  # frames are kept by the processor, whatever the network's device
                losses = [f.loss(pair, T[i : i + 1].cpu()) for i, f in enumerate(frames)]
                found[pair] = torch.stack(losses).to(T.device)
        if "joint" in pairs:
            found["loop"] = loop_loss(T_camera_lidar, T_lidar_radar, T_camera_radar)
        return found

    def _frame(self, batch: TrainingBatch, row: int) -> PaperFrame:
        partition = Partition(batch.vehicle[row], batch.day[row])
        if partition not in self._days:
            T_camera_lidar = batch.T_camera_lidar[row].double().cpu().numpy()
            T_camera_radar = batch.T_camera_radar[row].double().cpu().numpy()
            self._days[partition] = {
                o.frame_index: paper_frame(o, T_camera_lidar, T_camera_radar)
                for o in observations_of(self._lake, partition)
            }
        self._days.move_to_end(partition)
        while len(self._days) > 1 and sum(map(len, self._days.values())) > _KEPT:
            self._days.popitem(last=False)
        frame = self._days[partition].get(int(batch.frame_index[row]))
        if frame is None:
            told = f"no observation of frame {int(batch.frame_index[row])} of {partition.vehicle} {partition.day}"
            raise ContractError(str(self._lake.root), told)
        return frame


def paper_frame(
    observation: Observation,
    T_camera_lidar: Float[np.ndarray, "4 4"],
    T_camera_radar: Float[np.ndarray, "4 4"],
    dtype: torch.dtype = torch.float32,
) -> PaperFrame:
    """Prepare one frame; the poses (the day's prior) only say which points are asked to lie in view, as there."""
    margin = np.radians(SolveConfig().search_rotation_deg)
    lidar = camera_lidar_loss([observation], T_camera_lidar, margin)
    radar = camera_radar_loss([observation], T_camera_radar, margin)
    tensors = camera_radar_tensors(radar, dtype)
    return PaperFrame(
        _packed(camera_lidar_tensors(lidar, radar.cameras, dtype), float(lidar.frames.camera[0, 5])),
        replace(tensors, detections=_without_map(tensors.detections)),
        _packed(tensors.detections, float(radar.detections.camera[0, 5])),
        lidar_radar_tensors(lidar_radar_loss([observation]), dtype),
    )


def with_paper_inputs(network: CalibrationNetwork) -> None:
    """Make an untrained `concat` network blind to what is no measurement: its weights of those channels stay zero."""
    assert isinstance(network.core, ConcatCore)
    features = {"lidar": LIDAR_FEATURES, "radar": RADAR_FEATURES}
    for sensor, names in _DERIVED.items():
        if sensor in network.core.encoders:
            weight = next(
                network.core.encoders[sensor].parameters()
            )  # the first convolution's: outputs, channels
            seen = torch.ones_like(weight)
            for name in names:
                seen[:, _RENDERED + features[sensor].index(name)] = 0
            with torch.no_grad():
                weight.mul_(seen)
            weight.register_hook(lambda gradient, seen=seen: gradient * seen)  # type: ignore[no-untyped-call]


def _packed(tensors: FoldedTensors, step: float) -> _Folded:
    """Bytes in place of the map, exactly: the map is a whole number of steps."""
    return _Folded(_without_map(tensors), (tensors.maps / step).round().to(torch.uint8), step)


def _without_map(tensors: FoldedTensors) -> FoldedTensors:
    return replace(tensors, maps=tensors.maps[:, :0, :0])
