"""OpenCV's FileStorage (YAML): transforms, covariances and intrinsics, with names as in OpenCV's samples.

Source: OpenCV core/persistence; samples/cpp/tutorial_code/calib3d (image_width, camera_matrix, ...).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.texts import matrix_of, text_of
from pipeline.rig.graph import Edge, words_of

__all__ = ["OPENCV"]


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    for line in comment_lines(calibration):
        storage.writeComment(line)
    storage.write("vehicle", calibration.vehicle)
    storage.write("calibration_source", calibration.source)
    for name, pair in ((pair.identifier, pair) for pair in calibration.pairs.values()):
        storage.write(f"T_{name}", pair.T)
        storage.write(f"status_{name}", pair.status)
        if pair.covariance is not None:
            storage.write(f"covariance_{name}", pair.covariance)
    cameras = [sensor.name for sensor in calibration.sensors if sensor.kind == "camera"]
    for name in cameras:
        camera, of = calibration.cameras.get(name), f"_{name}" * (len(cameras) > 1)
        if camera is not None:
            D = (camera.D if len(camera.D) else np.zeros(4)).reshape(1, -1)
            storage.write(f"image_width{of}", camera.width_px)
            storage.write(f"image_height{of}", camera.height_px)
            storage.write(f"camera_matrix{of}", camera.K)
            storage.write(f"distortion_model{of}", camera.model)
            storage.write(f"distortion_coefficients{of}", D)
    return {"calibration.yaml": storage.releaseAndGetString().encode()}


def _read(files: Files, edges: Sequence[Edge], _names: FrameNames) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for file, content in files.items():
        try:
            storage = cv2.FileStorage(text_of(file, content), cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
            nodes = {edge: storage.getNode(f"T_{edge.parent.name}_{edge.child.name}") for edge in edges}
            values = {words_of(edge): node.mat() for edge, node in nodes.items() if not node.empty()}
        except (cv2.error, SystemError) as err:
            raise ConfigError(file, "", f"not a readable FileStorage: {' '.join(str(err).split())}") from err
        found |= {pair: matrix_of(file, f"T_{pair}", value) for pair, value in values.items()}
    if not found:
        raise ConfigError(", ".join(files), f"T_{edges[0].parent.name}_{edges[0].child.name}", "missing")
    return found


OPENCV = Format("opencv", _write, read=_read)
