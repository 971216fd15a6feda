"""The formats by name: what each writes, and how it is read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from pipeline.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames
from pipeline.export.tree import ESTIMATED_EDGES, pairs_of_tree
from pipeline.geometry.se3 import inverse
from pipeline.geometry.transform_tree import TransformTree
from pipeline.rig.edges import words_of
from pipeline.rig.graph import Edge

__all__ = ["FORMATS", "Files", "Format", "format_named"]

Files = Mapping[str, bytes]  # by name (when written, relative to --out)


@dataclass(frozen=True)
class Format:
    """A format as a value.

    Args:
        name: on the command line.
        write: files of a calibration; None of a format that is only read. Raises ConfigError where the format cannot
            hold it.
        tree: frames that files hold, where the format names frames.
        read: transforms that files hold of edges, by their words, where it has names of its own for them. Both raise
            ConfigError that names file and field.
        update: of a format whose files hold more than a calibration: a file with new numbers in place of the old, and
            the frames that have them.
        T_frame_camera: of a format whose camera frame is not the optical one: from the optical frame to its own.
        holds_provenance: the files say all that the side file would.
        notes: for the side file, what the format cannot say or takes for granted.
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
        """T_parent_child of edges, those of them that the files hold, by their words.

        Args:
            files: by name.
            names: of the frames.
            edges: that are asked for; as they are given, T_camera_lidar and T_lidar_radar.

        Raises:
            ConfigError: none, or the files cannot be read; it names file and field.
        """
        if self.read is not None:
            return self.read(files, edges, names)
        assert self.tree is not None, "a format names frames or pairs"
        found = pairs_of_tree(", ".join(files), self.tree(files), names, edges)
        if self.T_frame_camera is not None:
            for edge in (e for e in edges if words_of(e) in found):
                a, b = (self.T_frame_camera if s.kind == "camera" else np.eye(4) for s in edge.sensors)
                found[words_of(edge)] = inverse(a) @ found[words_of(edge)] @ b
        return found


# Name -> where its value is (resolved on use: some bring OpenCV or the ROS message types).
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
    "apollo": "pipeline.export.apollo:APOLLO",
    "openlabel": "pipeline.export.openlabel:OPENLABEL",
    "matlab": "pipeline.export.matlab:MATLAB",
}


def format_named(name: str) -> Format:
    """The format of a name.

    Raises:
        ConfigError: there is none.
    """
    if name not in FORMATS:
        raise ConfigError("command line", "format", f"{name!r} is none of {', '.join(FORMATS)}")
    module, value = FORMATS[name].split(":")
    found = getattr(import_module(module), value)
    assert isinstance(found, Format)
    return found
