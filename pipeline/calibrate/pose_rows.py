"""Rows of table `poses`: pose and certified axes of each sensor of an adjusted rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.adjusted import AdjustedRig, AdjustedSensor
from pipeline.calibrate.records import Inputs
from pipeline.calibrate.verify.seen_targets import targets_of
from pipeline.calibrate.verify.target_accuracy import Claim, claims_of
from pipeline.config import VerifyConfig
from pipeline.extrinsics.checks import faults_of
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.spherical import from_spherical
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import RigGraph, Sensor
from pipeline.rig.views import View
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow
from schemas.versions import CODE_VERSION

__all__ = ["pose_rows"]

# Ahead, left, up of a body as right, down, ahead of a camera.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def pose_rows(
    about: Inputs,
    graph: RigGraph,
    adjusted: AdjustedRig | None,
    views: Mapping[str, View],
    verify: VerifyConfig,
    judged: Mapping[str, CalibrationRecord] | None = None,
) -> list[PoseRow]:
    """A row for each sensor, the reference included.

    Args:
        adjusted: the adjusted rig; None if no edge had evidence.
        views: view of each sensor, by name; a pose is certified for directions in this view.
        judged: by sensor, the record of its edge to the reference if that was judged at the adjusted pose,
            with held-out frames; its verdict is used for the pose.
    """
    rows = [_row(about, graph, sensor, adjusted, views, verify) for sensor in graph.sensors]
    return [_as_judged(row, (judged or {}).get(row.sensor)) for row in rows]


def _as_judged(row: PoseRow, record: CalibrationRecord | None) -> PoseRow:
    if record is None or record.status == "refused" or row.status == "refused":
        return row
    return replace(
        row,
        status=record.status,
        reason=record.reason,
        faults=record.faults,
        determined=record.determined or [],
        azimuth_sigma_rad=record.azimuth_sigma_rad,
        elevation_sigma_rad=record.elevation_sigma_rad,
        unsure_only=any(record.diagnostics.get(name) for name in ("unsure_only", "few_only")),
    )


def _row(
    about: Inputs,
    graph: RigGraph,
    sensor: Sensor,
    adjusted: AdjustedRig | None,
    views: Mapping[str, View],
    verify: VerifyConfig,
) -> PoseRow:
    told = _identity(about, graph, sensor, views)
    if sensor == graph.reference:
        where = pose_columns(np.eye(4)) | {
            "covariance": np.zeros((6, 6)),
            "common_covariance": np.zeros((6, 6)),
        }
        return PoseRow(**told, **where, status="accepted", reason="poses refer to it", dt_s=0.0)
    found = None if adjusted is None else adjusted.sensors.get(sensor.name)
    if adjusted is None or found is None:
        why = "no edge of the rig has evidence" if adjusted is None else "its prior pose is unknown"
        return PoseRow(**told, status="refused", reason=why)
    if found.untied:
        why = f" ({about.absent[sensor.name]})" if sensor.name in about.absent else ""
        failed = [c for edge, e in adjusted.edges.items() if sensor in edge.sensors for c in e.failed]
        said = next((f"; {c.sentence}" for c in failed if c.fault), "")
        return PoseRow(**told, status="refused", reason=found.untied + why + said, faults=faults_of(failed))
    poses, reference = adjusted.poses, graph.reference.name
    targets = _targets(sensor, poses, views)
    claims = _claims(sensor, poses, targets, verify)
    determined = [name for name, claim in claims.items() if claim.margin >= 0]
    status, reason = _verdict(sensor, found, claims, determined)
    return PoseRow(
        **told,
        **pose_columns(poses.T[sensor.name]),
        **pose_columns(adjusted.before.T[sensor.name], "prior_"),
        prior_covariance=adjusted.before.covariance_between(reference, sensor.name),
        unsure_only=status == "held" and not found.doubts,
        covariance=poses.covariance_between(reference, sensor.name),
        common_covariance=poses.covariance_between(reference, sensor.name, common=True),
        observability=[float(v) for v in found.observability],
        observable=[bool(v) for v in found.determined],
        status=status,
        reason=reason,
        faults=["witnesses_disagree"] if found.doubts else [],
        determined=determined,
        targets_m=targets,
        azimuth_sigma_rad=claims["azimuth"].sigma_rad,
        elevation_sigma_rad=claims["elevation"].sigma_rad,
        dt_s=poses.dt_s.get(sensor.name),
        dt_sigma_s=found.dt_sigma_s,
        edges=[edge.name for edge in found.rests_on],
    )


def _identity(about: Inputs, graph: RigGraph, sensor: Sensor, views: Mapping[str, View]) -> dict[str, Any]:
    return {
        "vehicle": about.partition.vehicle,
        "day": about.partition.day,
        "method": about.method,
        "sensor": sensor.name,
        "kind": sensor.kind,
        "reference": graph.reference.name,
        "work_key": about.work_key,
        "code_version": CODE_VERSION,
        "inputs": list(about.inputs),
        "view_azimuth_rad": None if sensor.name not in views else _azimuth_seen(views[sensor.name], sensor),
    }


def _targets(sensor: Sensor, poses: Extrinsics, views: Mapping[str, View]) -> Float[np.ndarray, "3 3"]:
    """Targets in the sensor's view, in the reference's frame."""
    found = targets_of(poses.between(sensor.name, poses.reference.name), views.get(sensor.name), None)
    return DEFAULT_TARGETS if found is None else found


def _claims(
    sensor: Sensor, poses: Extrinsics, targets: Float[np.ndarray, "3 3"], verify: VerifyConfig
) -> dict[str, Claim]:
    """Claims for directions of the reference's points in the sensor, at these targets."""
    reference = poses.reference.name
    T = poses.between(sensor.name, reference)
    azimuth_rad, elevation_rad = verify.limits_rad(sensor.kind)
    return claims_of(
        f"{sensor.kind}_{poses.reference.kind}",
        T,
        poses.covariance_between(sensor.name, reference),
        None,
        azimuth_rad,
        verify.confidence,
        elevation_limit_rad=elevation_rad,
        targets=targets,
    )


