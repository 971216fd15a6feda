"""The equirectangular grid of all networks: directions of the camera's optical frame, in equal angles.

A camera is resampled onto it once; lidar and radar are rendered onto it at the current guess, so a rotation
error is a shift of cells for any lens. Column 0 is the leftmost, row 0 the highest; the centre of cell (v, u)
has azimuth `left - (u + 1/2) c` and elevation `top - (v + 1/2) c`, c the size of a cell. Azimuth is positive
to the left, elevation upwards, as in `rig.se3.camera_direction_angles`.

Also names, orders and counts that training, the exported file and inference share; nothing here needs torch.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.rig.cameras import Camera
from schemas.training import GRID_CLASSES

__all__ = [
    "CAMERA_CHANNELS", "CLASS_CHANNELS", "CLASS_CONFIDENCE", "EVIDENCE", "FEATURE_UNITS", "GRAPH_INPUTS",
    "LIDAR_CHANNELS", "LIDAR_FEATURES", "LIKELIHOOD", "MARKED_POINTS", "MARK_FLAT", "MARK_LEAST_SHARE",
    "MATCHED_POINTS", "NEAR_M", "OBJECT_POINTS", "PAIRS", "RADAR_CHANNELS", "RADAR_FEATURES", "RADAR_POINTS",
    "Grid", "NetworkConfig", "grid_rays", "resample_camera",
]  # fmt: skip


@dataclass(frozen=True)
class Grid:
    """Part of the camera's directions in cells of `cell_deg`: 0.4 for a CPU, 0.2 for a GPU.

    `left_deg` is the azimuth of the left border; the right one is its mirror image. The default is the paper
    rig's lidar (60 x 24 deg) and 8 deg around it.
    """

    cell_deg: float = 0.4
    left_deg: float = 38.4
    top_deg: float = 16.0
    bottom_deg: float = -22.4

    def __post_init__(self) -> None:
        spans_deg = {"width": 2 * self.left_deg, "height": self.top_deg - self.bottom_deg}
        for name, count in ((name, span / self.cell_deg) for name, span in spans_deg.items()):
            # Three halvings down and up again in the camera's encoder, and three levels of cells in the matcher.
            if abs(count - round(count)) > 1e-6 or round(count) % 16:
                raise ValueError(f"the grid's {name} of {count:g} cells is no multiple of 16")

    @property
    def width(self) -> int:
        """Columns."""
        return round(2 * self.left_deg / self.cell_deg)

    @property
    def height(self) -> int:
        """Rows."""
        return round((self.top_deg - self.bottom_deg) / self.cell_deg)

    def finer(self, factor: int) -> Grid:
        """The same view in cells 1/`factor` as large."""
        return _Level(self.cell_deg / factor, self.left_deg, self.top_deg, self.bottom_deg)

    def window(self, stored: tuple[int, int], step_deg: float) -> tuple[slice, slice]:
        """Rows and columns of this view in centred maps of (height, width) cells; else ValueError."""
        if abs(step_deg - self.cell_deg) > 1e-9:
            raise ValueError(f"the data has cells of {step_deg} deg, the network wants {self.cell_deg} deg")
        rows, columns = stored
        top, left = rows / 2 - self.top_deg / step_deg, columns / 2 - self.left_deg / step_deg
        row, column = round(top), round(left)
        if max(abs(top - row), abs(left - column)) > 1e-6:
            raise ValueError("the network's grid is between the cells of the data's grid")
        if min(row, column) < 0 or row + self.height > rows or column + self.width > columns:
            raise ValueError(f"the data's grid of {rows} x {columns} cells does not contain the network's")
        return slice(row, row + self.height), slice(column, column + self.width)

    def azimuth_rad(self) -> Float[np.ndarray, " W"]:
        """Azimuth of the columns' centres."""
        return np.radians(self.left_deg - (np.arange(self.width) + 0.5) * self.cell_deg)

    def elevation_rad(self) -> Float[np.ndarray, " H"]:
        """Elevation of the rows' centres."""
        return np.radians(self.top_deg - (np.arange(self.height) + 0.5) * self.cell_deg)


class _Level(Grid):
    """A level of a pyramid: any whole number of cells."""

    def __post_init__(self) -> None:
        return


def grid_rays(grid: Grid) -> Float[np.ndarray, "H W 3"]:
    """Unit rays through the cells' centres, optical frame (x right, y down, z forward)."""
    azimuth, elevation = np.meshgrid(grid.azimuth_rad(), grid.elevation_rad())
    c = np.cos(elevation)
    return np.stack([-c * np.sin(azimuth), -np.sin(elevation), c * np.cos(azimuth)], -1)


