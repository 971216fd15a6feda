"""Record of an edge with evidence but without a pair's estimate: the evidence with its prior, judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustmentLimits
from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.judging import Judged
from pipeline.calibrate.numerics.search_range import search_range
from pipeline.calibrate.records import Inputs, parts_numbers, unobservable, verdict_fields, verdict_numbers
from pipeline.calibrate.verify.edge_result import EdgeResult
from pipeline.calibrate.verify.held_out_test import HeldOutTest, paired_test
from pipeline.calibrate.verify.held_out_update import HeldOutUpdate
from pipeline.calibrate.verify.target_accuracy import claims_of, mounting_covariance, targets_of
from pipeline.calibrate.verify.verdict import Evidence, judge
from pipeline.core.config import FleetConfig
from pipeline.rig.changes import change_covariance
from pipeline.rig.edges import pose_columns
from pipeline.rig.evidence import EdgeEvidence, OtherScenes
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import BASE, Edge, RigGraph
from pipeline.rig.overlap import View
from pipeline.rig.prior import RigPrior
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.calibrations import CalibrationRecord
from schemas.versions import CODE_VERSION

__all__ = ["JudgedEdge", "judged_edge", "record_of_edge", "refused_edge"]


@dataclass(frozen=True, eq=False)
class JudgedEdge:
    """An edge's evidence, with its prior alone, and the verdict on it.

    `evidence` has the reason why the rig must not use it, if there is one.
    """

    evidence: EdgeEvidence
    alone: AdjustedRig
    judged: Judged


def judged_edge(
    evidence: EdgeEvidence, prior: RigPrior, views: Mapping[str, View], fleet: FleetConfig
) -> JudgedEdge:
    """Combine an edge's own data with its prior alone, and judge the result."""
    edge = evidence.edge
    free, limits = replace(evidence, checks=()), AdjustmentLimits(fleet.solve.time_offset_sigma_s)
    alone = adjust(RigGraph(edge.sensors, (edge,), edge.parent), _prior_of(edge, prior), [free], limits)
    T, covariance = alone.poses.T[edge.child.name], alone.poses.covariance
    targets = targets_of(T, views.get(edge.parent.name), views.get(edge.child.name))
    targets = DEFAULT_TARGETS if targets is None else targets
    azimuth_rad, elevation_rad = fleet.verify.limits_rad(edge.kind)
    mounting = mounting_covariance(edge.kind, T, covariance, None)
    test, update = _other_scenes(evidence.others, covariance)
    claims = claims_of(
        edge.kind,
        T,
        covariance,
        update,
        azimuth_rad,
        fleet.verify.confidence,
        fleet.verify.checks.held_out_contradiction_sigmas,
        elevation_limit_rad=elevation_rad,
        mounting=mounting,
        targets=targets,
    )
    result = _result(evidence, alone, prior, fleet, targets)
    verdict = judge(result, Evidence(test, claims, evidence.checks), fleet.verify.checks)
    judged = Judged(verdict, test, claims, mounting, targets)
    return JudgedEdge(replace(evidence, checks=verdict.against), alone, judged)


def record_of_edge(about: Inputs, found: JudgedEdge, frames_total: int) -> CalibrationRecord:
    """Record of an edge from its own data and its prior alone."""
    evidence, alone, child = found.evidence, found.alone, found.evidence.edge.child.name
    of_child = alone.sensors[child]
    pose = {} if found.judged.verdict.status == "refused" else pose_columns(alone.poses.T[child]) | {
        "covariance": alone.poses.covariance,
        "common_covariance": alone.poses.common,
        "observability": [float(v) for v in of_child.observability],
        "observable": [bool(v) for v in of_child.determined],
    }  # fmt: skip
    return CalibrationRecord(
        **_identity(about, evidence.edge, frames_total),
        **pose_columns(alone.before.T[child], "prior_"),
        prior_covariance=alone.before.covariance,
        **pose,
        **verdict_fields(found.judged),
        frames_used=evidence.frames_used,
        frames_rejected=dict(evidence.frames_rejected),
        notes=[*evidence.notes, *unobservable(of_child.determined)],
        diagnostics=dict(evidence.diagnostics)
        | verdict_numbers(found.judged)
        | parts_numbers(evidence.parts),
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


def _other_scenes(
    others: OtherScenes | None, covariance: np.ndarray
) -> tuple[HeldOutTest | None, HeldOutUpdate | None]:
    """What scenes that took no part in a fit show of the result."""
    if others is None:
        return None, None
    test = None if others.cost is None else paired_test(*others.cost)
    return test, HeldOutUpdate(others.shift, covariance, others.covariance, np.zeros((6, 6)))


def _result(
    evidence: EdgeEvidence, alone: AdjustedRig, prior: RigPrior, fleet: FleetConfig, targets: np.ndarray
) -> EdgeResult:
    """The edge's pose beside its prior."""
    edge, child = evidence.edge, evidence.edge.child.name
    sigmas = prior.sigmas_between(*(s.name for s in edge.sensors))
    before, before_sigma = alone.before.T[child], np.repeat(sigmas, 3)
    if edge.child != BASE:  # a parent that turns swings the child
        before_sigma = np.sqrt(np.diag(change_covariance(before, alone.before.covariance)))
    return EdgeResult(
        edge.kind,
        alone.poses.T[child],
        alone.poses.covariance,
        alone.sensors[child].determined,
        before,
        before_sigma,
        evidence.frames_used,
        search_range(sigmas, fleet.solve),
        targets,
    )


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
