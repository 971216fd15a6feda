"""Rows of table `poses`: pose and certified axes of each sensor of an adjusted rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.rig import AdjustedRig, AdjustedSensor
from pipeline.calibrate.adjusted_day import Concluded
from pipeline.calibrate.reasons import because
from pipeline.calibrate.records import Inputs, edge_of_pair
from pipeline.calibrate.rig_day import WrongPrior
from pipeline.calibrate.verify.target_accuracy import DIRECTIONS, Claim, claims_of, targets_of
from pipeline.core.config import VerifyConfig
from pipeline.rig.estimates import faults_of
from pipeline.rig.graph import RigGraph, Sensor, pose_columns
from pipeline.rig.overlap import View
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import adjoint, change_jacobian, exp_se3, from_spherical, inverse, transform_points
from pipeline.rig.targets import DEFAULT_TARGETS, errors_at_targets
from pipeline.store.current import prior_of, transform_of
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow
from schemas.versions import CODE_VERSION

__all__ = ["pose_rows", "poses_of_records"]

# Ahead, left, up of a body as right, down, ahead of a camera.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

_AT_REFERENCE: dict[str, Any] = pose_columns(np.eye(4)) | {
    "covariance": np.zeros((6, 6)), "common_covariance": np.zeros((6, 6)),
    "status": "accepted", "reason": because("reference"), "dt_s": 0.0,
}  # fmt: skip


def pose_rows(
    about: Inputs, graph: RigGraph, adjusted: AdjustedRig | None, before: Extrinsics,
    views: Mapping[str, View], verify: VerifyConfig, judged: Mapping[str, Concluded] | None = None,
    wrong: Sequence[WrongPrior] = (),
) -> list[PoseRow]:  # fmt: skip
    """A row for each sensor, the reference included.

    Args:
        adjusted: the adjusted rig; None if no edge had evidence.
        before: the prior of the sensors that have one.
        views: view of each sensor, by name; a pose is certified for directions in this view.
        judged: by sensor, what was concluded of its edge to the reference; the verdict is the pose's where it is on the
            adjusted pose, with held-out frames.
        wrong: priors that edges contradict: no direction is certified that such a prior would move beyond its limit.
    """
    rows = [_row(about, graph, sensor, adjusted, before, views, verify, wrong) for sensor in graph.sensors]
    return [_as_judged(row, (judged or {}).get(row.sensor)) for row in rows]


def poses_of_records(about: Inputs, records: Sequence[CalibrationRecord]) -> list[PoseRow]:
    """A row for each sensor of a method whose records are the answer: of edges to the lidar, else to the radar."""
    sensors = {s.name: s for pair in about.pairs for s in edge_of_pair(about, pair).sensors}
    reference = next(s for kind in ("lidar", "radar") for s in sensors.values() if s.kind == kind)
    rows = [PoseRow(**_identity(about, reference, reference), **_AT_REFERENCE)]
    for record in records:
        ends = record.parent_frame, record.child_frame
        if reference.name in ends:
            sensor = sensors[next(name for name in ends if name != reference.name)]
            rows.append(PoseRow(**_identity(about, reference, sensor), **_of_record(record, reference.name)))
    return rows


def _of_record(record: CalibrationRecord, reference: str) -> dict[str, Any]:
    """Columns of the pose of the sensor that an edge joins to the reference."""
    T, T_prior = transform_of(record), prior_of(record)
    C, B, P, targets = record.covariance, record.common_covariance, record.prior_covariance, record.targets_m
    if T_prior is not None and P is not None:  # a record's prior is of changes
        to_left = np.linalg.inv(change_jacobian(T_prior))
        P = to_left @ P @ to_left.T
    if record.child_frame == reference:
        (T, C, B), (T_prior, P, _) = _reversed(T, C, B), _reversed(T_prior, P, None)
    elif targets is not None and T is not None:
        targets = transform_points(T, targets)
    verdict = ("status", "reason", "faults", "determined", "azimuth_sigma_rad", "elevation_sigma_rad")
    return {
        **{name: getattr(record, name) for name in (*verdict, "observable")},
        **pose_columns(T),
        **pose_columns(T_prior, "prior_"),
        "covariance": C,
        "common_covariance": B,
        "prior_covariance": P,
        "targets_m": targets,
        "unsure_only": bool(record.diagnostics.get("unsure_only")),
    }


def _reversed(T: np.ndarray | None, *covariances: np.ndarray | None) -> tuple[np.ndarray | None, ...]:
    """The inverse of a transform, and covariances of its left perturbation as of the inverse's."""
    if T is None:
        return (None, *(None for _ in covariances))
    A = adjoint(inverse(T))
    return inverse(T), *(None if C is None else A @ C @ A.T for C in covariances)


