"""The paper's lidar-radar loss: drivable areas overlap, and tracked clusters lie at lidar clusters' centres.

Per frame: `1 - IoU` of the lidar's drivable cells (1 m2 each), seen from the radar, with the radar's drivable
area, plus the mean over tracked clusters of `d^2 / (d^2 + s^2)`, d = distance to the nearest lidar cluster
centre, s = 2 m. The IoU is smooth because the radar's area fades out over about 2 m.

Source: section 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float

from pipeline.rig.se3 import inverse
from schemas.observations import Observation

__all__ = ["LidarRadarLoss", "drivable_map", "lidar_radar_loss"]

SCALE_M = 2.0
CELL_M = 0.5
FAR_M = 80.0  # the paper's far limit
_FADE_M = 1.0
_CELLS = (int(FAR_M / CELL_M), int(2 * FAR_M / CELL_M))  # ahead, across
_DRIVABLE = 600  # lidar cells per frame


@dataclass(frozen=True, eq=False)
class LidarRadarLoss:
    """Drivable cells and maps, tracks and cluster centres of the selected frames, one after another."""

    drivable_lidar: np.ndarray  # float32, N 3
    drivable_first: np.ndarray  # F + 1
    lidar_area_m2: np.ndarray  # F
    radar_maps: np.ndarray  # float32, F ahead across
    radar_area_m2: np.ndarray  # F
    tracks_radar: np.ndarray  # M 3
    track_first: np.ndarray  # F + 1
    centres_lidar: np.ndarray  # K 3
    centre_first: np.ndarray  # F + 1
    flat: np.ndarray  # F, True where the radar measures no elevation

    @property
    def informative(self) -> Bool[np.ndarray, " F"]:
        """True for frames with tracked clusters and lidar clusters to compare, or two drivable areas."""
        return self._has_tracks | self._has_areas

    @property
    def _has_tracks(self) -> np.ndarray:
        return (np.diff(self.track_first) > 0) & (np.diff(self.centre_first) > 0)

    @property
    def _has_areas(self) -> np.ndarray:
        return (self.radar_area_m2 > 0) & (self.lidar_area_m2 > 0)

    def frame_losses(self, T_lidar_radar: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
        """Loss of each frame at each pose."""
        T = np.ascontiguousarray(T_lidar_radar, np.float64)
        tracks = np.zeros((len(T), len(self.flat)))
        _nearest_costs(
            T, self.tracks_radar, self.track_first, self.centres_lidar, self.centre_first, self.flat, SCALE_M,
            tracks,
        )  # fmt: skip
        tracks /= np.maximum(np.diff(self.track_first), 1)
        iou = self.drivable_iou(T)
        return np.where(self._has_areas, 1 - iou, 0.0) + np.where(self._has_tracks, tracks, 0.0)

    def drivable_iou(self, T_lidar_radar: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P F"]:
        """Smooth IoU of the two drivable areas, 0..1; 0 where a frame lacks one of them."""
        inside = np.zeros((len(T_lidar_radar), len(self.flat)))
        T_radar_lidar = inverse(np.ascontiguousarray(T_lidar_radar, np.float64))
        poses = np.ascontiguousarray(T_radar_lidar[:, :3].reshape(-1, 12), np.float32)
        _inside(poses, self.drivable_lidar, self.drivable_first, self.radar_maps, np.float32(CELL_M), inside)
        overlap = inside / np.maximum(np.diff(self.drivable_first), 1) * self.lidar_area_m2
        return overlap / np.maximum(self.lidar_area_m2 + self.radar_area_m2 - overlap, 1e-9)


def lidar_radar_loss(observations: Sequence[Observation]) -> LidarRadarLoss:
    """Prepare the loss of these frames."""
    drivable, areas, maps, tracks, centres = [], [], [], [], []
    for observation in observations:
        cells = observation.lidar_drivable_xyz_m
        cells = cells[(np.linalg.norm(cells[:, :2], axis=1) < FAR_M) & (cells[:, 0] > 0)]
        areas.append(float(len(cells)))  # 1 m grid
        keep = np.linspace(0, len(cells) - 1, min(len(cells), _DRIVABLE)).astype(int)
        drivable.append(cells[keep].astype(np.float32))
        maps.append(drivable_map(observation.radar_drivable_azimuth_rad, observation.radar_drivable_range_m))
        near = observation.radar_track_xyz_m
        tracks.append(near[np.linalg.norm(near, axis=1) < FAR_M].astype(np.float64))
        centres.append(observation.lidar_cluster_centre_m.astype(np.float64))
    radar_maps = np.stack(maps) if maps else np.zeros((0, *_CELLS), np.float32)
    return LidarRadarLoss(
        *_stacked(drivable, np.float32), np.array(areas), radar_maps,
        radar_maps.sum(axis=(1, 2), dtype=np.float64) * CELL_M**2, *_stacked(tracks, np.float64),
        *_stacked(centres, np.float64), np.array([not o.radar_has_elevation for o in observations], bool),
    )  # fmt: skip


def drivable_map(
    azimuth_rad: Float[np.ndarray, " B"], range_m: Float[np.ndarray, " B"]
) -> Float[np.ndarray, "ahead across"]:
    """The radar's drivable area as a soft map, x ahead by rows, y from right to left by columns, cells of CELL_M."""
    hard = np.zeros(_CELLS, np.float32)
    if len(azimuth_rad):
        order = np.argsort(azimuth_rad)
        half = np.diff(azimuth_rad[order]).min() / 2 if len(azimuth_rad) > 1 else 0.01
        x, y = np.meshgrid(
            (np.arange(_CELLS[0]) + 0.5) * CELL_M,
            (np.arange(_CELLS[1]) + 0.5) * CELL_M - FAR_M,
            indexing="ij",
        )
        azimuth = np.arctan2(y, x)
        free = np.interp(azimuth, azimuth_rad[order], range_m[order])
        sector = (azimuth > azimuth_rad.min() - half) & (azimuth < azimuth_rad.max() + half)
        hard = (sector & (np.hypot(x, y) < np.minimum(free, FAR_M))).astype(np.float32)
    return cv2.GaussianBlur(hard, (0, 0), _FADE_M / CELL_M)


