"""Kalibr's camera chain, with keys T_cam_SENSOR added for other sensors (T_cam_lidar, T_cam_radar).

Source: ethz-asl/kalibr wiki "Yaml formats" and kalibr_common/ConfigReader.py (counts the keys of the file as
cameras, so all entries are under cam0, cam1, ...); T_cam_lidar as in Oxford Spires.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames, cameras_of, needed_camera
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.texts import field_of, load_yaml, matrix_of, to_yaml
from pipeline.rig.cameras import Camera
from pipeline.rig.graph import Edge, words_of
from pipeline.rig.se3 import inverse

__all__ = ["KALIBR"]

_RADTAN = 4  # k1 k2 p1 p2


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    cameras = cameras_of(calibration, "kalibr")
    chain = {f"cam{k}": _camera(calibration, name) for k, name in enumerate(cameras)}
    for k, (before, name) in enumerate(pairwise(cameras), start=1):
        chain[f"cam{k}"]["T_cn_cnm1"] = calibration.T_between(name, before)
    comments = [
        *comment_lines(calibration),
        "T_cam_x maps coordinates from x to the camera's optical frame; rostopic is only a label",
    ]
    return {"camchain.yaml": to_yaml(chain, comments)}


def _camera(calibration: ExportedCalibration, name: str) -> dict[str, Any]:
    camera = needed_camera(calibration, "kalibr", name)
    model, coefficients = _distortion(name, camera)
    fx, fy = camera.focal_px
    cx, cy = camera.centre_px
    cam: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": [fx, fy, cx, cy],
        "distortion_model": model,
        "distortion_coeffs": coefficients,
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{calibration.names.of(name)}/image_raw",
        "cam_overlaps": [],
    }
    others = {s.name: calibration.T_between(name, s.name) for s in calibration.sensors if s.kind != "camera"}
    return cam | {f"T_cam_{other}": T for other, T in others.items() if T is not None}


def _distortion(name: str, camera: Camera) -> tuple[str, list[float]]:
    D = [float(v) for v in camera.D]
    if camera.model == "equidistant":
        return "equidistant", D or [0.0] * 4
    if any(D[_RADTAN:]):
        problem = f"{camera.model} with more than k1 k2 p1 p2 is not a model of Kalibr"
        raise ConfigError("export kalibr", f"{name}: distortion", problem)
    return "radtan", [*D[:_RADTAN], *[0.0] * (_RADTAN - len(D))]


def _read(files: Files, edges: Sequence[Edge], names: FrameNames) -> dict[str, np.ndarray]:
    """Transforms relative to the first lidar; cameras by topic, or by order of names if no topic matches."""
    found: dict[str, np.ndarray] = {}
    for file, content in files.items():
        chain = load_yaml(file, content)
        keys = _cameras_in(file, chain, edges, names)
        for edge in edges:
            is_camera = edge.parent.kind == "camera"
            key = keys.get(edge.parent.name) if is_camera else next(iter(keys.values()), "cam0")
            child = f"T_cam_{edge.child.name}"
            if key is None or (edge.child.kind != "lidar" and child not in field_of(file, chain, key)):
                continue
            T = matrix_of(file, f"{key}.{child}", field_of(file, chain, key, child))
            if not is_camera:
                parent = f"T_cam_{edge.parent.name}"
                T = inverse(matrix_of(file, f"{key}.{parent}", field_of(file, chain, key, parent))) @ T
            found[words_of(edge)] = T
    return found


def _cameras_in(file: str, chain: Any, edges: Sequence[Edge], names: FrameNames) -> dict[str, str]:
    """Key in the chain of each camera, by camera name, for the cameras in the chain."""
    cameras = sorted({edge.parent.name for edge in edges if edge.parent.kind == "camera"})
    held = chain if isinstance(chain, dict) else {}
    topics = {key: str(cam.get("rostopic")) for key, cam in held.items() if isinstance(cam, dict)}
    known = {f"/{names.of(name)}/image_raw": name for name in cameras}
    found = {known[topic]: key for key, topic in topics.items() if topic in known}
    if found and len(found) < sum(topic in known for topic in topics.values()):
        raise ConfigError(file, "rostopic", "two cameras have the same topic: a sensor occurs twice")
    if not found and len(cameras) not in (0, 1, len(topics)):
        problem = f"names none of {', '.join(known)}, and there are {len(topics)} cameras: use these topics"
        raise ConfigError(file, "rostopic", problem)
    return found or {name: f"cam{k}" for k, name in enumerate(cameras)}


KALIBR = Format("kalibr", _write, read=_read)
