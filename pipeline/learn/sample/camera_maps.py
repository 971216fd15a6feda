"""Maps of one label image on the camera's grid: classes and boundaries.

Maps are computed on a fine grid of 0.1 deg and sampled at the centres of the cells, so large cells do not
blur boundaries. On this grid a horizontal step is shorter than a vertical one by the cosine of the elevation:
3 % at 14 deg, to which no loss is sensitive.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, UInt8

from pipeline.learn.sample.grid import Grid, grid_rays
from pipeline.learn.sample.layout import CLASS_CONFIDENCE
from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY, boundary_offsets
from pipeline.rig.cameras import Camera
from schemas.training import CLASS_OF_LABEL, GRID_CLASSES, NO_EDGE, UNKNOWN_CLASS

__all__ = ["FINE_DEG", "CameraFeatures", "camera_features", "class_likelihood", "stored_grid"]

FINE_DEG = 0.1
_VOID_LABEL = 255
_EDGE_STEPS = 2  # boundaries are stored in halves of a fine cell: centres of cells lie between fine cells


@dataclass(frozen=True, eq=False)
class CameraFeatures:
    """Columns of table `training` computed from labels, as maps on the grid."""

    grid_class: UInt8[np.ndarray, "H W"]
    edge_offset: Int8[np.ndarray, "4 H W"]


def stored_grid(shape: tuple[int, int], step_deg: float) -> Grid:
    """The grid of (height, width) cells about the optical axis."""
    height, width = shape
    return Grid(step_deg, width / 2 * step_deg, height / 2 * step_deg, -height / 2 * step_deg)


def camera_features(labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid) -> CameraFeatures:
    """Features of a label image (Cityscapes train ids); `camera` belongs to the full image."""
    fine = _sample_finely(labels, camera, grid)
    per_cell = round(grid.cell_deg / FINE_DEG)
    classes = CLASS_OF_LABEL[fine.labels]
    return CameraFeatures(
        _majority(classes, per_cell, len(GRID_CLASSES)),
        _edge_offsets(fine.labels, per_cell),
    )


def class_likelihood(
    labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid
) -> Float32[np.ndarray, "C H W"]:
    """Class input of a network from a label image: see `likelihood_of_shares`.

    A cell that a boundary crosses has shares of both classes; `camera` belongs to the full image.
    """
    fine = _sample_finely(labels, camera, grid)
    per_cell = round(grid.cell_deg / FINE_DEG)
    classes = CLASS_OF_LABEL[fine.labels]
    cells = (grid.height, per_cell, grid.width, per_cell)
    share = [(classes == k).reshape(cells).mean(axis=(1, 3)) for k in range(len(GRID_CLASSES))]
    return likelihood_of_shares(np.stack(share).astype(np.float32))


def likelihood_of_shares(share: Float32[np.ndarray, "K H W"]) -> Float32[np.ndarray, "C H W"]:
    """Likelihood of each class, then one more channel: 1 if at least half of the cell has a class, else 0."""
    total = share.sum(axis=0)
    known = (total >= 0.5).astype(np.float32)
    doubt = np.float32((1 - CLASS_CONFIDENCE) / len(share))
    likelihood = np.float32(CLASS_CONFIDENCE) * share / np.maximum(total, np.float32(0.5)) + doubt
    return np.concatenate([likelihood * known, known[None]]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _FineLabels:
    labels: UInt8[np.ndarray, "Y X"]
    seen: Bool[np.ndarray, "Y X"]


def _sample_finely(labels: np.ndarray, camera: Camera, grid: Grid) -> _FineLabels:
    key = (camera.model, camera.K.tobytes(), camera.D.tobytes(), camera.width_px, camera.height_px)
    index, seen = _pixels(key, labels.shape, grid)
    return _FineLabels(np.where(seen, labels.ravel()[index], _VOID_LABEL).astype(np.uint8), seen)


@lru_cache(maxsize=4)  # one camera per vehicle-day; the projection costs more than all the rest
def _pixels(
    camera_key: tuple[str, bytes, bytes, int, int], size: tuple[int, int], grid: Grid
) -> tuple[Int32[np.ndarray, "Y X"], Bool[np.ndarray, "Y X"]]:
    """Flat index of the label pixel under each fine cell, and whether it exists."""
    model, K, D, width, height = camera_key
    camera = Camera(model, np.frombuffer(K).reshape(3, 3), np.frombuffer(D), width, height)
    small = camera.scaled(size[1] / width)
    uv, valid = small.project(grid_rays(grid.finer(round(grid.cell_deg / FINE_DEG))))
    u, v = np.rint(uv[..., 0]), np.rint(uv[..., 1])  # pixel centres are integers
    seen = valid & (u >= 0) & (v >= 0) & (u < size[1]) & (v < size[0])
    index = np.where(seen, v * size[1] + u, 0).astype(np.int32)
    return index, seen


def _edge_offsets(labels: np.ndarray, per_cell: int) -> np.ndarray:
    """Signed distance from each cell's centre to the nearest boundary by direction, in halves of a fine cell."""
    middle = per_cell // 2
    offsets = boundary_offsets(labels)[:, middle::per_cell, middle::per_cell].astype(np.int16)
    # A boundary lies half a fine cell behind pixel + offset, and the cell's centre (per_cell - 1) / 2 - middle
    # of one beside the pixel that was looked at.
    halves = _EDGE_STEPS * offsets + 1 - (per_cell - 1 - 2 * middle)
    known = (offsets != NO_BOUNDARY) & (np.abs(halves) <= 127)
    return np.where(known, halves, NO_EDGE).astype(np.int8)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _majority(classes: np.ndarray, per_cell: int, count: int) -> np.ndarray:
    """The class that holds at least half of a cell, else UNKNOWN_CLASS."""
    height, width = classes.shape[0] // per_cell, classes.shape[1] // per_cell
    out = np.full((height, width), UNKNOWN_CLASS, np.uint8)
    votes = np.zeros(count, np.int64)
    for i in range(height):
        for j in range(width):
            votes[:] = 0
            for a in range(per_cell):
                for b in range(per_cell):
                    c = classes[i * per_cell + a, j * per_cell + b]
                    if c < count:
                        votes[c] += 1
            winner = np.argmax(votes)
            if 2 * votes[winner] >= per_cell * per_cell:
                out[i, j] = winner
    return out
