"""Method `joint`: each pair from its two sensors alone; the adjustment combines them.

No evidence enters two pairs: vehicle boxes belong to camera-radar alone. One number is passed on:
camera-lidar's time offset moves the cloud along the driving direction, which in lidar axes comes from the
radar's Doppler (`objective/ego_motion`), with the uncertainty of the radar's rotation. If a sensor is
missing, the other pairs are solved as they are: camera-lidar along the lidar's own x axis. A CameraInfo that
the day contradicts holds camera-lidar, because its pose depends on it; a principal point, camera-radar too.

Camera-radar, without the lidar, is solved here: moving clusters against boxes in azimuth, detections in boxes in
elevation. The translation stays at the prior (angles of far objects hardly depend on it). The azimuth has a sigma of a
quarter of a degree, so this pair alone is held. In the adjustment it checks the lidar's pairs and determines a radar's
roll.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar, analyse_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import contradictions
from pipeline.calibrate.joint.lidar_radar.elevation_errors import tempered
from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.calibrate.numerics.covariance import Posterior, covariance_with_fixed, posterior
from pipeline.calibrate.numerics.frame_blocks import blocks_of
from pipeline.calibrate.numerics.nuisances import (
    BOX_ELEVATION_GATES_RAD,
    BOX_ROLL_FLOOR_CAMERA_RAD,
    CAMERA_RADAR_BIAS,
    PRIOR_CONTRADICTION_SIGMAS,
    Considered,
    estimate_biases,
)
from pipeline.calibrate.reasons import because
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.objective.ego_motion import mean_heading, shown_heading
from pipeline.objective.radar.moving_clusters import (
    MATCH_RAD,
    MovingClusters,
    azimuth_equations_camera,
    camera_azimuth_residuals,
    moving_clusters,
)
from pipeline.objective.radar.vehicle_boxes import (
    BIAS_SIGMA_RAD,
    BOX_CLASSES,
    VehicleBoxes,
    box_equations,
    box_pairs,
    vehicle_boxes,
)
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution, common_of
from pipeline.rig.se3 import (
    change_jacobian,
    compose_covariance,
    exp_so3,
    from_rotation_translation,
    inverse,
    log_so3,
)
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["estimate_camera_radar", "solve_joint"]

# Sigmas of priors where `terms` leaves time offsets or the position prior out.
_NO_OFFSET_S, _ANYWHERE_M = 1e-4, 10.0
# The radar's turn gives the heading: lidar-radar comes first.
_ORDER = ("lidar_radar", "camera_lidar", "camera_radar")

_Found = tuple[PairEstimate, list[Check]]


def solve_joint(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig, *, seed: int,
    triggered: Sequence[str] = PAIRS, progress: Progress = silent,
) -> Solution:  # fmt: skip
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
    pair: str, observations: Sequence[Observation], prior: Prior, config: SolveConfig, seed: int,
    before: Mapping[str, _Found],
) -> _Found:  # fmt: skip
    rng = np.random.default_rng([seed, ("camera_lidar", "lidar_radar", "camera_radar").index(pair)])
    if pair == "lidar_radar":
        return estimate_lidar_radar(observations, prior, config, rng), []
    if pair == "camera_radar":
        lidar = before.get("camera_lidar", (None, []))[1]
        turned = [check for check in lidar if check.fault == "camera_info" and check.error is not None]
        return estimate_camera_radar(observations, prior, config, rng, boxes="boxes" in config.terms), turned
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


_BOX_FLOOR = np.array([0.0, 0.0, BOX_ROLL_FLOOR_CAMERA_RAD, 0.0, 0.0, 0.0, *[0.0] * len(BOX_CLASSES)])
_YAW = 1  # of a turn about the camera's axes: its vertical
_FIXED = np.arange(6 + len(BOX_CLASSES)) // 3 == 1  # the position: angles of far objects hardly depend on it


# Scan about the camera's vertical: step, reach in search ranges, and clusters that a turn at the end of the range
# must match more than none.
_SCAN_STEP_RAD, _SCAN_REACH, _SCAN_PRIOR = np.radians(0.5), 1.2, 2.0
# A turn so far from the best one leaves the azimuth open where both match about as many clusters: less than so many of
# the matches' own sigmas apart. Tuned on 60 edges (seeds 7101 to 7127, 7401, 7423, a real car): by 1.46 and more,
# azimuths were right; by .94 and less, up to 7 deg off: on highways by traffic in the next lane, of side cameras by
# too few matches.
_RIVAL_APART_RAD, _RIVAL_SIGMAS = np.radians(2.0), 1.2
# Then one Newton step per gate, each no longer than some rad.
_AZIMUTH_GATES_RAD = np.radians([4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0])
_STEPS_AT_FIRST_BOX_GATE, _MAX_STEP_RAD = 4, 0.05


@dataclass(frozen=True, eq=False)
class _Seen:
    """Objects in view of both camera and radar in the day's frames."""

    observations: Sequence[Observation]
    clusters: MovingClusters
    boxes: VehicleBoxes


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations by (rotation about the radar, shift, box biases), and further results."""

    H: np.ndarray  # F P P
    g: np.ndarray  # F P
    box_sigma_rad: float
    azimuth_sigma_rad: float
    boxes: int


def estimate_camera_radar(
    observations: Sequence[Observation], prior: Prior, config: SolveConfig, rng: np.random.Generator, *,
    boxes: bool = True,
) -> PairEstimate:  # fmt: skip
    """Estimate the rotation of T_camera_radar from objects in view of both camera and radar, without the lidar.

    Args:
        boxes: whether elevations in vehicle boxes take part; without them pitch and roll stay at the prior.
    """
    seen = _Seen(observations, moving_clusters(observations), vehicle_boxes(observations if boxes else []))
    prior_covariance = prior.covariance("camera_radar")
    before = np.append(np.diag(prior_covariance), np.full(len(BOX_CLASSES), BIAS_SIGMA_RAD**2))
    T_start, rival, sigmas = _scan_azimuth(seen.clusters, prior.T_camera_radar, config)
    T, last = _solve_camera_radar(seen, prior.T_camera_radar, T_start, before)
    block = blocks_of(observations, config.bootstrap_blocks)
    information = last.H.sum(0) + np.diag(1 / before)
    covariance = covariance_with_fixed(last.H, last.g, before, information, _FIXED, block, rng)[:6, :6]
    # Left perturbations about the camera carry the radar along; these were turns about the radar.
    J = np.linalg.inv(change_jacobian(T))
    after = posterior(covariance, prior_covariance, CAMERA_RADAR_BIAS)
    notes = [because("no shift")]
    if sigmas < _RIVAL_SIGMAS:
        after = _with_open_azimuth(after, prior_covariance)
        notes.append(because("azimuth open", share=rival))
    frames = len(np.unique(seen.clusters.frame))
    diagnostics = {
        "box_sigma_rad": last.box_sigma_rad,
        "azimuth_sigma_rad": last.azimuth_sigma_rad,
        "boxes": float(last.boxes),
        "moving_clusters": float(seen.clusters.count),
        "rival_share": rival,
    }
    common = common_of(after.covariance, prior_covariance, np.diag(CAMERA_RADAR_BIAS**2))
    return PairEstimate(
        "camera_radar", T, J @ after.covariance @ J.T, after.observability, after.observable, frames,
        {"no moving cluster": len(observations) - frames},
        diagnostics={k: v for k, v in diagnostics.items() if np.isfinite(v)},
        notes=notes,
        common_covariance=J @ common @ J.T,
        **estimate_biases([Considered("boxes", np.diag(CAMERA_RADAR_BIAS * after.observable))], J),
    )  # fmt: skip


def _with_open_azimuth(after: Posterior, prior_covariance: np.ndarray) -> Posterior:
    """The result with the prior uncertainty of the rotation about the camera's vertical."""
    covariance, observability = after.covariance.copy(), after.observability.copy()
    covariance[_YAW, :] = covariance[:, _YAW] = 0.0
    covariance[_YAW, _YAW] = prior_covariance[_YAW, _YAW]
    observability[_YAW] = 0.0
    observable = after.observable & (np.arange(6) != _YAW)
    return replace(after, covariance=covariance, observability=observability, observable=observable)