def resample_camera(
    image: UInt8[np.ndarray, "Y X 3"], camera: Camera, grid: Grid
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
    """The image in the grid's cells, and 1 where the camera sees the whole cell.

    Colours are averaged over the cell: the image is first reduced to about half a cell per pixel, then
    sampled twice per cell and axis. `camera` may belong to another size of the same image.
    """
    fine = grid.finer(2)
    pitch_rad = 1.0 / max(camera.focal_px) * camera.width_px / image.shape[1]
    scale = min(1.0, pitch_rad / np.radians(fine.cell_deg))
    if scale < 1.0:
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], 3)
    uv, valid = camera.project(grid_rays(fine))
    valid = np.asarray(valid & camera.contains(uv))
    # By axis: sides are rounded to whole pixels, and 0.07 cells of elevation were lost to one factor for both.
    factor = np.array([image.shape[1] / camera.width_px, image.shape[0] / camera.height_px])
    u, v = np.moveaxis(((uv + 0.5) * factor - 0.5).astype(np.float32), -1, 0)
    sampled = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    whole = np.asarray(valid.reshape(grid.height, 2, grid.width, 2).all(axis=(1, 3)))
    reduced = cv2.resize(sampled, (grid.width, grid.height), interpolation=cv2.INTER_AREA)
    return np.where(whole[..., None], reduced, 0).astype(np.uint8), whole.astype(np.uint8)


PAIRS = ("camera_lidar", "camera_radar", "lidar_radar")
LIDAR_FEATURES = ("intensity", "height", "edge", "ground")
RADAR_FEATURES = ("speed", "power", "moving")
# What brings features to the order of one: heights [m], Doppler residuals [m/s], power over the median [dB].
FEATURE_UNITS = {"height": 3.0, "speed": 5.0, "power": 20.0}

CAMERA_CHANNELS = 4  # red, green, blue, and whether the image shows the cell
# Behind them, where a network takes classes: the likelihood of each class, and whether the cell has one.
CLASS_CHANNELS = len(GRID_CLASSES) + 1
# Of a segmenter in what it says: 85 to 90 % of pixels are right with those that Cityscapes ranks (mIoU of 66 to 80).
CLASS_CONFIDENCE = 0.9
LIDAR_CHANNELS = 2 + len(LIDAR_FEATURES)  # of a rendered sweep: occupied, nearness, features
RADAR_CHANNELS = 2 + len(RADAR_FEATURES)
NEAR_M = 0.5  # nothing outside the car is nearer
MATCHED_POINTS = 1536  # lidar points whose classes are matched with the camera's
MARKED_POINTS = 192  # points of bright ground that are matched with the image's paint
MARK_FLAT, MARK_LEAST_SHARE = 1e-3, 1e-4  # a spread below, and ground about a cell below, are rounding
OBJECT_POINTS = 512  # lidar points off the ground that radar detections are matched with
RADAR_POINTS = 384  # as table training holds them

# Inputs of the exported graph in order: the fields of `network.views.RenderedView`.
GRAPH_INPUTS = (
    "camera", "lidar_grid", "radar_grid", "points_camera", "point_weight", "objects", "object_weight",
    "radar_lidar", "radar_camera", "radar_features", "radar_valid", "radar_has_elevation", "marks_camera",
    "mark_weight",
)  # fmt: skip
LIKELIHOOD = "camera_log_likelihood"  # an output, where a graph can be cut to encode the camera once
# Outputs where a camera and a lidar are matched: the fields of `network.outputs.ClassEvidence`.
EVIDENCE = ("class_maps", "point_probability", "point_worth")


@dataclass(frozen=True)
class NetworkConfig:
    """Structure of a network.

    Args:
        width: channels of the encoders' first stage.
        hidden: features per pair before fusion (matching), fused features (concat).
        takes_classes: the camera input is the image and, if there is a segmenter, its classes (matching).
        marks: bright ground of the sweep is matched with the image's (matching); files before 0.9.0 do not.
    """

    architecture: Literal["matching", "concat"] = "matching"
    pairs: Literal["joint", "camera_lidar", "camera_radar", "lidar_radar"] = "joint"
    grid: Grid = field(default_factory=Grid)
    width: int = 16
    hidden: int = 192
    takes_classes: bool = False
    marks: bool = False

    @classmethod
    def of_json(cls, text: str) -> NetworkConfig:
        """Configuration from the metadata of a file; KeyError, TypeError or ValueError if it is none."""
        values = json.loads(text)
        return cls(**values | {"grid": Grid(**values["grid"])})

    @property
    def camera_channels(self) -> int:
        """Of the graph's input `camera`."""
        return CAMERA_CHANNELS + (CLASS_CHANNELS if self.takes_classes else 0)

    @property
    def estimated(self) -> tuple[str, ...]:
        """The pairs that the network corrects."""
        return PAIRS if self.pairs == "joint" else (self.pairs,)

    @property
    def composed(self) -> bool:
        """Whether the camera-radar correction applies to the product of the other two instead of the guess."""
        return self.architecture == "matching" and self.pairs == "joint"
