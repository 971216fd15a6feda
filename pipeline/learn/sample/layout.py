"""Names, orders and counts that training, the exported file and inference share; nothing here needs torch."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Literal

from pipeline.learn.sample.grid import Grid
from schemas.training import GRID_CLASSES

__all__ = [
    "CAMERA_CHANNELS", "CLASS_CHANNELS", "CLASS_CONFIDENCE", "EVIDENCE", "FEATURE_UNITS", "GRAPH_INPUTS",
    "LIDAR_CHANNELS", "LIDAR_FEATURES", "LIKELIHOOD", "MARKED_POINTS", "MARK_FLAT", "MARK_LEAST_SHARE",
    "MATCHED_POINTS", "NEAR_M", "OBJECT_POINTS", "PAIRS", "RADAR_CHANNELS", "RADAR_FEATURES", "RADAR_POINTS",
    "NetworkConfig",
]  # fmt: skip

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
