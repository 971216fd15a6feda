"""Method `tracking`: moving objects tracked by each sensor, tracks paired, each sensor turned to the lidar's.

The baseline of the paper's Table 1. The lidar is the reference: it alone measures an object in all
three dimensions. Camera and radar are each calibrated against it, camera-radar is composed. As in the source
only rotations are calibrated; translations keep the prior and its sigma. Association and alignment take turns
until the pairs stay the same.

Source: Persic, Petrovic, Markovic, Petrovic, "Online multi-sensor calibration based on moving object
tracking", Advanced Robotics 35, 2021 (reference 60 of the paper). Its lidar and camera detectors are 3D
networks; perception's clusters and boxes stand for them here. Known to us are its abstract and outline, not
its constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.covariance import OBSERVABLE, posterior
from pipeline.calibrate.numerics.nuisances import TRACKING_BIAS_RAD
from pipeline.calibrate.reasons import because
from pipeline.calibrate.tracking.association import (
    AlignedBearings,
    Association,
    Bearings,
    Shared,
    align_bearings,
    associate,
    bearing_sigma_rad,
    consistency,
    shared_sightings,
)
from pipeline.calibrate.tracking.object_tracks import (
    Track,
    box_centres,
    camera_tracks,
    lidar_tracks,
    motions,
    moves_over_ground,
    passes_by,
    radar_tracks,
)
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.core.results import Progress, silent
from pipeline.rig.estimates import Check, PairEstimate, Prior, Solution, common_of
from pipeline.rig.se3 import compose_covariance, inverse, log_so3, to_spherical
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["MIN_TRACKS", "PairTracks", "calibrate_pair", "solve_tracking"]

MIN_TRACKS = 5  # pairs of tracks: fewer are no majority that could outvote a wrong one
_ROUNDS = 6  # of association and alignment in turns, at most
_LEAST_ROTATION_SIGMA_RAD = np.radians(0.5)  # gate of later rounds: box against cluster, object by object
# Optical axes to x forward, y left, z up.
_CAMERA_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_SENSOR = {"camera_lidar": "camera", "lidar_radar": "radar"}


@dataclass(frozen=True, eq=False)
class PairTracks:
    """Tracks of the lidar and of one other sensor, each in level axes; `inverted` as in `Bearings`."""

    lidar: Sequence[Track]  # `target_m`: what the other sensor's bearings mean
    other: Sequence[Track]
    level: np.ndarray
    inverted: bool
    elevation: bool


def solve_tracking(
    observations: Mapping[str, Sequence[Observation]], prior: Prior, config: SolveConfig, *, seed: int,
    triggered: Sequence[str] = PAIRS, progress: Progress = silent,
) -> Solution:  # fmt: skip
    """Track, associate, turn: camera and radar against the lidar.

    Args:
        observations: selected frames per pair; tracks are followed through all of them.
        config: not used beyond the interface: the method has no search box.
        triggered: pairs to calibrate; camera_radar follows from the other two. Others keep the prior.

    Raises:
        SolveError: neither the camera nor the radar shares enough moving objects with the lidar.
    """
    del config
    progress(0, 3, "tracks")
    frames = sorted(
        {o.frame_index: o for pair in PAIRS for o in observations[pair]}.values(), key=lambda o: o.stamp_ns
    )
    sensors = _tracked(frames, prior)
    wanted = set(triggered) | ({"camera_lidar", "lidar_radar"} if "camera_radar" in triggered else set())
    pairs: dict[str, PairEstimate] = {}
    failed_checks: dict[str, list[Check]] = {pair: [] for pair in PAIRS}
    for k, pair in enumerate(("camera_lidar", "lidar_radar")):
        progress(1 + k, 3, pair)
        pairs[pair] = PairEstimate.at_prior(pair, prior)
        if pair not in wanted:
            pairs[pair] = replace(pairs[pair], notes=[because("not triggered")])
            continue
        usable = {o.frame_index for o in observations[pair]}
        rows = np.array([i for i, o in enumerate(frames) if o.frame_index in usable])
        try:
            rng = np.random.default_rng([seed, k])
            pairs[pair] = calibrate_pair(pair, sensors[pair], prior, rng, frames=rows)
        except SolveError as err:
            failed_checks[pair].append(Check(err.reason, err.fault))
    failed = [pair for pair in pairs if pair in wanted and failed_checks[pair]]
    if failed and len(failed) == len(wanted & set(pairs)):
        why = (f"{_SENSOR[p]} against lidar: {check.sentence}" for p in failed for check in failed_checks[p])
        raise SolveError("; ".join(why))
    pairs["camera_radar"] = _composed(pairs["camera_lidar"], pairs["lidar_radar"], prior)
    failed_checks["camera_radar"] = [*failed_checks["camera_lidar"], *failed_checks["lidar_radar"]]
    progress(3, 3, "done")
    checks = {p: found for p, found in failed_checks.items() if found}
    return Solution("tracking", {p: pairs[p] for p in PAIRS}, failed_checks=checks)


def calibrate_pair(
    pair: str, tracks: PairTracks, prior: Prior, rng: np.random.Generator, *, frames: np.ndarray | None = None
) -> PairEstimate:
    """Associate and align in turns, from the prior's gate to a narrow one.

    Args:
        tracks: of both sensors.
        frames: rows whose sightings may be used; None = all.

    Raises:
        SolveError: fewer than MIN_TRACKS pairs of tracks.
    """
    T, covariance = prior.of(pair), prior.covariance(pair)
    sigma, before = prior.rotation_sigma_rad, None
    shared = shared_sightings(tracks.lidar, tracks.other)
    for _ in range(_ROUNDS):
        found = associate(shared, _level_transform(T, tracks), sigma, elevation=tracks.elevation)
        bearings, used = _bearings(tracks, shared, found, frames)
        if bearings.tracks < MIN_TRACKS:
            raise SolveError(_too_few(pair, tracks, bearings.tracks))
        aligned = align_bearings(bearings, prior.of(pair), covariance, rng)
        T = aligned.T
        same = before is not None and np.array_equal(before.reference, found.reference)
        if same and before is not None and np.array_equal(before.other, found.other):
            break
        worst = float(np.sqrt(np.diag(aligned.covariance)[_steering(tracks)].max()))
        sigma, before = min(sigma, max(2 * worst, _LEAST_ROTATION_SIGMA_RAD)), found
    if aligned.kept.sum() < MIN_TRACKS:
        counts = {"kept": aligned.kept.sum(), "all": len(aligned.kept)}
        raise SolveError(because("tracks differ", **counts, needed=MIN_TRACKS))
    return _estimate(pair, tracks, prior, bearings, aligned, used)


def _tracked(frames: Sequence[Observation], prior: Prior) -> dict[str, PairTracks]:
    """Tracks of all three sensors: box centres for the camera, centres of points for the radar.

    Radar tracks all move, so only moving lidar tracks can match them; the camera sees parked cars too.
    """
    motion = motions(frames, prior)
    lidar = [t for t in lidar_tracks(frames, motion) if passes_by(t)]
    boxes = [replace(t, target_m=box_centres(t, frames)) for t in lidar]
    moving = [t for t in lidar if moves_over_ground(t)]
    elevation = any(o.radar_has_elevation for o in frames)
    return {
        "camera_lidar": PairTracks(boxes, camera_tracks(frames, motion), _CAMERA_LEVEL, False, True),
        "lidar_radar": PairTracks(moving, radar_tracks(frames), np.eye(3), True, elevation),
    }


def _level_transform(T: np.ndarray, tracks: PairTracks) -> Float[np.ndarray, "4 4"]:
    """From lidar axes to the other sensor's level axes."""
    if tracks.inverted:
        return inverse(T)
    level = np.eye(4)
    level[:3, :3] = tracks.level
    return level @ T


