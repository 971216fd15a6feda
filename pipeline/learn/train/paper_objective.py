"""The paper's own loss of a batch: the objective of `joint-optimisation`, frame by frame, with gradients.

Table `training` holds maps in equal angles for this project's loss. The paper's loss is computed from table
`observations`, by the same preparation as the optimiser's, and equals `pipeline.objective.paper` to rounding
(tests/learn/train/test_paper_objective.py). Frames are prepared on first use and kept, 0.5 MB each.

Source: paper, sections 4.3 (pairs), 4.4 (loop) and "Loss function" (L = L_P + L_G, all weights one).
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.config import SolveConfig
from pipeline.core.errors import ContractError
from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.network.calibration_network import CalibrationNetwork, ConcatCore
from pipeline.learn.sample.grid import LIDAR_FEATURES, RADAR_FEATURES
from pipeline.objective.differentiable.paper import (
    CameraRadarTensors,
    FoldedTensors,
    LidarRadarTensors,
    camera_radar_tensors,
    folded_tensors,
    lidar_radar_tensors,
)
from pipeline.objective.differentiable.projection import loop_loss
from pipeline.objective.paper.camera_lidar import camera_lidar_loss
from pipeline.objective.paper.camera_radar import camera_radar_loss
from pipeline.objective.paper.lidar_radar import lidar_radar_loss
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_manifest
from pipeline.store.views import observations_of
from schemas.observations import Observation
from schemas.training import SAMPLED, TRAINING

__all__ = ["PairLoss", "PaperFrames", "paper_frame", "with_paper_inputs"]

_KEPT = 4000  # frames: 2 GB; beyond, the day that was asked for longest ago is dropped
# What perception adds to the paper's inputs: a point's range, brightness and velocity stay.
_DERIVED = {"lidar": ("height", "edge", "ground"), "radar": ("moving",)}
_RENDERED = 2  # channels before the features: occupied, nearness


PairLoss = FoldedTensors | CameraRadarTensors | LidarRadarTensors


class PaperFrames:
    """Prepared frames of a lake's vehicle-days, the last used ones."""

    def __init__(self, lake: Lake) -> None:
        """Frames of a lake that has observations in addition to its table `training`."""
        self._lake = lake
        self._days: OrderedDict[Partition, dict[int, dict[str, PairLoss]]] = OrderedDict()

    def terms(
        self, batch: TrainingBatch, T_camera_lidar: Float[Tensor, "B 4 4"],
        T_camera_radar: Float[Tensor, "B 4 4"], T_lidar_radar: Float[Tensor, "B 4 4"], pairs: tuple[str, ...],
    ) -> dict[str, Float[Tensor, " B"]]:  # fmt: skip
        """Losses of the pairs, and of the loop if `joint` is among them; their sum is the paper's L.

        Raises:
            ContractError: a frame of the batch no longer has an observation.
        """
        frames = [self._frame(batch, i) for i in range(len(batch))]
        poses = {"camera_lidar": T_camera_lidar, "camera_radar": T_camera_radar, "lidar_radar": T_lidar_radar}
        found = {}
        for pair, T in poses.items():
            if pair in pairs:  # frames are kept by the processor, whatever the network's device
                losses = [f[pair].frame_losses(T[i : i + 1].cpu())[0] for i, f in enumerate(frames)]
                found[pair] = torch.stack(losses).to(T.device)
        if "joint" in pairs:
            found["loop"] = loop_loss(T_camera_lidar, T_lidar_radar, T_camera_radar)
        return found

    def _frame(self, batch: TrainingBatch, row: int) -> dict[str, PairLoss]:
        partition = Partition(batch.vehicle[row], batch.day[row])
        if partition not in self._days:
            T_camera_lidar = batch.T_camera_lidar[row].double().cpu().numpy()
            T_camera_radar = batch.T_camera_radar[row].double().cpu().numpy()
            manifest = read_manifest(self._lake, TRAINING, partition)
            chosen = None if manifest is None else manifest.extra.get(SAMPLED)  # sensors of the samples
            self._days[partition] = {
                o.frame_index: paper_frame(o, T_camera_lidar, T_camera_radar)
                for o in observations_of(self._lake, partition, chosen=chosen)
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
) -> dict[str, PairLoss]:
    """The losses of one frame by pair; the day's prior determines which points must be in view."""
    margin = np.radians(SolveConfig().search_rotation_deg)
    return {
        "camera_lidar": folded_tensors(camera_lidar_loss([observation], T_camera_lidar, margin).frames),
        "camera_radar": camera_radar_tensors(camera_radar_loss([observation], T_camera_radar, margin)),
        "lidar_radar": lidar_radar_tensors(lidar_radar_loss([observation])),
    }


def with_paper_inputs(network: CalibrationNetwork) -> None:
    """Set the weights of channels that are not measured to zero in an untrained `concat` network."""
    assert isinstance(network.core, ConcatCore)
    features = {"lidar": LIDAR_FEATURES, "radar": RADAR_FEATURES}
    for sensor, names in _DERIVED.items():
        if sensor in network.core.encoders:
            # The first convolution's: outputs, channels.
            weight = next(network.core.encoders[sensor].parameters())
            seen = torch.ones_like(weight)
            for name in names:
                seen[:, _RENDERED + features[sensor].index(name)] = 0
            with torch.no_grad():
                weight.mul_(seen)
            weight.register_hook(lambda gradient, seen=seen: gradient * seen)  # type: ignore[no-untyped-call]
