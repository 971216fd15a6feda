"""The paper's camera-radar loss: tracked clusters lie at road users' centres; no detection in the sky or out of view.

Per frame: mean over tracked clusters of `d^2 / (d^2 + s^2)`, d = angle in the image to the nearest detected
road user's box centre, s = 2 deg, plus the mean over radar detections of [sky or out of view]. Weights are 1,
because the paper gives none.

Source: section 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.objective.paper.classes import (
    SKY,
    FoldedFrames,
    camera_at_label_size,
    distance_cost,
    fold_frames,
    frame_costs,
    in_range,
    labels_of,
    safely_in_view,
    thin,
)
from pipeline.rig.se3 import transform_points
from schemas.observations import Observation

__all__ = ["CameraRadarLoss", "camera_radar_loss"]

SCALE_RAD = np.radians(2.0)
PENALTY = 1.0
_DETECTIONS = 300  # per frame
_FAR_PX = 1e6  # where absent targets are put


@dataclass(frozen=True, eq=False)
class CameraRadarLoss:
    """Tracks, box centres, detections and sky maps of the selected frames; centres padded far outside the image."""

    tracks_radar: np.ndarray  # M 3, of all frames
    track_frame: np.ndarray  # M
    centres_px: np.ndarray  # F B 2, at label size
    detections: FoldedFrames

    @property
    def informative(self) -> Bool[np.ndarray, " F"]:
        """True for frames with a tracked cluster and a road user."""
        return self._tracks_per_frame * (self.centres_px[:, 0, 0] < _FAR_PX) > 0

    @property
    def _tracks_per_frame(self) -> np.ndarray:
        return np.bincount(self.track_frame, minlength=self.detections.frames)

    def frame_losses(self, T_camera_radar: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
        """Loss of each frame at each pose."""
        penalties = frame_costs(self.detections, T_camera_radar) / np.maximum(self.detections.counts, 1)
        losses = np.zeros_like(penalties)
        if len(self.tracks_radar):
            costs = self._track_costs(T_camera_radar)
            np.add.at(losses.T, self.track_frame, costs.T)
        losses = losses / np.maximum(self._tracks_per_frame, 1) + penalties
        return losses * self.informative

    def _track_costs(self, T: np.ndarray) -> np.ndarray:
        camera = self.detections.cameras[0]  # one camera a day: checked when the loss was prepared
        points = self.tracks_radar @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        uv, valid = camera.project(points)
        delta = uv[:, :, None, :] - self.centres_px[self.track_frame][None]
        nearest = np.sqrt(np.min(np.einsum("pmbk,pmbk->pmb", delta, delta), axis=2))
        return np.where(valid, distance_cost(nearest, SCALE_RAD * camera.focal_px[0]), 1.0)


def camera_radar_loss(
    observations: Sequence[Observation], T_prior: Float[np.ndarray, "4 4"], margin_rad: float
) -> CameraRadarLoss:
    """Prepare the loss of these frames; `T_prior` and `margin_rad` as in `camera_lidar_loss`, for T_camera_radar."""
    tracks, frame_of, centres, cameras, clouds, costs = [], [], [], [], [], []
    for index, observation in enumerate(observations):
        labels = labels_of(observation)
        camera = camera_at_label_size(observation, labels)
        cameras.append(camera)
        near = in_range(observation.radar_track_xyz_m)
        near = near[safely_in_view(camera, transform_points(T_prior, near), margin_rad)]
        tracks.append(near)
        frame_of.append(np.full(len(near), index))
        boxes = observation.road_user_boxes_px.astype(np.float64).reshape(-1, 4)
        # Pixel centres are integers: a full-image pixel u lies at (u + 1/2) s - 1/2 in the label image.
        middle = ((boxes[:, :2] + boxes[:, 2:]) / 2 + 0.5) * observation.label_scale - 0.5
        centres.append(middle - observation.label_offset_px)
        cloud = in_range(observation.radar_xyz_m)
        clouds.append(
            thin(cloud[safely_in_view(camera, transform_points(T_prior, cloud), margin_rad)], _DETECTIONS)
        )
        costs.append(np.where(labels == SKY, PENALTY, 0.0))
    return CameraRadarLoss(
        tracks_radar=np.concatenate(tracks) if tracks else np.zeros((0, 3)),
        track_frame=np.concatenate(frame_of).astype(np.int64) if frame_of else np.zeros(0, np.int64),
        centres_px=_padded(centres, _FAR_PX),
        detections=fold_frames(clouds, costs, cameras, PENALTY),
    )


def _padded(arrays: list[np.ndarray], fill: float) -> np.ndarray:
    longest = max([1, *(len(a) for a in arrays)])
    out = np.full((len(arrays), longest, 2), fill)
    for row, a in zip(out, arrays, strict=True):
        row[: len(a)] = a
    return out