def _verdict(
    sensor: Sensor, found: AdjustedSensor, claims: Mapping[str, Claim], determined: Sequence[str]
) -> tuple[str, str]:
    """Status and reason: a radar needs azimuth only, other sensors need both directions."""
    doubts = ", ".join(e.name for e in found.doubts)
    if doubts:
        return "held", f"its edges contradict each other and nothing tells which is wrong: {doubts}"
    if not found.determined.any():
        return "held", "the day determines no degree of freedom: the pose stays at the prior"
    needed = ("azimuth",) if sensor.kind == "radar" else tuple(claims)
    unsure = {name: claim for name, claim in claims.items() if name not in determined}
    words = "; ".join(
        f"{name} known to {np.degrees(c.sigma_rad):.2f} deg (1 sigma), not within {np.degrees(c.limit_rad):.2f} deg "
        f"at {100 * c.confidence:g} %"
        for name, c in unsure.items()
    )
    if set(needed) & set(unsure):
        return "held", words
    return "accepted", f"not certified: {words}" if words else ""


def _azimuth_seen(view: View, sensor: Sensor) -> float:
    """Width in azimuth of a sensor's view near its horizon [rad]."""
    azimuth, elevation = np.radians(np.arange(-179.5, 180.0)), np.radians([-10.0, 0.0, 10.0])
    points = from_spherical(
        np.stack([*np.meshgrid(azimuth, elevation, indexing="ij"), np.full((360, 3), 25.0)], -1)
    )
    if sensor.kind == "camera":
        points = points @ _OPTICAL
    return float(2 * np.pi * view(points).any(axis=1).mean())
