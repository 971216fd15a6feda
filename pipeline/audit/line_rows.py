"""What a model line shares of one edge, and its vehicles' answers, as rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.audit.estimates import day_name
from pipeline.audit.line_days import Drawing
from pipeline.audit.state_rows import pose_columns
from pipeline.config import FleetModelConfig, VerifyConfig
from pipeline.fleet_model.answers import DIFFERS_SIGMAS, Answers, largest_change_without_one, with_line
from pipeline.fleet_model.apart import shared_axes, shared_errors
from pipeline.fleet_model.contradictions import Motion, contradiction_of, motion_of
from pipeline.fleet_model.evidence import LineEvidence, LinePrior, evidence_of_days, with_witness
from pipeline.fleet_model.line import FEWEST_VEHICLES, LineModel, learn_line
from pipeline.fleet_model.sums import DaySums
from pipeline.geometry.changes import change_jacobian, changed
from pipeline.geometry.se3 import to_quaternion
from pipeline.rig.graph import Edge, RigPose
from pipeline.rig.sigmas import direction_sigmas
from schemas.calibrations import DOF_NAMES
from schemas.fleet_model import OF_ALL, FleetModelRow, LineAnswer

__all__ = ["LineOfEdge", "Witnesses", "as_answers", "line_rows"]

# Vehicles of a line with a change that matters on one edge: more are no chance, and no majority says who is right.
_ALARMS, _FEWEST_ALARMS = 0.1, 3
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_WORDS = {"two groups": "form two groups", "many outside": "lie outside of the others"}


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Mounts that radars report themselves: by name of a shared axis, angle [rad] and inverse variance by vehicle."""

    value: dict[str, Float[np.ndarray, " N"]]
    information: dict[str, Float[np.ndarray, " N"]]


@dataclass(frozen=True, eq=False)
class LineOfEdge:
    """Days of N vehicles of a line on one edge.

    Args:
        about: columns that rows of the line share: day, method, line, pair and frames.
        drawing: from which changes count.
        sums: of the vehicles' days.
        scale: ratio of days' scatter to sigmas.
        autocorrelation: of neighbouring days' errors.
        remounted: a workshop set the mount.
        changed: the audit found a change of the edge that matters.
        witnesses: what radars report of their own mount.
    """

    about: dict[str, Any]
    edge: Edge
    vehicles: Sequence[str]
    drawing: Drawing
    sums: DaySums
    scale: Float[np.ndarray, "N 6"]
    autocorrelation: Float[np.ndarray, "N 6"]
    remounted: Bool[np.ndarray, " N"]
    changed: Bool[np.ndarray, " N"]
    witnesses: Witnesses


@dataclass(frozen=True, eq=False)
class _Found:
    """A line's model and what became of it."""

    status: str
    reason: str
    prior: LinePrior
    model: LineModel | None
    motion: Motion
    answers: Answers | None


def line_rows(
    line: LineOfEdge, config: FleetModelConfig, verify: VerifyConfig
) -> tuple[FleetModelRow, list[dict[str, Any]]]:
    """The line's row, and for each vehicle the columns of its answer."""
    prior = _prior(line, config)
    evidence = _evidence(line, prior, days="all")
    found = _model(line, evidence, prior)
    names = np.array(list(line.vehicles))
    outside = []
    if found.answers is not None:
        outside = names[found.answers.distance > DIFFERS_SIGMAS].tolist()
    most = None
    if found.model is not None and found.status == "GREEN":
        most = largest_change_without_one(found.model, evidence, line.sums.common)
    first = line.sums.first[line.sums.first > 0]
    row = FleetModelRow(
        vehicle=OF_ALL, **line.about, status=found.status, reason=found.reason, vehicles=len(names), outside=outside,
        since=day_name(int(first.min())) if len(first) else None, most_without_one=most,
        **{f"drawing_{name}": value for name, value in pose_columns(line.drawing.T).items()},
        **_model_columns(line, found), **_motion_columns(found.motion),
    )  # fmt: skip
    return row, _answer_columns(line, prior, evidence, found, verify)


def _prior(line: LineOfEdge, config: FleetModelConfig) -> LinePrior:
    variance = line.drawing.prior_variance.copy()
    if config.common_mount_sigma_deg is not None:
        variance[:3] = np.radians(config.common_mount_sigma_deg) ** 2
    if config.common_mount_sigma_m is not None:
        variance[3:] = config.common_mount_sigma_m**2
    # What is common to all days of a vehicle cannot be zero: it is inverted.
    bias = line.sums.common.mean(axis=0) + np.diag(1e-8 * line.drawing.prior_variance)
    used = [name for name, own in line.witnesses.information.items() if (own > 0).any()]
    if not _has_reference(line.edge) or not used:
        return LinePrior(np.diag(variance), bias)
    more = np.zeros((6 + len(used), 6 + len(used)))
    more[:6, :6], more[6:, 6:] = bias, np.eye(len(used)) * variance[:3].max()
    return LinePrior(np.diag(variance), more)


