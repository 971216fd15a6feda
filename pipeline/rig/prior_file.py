"""Prior files: poses of all sensors relative to one, or two matrices for a camera, a lidar and a radar."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ConfigError
from pipeline.rig.graph import Sensor
from pipeline.rig.prior import middle_of
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse
from schemas.calibrations import FRAMES_OF_PAIR, SENSORS, pairs_of

__all__ = ["read_star", "read_transforms"]

_KEYS = {"T_camera_lidar", "T_lidar_radar", "T_radar_lidar", "T_camera_radar"}
_SAME = 1e-6  # rad and m: tolerance for written numbers, which have no noise


def read_star(path: Path, rig: Rig) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Transforms between a rig's sensors, by (parent, child).

    The file has the form {"reference": "top", "T": {"front": 4x4, ...}} with T_reference_sensor, row-major,
    for every sensor of the rig and for `base` if the rig has one. For a rig with one sensor of each kind it
    may have T_camera_lidar and T_lidar_radar instead.

    Raises:
        ConfigError: another form, missing or unknown sensors, or matrices that are not rigid transforms.
    """
    content = _content(path)
    if "T" in content:
        return _star(path, content, [node.name for node in rig.nodes])
    kinds = {str(node.kind): node for node in rig.nodes}
    if len(kinds) < len(rig.nodes) or "base" in kinds:
        wanted = '{"reference": "%s", "T": {...}}' % (rig.reference or middle_of(rig.nodes).name)
        raise ConfigError(str(path), "T", f"missing: {_listed(rig.nodes)} need a file with {wanted}")
    found = read_transforms(path, [node.kind for node in rig.nodes])
    names = {pair: (kinds[a].name, kinds[b].name) for pair, (a, b) in FRAMES_OF_PAIR.items() if pair in found}
    return {names[pair]: T for pair, T in found.items() if len(found) == 1 or pair != "camera_radar"}


def read_transforms(path: Path, sensors: Sequence[str] = SENSORS) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Transforms from a JSON file by pair: T_camera_lidar, T_lidar_radar (or T_radar_lidar), 4x4 row-major.

    In a file with several such objects by name (one per log), all must agree. For a rig with two sensors only
    their transform is read; T_camera_radar may be given as the product of the other two.

    Raises:
        ConfigError: another form, or matrices that are not rigid transforms.
    """
    content = _content(path)
    if "T" in content:
        return _pairs(_star(path, content, sensors), content["reference"], sensors)
    if not _KEYS & content.keys():
        entries = [v for v in content.values() if isinstance(v, dict) and _KEYS & v.keys()]
        found = [_transforms(path, entry, sensors) for entry in entries]
        if not found:
            raise ConfigError(str(path), f"T_{pairs_of(sensors)[0]}", "missing")
        for other in found[1:]:
            if any(np.abs(other[pair] - found[0][pair]).max() > _SAME for pair in other):
                raise ConfigError(str(path), f"T_{pairs_of(sensors)[0]}", "the file's entries disagree")
        return found[0]
    return _transforms(path, content, sensors)


def _content(path: Path) -> dict[str, object]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as err:
        raise ConfigError(str(path), "", f"no readable JSON: {err}") from err
    if not isinstance(content, dict):
        raise ConfigError(str(path), "", "is not a JSON object")
    return content


def _star(
    path: Path, content: Mapping[str, object], nodes: Sequence[str]
) -> dict[tuple[str, str], Float[np.ndarray, "4 4"]]:
    """Poses relative to the reference, for exactly these nodes."""
    reference, given = content.get("reference"), content["T"]
    if not isinstance(reference, str) or reference not in nodes:
        raise ConfigError(str(path), "reference", f"{reference!r} is none of {', '.join(nodes)}")
    if not isinstance(given, dict):
        raise ConfigError(str(path), "T", "is not an object of 4x4 matrices by sensor")
    poses = {name: _rigid(path, f"T.{name}", T) for name, T in given.items()}
    own = poses.pop(reference, np.eye(4))
    if np.abs(own - np.eye(4)).max() > _SAME:
        raise ConfigError(str(path), f"T.{reference}", "is the reference's own pose, and not the identity")
    unknown, missing = sorted(set(poses) - set(nodes)), [n for n in nodes if n not in {*poses, reference}]
    if unknown or missing:
        said = f"has {', '.join(unknown)}, not in the rig" if unknown else f"lacks {', '.join(missing)}"
        raise ConfigError(str(path), "T", said)
    return {(reference, name): poses[name] for name in nodes if name != reference}


def _pairs(
    star: Mapping[tuple[str, str], np.ndarray], reference: object, sensors: Sequence[str]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    pose = {name: T for (_, name), T in star.items()} | {reference: np.eye(4)}
    return {
        pair: inverse(pose[a]) @ pose[b]
        for pair, (a, b) in FRAMES_OF_PAIR.items()
        if pair in pairs_of(sensors)
    }


def _listed(nodes: Sequence[Sensor]) -> str:
    return ", ".join(node.name for node in nodes)


def _transforms(path: Path, entry: Mapping[str, object], sensors: Sequence[str]) -> dict[str, np.ndarray]:
    if "lidar" not in sensors and "T_camera_radar" in entry:
        return {"camera_radar": _rigid(path, "T_camera_radar", entry["T_camera_radar"])}
    found = {}
    if "camera" in sensors:
        found["camera_lidar"] = _rigid(path, "T_camera_lidar", entry.get("T_camera_lidar"))
    if "radar" in sensors and "T_lidar_radar" in entry:
        found["lidar_radar"] = _rigid(path, "T_lidar_radar", entry["T_lidar_radar"])
    elif "radar" in sensors:
        found["lidar_radar"] = inverse(_rigid(path, "T_radar_lidar", entry.get("T_radar_lidar")))
    if len(found) == 2:
        found["camera_radar"] = found["camera_lidar"] @ found["lidar_radar"]
    return {pair: found[pair] for pair in pairs_of(sensors)}


def _rigid(path: Path, key: str, value: object) -> np.ndarray:
    try:
        T = np.array(value, np.float64)
    except (TypeError, ValueError) as err:
        raise ConfigError(str(path), key, "is no 4x4 matrix") from err
    if not np.all(np.isfinite(T)):
        raise ConfigError(str(path), key, "has a number that is not finite")
    if T.shape != (4, 4) or not np.allclose(T[3], [0, 0, 0, 1]):
        raise ConfigError(str(path), key, "is no 4x4 matrix with the last row 0 0 0 1")
    R = T[:3, :3]
    # 1e-3: accepts rotations written with three or four digits.
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise ConfigError(str(path), key, "its upper left 3x3 is no rotation")
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    return T
