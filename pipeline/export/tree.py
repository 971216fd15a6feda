"""Pairs of sensors out of the trees of frames that most formats hold."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.errors import ConfigError
from pipeline.export.calibration import FrameNames
from pipeline.geometry.transform_tree import TransformTree
from schemas.calibrations import FRAMES_OF_PAIR

__all__ = ["ESTIMATED_PAIRS", "pairs_of_tree", "require_frames"]

# The pairs that a prior file holds; the third is their composition.
ESTIMATED_PAIRS = ("camera_lidar", "lidar_radar")


def pairs_of_tree(file: str, tree: TransformTree, names: FrameNames) -> dict[str, Float[np.ndarray, "4 4"]]:
    """T_camera_lidar and T_lidar_radar, those of them that the tree joins.

    Raises:
        ConfigError: neither; it names the frames that the file holds.
    """
    found = {}
    for pair in ESTIMATED_PAIRS:
        parent, child = FRAMES_OF_PAIR[pair]
        T = tree.lookup(names.of(parent), names.of(child))
        if T is not None:
            found[pair] = T
    if not found:
        frames = sorted({*tree.edges, *tree.edges.values()})
        raise ConfigError(
            file,
            f"{names.camera}, {names.lidar}, {names.radar}",
            f"no chain joins these frames; the file has: {', '.join(frames) or 'none'}. "
            "Name them with --camera-frame, --lidar-frame, --radar-frame",
        )
    return found


def require_frames(file: str, parent: object, child: object) -> tuple[str, str]:
    """Two frame names as a file gives them, without ROS 1's leading slash.

    Raises:
        ConfigError: they are no two different names.
    """
    if not (isinstance(parent, str) and isinstance(child, str)):
        raise ConfigError(file, "parent, child", f"{parent!r} and {child!r} are no frame names")
    parent, child = parent.lstrip("/"), child.lstrip("/")
    if not parent or not child or parent == child:
        raise ConfigError(file, "parent, child", f"{parent!r} and {child!r} are no two frames")
    return parent, child
