"""The formats by name, with their functions for writing and reading."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames
from pipeline.export.tree import ESTIMATED_EDGES, pairs_of_tree
from pipeline.rig.graph import Edge, words_of
from pipeline.rig.se3 import inverse
from pipeline.rig.transform_tree import TransformTree

__all__ = ["FORMATS", "Files", "Format", "format_named"]

Files = Mapping[str, bytes]  # by file name (when written, relative to --out)


@dataclass(frozen=True)
class Format:
    """A file format.

    Args:
        name: on the command line.
        write: returns the files of a calibration; None if the format can only be read. Raises ConfigError if
            the format cannot hold the calibration.
        tree: reads the frames in the files, for formats that name frames.
        read: reads edges from the files, by edge name, for formats with names of their own. `tree` and `read`
            raise ConfigError with file and field.
        update: for formats whose files hold more than a calibration: returns a file with new poses in place
            of the old ones, and the updated frames.
        T_frame_camera: from the optical frame to the format's camera frame, if they differ.
        holds_provenance: the files contain all that the side file would contain.
        notes: for the side file: assumptions, and information that the format cannot hold.
    """

    name: str
    write: Callable[[ExportedCalibration], dict[str, bytes]] | None = None
    tree: Callable[[Files], TransformTree] | None = None
    read: Callable[[Files, Sequence[Edge], FrameNames], dict[str, np.ndarray]] | None = None
    update: Callable[[str, bytes, ExportedCalibration], tuple[bytes, list[str]]] | None = None
    T_frame_camera: np.ndarray | None = None
    holds_provenance: bool = False
    notes: tuple[str, ...] = ()

    def pairs(
        self, files: Files, names: FrameNames, edges: Sequence[Edge] = ESTIMATED_EDGES
    ) -> dict[str, np.ndarray]:
        """T_parent_child of those `edges` (in the given direction) that the files hold, by edge name.

        Raises:
            ConfigError: no edge found, or the files cannot be read; the message has file and field.
        """
        if self.read is not None:
            return self.read(files, edges, names)
        assert self.tree is not None, "a format needs `tree` or `read`"
        found = pairs_of_tree(", ".join(files), self.tree(files), names, edges)
        if self.T_frame_camera is not None:
            for edge in (e for e in edges if words_of(e) in found):
                a, b = (self.T_frame_camera if s.kind == "camera" else np.eye(4) for s in edge.sensors)
                found[words_of(edge)] = inverse(a) @ found[words_of(edge)] @ b
        return found


# Name -> import path, resolved on use: some import OpenCV or the ROS message types.
FORMATS = {
    "ros2": "pipeline.export.ros2:ROS2",
    "tf-static": "pipeline.export.tf_static:TF_STATIC",
    "urdf": "pipeline.export.urdf:URDF",
    "xacro": "pipeline.export.urdf:XACRO",
    "autoware": "pipeline.export.autoware:AUTOWARE",
    "kitti": "pipeline.export.kitti:KITTI",
    "vod": "pipeline.export.kitti:VOD",
    "nuscenes": "pipeline.export.nuscenes:NUSCENES",
    "t4": "pipeline.export.nuscenes:T4",
    "kalibr": "pipeline.export.kalibr:KALIBR",
    "opencv": "pipeline.export.opencv:OPENCV",
}


def format_named(name: str) -> Format:
    """The format of this name; raises ConfigError if there is none."""
    if name not in FORMATS:
        raise ConfigError("command line", "format", f"{name!r} is none of {', '.join(FORMATS)}")
    module, value = FORMATS[name].split(":")
    found = getattr(import_module(module), value)
    assert isinstance(found, Format)
    return found
