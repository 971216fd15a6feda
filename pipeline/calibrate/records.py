"""Calibration records from the results of select, solve and verify."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjusted_day import SolvedDay
from pipeline.calibrate.judging import EdgeJudging, Judged
from pipeline.calibrate.reasons import because
from pipeline.calibrate.select.triggers import trigger_metrics
from pipeline.calibrate.verify.day_checks import PART_FLOOR_RAD
from pipeline.calibrate.verify.verdict import undetermined
from pipeline.core.errors import SolveError
from pipeline.core.stage_work import NO_PROBES, Probes
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import DayParts, PairEstimate, Prior, Solution
from pipeline.rig.graph import Edge, edge_named, pose_columns
from pipeline.rig.se3 import adjoint, camera_direction_angles, change_between, inverse
from pipeline.store.partitions import Partition
from schemas.calibrations import DOF_NAMES, FRAMES_OF_PAIR, PAIRS, CalibrationRecord
from schemas.observations import WITHOUT_LABELS, Observation
from schemas.versions import CODE_VERSION

__all__ = [
    "Inputs",
    "computed_record",
    "edge_of_pair",
    "environment_of",
    "half_days_of",
    "notes_of_pair",
    "record_of",
    "record_of_edge",
    "refused_edge",
    "refused_record",
]

# Speeds that separate a highway from a town [m/s]: 20 m/s = 72 km/h is above town limits.
_FAST_MPS = 20.0
_MOVING_MPS = 1.0
_OF_K = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}


@dataclass(frozen=True)
class Inputs:
    """Identity of a calibration: the same inputs give the same record."""

    partition: Partition
    method: str
    work_key: str
    seed: int
    inputs: tuple[str, ...]
    pairs: tuple[str, ...] = PAIRS  # of the rig: others have no record
    absent: Mapping[str, str] = field(default_factory=dict)  # why frames lack a sensor, in words by sensor
    # Names of the sensors that play camera, lidar and radar; those left out are called by their kinds.
    chosen: Mapping[str, str] = field(default_factory=dict)
    probe_deg: Probes = NO_PROBES  # as `Task.probe_deg`


def record_of(
    about: Inputs, pair: str, day: SolvedDay, estimate: PairEstimate, judged: Judged
) -> CalibrationRecord:
    """The record of one pair of camera, lidar and radar that was computed, at its own or the adjusted pose."""
    selection = day.selection
    trigger_after = trigger_metrics(day.trigger_sample, {pair: estimate.T})[pair]
    faults = {p: judged.verdict.faults for p, judged in day.judged.items()}
    rejected = selection.rejected[pair], estimate.frames_rejected
    notes = [*notes_of_pair(pair, day.observations), *selection.notes.get(pair, [])]
    record = computed_record(about, edge_of_pair(about, pair), len(day.observations), estimate, judged, notes)
    return replace(
        record,
        **_prior_fields(pair, day.prior),
        **_loop_fields(day.solution),
        frames_rejected={n: sum(of.get(n, 0) for of in rejected) for n in {**rejected[0], **rejected[1]}},
        environment=environment_of(day.observations),
        triggered=day.triggered[pair],
        trigger_before=dict(day.trigger_before[pair]),
        trigger_after=dict(trigger_after),
        time_offset_s=estimate.time_offset_s,
        time_offset_sigma_s=estimate.time_offset_sigma_s,
        assumptions=[*_assumed(estimate, day.observations), *estimate.notes],
        drive_missing=selection.missing.get(pair, []),
        diagnostics=record.diagnostics
        | _camera_numbers(pair, day.observations)
        | dict(day.numbers)
        | {"paper_frames": float(selection.passed[pair])},
        half_days=half_days_of(pair, day.solution.pairs, faults),
    )


def notes_of_pair(pair: str, observations: Sequence[Observation]) -> list[str]:
    """Notes for the record of a pair: how its camera was aligned, and by what it was not checked."""
    is_unlabelled = "camera" in FRAMES_OF_PAIR[pair] and any(o.is_unlabelled for o in observations)
    return [WITHOUT_LABELS, because("unchecked")] if is_unlabelled else []


def computed_record(
    about: Inputs, edge: Edge, frames_total: int, found: PairEstimate, judged: Judged, notes: Sequence[str]
) -> CalibrationRecord:
    """The record of an edge of any kind; a refused one lacks the transform and its covariance."""
    pose = {} if judged.verdict.status == "refused" else pose_columns(found.T) | {
        "covariance": found.covariance,
        "common_covariance": found.common_covariance,
        "observability": [float(v) for v in found.observability],
        "observable": [bool(v) for v in found.observable],
    }  # fmt: skip
    return CalibrationRecord(
        **_identity(about, edge, frames_total),
        **pose,
        **_verdict_fields(judged),
        frames_used=found.frames_used,
        frames_rejected=dict(found.frames_rejected),
        notes=[*notes, *undetermined(edge.kind, found.observable)],
        diagnostics=dict(found.diagnostics) | _verdict_numbers(judged) | _parts_numbers(found.parts),
    )


def record_of_edge(
    about: Inputs, found: EdgeJudging, frames_total: int, estimate: PairEstimate, judged: Judged
) -> CalibrationRecord:
    """Record of an edge of another kind, at its own or the adjusted pose."""
    edge, before = found.evidence.edge, found.before
    record = computed_record(about, edge, frames_total, estimate, judged, found.evidence.notes)
    prior = pose_columns(before.T[edge.child.name], "prior_")
    return replace(record, **prior, prior_covariance=before.covariance)


def refused_record(
    about: Inputs,
    pair: str,
    why: SolveError,
    observations: Sequence[Observation],
    prior: Prior,
    counts: Mapping[str, int],
) -> CalibrationRecord:
    """The record of one pair that the day cannot calibrate; `counts` of frames not used, by reason."""
    refused = refused_edge(about, edge_of_pair(about, pair), why.reason, len(observations), why.fault)
    environment, rejected = environment_of(observations), dict(counts)
    return replace(refused, **_prior_fields(pair, prior), environment=environment, frames_rejected=rejected)


def refused_edge(about: Inputs, edge: Edge, why: str, frames_total: int, *faults: str) -> CalibrationRecord:
    """The record of an edge that the day cannot calibrate."""
    identity = _identity(about, edge, frames_total)
    return CalibrationRecord(**identity, status="refused", reason=why, faults=[f for f in faults if f])


def environment_of(observations: Sequence[Observation]) -> str:
    """Highway, urban, mixed or unknown, from the speeds of the moving frames.

    More than 70 % of them at 20 m/s or more is a highway, less than 30 % a town; a traffic jam on a highway
    passes for a town. Unknown where less than half of the frames have a speed or none moves.
    """
    speeds = np.array([abs(o.ego_speed_mps) for o in observations if o.ego_speed_mps is not None])
    moving = speeds[speeds > _MOVING_MPS]
    if 2 * len(speeds) < len(observations) or not len(moving):
        return "unknown"
    fast = float(np.mean(moving >= _FAST_MPS))
    return "highway" if fast > 0.7 else "urban" if fast < 0.3 else "mixed"


def edge_of_pair(about: Inputs, pair: str) -> Edge:
    """The edge of a pair of camera, lidar and radar, by the names of the sensors that play them."""
    return edge_named(pair, *(about.chosen.get(kind, kind) for kind in FRAMES_OF_PAIR[pair]))


def _identity(about: Inputs, edge: Edge, frames_total: int) -> dict[str, Any]:
    return {
        "vehicle": about.partition.vehicle,
        "day": about.partition.day,
        "method": about.method,
        "pair": edge.kind,
        "parent_frame": edge.parent.name,
        "child_frame": edge.child.name,
        "work_key": about.work_key,
        "code_version": CODE_VERSION,
        "seed": about.seed,
        "inputs": list(about.inputs),
        "frames_total": frames_total,
    }


def _prior_fields(pair: str, prior: Prior) -> dict[str, Any]:
    if not prior.knows(pair):
        return {}
    return pose_columns(prior.of(pair), "prior_") | {"prior_covariance": prior.covariance(pair)}


def _camera_numbers(pair: str, observations: Sequence[Observation]) -> dict[str, float]:
    """The CameraInfo of the record's directions, to distinguish days with another one."""
    o = next((o for o in observations if "camera" in o.sensors), None)
    if "camera" not in FRAMES_OF_PAIR[pair] or o is None:
        return {}
    return {f"camera_{name}_px": float(o.camera_K[at]) for name, at in _OF_K.items()}


