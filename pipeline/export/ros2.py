"""ROS 2 static transforms: the same publishers as a Python and as a YAML launch file.

Source: tf2_ros, static_transform_publisher's named arguments (Humble and later); ROS 2 launch, YAML front end.
"""

from __future__ import annotations

import ast
import shlex
from collections.abc import Sequence
from typing import Any

from pipeline.core.errors import ConfigError
from pipeline.export.calibration import ExportedCalibration, Pose, poses_of
from pipeline.export.formats import Files, Format
from pipeline.export.provenance import comment_lines
from pipeline.export.texts import field_of, load_yaml, pose_of_quaternion, text_of, to_yaml
from pipeline.export.tree import require_frames
from pipeline.rig.se3 import to_quaternion
from pipeline.rig.transform_tree import TransformTree

__all__ = ["ROS2"]

_PYTHON, _YAML = "static_transforms.launch.py", "static_transforms.launch.yaml"
_NUMBERS = ("--x", "--y", "--z", "--qw", "--qx", "--qy", "--qz")


def _write(calibration: ExportedCalibration) -> dict[str, bytes]:
    comments = comment_lines(calibration)
    edges = poses_of(calibration)
    nodes = [
        {
            "node": {
                "pkg": "tf2_ros",
                "exec": "static_transform_publisher",
                "name": _node_name(e),
                "args": shlex.join(_arguments(e)),
            }
        }
        for e in edges
    ]
    return {_PYTHON: _python(edges, comments).encode(), _YAML: to_yaml({"launch": nodes}, comments)}


def _python(edges: Sequence[Pose], comments: Sequence[str]) -> str:
    nodes = ",\n".join(
        f"            Node(\n"
        f'                package="tf2_ros",\n'
        f'                executable="static_transform_publisher",\n'
        f"                name={_node_name(edge)!r},\n"
        f"                arguments={_arguments(edge)!r},\n"
        f"            )"
        for edge in edges
    )
    return (
        "".join(f"# {line}\n" for line in comments)
        + "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
        + "def generate_launch_description():\n    return LaunchDescription(\n        [\n"
        + f"{nodes},\n        ]\n    )\n"
    )


def _node_name(edge: Pose) -> str:
    """A ROS node name of letters, digits and underscores."""
    words = f"boresight_{edge.parent}_{edge.child}"
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in words)


def _arguments(edge: Pose) -> list[str]:
    values = [*edge.T[:3, 3], *to_quaternion(edge.T)]
    pairs = [text for name, v in zip(_NUMBERS, values, strict=True) for text in (name, repr(float(v) + 0.0))]
    return [*pairs, "--frame-id", edge.parent, "--child-frame-id", edge.child]


def _tree(files: Files) -> TransformTree:
    tree = TransformTree()
    for file, content in files.items():
        is_python = file.endswith(".py")
        for arguments in (_from_python if is_python else _from_yaml)(file, content):
            _add(file, tree, arguments)
    return tree


def _from_yaml(file: str, content: bytes) -> list[list[str]]:
    nodes = field_of(file, load_yaml(file, content), "launch")
    if not isinstance(nodes, list):
        raise ConfigError(file, "launch", "is not a list of nodes")
    found = []
    for k, entry in enumerate(nodes):
        node = entry.get("node") if isinstance(entry, dict) else None
        if isinstance(node, dict) and node.get("exec") == "static_transform_publisher":
            found.append(shlex.split(str(field_of(file, nodes, k, "node", "args"))))
    return found


def _from_python(file: str, content: bytes) -> list[list[str]]:
    """Lists of literals passed as `arguments=` to Node(...); the file is parsed, not run."""
    try:
        tree = ast.parse(text_of(file, content))
    except (SyntaxError, ValueError, RecursionError) as err:
        raise ConfigError(file, "", f"is not Python: {err}") from err
    found: list[list[str]] = []
    for call in ast.walk(tree):
        if isinstance(call, ast.Call):
            given = {k.arg: k.value for k in call.keywords}
            if "arguments" in given and _literal(given.get("executable")) == "static_transform_publisher":
                arguments = _literal(given["arguments"])
                if not isinstance(arguments, list):
                    raise ConfigError(file, f"line {call.lineno}: arguments", "is not a list of literals")
                found.append([str(a) for a in arguments])
    return found


def _literal(node: ast.expr | None) -> Any:
    try:
        return None if node is None else ast.literal_eval(node)
    except ValueError:  # not a literal
        return None


def _add(file: str, tree: TransformTree, arguments: Sequence[str]) -> None:
    given = dict(zip(arguments[::2], arguments[1::2], strict=False))
    values = []
    for name in _NUMBERS:
        try:
            values.append(float(given[name]))
        except (KeyError, ValueError) as err:
            problem = "missing" if isinstance(err, KeyError) else f"{given[name]!r} is not a number"
            raise ConfigError(file, name, problem) from err
    parent, child = require_frames(file, given.get("--frame-id"), given.get("--child-frame-id"))
    tree.add_transform(parent, child, pose_of_quaternion(file, "--qw", values[3:], values[:3]))


ROS2 = Format("ros2", _write, tree=_tree)
