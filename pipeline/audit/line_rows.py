"""What a model line shares of one edge, and its vehicles' answers, as rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.audit.estimates import day_name
from pipeline.audit.line_days import Drawing
from pipeline.audit.line_witnesses import Witnesses
from pipeline.config import FleetModelConfig, VerifyConfig
from pipeline.fleet_model.answers import DIFFERS_SIGMAS, Answers, largest_change_without_one, with_line
from pipeline.fleet_model.apart import shared_axes, shared_errors, widened
from pipeline.fleet_model.contradictions import Motion, contradiction_of, motion_of
from pipeline.fleet_model.evidence import (
    LineEvidence,
    LinePrior,
    OwnPriors,
    evidence_of_days,
    with_witness,
)
from pipeline.fleet_model.line import FEWEST_VEHICLES, LineModel, learn_line
from pipeline.fleet_model.sums import DaySums
from pipeline.geometry.changes import change_jacobian, changed
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.se3 import to_quaternion
from pipeline.rig.graph import Edge, RigPose
from pipeline.rig.sigmas import direction_sigmas
from schemas.calibrations import DOF_NAMES
from schemas.columns import POSE_COLUMNS
from schemas.fleet_model import OF_ALL, FleetModelRow, LineAnswer

__all__ = ["LineOfEdge", "as_answers", "line_rows"]

# Vehicles of a line with a change that matters on one edge: more are no chance, and no majority says who is right.
_ALARMS, _FEWEST_ALARMS = 0.1, 3
_NO_SURER = 1.2  # times the sigma alone: an answer that is so much less sure with the line is of no use
_OBSERVABLE = 0.5  # of the prior's variance: with less an axis counts as determined
_PRIORS_APART = 3.0  # ratio of the largest sigma of a vehicle's prior to the smallest, which is said
_WORDS = {"two groups": "form two groups", "many outside": "lie outside of the others"}


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
    reason = "; ".join(text for text in (found.reason, _priors_apart(line)) if text)
    first = line.sums.first[line.sums.first > 0]
    row = FleetModelRow(
        vehicle=OF_ALL, **line.about, status=found.status, reason=reason, vehicles=len(names), outside=outside,
        since=day_name(int(first.min())) if len(first) else None, most_without_one=most,
        **pose_columns(line.drawing.T, "drawing_"),
        **_model_columns(line, found), **_motion_columns(found.motion),
    )  # fmt: skip
    return row, _answer_columns(line, prior, evidence, found, verify)


def _prior(line: LineOfEdge, config: FleetModelConfig) -> LinePrior:
    own = _prior_variance(line)
    variance = own.copy()
    if config.common_mount_sigma_deg is not None:
        variance[:3] = np.radians(config.common_mount_sigma_deg) ** 2
    if config.common_mount_sigma_m is not None:
        variance[3:] = config.common_mount_sigma_m**2
    # What is common to all days of a vehicle cannot be zero: it is inverted.
    bias = _least_common(line.sums.common, own) + np.diag(1e-8 * own)
    used = [name for name, reports in line.witnesses.information.items() if (reports > 0).any()]
    if not _has_reference(line.edge) or not used:
        return LinePrior(np.diag(variance), bias)
    more = np.zeros((6 + len(used), 6 + len(used)))
    more[:6, :6], more[6:, 6:] = bias, np.eye(len(used)) * variance[:3].max()
    return LinePrior(np.diag(variance), more)


def _prior_variance(line: LineOfEdge) -> Float[np.ndarray, " 6"]:
    """By axis, of the vehicles' priors: their median."""
    return np.asarray(np.median(np.einsum("nii->ni", line.sums.prior), axis=0))


def _own_priors(line: LineOfEdge) -> OwnPriors:
    return OwnPriors(line.sums.own_prior, line.sums.prior)


def _least_common(
    common: Float[np.ndarray, "N 6 6"], unit: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, "6 6"]:
    """Mean of the quarter of the vehicles that state least; what others state beyond it is their own."""
    size = (np.einsum("nii->ni", common) / unit).sum(axis=1)
    return np.asarray(common[size <= np.quantile(size, 0.25, method="higher")].mean(axis=0))


