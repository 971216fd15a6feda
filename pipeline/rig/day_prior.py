"""Prior of a vehicle-day: from logged tf_static or from a file; perturbed for tests."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.rigs import CameraPrior, SensorPrior
from pipeline.rig.estimates import Prior
from pipeline.rig.prior import RigPrior, Star, agreed, from_rows, middle_of
from pipeline.rig.prior_file import read_star
from pipeline.rig.rig import Rig
from pipeline.rig.se3 import perturb_exactly
from schemas.calibrations import FRAMES_OF_PAIR, SENSORS, pairs_of
from schemas.observations import Observation

__all__ = [
    "no_prior",
    "perturbed",
    "prior_key",
    "prior_of_three",
    "read_prior",
    "require_named_files",
    "rig_prior",
]


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


def perturbed(prior: Prior, perturb: tuple[float, float] | None, seed: int) -> Prior:
    """The prior with all transforms moved by an exact angle [deg] and shift [m]; sigmas at least as large.

    The sigmas become max(configured sigma, size of the perturbation): the size is known, like the tolerance
    of a workshop, but the direction is not.
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
