"""Method `joint`: each pair from its two sensors alone; the adjustment combines them.

No evidence enters two pairs: vehicle boxes belong to camera-radar alone. One number is passed on:
camera-lidar's time offset moves the cloud along the driving direction, which in lidar axes comes from the
radar's Doppler (`objective/ego_motion`), with the uncertainty of the radar's rotation. If a sensor is
missing, the other pairs are solved as they are: camera-lidar along the lidar's own x axis. A CameraInfo that
the day contradicts holds camera-lidar, because its pose depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import contradictions
from pipeline.calibrate.joint.camera_radar import estimate_camera_radar
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.objective.ego_motion import mean_heading, shown_heading
from pipeline.rig.checks import Check
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import compose_covariance, inverse, log_so3
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["solve_joint"]

# Sigmas of priors where `terms` leaves time offsets or the position prior out.
_NO_OFFSET_S, _ANYWHERE_M = 1e-4, 10.0
# The radar's turn gives the heading: lidar-radar comes first.
_ORDER = ("lidar_radar", "camera_lidar", "camera_radar")

_Found = tuple[PairEstimate, list[Check]]


def solve_joint(
    observations: Mapping[str, Sequence[Observation]],
    prior: Prior,
    config: SolveConfig,
    *,
    seed: int,
    triggered: Sequence[str] = PAIRS,
    progress: Progress = silent,
) -> Solution:
    """Solve the pairs that have frames, if triggered; others keep the prior.

    A pair that the day cannot determine keeps its prior too, with a failed check that gives the reason.
    """
    prior, config = _without_terms(prior, config)
    found: dict[str, _Found] = {}
    for done, pair in enumerate(p for p in _ORDER if p in observations):
        progress(done, len(observations), pair.replace("_", "-"))
        found[pair] = PairEstimate.at_prior(pair, prior), []
        if pair in triggered:
            try:
                found[pair] = _solved(pair, observations[pair], prior, config, seed, found)
            except SolveError as err:
                found[pair] = found[pair][0], [Check(err.reason, err.fault)]
    progress(len(observations), len(observations), "done")
    pairs = {pair: found[pair][0] for pair in PAIRS if pair in found}
    checks = {pair: found[pair][1] for pair in pairs if found[pair][1]}
    return _with_loop(Solution("joint", pairs, failed_checks=checks))


def _solved(
    pair: str,
    observations: Sequence[Observation],
    prior: Prior,
    config: SolveConfig,
    seed: int,
    before: Mapping[str, _Found],
) -> _Found:
    rng = np.random.default_rng([seed, ("camera_lidar", "lidar_radar", "camera_radar").index(pair)])
    if pair == "lidar_radar":
        return estimate_lidar_radar(observations, prior, config, rng), []
    if pair == "camera_radar":
        return estimate_camera_radar(observations, prior, config, rng, boxes="boxes" in config.terms), []
    aligned = align_camera_lidar(observations, prior, config, rng)
    heading_rad = _heading_rad(observations, before.get("lidar_radar"), prior)
    found = analyse_camera_lidar(aligned, np.random.default_rng([seed, 3]), heading_rad=heading_rad)
    found = replace(found, disproved=aligned.basin.doubt)
    # Intrinsics of a lost basin have no known accuracy.
    told = [] if found.disproved else contradictions(aligned.intrinsics, prior.camera)
    return found, [*told, *found.failed_checks]


def _with_loop(solution: Solution) -> Solution:
    """The solution with the rotation of its open loop, over the rotations that camera and radar determined.

    Positions are the prior's, so the loop has no shift.
    """
    if len(solution.pairs) < len(PAIRS) or not solution.pairs["camera_radar"].observable[:3].any():
        return solution
    cl, cr, lr = (solution.pairs[pair] for pair in PAIRS)
    known = cr.observable[:3]
    difference = log_so3((cl.T @ lr.T @ inverse(cr.T))[:3, :3])[known]
    variance = np.diag(compose_covariance(cl.T, cl.covariance, lr.covariance) + cr.covariance)[:3][known]
    numbers = cr.diagnostics | {"loop_rotation_sigma_rad": float(np.sqrt(variance.sum()))}
    pairs = solution.pairs | {"camera_radar": replace(cr, diagnostics=numbers)}
    return replace(solution, pairs=pairs, loop_rotation_rad=float(np.linalg.norm(difference)))


def _without_terms(prior: Prior, config: SolveConfig) -> tuple[Prior, SolveConfig]:
    """Time offsets fixed to zero, and a prior without position, where `terms` leaves those out."""
    if "time_offsets" not in config.terms:
        config = config.model_copy(update={"time_offset_sigma_s": _NO_OFFSET_S})
    if "translation_prior" not in config.terms:
        prior = replace(prior, translation_sigma_m=_ANYWHERE_M)
    return prior, config


def _heading_rad(
    observations: Sequence[Observation], lidar_radar: _Found | None, prior: Prior
) -> float | None:
    """Driving direction in lidar axes, from the radar's Doppler and the prior; None if unknown."""
    found = [] if prior.heading is None else [prior.heading]
    if lidar_radar is not None and not lidar_radar[1] and lidar_radar[0].observable[2]:
        shown = shown_heading(observations, lidar_radar[0].T)
        own = [] if shown is None else [(shown, float(np.sqrt(lidar_radar[0].covariance[2, 2])))]
        found = [*own, *found]
    mean = mean_heading(found)
    return None if mean is None else mean[0]