def _priors_apart(line: LineOfEdge) -> str:
    """Words where priors of vehicles differ, as those of two configurations under one name."""
    sigma = np.sqrt(np.einsum("nii->ni", line.sums.prior))
    ratio = sigma.max(axis=0) / sigma.min(axis=0)
    axis = int(np.argmax(ratio))
    if ratio[axis] < _PRIORS_APART:
        return ""
    return f"priors of its vehicles differ, along {DOF_NAMES[axis]} by {ratio[axis]:.1f} times"


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
        reason = f"{count} vehicle{'s' if count > 1 else ''} with days, {FEWEST_VEHICLES} needed"
        return _Found("UNKNOWN", reason, prior, None, motion, None)
    motion = _motion(line, prior)
    # How far days err alike is hardly known of few days. Where it is less than assumed, mounts scatter by more.
    apart = _evidence(line, prior, days="all", alike=False)
    model = learn_line(evidence, prior, learn_line(apart, prior).variance)
    wide = widened(model, shared_axes(line.edge.kind, line.drawing.T[:3, :3]))
    if wide is not prior:
        model = learn_line(evidence, wide, learn_line(apart, wide).variance)
    answers = with_line(model, evidence, line.sums.common, _own_priors(line))
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
    (before, spread), (lately, wider) = (part.alone(own, _own_priors(line)) for part in parts)
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
        "prior_sigma": np.sqrt(_prior_variance(line)).tolist(),
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
    sums, owns = line.sums, _own_priors(line)
    own = LinePrior(prior.mount, prior.bias[:6, :6])
    alone, spread = evidence.alone(own, owns)
    alone_covariance = spread + sums.common
    of_day = _evidence(line, prior, days="last")
    day_change, day_spread = of_day.alone(own, owns)
    day_alone_covariance = day_spread + sums.common
    change, covariance, day_covariance = alone, alone_covariance, day_alone_covariance
    standing = _Standing(found, sums.away, np.ones(len(alone), bool))
    if found.status == "GREEN" and found.model is not None and found.answers is not None:
        answers = found.answers
        sigma, sigma_alone = (
            direction_sigmas(line.edge, line.drawing.T, _twist(line, of))
            for of in (answers.covariance, alone_covariance)
        )
        standing = replace(standing, surer=np.asarray((sigma <= _NO_SURER * sigma_alone).all(axis=1)))
        shared = standing.shared[:, None]
        change = np.where(shared, answers.change, alone)
        covariance = np.where(shared[:, None], answers.covariance, alone_covariance)
        day = with_line(found.model, of_day, sums.common, owns)
        day_change = np.where(shared, day.change, day_change)
        day_covariance = np.where(shared[:, None], day.covariance, day_alone_covariance)
    T = changed(line.drawing.T, change)
    observable = np.einsum("nii->ni", covariance) < _OBSERVABLE * np.einsum("nii->ni", sums.prior)
    covariance, alone_covariance, common, day_covariance, day_alone_covariance = (
        _twist(line, of, T)
        for of in (covariance, alone_covariance, sums.common, day_covariance, day_alone_covariance)
    )
    pose = np.concatenate([to_quaternion(T), T[:, :3, 3]], axis=1).tolist()
    sigma = direction_sigmas(line.edge, line.drawing.T, covariance)
    moved_by, of_record = (change - alone).tolist(), (day_change - change).tolist()
    return [
        {
            **dict(zip(POSE_COLUMNS, pose[k], strict=True)), "covariance": covariance[k],
            "common_covariance": common[k], "observable": observable[k].tolist(),
            "alone_covariance": alone_covariance[k], "moved_by": moved_by[k],
            "record_day": day_name(int(sums.last[k])), "record_alone_covariance": day_alone_covariance[k],
            "record_change": of_record[k], "record_covariance": day_covariance[k],
            **_sure(line.edge, sigma[k], verify), **standing.of(k),
        }
        for k in range(len(T))
    ]  # fmt: skip


def _twist(
    line: LineOfEdge, covariance: np.ndarray, T: np.ndarray | None = None
) -> Float[np.ndarray, "N 6 6"]:
    """Covariances of changes as those of left perturbations, at the poses or at the drawing."""
    back = np.linalg.inv(change_jacobian(line.drawing.T if T is None else T))
    return np.asarray(back @ covariance @ back.swapaxes(-1, -2))


@dataclass(frozen=True, eq=False)
class _Standing:
    """Which answers the line has a part in, and why not in the others.

    Args:
        away: last days of a vehicle that lie elsewhere and are left out of its sums.
        surer: vehicles whose directions are as sure with the line as alone.
    """

    found: _Found
    away: np.ndarray
    surer: Bool[np.ndarray, " N"]

    @cached_property
    def shared(self) -> Bool[np.ndarray, " N"]:
        """Vehicles whose answer the line has a part in."""
        if self.found.status != "GREEN" or self.found.answers is None:
            return np.zeros(len(self.away), bool)
        return np.asarray(self.found.answers.shared & (self.away == 0) & self.surer)

    def of(self, k: int) -> dict[str, Any]:
        """Status of one vehicle's answer, and how far it lies from the line."""
        found = self.found
        if found.answers is None:
            return {"status": "alone", "reason": found.reason}
        distance, axis = float(found.answers.distance[k]), DOF_NAMES[int(found.answers.axis[k])]
        differs = distance > DIFFERS_SIGMAS
        told = [found.reason, f"{distance:.1f} sigmas from its line along {axis}" if differs else ""]
        status = "alone"
        if found.status == "GREEN":
            status = "shared" if self.shared[k] else "outside"
            if self.away[k]:
                days = "its last day lies" if self.away[k] == 1 else f"its last {self.away[k]} days lie"
                told.append(f"left out of its answer: {days} far from the others")
            elif not self.surer[k]:
                told.append("with its line it would be much less sure")
        return {
            "status": status,
            "reason": "; ".join(text for text in told if text),
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