def _solve_camera_radar(
    seen: _Seen, T0: np.ndarray, T_start: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, _Equations]:
    """The pose after all gates, and the equations at the last one."""
    T, bias = T_start, np.zeros(len(BOX_CLASSES))
    for k in range(len(_AZIMUTH_GATES_RAD)):
        equations = _equations(seen, T, bias, k)
        x = np.concatenate([log_so3(T[:3, :3] @ T0[:3, :3].T), np.zeros(3), bias])
        # A prior that the data contradict by many sigmas loses weight (Cauchy); along an axis that they do not
        # determine, it keeps it.
        weight = np.diag(1 / before / (1 + x**2 / before / PRIOR_CONTRADICTION_SIGMAS**2))
        step = np.zeros(len(x))
        at = np.ix_(~_FIXED, ~_FIXED)
        gradient = equations.g.sum(0) + weight @ x
        step[~_FIXED] = -np.linalg.solve((equations.H.sum(0) + weight)[at], gradient[~_FIXED])
        step *= min(1.0, _MAX_STEP_RAD / max(float(np.abs(step).max()), 1e-9))
        T = from_rotation_translation(exp_so3(step[:3]) @ T[:3, :3], T0[:3, 3])
        bias = bias + step[6:]
    return T, equations


def _scan_azimuth(
    clusters: MovingClusters, T0: np.ndarray, config: SolveConfig
) -> tuple[np.ndarray, float, float]:
    """The rotation about the camera's vertical at which most moving clusters match a box, near ones first.

    Also returns the matches of the best other rotation: as a share of this one's, and by how many sigmas fewer.
    """
    reach = np.radians(_SCAN_REACH * config.search_rotation_deg)
    turns = np.arange(-np.ceil(reach / _SCAN_STEP_RAD), np.ceil(reach / _SCAN_STEP_RAD) + 1) * _SCAN_STEP_RAD
    poses = [
        from_rotation_translation(exp_so3(np.array([0.0, a, 0.0])) @ T0[:3, :3], T0[:3, 3]) for a in turns
    ]
    scores = []
    for T, turn in zip(poses, turns, strict=True):
        residual, _, _ = camera_azimuth_residuals(clusters, T, 3 * MATCH_RAD)
        # The search box as a weak prior: chance matches must not decide where nothing moves.
        prior = _SCAN_PRIOR * (turn / reach) ** 2
        scores.append(float(np.sum(1 / (1 + (residual / MATCH_RAD) ** 2))) - prior)
    best = int(np.argmax(scores))
    elsewhere = np.abs(turns - turns[best]) >= _RIVAL_APART_RAD
    rival = max((s for s, far in zip(scores, elsewhere, strict=True) if far), default=0.0)
    most, other = max(scores[best], 0.0), max(rival, 0.0)
    both = max(most + other, 1.0)
    return poses[best], other / max(most, 1.0), (most - other) / both**0.5


