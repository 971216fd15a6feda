"""Records of observations in memory, as the stage makes them of a lake's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.calibrate.methods import Solver
from pipeline.calibrate.records import Inputs
from pipeline.calibrate.rig_day import RigDay, calibrate_rig
from pipeline.core.config import FleetConfig
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import EDGE_OF_PAIR, RigGraph, Sensor
from pipeline.rig.prior import RigPrior, middle_of
from pipeline.rig.se3 import perturb_exactly
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["perturbed", "records_of_rows", "rig_prior_of"]


def rig_prior_of(prior: Prior, sensors: Sequence[Sensor]) -> RigPrior:
    """A prior of sensors that are called by their kinds as that of a rig."""
    known = {
        pair: e for pair, e in EDGE_OF_PAIR.items() if set(e.sensors) <= set(sensors) and prior.knows(pair)
    }
    if len(known) == 3:
        del known["camera_radar"]  # it follows from the others
    T = {(e.parent.name, e.child.name): prior.of(pair) for pair, e in known.items()}
    return RigPrior(
        tuple(sensors), middle_of(sensors), T, dict.fromkeys((s.name for s in sensors), prior.sigmas)
    )


def records_of_rows(
    rows: Sequence[Observation], prior: Prior, fleet: FleetConfig, about: Inputs, solver: Solver | None = None
) -> list[CalibrationRecord]:
    """Records of the pairs `about.pairs` of sensors that are called by their kinds."""
    edges = tuple(EDGE_OF_PAIR[pair] for pair in about.pairs)
    sensors = tuple(dict.fromkeys(s for e in edges for s in e.sensors))
    graph, known = RigGraph(sensors, edges, middle_of(sensors)), rig_prior_of(prior, sensors)
    rig = next(iter(fleet.rigs.values()))
    return calibrate_rig(
        RigDay(rig, graph, known, {}, lambda _: list(rows)), fleet, about, solver=solver
    ).records


def perturbed(prior: Prior, perturb: tuple[float, float] | None, seed: int) -> Prior:
    """The prior with all transforms moved by an exact angle [deg] and shift [m]; its sigmas at least as large."""
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
