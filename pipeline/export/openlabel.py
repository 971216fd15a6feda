"""ASAM OpenLABEL 1.0: coordinate systems and streams; provenance under metadata, sigma with each pose.

`pose_wrt_parent` maps coordinates from child to parent: X_parent = pose X_child.

Source: ASAM OpenLABEL 1.0.0, section 7.8 and JSON schema.
"""

from __future__ import annotations

from typing import Any

from pipeline.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, poses_of, sigmas_of
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import provenance_of
from pipeline.export.texts import field_of, load_json, matrix_of, number_of, pose_of_quaternion, to_json
from pipeline.export.tree import require_frames
from pipeline.geometry.cameras import Camera
from pipeline.geometry.transform_tree import TransformTree

__all__ = ["OPENLABEL"]

_FEWEST_COEFFICIENTS = 5  # fewest distortion_coeffs that the schema allows


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    edges, names = poses_of(calibration), calibration.names
    root_type = "sensor_cs" if calibration.T_base is None else "local_cs"
    systems: dict[str, dict[str, Any]] = {calibration.root: {"type": root_type, "parent": "", "children": []}}
    for edge in edges:
        systems[edge.parent]["children"].append(edge.child)
        systems[edge.child] = {
            "type": "sensor_cs",
            "parent": edge.parent,
            "children": [],
            "pose_wrt_parent": {"matrix4x4": [float(v) + 0.0 for v in edge.T.reshape(-1)]},
            "sigma": sigmas_of(edge.T, edge.covariance),
        }
    present = {names.of(calibration.reference.name), *(edge.child for edge in edges)}
    streams: dict[str, dict[str, Any]] = {}
    for sensor in calibration.sensors:
        name, camera = names.of(sensor.name), calibration.camera_of(sensor.name)
        if name in present:
            streams[name] = {"type": sensor.kind, "uri": "", "description": f"coordinate system {name}"}
            streams[name] |= {} if camera is None else {"stream_properties": _intrinsics(camera)}
    metadata = {
        "schema_version": "1.0.0",
        "annotator": f"Boresight {calibration.code_version}",
        "comment": f"{calibration.vehicle}, {calibration.source}; pose_wrt_parent: X_parent = pose X_child",
        "boresight": provenance_of(calibration),
    }
    content = {"metadata": metadata, "coordinate_systems": systems, "streams": streams}
    return {"openlabel.json": to_json({"openlabel": content})}


def _intrinsics(camera: Camera) -> dict[str, Any]:
    D = [float(v) for v in camera.D]
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    if camera.model == "equidistant":
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
        optics = {"focal_length_x": fx, "focal_length_y": fy, "center_x_px": cx, "center_y_px": cy}
        return {"intrinsics_fisheye": size | optics | {"lens_coeffs": D or [0.0] * 4}}
    matrix = [float(v) for row in camera.K for v in (*row, 0.0)]
    coefficients = [*D, *[0.0] * (_FEWEST_COEFFICIENTS - len(D))]
    return {"intrinsics_pinhole": size | {"camera_matrix": matrix, "distortion_coeffs": coefficients}}


def _tree(files: Files) -> TransformTree:
    tree = TransformTree()
    for file, content in files.items():
        held = load_json(file, content)
        key = "vcd" if isinstance(held, dict) and "vcd" in held else "openlabel"
        if key == "vcd":
            problem = "some drafts before OpenLABEL 1.0 store inverse poses; convert the file first"
            raise ConfigError(file, "vcd", problem)
        systems = field_of(file, held, key, "coordinate_systems")
        if not isinstance(systems, dict):
            raise ConfigError(file, "openlabel.coordinate_systems", "is no object")
        for child in systems:
            parent = field_of(file, systems, child, "parent")
            if parent:
                _add(file, tree, systems, *require_frames(file, parent, child))
    return tree


def _add(file: str, tree: TransformTree, systems: Any, parent: str, child: str) -> None:
    pose = field_of(file, systems, child, "pose_wrt_parent")
    where = f"{child}.pose_wrt_parent"
    if isinstance(pose, dict) and "quaternion" in pose:
        x, y, z, w = (number_of(file, systems, child, "pose_wrt_parent", "quaternion", i) for i in range(4))
        t = [number_of(file, systems, child, "pose_wrt_parent", "translation", i) for i in range(3)]
        T = pose_of_quaternion(file, f"{where}.quaternion", [w, x, y, z], t)
    elif isinstance(pose, dict) and "euler_angles" in pose:
        raise ConfigError(file, f"{where}.euler_angles", "is not read: give matrix4x4 or a quaternion")
    else:
        values = pose if isinstance(pose, list) else field_of(file, pose, "matrix4x4")
        T = matrix_of(file, where, values)
    tree.add_transform(parent, child, T)


OPENLABEL = Format("openlabel", _write, tree=_tree, holds_provenance=True)