def _equations(seen: _Seen, T: np.ndarray, bias: np.ndarray, step: int) -> _Equations:
    """Equations of boxes and moving clusters at a pose; `step` chooses the gates."""
    F = len(seen.observations)
    gate = BOX_ELEVATION_GATES_RAD[min(step // _STEPS_AT_FIRST_BOX_GATE, 1)]
    pairs = box_pairs(seen.boxes, T, float(gate))
    Hb, gb, box_sigma = box_equations(pairs, T, bias, F)
    Ha, ga, azimuth_sigma = azimuth_equations_camera(seen.clusters, T, float(_AZIMUTH_GATES_RAD[step]))
    about_radar = np.eye(Hb.shape[1])
    about_radar[:6, :6] = np.linalg.inv(change_jacobian(T))
    # Azimuths determine yaw: on roll and pitch they depend only by the heights of clusters, which are guesses.
    # Elevations in boxes determine pitch and roll, and roll no better than the choice of a box's detections allows; not
    # yaw, for boxes were matched by azimuth at this pose.
    only_yaw, only_elevation = about_radar.copy(), about_radar.copy()
    only_yaw[:, [0, 2]], only_elevation[:, 1] = 0.0, 0.0
    Hb, gb = tempered(only_elevation.T @ Hb @ only_elevation, gb @ only_elevation, np.diag(_BOX_FLOOR**2))
    A = only_yaw[:6, :6]
    Hb[:, :6, :6] += A.T @ Ha @ A
    gb[:, :6] += ga @ A
    return _Equations(Hb, gb, box_sigma, azimuth_sigma, pairs.count)
