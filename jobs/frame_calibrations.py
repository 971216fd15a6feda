"""Calibrations for exported frames: a vehicle's state, a day's records, or the prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jobs.calibration_sources import pairs_to, read_calibration
from pipeline.core.config import FleetConfig
from pipeline.core.errors import ConfigError, SolveError
from pipeline.export.calibration import sigmas_of
from pipeline.learn.frames.frame import Mounting
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.graph import BASE
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested
from schemas.moments import PRIOR

__all__ = ["mounting_of"]


def mounting_of(
    lake: Lake,
    fleet: FleetConfig,
    day: Partition,
    kind: str,
    method: str,
    sensors: Sequence[str],
    *,
    force: bool,
) -> Mounting:
    """Poses of the named sensors (no name: all) on one vehicle-day, from the chosen kind of calibration.

    Raises:
        ConfigError: there is no such calibration, or the rig has no sensor of that name.
        SolveError: fewer than two sensors have a pose, or the state starts after that day.
    """
    rig = fleet.rig_of(day.vehicle)
    unknown = [name for name in sensors if name not in rig.sensors]
    if unknown:
        problem = f"no {', '.join(unknown)}: the rig of {day.vehicle} has {', '.join(rig.sensors)}"
        raise ConfigError("command line", "sensor", problem)
    of_prior = kind == "prior"
    found = _of_prior(lake, fleet, day) if of_prior else _of_calibration(lake, day, kind, method, force=force)
    T = {n: T for n, T in found.T.items() if not sensors or n in sensors}
    if len(T) < 2:
        problem = f"{found.source} has poses of {', '.join(T) or 'no sensor'}, and a frame needs two"
        raise SolveError(problem)
    return replace(found, T=T)


def _of_prior(lake: Lake, fleet: FleetConfig, day: Partition) -> Mounting:
    manifest, rig = ingested(lake, day), fleet.rig_of(day.vehicle)
    prior = rig_prior((manifest.extra if manifest else {}).get(PRIOR, ()), fleet, rig)
    reference = prior.reference.name
    T = {n: T for n in rig.sensors if (T := prior.between(reference, n)) is not None}
    about = {}
    for name in T:
        turn, shift = prior.sigmas_between(reference, name) if name != reference else (0.0, 0.0)
        about[name] = _about("prior", [float(np.degrees(turn))] * 3, [shift] * 3)
    without = {name: "no transform joins it to the others" for name in rig.sensors if name not in T}
    return Mounting(f"prior of {day.day}", reference, T, about, prior.between(BASE.name, reference), without)


def _of_calibration(lake: Lake, day: Partition, kind: str, method: str, *, force: bool) -> Mounting:
    of_day = day.day if kind == "day" else None
    found = read_calibration(str(lake), day.vehicle, of_day, method, force=force)
    reference = found.reference.name
    T, about = {reference: np.eye(4)}, {reference: _about("reference", [0.0] * 3, [0.0] * 3)}
    for sensor in (s.name for s in found.sensors if s.name != reference):
        pose = found.between(reference, sensor)
        if pose is None:
            continue
        pairs, status = pairs_to(found, sensor)
        for since in (pair.details.get("since") for pair in pairs):
            if since and str(since) > day.day:
                counts = f"{found.source} counts since {since} (--calibration day takes each day's own)"
                raise SolveError(f"{sensor} moved: {counts}")
        sigma = list((sigmas_of(*pose) or {}).values())
        T[sensor] = pose[0]
        about[sensor] = _about(status, [float(np.degrees(s)) for s in sigma[:3]] or None, sigma[3:] or None)
        if at_prior := sorted({dof for pair in pairs for dof in pair.at_prior}):
            about[sensor] |= {"kept_at_prior": at_prior}  # or no check covers them
    return Mounting(found.source, reference, T, about, found.T_base, dict(found.left_out))


def _about(
    status: str, rotation_deg: list[float] | None, translation_m: list[float] | None
) -> dict[str, Any]:
    return {"status": status, "sigma_rotation_deg": rotation_deg, "sigma_translation_m": translation_m}