def _as_judged(row: PoseRow, concluded: Concluded | None) -> PoseRow:
    """The pose with the verdict on its edge to the reference, unless that shows nothing, or the others certify it."""
    if concluded is None or "refused" in (concluded.record.status, row.status):
        return row
    record = concluded.record
    if not concluded.is_adjusted and (row.status == "accepted" or not any(record.observable or ())):
        return row
    if concluded.is_adjusted:  # else the record's sigmas are of another pose
        row = replace(
            row, azimuth_sigma_rad=record.azimuth_sigma_rad, elevation_sigma_rad=record.elevation_sigma_rad
        )
    return replace(
        row, status=record.status, reason=record.reason, faults=record.faults,
        determined=record.determined or [], unsure_only=bool(record.diagnostics.get("unsure_only")),
    )  # fmt: skip


def _row(
    about: Inputs, graph: RigGraph, sensor: Sensor, adjusted: AdjustedRig | None, before: Extrinsics,
    views: Mapping[str, View], verify: VerifyConfig, wrong: Sequence[WrongPrior],
) -> PoseRow:  # fmt: skip
    told = _identity(about, graph.reference, sensor)
    told["view_azimuth_rad"] = _azimuth_seen(views[sensor.name], sensor) if sensor.name in views else None
    if sensor == graph.reference:
        return PoseRow(**told, **_AT_REFERENCE)
    if sensor.name in before.T:
        told |= pose_columns(before.T[sensor.name], "prior_")
        told["prior_covariance"] = before.covariance_between(graph.reference.name, sensor.name)
    found = None if adjusted is None else adjusted.sensors.get(sensor.name)
    if adjusted is None or found is None:
        why = because("no evidence" if adjusted is None else "no prior")
        return PoseRow(**told, status="refused", reason=why)
    if found.untied:
        why = f" ({about.absent[sensor.name]})" if sensor.name in about.absent else ""
        failed = [c for edge, e in adjusted.edges.items() if sensor in edge.sensors for c in e.failed]
        said = next((f"; {c.sentence}" for c in failed if c.fault), "")
        return PoseRow(**told, status="refused", reason=found.untied + why + said, faults=faults_of(failed))
    poses, reference = adjusted.poses, graph.reference.name
    targets = targets_of(poses.between(sensor.name, reference), views.get(sensor.name), None)
    targets = DEFAULT_TARGETS if targets is None else targets
    claims = _claims(sensor, poses, targets, verify)
    doubted = _doubted(sensor, adjusted, claims, targets, wrong)
    determined = [
        n
        for n, claim in claims.items()
        if claim.margin >= 0 and not any(n in names for names in doubted.values())
    ]
    status, reason = _verdict(sensor, found, claims, determined, doubted)
    return PoseRow(
        **told, **pose_columns(poses.T[sensor.name]),
        unsure_only=status == "held" and not found.doubts and not doubted,
        covariance=poses.covariance_between(reference, sensor.name),
        common_covariance=poses.covariance_between(reference, sensor.name, common=True),
        observability=[float(v) for v in found.observability], observable=[bool(v) for v in found.determined],
        status=status, reason=reason,
        faults=["witnesses_disagree"] * bool(found.doubts) + ["prior"] * bool(doubted), determined=determined,
        targets_m=targets, azimuth_sigma_rad=claims["azimuth"].sigma_rad,
        elevation_sigma_rad=claims["elevation"].sigma_rad, dt_s=poses.dt_s.get(sensor.name),
        dt_sigma_s=found.dt_sigma_s, edges=[edge.name for edge in found.rests_on],
    )  # fmt: skip


