"""Prior of a vehicle-day: from logged tf_static or from a file; perturbed for tests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.rigs import CameraPrior, SensorPrior
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import Sensor
from pipeline.rig.prior import RigPrior, Star, agreed, from_rows, middle_of
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import inverse
from schemas.calibrations import FRAMES_OF_PAIR, SENSORS, pairs_of
from schemas.observations import Observation

__all__ = [
    "no_prior", "prior_key", "prior_of_three", "read_prior", "read_star", "read_transforms",
    "require_named_files", "rig_prior",
]  # fmt: skip

_KEYS = {"T_camera_lidar", "T_lidar_radar", "T_radar_lidar", "T_camera_radar"}
_SAME = 1e-6  # rad and m: tolerance for written numbers, which have no noise


def read_prior(observations: Sequence[Observation], fleet: FleetConfig, vehicle: str) -> Prior:
    """The prior of one camera, lidar and radar (`Rig.one_of_each`), from the logs or from the rig's file.

    Raises:
        SolveError: no frame has a tf_static prior, or it changes over the day.
        ConfigError: unknown vehicle, or the prior file cannot be read.
    """
    rig = fleet.rig_of(vehicle)
    names = _only(rig)
    stars = _carried(observations, [name or kind for name, kind in zip(names, SENSORS, strict=True)])
    return prior_of_three(_prior(lambda: agreed(stars), fleet, rig), rig, *names)


def rig_prior(rows: Iterable[Mapping[str, Any]], fleet: FleetConfig, rig: Rig) -> RigPrior:
    """The prior of all sensors of a rig, from the logs or from the rig's file.

    Args:
        rows: `schemas.moments.PRIOR` of ingest's manifest.

    Raises:
        SolveError: the logs have no transform between any two sensors, or one changes over the day.
        ConfigError: the prior file cannot be read, or belongs to another rig.
    """
    return _prior(lambda: from_rows(rows), fleet, rig)


def _prior(logged: Callable[[], Star], fleet: FleetConfig, rig: Rig) -> RigPrior:
    file = rig.prior.file
    T = logged() if file is None else read_star(fleet.path_of(file), rig)
    if not T:
        raise SolveError(no_prior("any pair"))
    nodes = {node.name: node for node in rig.nodes}
    sigmas = {name: _sigmas(rig.prior_of(name)) for name in nodes}
    reference = middle_of(rig.nodes) if rig.reference is None else nodes[rig.reference]
    return RigPrior(rig.nodes, reference, T, sigmas)


def prior_of_three(
    prior: RigPrior, rig: Rig, camera: str | None, lidar: str | None, radar: str | None
) -> Prior:
    """The prior of one camera, one lidar and one radar, for three-sensor methods; None = without that sensor.

    Its sigmas are those of the least certain transform.
    """
    names = {"camera": camera, "lidar": lidar, "radar": radar}
    T, sigmas = dict[str, np.ndarray](), list[tuple[float, float]]()
    for pair in pairs_of([kind for kind, name in names.items() if name is not None]):
        a, b = (names[kind] or "" for kind in FRAMES_OF_PAIR[pair])
        known = prior.between(a, b)
        if known is not None:
            T[pair] = known
            # Camera-radar follows from the other two if the lidar's pose is known.
            sigmas += [prior.sigmas_between(a, b)] if pair != "camera_radar" else []
    if not sigmas and "camera_radar" in T:
        sigmas = [prior.sigmas_between(camera or "", radar or "")]
    unknown = np.full((4, 4), np.nan)
    return Prior(
        T.get("camera_lidar", unknown),
        T.get("lidar_radar", unknown),
        max((s for s, _ in sigmas), default=np.nan),
        max((s for _, s in sigmas), default=np.nan),
        camera=CameraPrior() if camera is None else rig.cameras[camera].known,
        T_camera_radar_alone=T.get("camera_radar") if len(T) == 1 else None,
    )


def _carried(observations: Sequence[Observation], names: Sequence[str]) -> list[Star]:
    """Transforms in the logs of observations; observations from one log have the same."""
    ends = {
        pair: tuple(names[SENSORS.index(kind)] for kind in kinds) for pair, kinds in FRAMES_OF_PAIR.items()
    }
    carried = {id(o.priors): o.priors for o in observations}.values()
    return [{(ends[p][0], ends[p][1]): T for p, T in priors.items()} for priors in carried]


def no_prior(pair: str) -> str:
    """Reason for refusing a day or a pair without a prior."""
    return f'no prior: the logs have no tf_static chain for {pair}; give prior.source = "file"'


def prior_key(fleet: FleetConfig, vehicle: str) -> str:
    """Hash of the prior file's content, for the work key; empty if the prior is logged."""
    file = fleet.rig_of(vehicle).prior.file
    if file is None:
        return ""
    path = fleet.path_of(file)
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as err:
        raise ConfigError(str(fleet.file), "prior.file", f"cannot read {path}: {err.strerror}") from err


def require_named_files(fleet: FleetConfig) -> None:
    """Raise ConfigError for a missing model or prior file, before the first log is opened."""
    fleet.require_files()
    for rig in {v.rig for v in fleet.vehicles.values()}:
        file = fleet.rigs[rig].prior.file
        if file is not None:
            read_star(fleet.path_of(file), fleet.rigs[rig])


def _sigmas(prior: SensorPrior) -> tuple[float, float]:
    """Sigmas of rotation [rad] and translation [m]."""
    assert prior.rotation_sigma_deg is not None
    assert prior.translation_sigma_m is not None
    return float(np.radians(prior.rotation_sigma_deg)), prior.translation_sigma_m


def _only(rig: Rig) -> tuple[str | None, str | None, str | None]:
    """Names of the only sensor of each kind, or of the rig's `three`; ConfigError if there is neither."""
    names = rig.one_of_each("this")
    return names.get("camera"), names.get("lidar"), names.get("radar")


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