def _has_reference(edge: Edge) -> bool:
    """A radar reports its mount in the vehicle; of an edge to another sensor that one's mount is unknown besides."""
    return "base" not in (edge.parent.kind, edge.child.kind)


def _evidence(line: LineOfEdge, prior: LinePrior, days: str, *, alike: bool = True) -> LineEvidence:
    """Evidence of all days, or of each vehicle's last day; `alike`: neighbouring days err as charts take them to."""
    sums = line.sums
    information, pull, count = (
        (sums.information, sums.pull, sums.days)
        if days == "all"
        else (sums.day_information, sums.day_pull, np.ones(len(sums.days)))
    )
    own = LinePrior(prior.mount, prior.bias[:6, :6])
    autocorrelation = line.autocorrelation if alike else np.zeros_like(line.autocorrelation)
    evidence = evidence_of_days(information, pull, count, line.scale, autocorrelation, own)
    evidence = LineEvidence(
        evidence.value, evidence.information, evidence.to_mount, evidence.to_bias, line.remounted
    )
    axes = shared_axes(line.edge.kind, line.drawing.T[:3, :3])
    for name, value in line.witnesses.value.items():
        if not (line.witnesses.information[name] > 0).any():
            continue
        h = -axes[name]  # a radar that is mounted too high looks like one that measures too low
        along = value + sums.own_prior @ h
        evidence = with_witness(
            evidence, h, along, line.witnesses.information[name], of_its_own=_has_reference(line.edge)
        )
    return evidence


def _model(line: LineOfEdge, evidence: LineEvidence, prior: LinePrior) -> _Found:
    motion = Motion("none", -1, 0.0, 0)
    count = len(line.vehicles)
    if count < FEWEST_VEHICLES:
        reason = f"{count} vehicles with days, {FEWEST_VEHICLES} needed"
        return _Found("UNKNOWN", reason, prior, None, motion, None)
    motion = _motion(line, prior)
    # How far days err alike is hardly known of few days. Where it is less than assumed, mounts scatter by more.
    apart = _evidence(line, prior, days="all", alike=False)
    model = learn_line(evidence, prior, learn_line(apart, prior).variance)
    answers = with_line(model, evidence, line.sums.common, line.sums.own_prior)
    contradiction = contradiction_of(evidence, model)
    alarms = int(line.changed.sum())
    if alarms >= max(_FEWEST_ALARMS, _ALARMS * count):
        reason = f"{alarms} of {count} vehicles changed, by their own charts"
        return _Found("RED", reason, prior, model, motion, answers)
    if motion.kind == "part":
        axis = DOF_NAMES[motion.axis]
        reason = f"{motion.vehicles} of {count} vehicles moved along {axis} lately, the others did not"
        return _Found("RED", reason, prior, model, motion, answers)
    if contradiction is not None:
        axis = DOF_NAMES[contradiction.axis]
        reason = f"{contradiction.vehicles} of {count} vehicles {_WORDS[contradiction.kind]} along {axis}"
        return _Found("UNKNOWN", reason, prior, model, motion, answers)
    if motion.kind == "whole":
        axis = DOF_NAMES[motion.axis]
        reason = f"all vehicles moved alike along {axis} lately: one event, such as a release"
        return _Found("UNKNOWN", reason, prior, model, motion, answers)
    return _Found("GREEN", "", prior, model, motion, answers)


def _motion(line: LineOfEdge, prior: LinePrior) -> Motion:
    """How the line moved: each vehicle's last days against all of its days."""
    sums = line.sums
    own = LinePrior(prior.mount, prior.bias[:6, :6])
    parts = [
        evidence_of_days(information, pull, days, line.scale, line.autocorrelation, own)
        for information, pull, days in (
            (sums.information, sums.pull, sums.days),
            (sums.recent_information, sums.recent_pull, sums.recent_days),
        )
    ]
    (before, spread), (lately, wider) = (part.alone(own, sums.own_prior) for part in parts)
    seen = np.logical_and(*(part.determined(own) for part in parts)) & (sums.days > 2)[:, None]
    return motion_of(lately - before, spread + wider, seen)


def _motion_columns(motion: Motion) -> dict[str, Any]:
    axis = DOF_NAMES[motion.axis] if motion.axis >= 0 else None
    size = motion.size if motion.axis >= 0 else None
    return {
        "moved": motion.kind,
        "moved_axis": axis,
        "moved_size": size,
        "moved_vehicles": motion.vehicles,
    }