def _identity(about: Inputs, reference: Sensor, sensor: Sensor) -> dict[str, Any]:
    return {
        "vehicle": about.partition.vehicle,
        "day": about.partition.day,
        "method": about.method,
        "sensor": sensor.name,
        "kind": sensor.kind,
        "reference": reference.name,
        "work_key": about.work_key,
        "code_version": CODE_VERSION,
        "inputs": list(about.inputs),
    }


def _claims(
    sensor: Sensor, poses: Extrinsics, targets: Float[np.ndarray, "3 3"], verify: VerifyConfig
) -> dict[str, Claim]:
    """Claims for directions of the reference's points in the sensor, at these targets."""
    reference = poses.reference.name
    T = poses.between(sensor.name, reference)
    azimuth_rad, elevation_rad = verify.limits_rad(sensor.kind)
    return claims_of(
        f"{sensor.kind}_{poses.reference.kind}", T, poses.covariance_between(sensor.name, reference), None,
        azimuth_rad, verify.confidence, elevation_limit_rad=elevation_rad, targets=targets,
    )  # fmt: skip


def _doubted(
    sensor: Sensor,
    rig: AdjustedRig,
    claims: Mapping[str, Claim],
    targets: Float[np.ndarray, "3 3"],
    wrong: Sequence[WrongPrior],
) -> dict[str, list[str]]:
    """Directions that contradicted priors would move beyond their limits, by the sentence about the prior."""
    reference = rig.poses.reference
    T, found = rig.poses.between(sensor.name, reference.name), dict[str, list[str]]()
    for prior in wrong:
        T_wrong = exp_se3(prior.error(rig, sensor.name, reference.name)) @ T
        off = errors_at_targets(f"{sensor.kind}_{reference.kind}", T_wrong, T, targets)[:2]
        names = [
            name for name, rad in zip(DIRECTIONS, off, strict=True) if claims[name].is_exceeded_by(float(rad))
        ]
        if names:
            found[prior.sentence] = names
    return found


def _verdict(
    sensor: Sensor,
    found: AdjustedSensor,
    claims: Mapping[str, Claim],
    determined: Sequence[str],
    doubted: Mapping[str, Sequence[str]],
) -> tuple[str, str]:
    """Status and reason: a radar needs azimuth only, other sensors need both directions."""
    doubts = ", ".join(e.name for e in found.doubts)
    if doubts:
        return "held", because("of its edges", edges=doubts)
    if not found.determined.any():
        return "held", because("at prior")
    needed = ("azimuth",) if sensor.kind == "radar" else tuple(claims)
    said = [
        because("not certified", reason=why, directions=" and ".join(names)) for why, names in doubted.items()
    ]
    unsure = [
        because("uncertified", direction=name, reason=claim.reason)
        for name, claim in claims.items()
        if claim.margin < 0
    ]
    status = "accepted" if set(needed) <= set(determined) else "held"
    return status, "; ".join([*said, *unsure])


def _azimuth_seen(view: View, sensor: Sensor) -> float:
    """Width in azimuth of a sensor's view near its horizon [rad]."""
    azimuth, elevation = np.radians(np.arange(-179.5, 180.0)), np.radians([-10.0, 0.0, 10.0])
    points = from_spherical(
        np.stack([*np.meshgrid(azimuth, elevation, indexing="ij"), np.full((360, 3), 25.0)], -1)
    )
    if sensor.kind == "camera":
        points = points @ _OPTICAL
    return float(2 * np.pi * view(points).any(axis=1).mean())