def _steering(tracks: PairTracks) -> list[int]:
    """Axes of the parent frame about which a turn moves bearings ahead: not roll, and not pitch without elevation."""
    if not tracks.inverted:
        return [0, 1]  # optical axes
    return [1, 2] if tracks.elevation else [2]


def _bearings(
    tracks: PairTracks, shared: Shared, found: Association, frames: np.ndarray | None
) -> tuple[Bearings, np.ndarray]:
    """Shared sightings of the paired tracks, and the frame of each."""
    rows, pair = found.sightings, found.pair
    if frames is not None:
        usable = np.isin(shared.of_reference.frame[rows], frames)
        rows, pair = rows[usable], pair[usable]
    seen = to_spherical(shared.of_other.position_m[rows])
    names = np.unique(pair, return_inverse=True)[1].astype(np.int64)
    bearings = Bearings(
        shared.of_reference.target_m[rows], seen[:, : 2 if tracks.elevation else 1], bearing_sigma_rad(seen[:, 2]),
        names, tracks.level, tracks.inverted,
    )  # fmt: skip
    return bearings, shared.of_reference.frame[rows]


def _estimate(
    pair: str, tracks: PairTracks, prior: Prior, bearings: Bearings, aligned: AlignedBearings,
    frame: np.ndarray,
) -> PairEstimate:  # fmt: skip
    before = prior.covariance(pair)
    floor = np.concatenate([TRACKING_BIAS_RAD, np.zeros(3)])
    found = posterior(aligned.covariance, before, floor)
    observability = np.concatenate([found.observability[:3], np.zeros(3)])
    statistic, threshold = consistency(aligned, prior.of(pair), TRACKING_BIAS_RAD)
    turned = log_so3(aligned.T[:3, :3] @ prior.of(pair)[:3, :3].T)
    inlier = aligned.kept[bearings.track]
    diagnostics = {
        "tracks_lidar": float(len(tracks.lidar)),
        "tracks_other": float(len(tracks.other)),
        "tracks_paired": float(bearings.tracks),
        "tracks_agreeing": float(aligned.kept.sum()),
        "sightings": float(inlier.sum()),
        "residual_azimuth_rad": float(aligned.residual_rad[0]),
        "decalibration_statistic": statistic,
        "decalibration_threshold": threshold,
        "turned_rad": float(np.linalg.norm(turned)),
    }
    if tracks.elevation:
        diagnostics["residual_elevation_rad"] = float(aligned.residual_rad[1])
    verdict = "tracks deny" if statistic > threshold else "tracks fit"
    notes = [
        because("rotation only"),
        because(verdict, statistic=statistic, threshold=threshold),
        because("tracks agree", kept=aligned.kept.sum(), all=bearings.tracks),
    ]
    return PairEstimate(
        pair, aligned.T, found.covariance, observability, found.observable & (np.arange(6) < 3),
        len(np.unique(frame[inlier])), diagnostics=diagnostics, notes=notes,
        common_covariance=common_of(found.covariance, before, np.diag(floor**2)),
    )  # fmt: skip


