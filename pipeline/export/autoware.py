"""Autoware's sensor kit: sensor_kit_calibration.yaml, sensors_calibration.yaml, and a xacro.

Children of the kit are links: a camera's link looks along x; the camera's own xacro adds the optical frame
below it. A lidar's `*_base_link` may differ from the frame of its points, as given in the lidar's
description.

Source: autowarefoundation/sample_sensor_kit_launch and tier4/aip_launcher (config/*.yaml,
urdf/sensor_kit.xacro).
"""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.texts import edit_yaml, field_of, load_yaml, number_of, to_yaml
from pipeline.export.tree import T_LINK_OPTICAL, pose_of_rpy, require_frames, rpy_of
from pipeline.export.urdf import xml_of
from pipeline.rig.graph import BASE
from pipeline.rig.se3 import inverse
from pipeline.rig.transform_tree import TransformTree

__all__ = ["AUTOWARE"]

_KIT = "sensor_kit_base_link"
_FIELDS = ("x", "y", "z", "roll", "pitch", "yaw")
_KIT_FILE, _CAR_FILE, _XACRO_FILE = (
    "sensor_kit_calibration.yaml",
    "sensors_calibration.yaml",
    "sensor_kit.xacro",
)


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    """Files of a calibration; the kit is placed at the reference lidar unless the base frame is the kit."""
    T_base_lidar, base = calibration.T_base, calibration.names.of(BASE.name)
    lidar = calibration.names.of(calibration.reference.name)
    T_kit_lidar = T_base_lidar if base == _KIT else None
    poses = {lidar: np.eye(4) if T_kit_lidar is None else T_kit_lidar}
    poses |= _links(calibration, poses[lidar])
    comments = comment_lines(
        calibration, "pose of the camera's link (x forward, y left, z up), not of its optical frame"
    )
    if T_kit_lidar is None:
        comments.append(f"{_KIT} sits at {lidar}")
    children = {child: _entry(T) for child, T in poses.items()}
    files = {
        _KIT_FILE: to_yaml({_KIT: children}, comments),
        _XACRO_FILE: xml_of(_xacro(list(poses)), comments),
    }
    if T_base_lidar is not None and T_kit_lidar is None:
        files[_CAR_FILE] = to_yaml({base: {_KIT: _entry(T_base_lidar)}}, comments)
    return files


def _links(calibration: ExportedCalibration, T_kit_lidar: np.ndarray) -> dict[str, np.ndarray]:
    """Poses in the kit of camera links and of the other sensors, for the sensors in the calibration."""
    poses, reference = {}, calibration.reference
    for sensor in calibration.sensors:
        T = calibration.T_between(reference.name, sensor.name)
        if T is not None and sensor != reference:
            T_sensor_link = inverse(T_LINK_OPTICAL) if sensor.kind == "camera" else np.eye(4)
            poses[calibration.names.of(sensor.name)] = T_kit_lidar @ T @ T_sensor_link
    return poses


def _update(file: str, content: bytes, calibration: ExportedCalibration) -> tuple[bytes, list[str]]:
    """Write new poses into an existing sensor_kit_calibration.yaml.

    The reference lidar keeps its pose in the kit; entries of other sensors, their order and all comments
    stay.

    Returns:
        The file's new content, and the frames with new poses.

    Raises:
        ConfigError: the file is not a kit with that lidar, or has none of the other sensors.
    """
    names, changed = calibration.names, list[str]()
    lidar = names.of(calibration.reference.name)

    def edit(held: Any) -> None:
        values = np.array([number_of(file, held, _KIT, lidar, name) for name in _FIELDS])
        for child, T in _links(calibration, pose_of_rpy(values[:3], values[3:])).items():
            if child in held[_KIT]:
                field_of(file, held, _KIT, child, "x")
                held[_KIT][child].update(_entry(T))
                changed.append(child)

    text = edit_yaml(file, content, edit)
    if not changed:
        others = [names.of(s.name) for s in calibration.sensors if names.of(s.name) != lidar]
        problem = f"none is in {_KIT}; name them with --frame SENSOR=NAME"
        raise ConfigError(file, ", ".join(others), problem)
    return text, changed


def _entry(T: np.ndarray) -> dict[str, float]:
    values = [*T[:3, 3], *rpy_of(T[:3, :3])]
    return {name: float(v) + 0.0 for name, v in zip(_FIELDS, values, strict=True)}


def _xacro(children: list[str]) -> ET.Element:
    """Xacro with the macro `sensor_kit_macro`, which Autoware's vehicles include; it has links and joints only."""
    robot = ET.Element("robot", {"xmlns:xacro": "http://ros.org/wiki/xacro"})
    macro = ET.SubElement(
        robot, "xacro:macro", name="sensor_kit_macro", params="parent x y z roll pitch yaw config_dir:=."
    )
    ET.SubElement(
        macro,
        "xacro:property",
        name="calibration",
        value=f"${{xacro.load_yaml(config_dir + '/{_KIT_FILE}')}}",
    )
    _joint(macro, "${parent}", _KIT, "${x} ${y} ${z}", "${roll} ${pitch} ${yaw}")
    for child in children:
        given = [f"${{calibration['{_KIT}']['{child}']['{name}']}}" for name in _FIELDS]
        _joint(macro, _KIT, child, " ".join(given[:3]), " ".join(given[3:]))
    return robot


def _joint(macro: ET.Element, parent: str, child: str, xyz: str, rpy: str) -> None:
    ET.SubElement(macro, "link", name=child)
    joint = ET.SubElement(macro, "joint", name=f"{child}_joint", type="fixed")
    ET.SubElement(joint, "origin", rpy=rpy, xyz=xyz)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)


def _tree(files: Files) -> TransformTree:
    tree = TransformTree()
    for file, content in files.items():
        if file.endswith(".xacro"):
            continue  # it loads the YAML file beside it
        held: Any = load_yaml(file, content)
        if not isinstance(held, dict):
            raise ConfigError(file, "", "is not a map of parent frames")
        for parent, children in held.items():
            if not isinstance(children, dict):
                raise ConfigError(file, str(parent), "is not a map of child frames")
            for child in children:
                names = require_frames(file, parent, child)
                values = np.array([number_of(file, held, parent, child, name) for name in _FIELDS])
                tree.add_transform(*names, pose_of_rpy(values[:3], values[3:]))
    return tree


AUTOWARE = Format("autoware", _write, tree=_tree, update=_update, T_frame_camera=T_LINK_OPTICAL)
