"""Maps of one label image on the camera's grid: classes and boundaries.

Maps are computed on a fine grid of 0.1 deg and sampled at the centres of the cells, so large cells do not
blur boundaries. On this grid a horizontal step is shorter than a vertical one by the cosine of the elevation:
3 % at 14 deg, to which no loss is sensitive.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int8, Int32, UInt8

from pipeline.learn.sample.grid import Grid, grid_rays
from pipeline.learn.sample.layout import CLASS_CONFIDENCE
from pipeline.objective.camera_lidar.image_maps import NO_BOUNDARY, boundary_offsets
from pipeline.rig.cameras import Camera
from schemas.training import CLASS_OF_LABEL, GRID_CLASSES, NO_EDGE, UNKNOWN_CLASS

__all__ = ["camera_features", "class_likelihood", "stored_grid"]

_FINE_DEG = 0.1
_VOID_LABEL = 255
_EDGE_STEPS = 2  # boundaries are stored in halves of a fine cell: centres of cells lie between fine cells


def stored_grid(shape: tuple[int, int], step_deg: float) -> Grid:
    """The grid of (height, width) cells about the optical axis."""
    height, width = shape
    return Grid(step_deg, width / 2 * step_deg, height / 2 * step_deg, -height / 2 * step_deg)


def camera_features(
    labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid
) -> tuple[UInt8[np.ndarray, "H W"], Int8[np.ndarray, "4 H W"]]:
    """Columns grid_class and edge_offset of table `training`, as maps.

    A cell has the class of at least half of it. `labels` are Cityscapes train ids; `camera` belongs to the full
    image.
    """
    fine = _sample_finely(labels, camera, grid)
    share = _shares(fine, grid)
    grid_class = np.where(share.max(axis=0) >= 0.5, share.argmax(axis=0), UNKNOWN_CLASS).astype(np.uint8)
    return grid_class, _edge_offsets(fine, round(grid.cell_deg / _FINE_DEG))


def class_likelihood(
    labels: UInt8[np.ndarray, "Y X"], camera: Camera, grid: Grid
) -> Float32[np.ndarray, "C H W"]:
    """Class input of a network: likelihood of each class, and 1 if at least half of the cell has a class, else 0.

    A cell that a boundary crosses has shares of both classes; arguments as of `camera_features`.
    """
    share = _shares(_sample_finely(labels, camera, grid), grid)
    total = share.sum(axis=0)
    known = (total >= 0.5).astype(np.float32)
    doubt = np.float32((1 - CLASS_CONFIDENCE) / len(share))
    likelihood = np.float32(CLASS_CONFIDENCE) * share / np.maximum(total, np.float32(0.5)) + doubt
    return np.concatenate([likelihood * known, known[None]]).astype(np.float32)


def _shares(fine: np.ndarray, grid: Grid) -> Float32[np.ndarray, "K H W"]:
    """Share of each class in each cell of finely sampled labels."""
    classes, size = CLASS_OF_LABEL[fine], (grid.width, grid.height)
    planes = ((classes == k).astype(np.float32) for k in range(len(GRID_CLASSES)))
    return np.stack([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes])


def _sample_finely(labels: np.ndarray, camera: Camera, grid: Grid) -> UInt8[np.ndarray, "Y X"]:
    key = (camera.model, camera.K.tobytes(), camera.D.tobytes(), camera.width_px, camera.height_px)
    index, seen = _pixels(key, labels.shape, grid)
    return np.where(seen, labels.ravel()[index], _VOID_LABEL).astype(np.uint8)


@lru_cache(maxsize=4)  # one camera per vehicle-day; the projection costs more than all the rest
def _pixels(
    camera_key: tuple[str, bytes, bytes, int, int], size: tuple[int, int], grid: Grid
) -> tuple[Int32[np.ndarray, "Y X"], Bool[np.ndarray, "Y X"]]:
    """Flat index of the label pixel under each fine cell, and whether it exists."""
    model, K, D, width, height = camera_key
    camera = Camera(model, np.frombuffer(K).reshape(3, 3), np.frombuffer(D), width, height)
    small = camera.scaled(size[1] / width)
    uv, valid = small.project(grid_rays(grid.finer(round(grid.cell_deg / _FINE_DEG))))
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
