"""JSON for MATLAB's jsondecode: matrices as rows of equal length, names as identifiers; also a prior.

`rigidtform3d(s.T_camera_lidar)` (R2022b and later) uses column vectors, as the matrix does; the older
`rigid3d` uses row vectors: pass the transpose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, FrameNames
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import provenance_of
from pipeline.export.texts import load_json, matrix_of, to_json
from pipeline.rig.edges import words_of
from pipeline.rig.graph import Edge

__all__ = ["MATLAB"]


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    pairs = calibration.pairs.values()
    content: dict[str, Any] = {f"T_{pair.identifier}": pair.T.tolist() for pair in pairs}
    for pair in pairs:
        if pair.covariance is not None:
            content[f"covariance_{pair.identifier}"] = pair.covariance.tolist()
    cameras = [sensor.name for sensor in calibration.sensors if sensor.kind == "camera"]
    for name in cameras:
        camera = calibration.camera_of(name)
        if camera is not None:
            content["camera" if len(cameras) == 1 else f"camera_{name}"] = {
                "model": camera.model,
                "K": camera.K.tolist(),
                "D": camera.D.tolist(),
                "image_size_px": [camera.height_px, camera.width_px],  # rows first, as MATLAB's ImageSize
            }
    content["provenance"] = provenance_of(calibration)
    return {"calibration.json": to_json(content)}


def _read(files: Files, edges: Sequence[Edge], _names: FrameNames) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for file, content in files.items():
        held = load_json(file, content)
        if not isinstance(held, dict):
            raise ConfigError(file, "", "holds no object")
        keys = {words_of(edge): f"T_{edge.parent.name}_{edge.child.name}" for edge in edges}
        found |= {words: matrix_of(file, key, held[key]) for words, key in keys.items() if key in held}
    if not found:
        raise ConfigError(", ".join(files), f"T_{edges[0].parent.name}_{edges[0].child.name}", "missing")
    return found


MATLAB = Format("matlab", _write, read=_read, holds_provenance=True)