def _model_columns(line: LineOfEdge, found: _Found) -> dict[str, Any]:
    noise = {
        "prior_sigma": np.sqrt(line.drawing.prior_variance).tolist(),
        "day_scale": np.median(line.scale, axis=0).tolist(),
        "day_autocorrelation": np.median(line.autocorrelation, axis=0).tolist(),
    }
    model = found.model
    if model is None:
        return noise
    scatter = np.sqrt(model.variance)
    known = model.learnt
    errors = shared_errors(model, shared_axes(line.edge.kind, line.drawing.T[:3, :3]))
    return noise | {
        "mean": model.mean,
        "mean_covariance": model.covariance.ravel(),
        "scatter": np.where(known, scatter, np.nan).tolist(),
        "scatter_most": np.where(known, np.sqrt(model.safe_variance), np.nan).tolist(),
        "shared_errors": {e.name: e.value for e in errors},
        "shared_error_sigmas": {e.name: e.sigma for e in errors},
        "totals": {e.name: e.total for e in errors},
        "total_sigmas": {e.name: e.total_sigma for e in errors},
        "told_apart": [e.name for e in errors if e.told],
    }


def _answer_columns(
    line: LineOfEdge, prior: LinePrior, evidence: LineEvidence, found: _Found, verify: VerifyConfig
) -> list[dict[str, Any]]:
    sums = line.sums
    own = LinePrior(prior.mount, prior.bias[:6, :6])
    alone, spread = evidence.alone(own, sums.own_prior)
    alone_covariance = spread + sums.common
    change, covariance = alone, alone_covariance
    shared = np.zeros(len(sums.days), bool)
    of_day = _evidence(line, prior, days="last")
    day_alone = of_day.alone(own, sums.own_prior)
    day_with: tuple[np.ndarray, np.ndarray] | None = None
    if found.status == "GREEN" and found.model is not None and found.answers is not None:
        change, covariance, shared = found.answers.change, found.answers.covariance, found.answers.shared
        day = with_line(found.model, of_day, sums.common, sums.own_prior)
        day_with = day.change, day.covariance
    T = changed(line.drawing.T, change)
    back = np.linalg.inv(change_jacobian(T))

    def twist(of: np.ndarray) -> np.ndarray:
        return np.asarray(back @ of @ back.swapaxes(1, 2))

    covariance, alone_covariance, common = twist(covariance), twist(alone_covariance), twist(sums.common)
    day_covariance = twist(day_alone[1] + sums.common)
    day_shared = None if day_with is None else twist(day_with[1])
    pose = np.concatenate([to_quaternion(T), T[:, :3, 3]], axis=1).tolist()
    sigma = direction_sigmas(line.edge, line.drawing.T, covariance)
    moved_by = (change - alone).tolist()
    rows = []
    for k in range(len(T)):
        columns: dict[str, Any] = {
            **dict(zip(_POSE, pose[k], strict=True)), "covariance": covariance[k], "common_covariance": common[k],
            "alone_covariance": alone_covariance[k], "moved_by": moved_by[k],
            "record_day": day_name(int(sums.last[k])), "record_alone_covariance": day_covariance[k],
            **_sure(line.edge, sigma[k], verify), **_standing(found, bool(shared[k]), k),
        }  # fmt: skip
        if day_with is not None and day_shared is not None:
            columns |= {
                "record_change": (day_with[0][k] - change[k]).tolist(),
                "record_covariance": day_shared[k],
            }
        rows.append(columns)
    return rows


def _standing(found: _Found, shared: bool, k: int) -> dict[str, Any]:
    """Status of one vehicle's answer, and how far it lies from the line."""
    if found.answers is None:
        return {"status": "alone", "reason": found.reason}
    distance, axis = float(found.answers.distance[k]), DOF_NAMES[int(found.answers.axis[k])]
    differs = distance > DIFFERS_SIGMAS
    far = f"{distance:.1f} sigmas from its line along {axis}" if differs else ""
    status = ("shared" if shared else "outside") if found.status == "GREEN" else "alone"
    reason = "; ".join(text for text in (found.reason, far) if text)
    return {
        "status": status,
        "reason": reason,
        "distance_sigmas": distance,
        "distance_axis": axis,
        "differs": differs,
    }


def _sure(edge: Edge, sigma: Float[np.ndarray, " 2"], verify: VerifyConfig) -> dict[str, Any]:
    """Sigmas of azimuth and elevation, and which of them lie within their limits."""
    has_radar = "radar" in (edge.child.kind if isinstance(edge, RigPose) else edge.kind)
    limits = (
        (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
        if has_radar
        else (verify.camera_lidar_limit_deg, verify.camera_lidar_limit_deg)
    )
    reach = float(ndtri(0.5 + verify.confidence / 2)) * np.degrees(sigma)
    names = ("azimuth", "elevation")
    return {
        "azimuth_sigma_rad": float(sigma[0]),
        "elevation_sigma_rad": float(sigma[1]),
        "determined": [n for n, r, limit in zip(names, reach, limits, strict=True) if r <= limit],
    }


def as_answers(
    line: LineOfEdge, columns: Sequence[dict[str, Any]], counted: Sequence[dict[str, Any]]
) -> list[LineAnswer]:
    """Rows of `line_answers` from their columns and what the next night goes on from."""
    about = {name: value for name, value in line.about.items() if name != "line"}
    return [
        LineAnswer(vehicle=vehicle, **about, **own, **sums)
        for vehicle, own, sums in zip(line.vehicles, columns, counted, strict=True)
    ]
