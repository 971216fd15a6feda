"""Record of an edge with evidence but without a pair's estimate: the evidence with its prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustmentLimits
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.records import Inputs
from pipeline.calibrate.verify.seen_targets import targets_of
from pipeline.calibrate.verify.target_accuracy import claims_of
from pipeline.config import FleetConfig
from pipeline.extrinsics.checks import faults_of
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, RigGraph
from pipeline.rig.prior import RigPrior
from pipeline.rig.views import View
from schemas.calibrations import DOF_NAMES, CalibrationRecord
from schemas.versions import CODE_VERSION

__all__ = ["record_of_evidence", "refused_edge"]


def record_of_evidence(
    about: Inputs,
    evidence: EdgeEvidence,
    prior: RigPrior,
    views: Mapping[str, View],
    fleet: FleetConfig,
    frames_total: int,
) -> CalibrationRecord:
    """Record of an edge from its own data and its prior alone."""
    edge, limits = evidence.edge, AdjustmentLimits(fleet.solve.time_offset_sigma_s)
    before = _prior_of(edge, prior)
    alone = adjust(
        RigGraph(edge.sensors, (edge,), edge.parent), before, [replace(evidence, checks=())], limits
    )
    found = alone.sensors[edge.child.name]
    T, covariance = alone.poses.T[edge.child.name], alone.poses.covariance
    status, reason, determined, sigmas = _judged(alone, evidence, views, fleet)
    return CalibrationRecord(
        **_identity(about, edge, frames_total),
        **pose_columns(before.T[edge.child.name], "prior_"),
        prior_covariance=before.covariance,
        **pose_columns(T),
        covariance=covariance,
        common_covariance=alone.poses.common,
        observability=[float(v) for v in found.observability],
        observable=[bool(v) for v in found.determined],
        status=status,
        reason=reason,
        faults=faults_of(evidence.checks),
        determined=determined,
        limit_rad=float(np.radians(fleet.verify.camera_lidar_limit_deg)),
        azimuth_sigma_rad=sigmas[0],
        elevation_sigma_rad=sigmas[1],
        frames_used=evidence.frames_used,
        frames_rejected=dict(evidence.frames_rejected),
        notes=[*evidence.notes, *_unobservable(found.determined)],
        diagnostics=dict(evidence.diagnostics),
    )


def refused_edge(about: Inputs, edge: Edge, why: str, frames_total: int, *faults: str) -> CalibrationRecord:
    """The record of an edge that the day cannot calibrate."""
    told = _identity(about, edge, frames_total)
    return CalibrationRecord(**told, status="refused", reason=why, faults=[f for f in faults if f])


def _prior_of(edge: Edge, prior: RigPrior) -> Extrinsics:
    parent, child = (s.name for s in edge.sensors)
    T = prior.between(parent, child)
    assert T is not None, "an edge whose ends nothing ties is refused before"
    rotation, translation = prior.sigmas_between(parent, child)
    covariance = np.diag([rotation**2] * 3 + [translation**2] * 3)
    return Extrinsics(edge.parent, {parent: np.eye(4), child: T}, (child,), covariance, covariance)


def _judged(
    alone: AdjustedRig, evidence: EdgeEvidence, views: Mapping[str, View], fleet: FleetConfig
) -> tuple[str, str, list[str], tuple[float, float]]:
    """Status, reason, certified directions and sigmas of azimuth and elevation."""
    edge, verify = evidence.edge, fleet.verify
    parent, child = edge.sensors
    T = alone.poses.T[child.name]
    targets = targets_of(T, views.get(parent.name), views.get(child.name))
    is_radar = "radar" in edge.kind
    azimuth_deg = verify.radar_limit_deg if is_radar else verify.camera_lidar_limit_deg
    elevation_deg = verify.radar_elevation_limit_deg if is_radar else verify.camera_lidar_limit_deg
    claims = claims_of(
        edge.kind,
        T,
        alone.poses.covariance,
        None,
        float(np.radians(azimuth_deg)),
        verify.confidence,
        elevation_limit_rad=float(np.radians(elevation_deg)),
        targets=DEFAULT_TARGETS if targets is None else targets,
    )
    sigmas = claims["azimuth"].sigma_rad, claims["elevation"].sigma_rad
    determined = [name for name, claim in claims.items() if claim.margin >= 0]
    if evidence.checks:
        return "held", "; ".join(c.sentence for c in evidence.checks), [], sigmas
    if not determined:
        words = ", ".join(f"{n} known to {np.degrees(c.sigma_rad):.2f} deg" for n, c in claims.items())
        return "held", f"{words} (1 sigma), not within its limit", [], sigmas
    return "accepted", "", determined, sigmas


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


def _unobservable(determined: np.ndarray) -> list[str]:
    names = [name for name, seen in zip(DOF_NAMES, determined, strict=True) if not seen]
    return [f"not determined by the day: {', '.join(names)}"] if names else []
