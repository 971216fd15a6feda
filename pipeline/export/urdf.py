"""URDF: a link per frame, a fixed joint per pose; and a xacro macro of both, for a car's own description.

Source: URDF XML specification (origin: xyz [m], rpy [rad] about fixed axes); xacro's macros and properties.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, Pose, poses_of
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.tree import pose_of_rpy, require_frames, rpy_of
from pipeline.rig.transform_tree import TransformTree

__all__ = ["URDF", "XACRO", "joint_of", "xml_of"]

_XACRO = "http://ros.org/wiki/xacro"
_MACRO = "boresight_sensors"


def _write_urdf(calibration: ExportedCalibration) -> dict[str, bytes]:
    robot = ET.Element("robot", name=_identifier(calibration.vehicle))
    edges = poses_of(calibration)
    for name in dict.fromkeys([calibration.root, *(e.child for e in edges)]):
        ET.SubElement(robot, "link", name=name)
    robot.extend(joint_of(edge) for edge in edges)
    return {"sensors.urdf": xml_of(robot, comment_lines(calibration))}


def _write_xacro(calibration: ExportedCalibration) -> dict[str, bytes]:
    """A macro with all links and joints below the root, and one call; the including file has the root."""
    edges = poses_of(calibration)
    robot = ET.Element("robot", {"xmlns:xacro": _XACRO, "name": _identifier(calibration.vehicle)})
    macro = ET.SubElement(robot, "xacro:macro", name=_MACRO, params=f"parent:={calibration.root}")
    for edge in edges:
        ET.SubElement(macro, "link", name=edge.child)
        parent = "${parent}" if edge.parent == calibration.root else edge.parent
        macro.append(joint_of(edge, parent))
    ET.SubElement(robot, "link", name=calibration.root)
    ET.SubElement(robot, f"xacro:{_MACRO}")
    return {"sensors.urdf.xacro": xml_of(robot, comment_lines(calibration))}


def joint_of(edge: Pose, parent: str | None = None) -> ET.Element:
    """Fixed joint of a pose; `parent` = name of the macro parameter that replaces the parent link."""
    joint = ET.Element("joint", name=f"{edge.parent}_to_{edge.child}", type="fixed")
    ET.SubElement(joint, "origin", xyz=_numbers(edge.T[:3, 3]), rpy=_numbers(rpy_of(edge.T[:3, :3])))
    ET.SubElement(joint, "parent", link=parent or edge.parent)
    ET.SubElement(joint, "child", link=edge.child)
    return joint


def xml_of(root: ET.Element, comments: Sequence[str]) -> bytes:
    """Indented document with comments on its first lines; double hyphens are separated."""
    safe = [line.replace("--", "- -").replace("--", "- -") for line in comments]
    for line in reversed(safe):
        root.insert(0, ET.Comment(f" {line} "))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _numbers(values: Float[np.ndarray, " 3"]) -> str:
    return " ".join(repr(float(v) + 0.0) for v in values)


def _identifier(vehicle: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in vehicle)


def _tree(files: Files) -> TransformTree:
    tree = TransformTree()
    for file, content in files.items():
        try:
            # expat limits entity expansion (libexpat 2.4.1 and later) and loads no external entities.
            root = ET.fromstring(content)  # noqa: S314
        except ET.ParseError as err:
            raise ConfigError(file, "", f"not readable XML: {err}") from err
        default = _default_parent(root)
        for joint in root.iter("joint"):
            if joint.get("type") == "fixed":
                _add(file, tree, joint, default)
    return tree


def _default_parent(root: ET.Element) -> str:
    """Default of `${parent}` in Boresight's own macro."""
    macro = root.find(f"{{{_XACRO}}}macro")
    params = macro.get("params", "") if macro is not None else ""
    return params.partition(":=")[2]


def _add(file: str, tree: TransformTree, joint: ET.Element, default: str) -> None:
    where = f"joint {joint.get('name')!r}"
    ends = [joint.find(tag) for tag in ("parent", "child")]
    links = [None if end is None else end.get("link") for end in ends]
    if links[0] == "${parent}":
        links[0] = default
    parent, child = require_frames(file, *links)
    origin = joint.find("origin")
    values = []
    for name in ("xyz", "rpy"):
        text = "0 0 0" if origin is None else origin.get(name, "0 0 0")  # URDF's default
        try:
            numbers = np.array([float(v) for v in text.split()])
        except ValueError as err:
            problem = f"{text!r} is not three numbers; expand xacro's expressions first (`xacro FILE`)"
            raise ConfigError(file, f"{where}: {name}", problem) from err
        if numbers.shape != (3,) or not np.all(np.isfinite(numbers)):
            raise ConfigError(file, f"{where}: {name}", f"{text!r} is not three finite numbers")
        values.append(numbers)
    tree.add_transform(parent, child, pose_of_rpy(*values))


URDF = Format("urdf", _write_urdf, tree=_tree)
XACRO = Format("xacro", _write_xacro, tree=_tree)
