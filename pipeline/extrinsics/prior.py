"""The prior of a vehicle-day: from tf_static as logged, or from a file; moved on purpose for tests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.config import FleetConfig
from pipeline.errors import ConfigError, SolveError
from pipeline.extrinsics.estimates import Prior
from pipeline.geometry.se3 import from_quaternion, inverse, log_se3, perturb_exactly
from pipeline.rigs import CameraPrior, PriorConfig
from schemas.calibrations import PAIRS, SENSORS, pairs_of
from schemas.observations import Observation

__all__ = [
    "logged_prior",
    "no_prior",
    "perturbed",
    "prior_key",
    "read_prior",
    "read_transforms",
    "require_named_files",
]

_QUATERNION, _TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
_KEYS = {"T_camera_lidar", "T_lidar_radar", "T_radar_lidar", "T_camera_radar"}
_SAME = 1e-6  # rad and m: tf_static repeats numbers, it does not measure


def read_prior(observations: Sequence[Observation], fleet: FleetConfig, vehicle: str) -> Prior:
    """The prior of a vehicle as its rig says: logged, or from a file.

    Raises:
        SolveError: no frame carries a tf_static prior, or it changes over the day.
        ConfigError: unknown vehicle, or the prior file cannot be read.
    """
    rig = fleet.rig_of(vehicle)
    config = rig.prior
    camera = CameraPrior() if rig.camera is None else rig.camera.known
    if config.file is None:
        return replace(logged_prior(observations, config), camera=camera)
    return replace(_prior(read_transforms(fleet.path_of(config.file), rig.sensors), config), camera=camera)


def logged_prior(observations: Sequence[Observation], config: PriorConfig) -> Prior:
    """The prior that the logs carry (tf_static), as far to be trusted as the configuration says.

    Raises:
        SolveError: no frame carries one, or it changes over the day.
    """
    logged = {pair: _logged(observations, pair) for pair in PAIRS}
    found = {pair: T for pair, T in logged.items() if T is not None}
    if not found:
        raise SolveError(no_prior("any pair"))
    return _prior(found, config)


def no_prior(pair: str) -> str:
    """What a day or a pair without a prior is refused with."""
    return f'no prior: the logs have no tf_static chain for {pair}; give prior.source = "file"'


def perturbed(prior: Prior, perturb: tuple[float, float] | None, seed: int) -> Prior:
    """The prior moved by an exact angle [deg] and shift [m] on all transforms, with sigmas that allow for it.

    The sigmas become max(configured sigma, size of the perturbation): whoever moves a prior on purpose knows
    how far, as a workshop knows its tolerance, but not which way.
    """
    if perturb is None:
        return prior
    angle, shift = np.radians(perturb[0]), perturb[1]
    rng = np.random.default_rng(seed)
    T_camera_lidar = perturb_exactly(prior.T_camera_lidar, float(angle), shift, rng)
    T_lidar_radar = perturb_exactly(prior.T_lidar_radar, float(angle), shift, rng)
    alone = prior.T_camera_radar_alone
    return replace(
        prior,
        T_camera_lidar=T_camera_lidar,
        T_lidar_radar=T_lidar_radar,
        T_camera_radar_alone=None if alone is None else perturb_exactly(alone, float(angle), shift, rng),
        rotation_sigma_rad=max(prior.rotation_sigma_rad, float(angle)),
        translation_sigma_m=max(prior.translation_sigma_m, shift),
    )


def prior_key(fleet: FleetConfig, vehicle: str) -> str:
    """Hash of the prior file's content for the work key; empty where the prior is logged."""
    file = fleet.rig_of(vehicle).prior.file
    if file is None:
        return ""
    path = fleet.path_of(file)
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as err:
        raise ConfigError(str(fleet.file), "prior.file", f"cannot read {path}: {err.strerror}") from err


def require_named_files(fleet: FleetConfig) -> None:
    """Raise ConfigError for a model or prior that the configuration names and that is missing, or a prior that is none.

    For commands that read logs: before the first one is opened, not after a night.
    """
    fleet.require_files()
    for rig in {v.rig for v in fleet.vehicles.values()}:
        file = fleet.rigs[rig].prior.file
        if file is not None:
            read_transforms(fleet.path_of(file), fleet.rigs[rig].sensors)


def read_transforms(path: Path, sensors: Sequence[str] = SENSORS) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Transforms from a JSON file, by pair: T_camera_lidar and T_lidar_radar (or T_radar_lidar), 4x4 row-major.

    A file of several such objects by name (one per log) must agree with itself. Of a rig with two sensors their
    transform alone is read; T_camera_radar may be given as the product of the other two.

    Raises:
        ConfigError: not such a file, or not rigid transforms.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as err:
        raise ConfigError(str(path), "", f"no readable JSON: {err}") from err
    if not isinstance(content, dict):
        raise ConfigError(str(path), "", "holds no object")
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


def _prior(T: Mapping[str, np.ndarray], config: PriorConfig) -> Prior:
    """The prior with NaN for what is not given."""
    camera_lidar, lidar_radar = (
        T.get(pair, np.full((4, 4), np.nan)) for pair in ("camera_lidar", "lidar_radar")
    )
    return Prior(camera_lidar, lidar_radar, *_sigmas(config), T_camera_radar_alone=T.get("camera_radar"))


def _sigmas(config: PriorConfig) -> tuple[float, float]:
    """Of rotation [rad] and translation [m]."""
    return float(np.radians(config.rotation_sigma_deg)), config.translation_sigma_m


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
        raise ConfigError(str(path), key, "holds a number that is not finite")
    if T.shape != (4, 4) or not np.allclose(T[3], [0, 0, 0, 1]):
        raise ConfigError(str(path), key, "is no 4x4 matrix with the last row 0 0 0 1")
    R = T[:3, :3]
    # 1e-3: calibrations shipped with three or four digits are still meant as rotations.
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise ConfigError(str(path), key, "its upper left 3x3 is no rotation")
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    return T


def _logged(observations: Sequence[Observation], pair: str) -> np.ndarray | None:
    names = [f"prior_{pair}_{part}" for part in (*_QUATERNION, *_TRANSLATION)]
    rows = [[getattr(o, name) for name in names] for o in observations]
    known = np.array([row for row in rows if None not in row], np.float64)
    if not len(known):
        return None
    values = np.unique(known, axis=0)
    T = from_quaternion(values[:, :4], values[:, 4:])
    if np.abs(log_se3(inverse(T[0]) @ T)).max() > _SAME:
        raise SolveError(f"the logged prior of {pair} changes over the day ({len(values)} values)")
    return T[0]
