"""Apollo's extrinsics: a file per child frame, and the camera's intrinsics as a CameraInfo.

`transform` maps coordinates from child_frame_id to header.frame_id; camera frames are optical frames.

Source: ApolloAuto/apollo, modules/calibration/data and modules/transform (extrinsic_file in
static_transform_conf).
"""

from __future__ import annotations

from typing import Any

from pipeline.export.calibration import ExportedCalibration, Pose, poses_of
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.texts import field_of, load_yaml, number_of, pose_of_quaternion, to_yaml
from pipeline.export.tree import require_frames
from pipeline.geometry.cameras import Camera
from pipeline.geometry.se3 import to_quaternion
from pipeline.geometry.transform_tree import TransformTree

__all__ = ["APOLLO"]

_ROTATION, _TRANSLATION = ("w", "x", "y", "z"), ("x", "y", "z")


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    comments = comment_lines(calibration)
    files = {
        f"{_file_name(e.child)}_extrinsics.yaml": to_yaml(_extrinsics(e), comments)
        for e in poses_of(calibration)
    }
    for sensor in calibration.sensors:
        camera, name = calibration.camera_of(sensor.name), calibration.names.of(sensor.name)
        if camera is not None:
            files[f"{_file_name(name)}_intrinsics.yaml"] = to_yaml(_intrinsics(name, camera), comments)
    return files


def _file_name(frame: str) -> str:
    return frame.replace("/", "_")


def _header(frame: str) -> dict[str, Any]:
    return {"seq": 0, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": frame}


def _extrinsics(edge: Pose) -> dict[str, Any]:
    q, t = to_quaternion(edge.T), edge.T[:3, 3]
    rotation = {name: float(v) + 0.0 for name, v in zip(_ROTATION, q, strict=True)}
    translation = {name: float(v) + 0.0 for name, v in zip(_TRANSLATION, t, strict=True)}
    return {
        "header": _header(edge.parent),
        "child_frame_id": edge.child,
        "transform": {"translation": translation, "rotation": rotation},
    }


def _intrinsics(frame: str, camera: Camera) -> dict[str, Any]:
    return {
        "header": _header(frame),
        "height": camera.height_px,
        "width": camera.width_px,
        "distortion_model": camera.model,
        "D": [float(v) for v in camera.D],
        "K": [float(v) for v in camera.K.reshape(-1)],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [float(v) for row in camera.K for v in (*row, 0.0)],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def _tree(files: Files) -> TransformTree:
    tree = TransformTree()
    for file, content in files.items():
        held = load_yaml(file, content)
        if isinstance(held, dict) and "transform" not in held and "K" in held:
            continue  # camera intrinsics, stored beside the extrinsics
        parent, child = field_of(file, held, "header", "frame_id"), field_of(file, held, "child_frame_id")
        q = [number_of(file, held, "transform", "rotation", n) for n in _ROTATION]
        t = [number_of(file, held, "transform", "translation", n) for n in _TRANSLATION]
        names = require_frames(file, parent, child)
        tree.add_transform(*names, pose_of_quaternion(file, "transform.rotation", q, t))
    return tree


APOLLO = Format("apollo", _write, tree=_tree)