def _loop_fields(solution: Solution) -> dict[str, Any]:
    """Residual of the loop, with sigmas from three pairs estimated apart or from the method's own check."""
    rotation, translation = solution.loop_rotation_rad, solution.loop_translation_m
    sigmas: tuple[float | None, ...] = None, None
    if rotation is not None and translation is not None:
        # Of T_camera_lidar T_lidar_radar T_radar_camera, with independent factors (first order).
        cl, cr, lr = (solution.pairs[pair] for pair in PAIRS)
        A, B = adjoint(cl.T), adjoint(cl.T @ lr.T @ inverse(cr.T))
        covariance = cl.covariance + A @ lr.covariance @ A.T + B @ cr.covariance @ B.T
        sigmas = tuple(float(np.sqrt(np.trace(covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
    elif "camera_radar" in solution.pairs:
        sigmas = solution.pairs["camera_radar"].diagnostics.get("loop_rotation_sigma_rad"), None
    return {
        "loop_rotation_rad": rotation,
        "loop_translation_m": translation,
        "loop_rotation_sigma_rad": sigmas[0],
        "loop_translation_sigma_m": sigmas[1],
    }


def _assumed(estimate: PairEstimate, observations: Sequence[Observation]) -> list[str]:
    """Assumptions of every method, and the effect of errors in them."""
    rigid = because("rigid")
    if estimate.parts is not None:
        rigid = because("rigid, tested", sigmas=np.abs(estimate.parts.sigmas(PART_FLOOR_RAD)).max())
    assumed = [rigid, because("clocks")]
    o = next((o for o in observations if "camera" in o.sensors), None)
    if "camera" not in FRAMES_OF_PAIR[estimate.pair] or o is None:
        return assumed
    camera = camera_of(o)
    wrong = replace(camera, K=o.camera_K * [[1.001, 1.0, 1.0], [1.0, 1.001, 1.0], [1.0, 1.0, 1.0]])
    edge = np.array([[0.0, o.image_height_px / 2], [o.image_width_px - 1.0, o.image_height_px / 2]])
    angles = camera_direction_angles(camera.unproject(edge)) - camera_direction_angles(wrong.unproject(edge))
    worth = float(np.degrees(np.abs(angles[:, 0]).max()))
    turn = float(np.degrees(1 / o.camera_K[0, 0]))
    return [*assumed, because("camera as logged", edge=worth, turn=turn)]


def _parts_numbers(parts: DayParts | None) -> dict[str, float]:
    """How far the last part of the day turns from its first, and in how many sigmas."""
    if parts is None:
        return {}
    numbers = {f"parts_{DOF_NAMES[k]}_rad": float(parts.step[k]) for k in parts.tested}
    return numbers | {"parts_sigmas": float(np.abs(parts.sigmas(PART_FLOOR_RAD)).max())}


def _verdict_fields(judged: Judged) -> dict[str, Any]:
    """Fields of the verdict; sigmas and targets are missing in a refused record."""
    verdict, test, claims = judged.verdict, judged.test, judged.claims
    fields = {
        "status": verdict.status,
        "reason": verdict.reason,
        "faults": list(verdict.faults),
        "score": verdict.score,
        "determined": list(verdict.determined),
        "mounting_determined": list(verdict.mounting),
        "limit_rad": claims["azimuth"].limit_rad,
        "alignment_before": test.before if test else None,
        "alignment_after": test.after if test else None,
    }
    if verdict.status == "refused":
        return fields
    fields |= {f"{name}_sigma_rad": claim.sigma_rad for name, claim in claims.items()}
    if judged.mounting_covariance is not None:  # the principal point is known
        fields |= {f"mounting_{name}_sigma_rad": claim.mounting_sigma_rad for name, claim in claims.items()}
        fields["mounting_covariance"] = judged.mounting_covariance
    return fields | {"targets_m": judged.targets}


def _verdict_numbers(judged: Judged) -> dict[str, float]:
    """Numbers behind the verdict: held-out frames, known turns of the result, score, certified axes."""
    test, verdict = judged.test, judged.verdict
    held_out = (
        {} if test is None else {"frames": float(test.frames), "blocks": float(test.blocks), "z": test.z}
    )
    for name, claim in judged.claims.items():
        held_out[f"{name}_shift_rad"] = claim.shift_rad
        held_out[f"{name}_shift_sigma_rad"] = claim.shift_sigma_rad
        held_out[f"{name}_remaining_sigma_rad"] = claim.remaining_sigma_rad
    return dict(judged.probes) | {f"holdout_{name}": value for name, value in held_out.items()} | {
        "confidence": verdict.score,
        "disproved": float(verdict.disproved),
        "unsure_only": float(verdict.unsure_only),
        "vouched_az": float("azimuth" in verdict.determined),
        "vouched_el": float("elevation" in verdict.determined),
        "elevation_limit_rad": judged.claims["elevation"].limit_rad,
    }  # fmt: skip


def half_days_of(
    pair: str, estimates: Mapping[str, PairEstimate], faults: Mapping[str, Sequence[str]]
) -> Float[np.ndarray, "2 2 6"] | None:
    """Changes of a pair from its estimate to its first and last part, with sigmas; None if it did not move.

    Camera_radar changes as the other two do. `faults` are those of each pair's verdict.
    """
    parts, own = (
        {p: _parts(e, "moved_in_day" in faults.get(p, ())) for p, e in estimates.items()},
        estimates[pair],
    )
    poses, sigmas = parts[pair]
    if pair == "camera_radar" and own.parts is None and len(parts) == len(PAIRS):
        (T_cl, s_cl), (T_lr, s_lr) = parts["camera_lidar"], parts["lidar_radar"]
        # From where the other two have it, for its own pose is of all three.
        back = inverse(estimates["camera_lidar"].T @ estimates["lidar_radar"].T) @ own.T
        poses, sigmas = [a @ b @ back for a, b in zip(T_cl, T_lr, strict=True)], np.hypot(s_cl, s_lr)
    change = np.array([change_between(own.T, T) for T in poses])
    if not sigmas.any():
        return None
    # A turn of the parent carries the child's origin along.
    shift = np.where(np.abs(change[:, 3:]).max() > 0, sigmas.max(axis=1) * np.linalg.norm(own.T[:3, 3]), 0.0)
    return np.stack([change, np.column_stack([sigmas, *[shift] * 3])], axis=1)


def _parts(estimate: PairEstimate, has_moved: bool) -> tuple[list[np.ndarray], Float[np.ndarray, "2 3"]]:
    """Poses of the two parts and sigmas of their rotations; the estimate itself if it did not move."""
    if estimate.parts is None or not has_moved:
        return [estimate.T, estimate.T], np.zeros((2, 3))
    compared = np.isin(np.arange(3), estimate.parts.tested)
    sigma = [np.where(compared, np.sqrt(np.diag(s)), 0.0) for s in estimate.parts.spread]
    return list(estimate.parts.T), np.array(sigma)