def _composed(camera_lidar: PairEstimate, lidar_radar: PairEstimate, prior: Prior) -> PairEstimate:
    covariance = compose_covariance(camera_lidar.T, camera_lidar.covariance, lidar_radar.covariance)
    before = np.diag(prior.covariance("camera_radar"))
    observability = np.clip(1 - np.diag(covariance) / before, 0.0, 1.0)
    observability[3:] = 0.0
    commons = [e.common_covariance for e in (camera_lidar, lidar_radar) if e.common_covariance is not None]
    return PairEstimate(
        "camera_radar", camera_lidar.T @ lidar_radar.T, covariance, observability, observability >= OBSERVABLE,
        min(camera_lidar.frames_used, lidar_radar.frames_used),
        notes=[because("over lidar"), because("rotation only")],
        common_covariance=compose_covariance(camera_lidar.T, *commons) if len(commons) == 2 else None,
    )  # fmt: skip


def _too_few(pair: str, tracks: PairTracks, paired: int) -> str:
    other = _SENSOR[pair]
    if not tracks.lidar:
        return because("no tracks", other=len(tracks.other), sensor=other)
    counts = {"paired": paired, "needed": MIN_TRACKS, "lidar": len(tracks.lidar), "other": len(tracks.other)}
    return because("few tracks", **counts, sensor=other)