def _stacked(arrays: list[np.ndarray], dtype: type) -> tuple[np.ndarray, np.ndarray]:
    first = np.concatenate([[0], np.cumsum([len(a) for a in arrays])]).astype(np.int64)
    return np.concatenate([np.zeros((0, 3), dtype), *arrays]).astype(dtype), first


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True)
def _nearest_costs(T, tracks, track_first, centres, centre_first, flat, scale_m, out):  # noqa: ANN001, ANN202
    for p in range(len(T)):
        t = T[p]
        for f in range(len(flat)):
            for i in range(track_first[f], track_first[f + 1]):
                x, y, z = tracks[i]
                px = t[0, 0] * x + t[0, 1] * y + t[0, 2] * z + t[0, 3]
                py = t[1, 0] * x + t[1, 1] * y + t[1, 2] * z + t[1, 3]
                pz = t[2, 0] * x + t[2, 1] * y + t[2, 2] * z + t[2, 3]
                best = 1e12
                for j in range(centre_first[f], centre_first[f + 1]):
                    dx, dy, dz = px - centres[j, 0], py - centres[j, 1], pz - centres[j, 2]
                    d2 = dx * dx + dy * dy + (0.0 if flat[f] else dz * dz)
                    best = min(best, d2)
                out[p, f] += best / (best + scale_m * scale_m)


@no_type_check
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _inside(poses, points, first, maps, cell_m, out):  # noqa: ANN001, ANN202
    rows, columns = maps.shape[1], maps.shape[2]
    half = np.float32(0.5)
    for f in range(len(maps)):
        for p in range(len(poses)):
            t = poses[p]
            total = np.float32(0)
            for i in range(first[f], first[f + 1]):
                x, y, z = points[i, 0], points[i, 1], points[i, 2]
                r = (t[0] * x + t[1] * y + t[2] * z + t[3]) / cell_m - half
                c = (t[4] * x + t[5] * y + t[6] * z + t[7]) / cell_m - half + np.float32(columns // 2)
                if (r >= 0) & (c >= 0) & (r < rows - 1) & (c < columns - 1):
                    ir, ic = int(r), int(c)
                    a, b = r - np.float32(ir), c - np.float32(ic)
                    top = maps[f, ir, ic] + b * (maps[f, ir, ic + 1] - maps[f, ir, ic])
                    low = maps[f, ir + 1, ic] + b * (maps[f, ir + 1, ic + 1] - maps[f, ir + 1, ic])
                    total += top + a * (low - top)
            out[p, f] += total
