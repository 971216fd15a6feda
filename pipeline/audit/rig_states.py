"""What a vehicle should load tonight: one rig, a pose per sensor, and every edge composed of these poses.

A sensor's days count since the sensor or the reference last moved: by a service event, by what the audit found, or by a
step that the sensor's own days show. A sensor without such days is at its prior, and its row has the reason.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.audit.estimates import day_name
from pipeline.audit.fusion import Mount, after_a_move, fuse, with_held_day
from pipeline.audit.pose_days import SensorDays, VehiclePoses
from pipeline.audit.reasons import REASONS, because
from pipeline.audit.references import drift_per_day, last_restart
from pipeline.core.config import VerifyConfig
from pipeline.rig.graph import Edge, Sensor, pose_columns, tie
from pipeline.rig.se3 import adjoint, change_covariance, inverse, transform_points
from pipeline.rig.targets import DEFAULT_TARGETS, target_sigmas
from schemas.drift import DriftFinding
from schemas.service_events import ServiceEvent
from schemas.states import StateRow

__all__ = ["rig_states"]

_USED = 0.5  # share of the prior's variance that an axis lacks from which it is used: as in a day's record
_DIRECTIONS = ("azimuth", "elevation")
_NOTHING = np.zeros((6, 6))


@dataclass(frozen=True, eq=False)
class _Pose:
    """T_reference_sensor with its covariances (left perturbation), of tonight and before any day."""

    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 6"]
    of_prior: Float[np.ndarray, "6 6"]
    T_prior: Float[np.ndarray, "4 4"]
    prior_covariance: Float[np.ndarray, "6 6"]

    @property
    def used(self) -> Bool[np.ndarray, " 6"]:
        """Axes that the days determine: rotations by the variance that they removed, positions by their own share.

        A position that only the prior determines, given a rotation, is surer than the prior, and still the prior's.
        """
        after = np.diag(change_covariance(self.T, self.covariance))
        before = np.diag(change_covariance(self.T_prior, self.prior_covariance))
        lent = np.diag(change_covariance(self.T, self.of_prior))
        left = np.concatenate([after[:3] - (1 - _USED) * before[:3], lent[3:] - (1 - _USED) * after[3:]])
        return np.asarray(left <= 0)


def rig_states(
    about: tuple[str, str, str],
    own: VehiclePoses | None,
    edges: Mapping[Edge, Float[np.ndarray, "3 3"] | None],
    known: tuple[Sequence[ServiceEvent], Sequence[DriftFinding]],
    mounts: Mapping[Edge, Mount],
    verify: VerifyConfig,
) -> list[StateRow]:
    """A row per edge, then a row per sensor, the reference's first.

    Args:
        about: vehicle, last day, method.
        own: its poses; None if no day has any.
        edges: edges of the vehicle's records, with targets in the child's frame.
        known: service events and the audit's findings.
        mounts: by tie of sensor and reference.
    """
    vehicle, last, method = about
    name = "" if own is None else own.reference.name
    empty = StateRow(
        vehicle=vehicle, day=last, method=method, pair="pose", parent_frame=name, child_frame="",
        status="none", reason="",
    )  # fmt: skip
    if own is None:
        return [_edge_row(empty, edge, targets, {}, {}, verify) for edge, targets in edges.items()]
    reference = own.reference
    identity = _Pose(np.eye(4), _NOTHING, _NOTHING, _NOTHING, np.eye(4), _NOTHING)
    poses: dict[str, _Pose] = {reference.name: identity}
    rows: dict[str, StateRow] = {}
    seen = dict(edges)
    for sensor, days in own.sensors.items():
        edge = tie(sensor, reference)
        rows[sensor.name], pose = _sensor_row(empty, own, (sensor, days), known, mounts.get(edge))
        if pose is not None:
            poses[sensor.name] = pose
            if seen.get(edge) is None and days.targets is not None:
                is_child = edge.child == sensor
                seen[edge] = transform_points(inverse(pose.T), days.targets) if is_child else days.targets
    every_day = sorted({day for row in rows.values() for day in row.days})
    first = replace(
        empty, **_columns(identity), child_frame=reference.name, sensor=reference.name, kind=reference.kind,
        status="current", reason=REASONS["reference"], days=every_day,
    )  # fmt: skip
    rows[reference.name] = first
    of_edges = [_edge_row(empty, edge, seen[edge], rows, poses, verify) for edge in edges]
    of_sensors = [
        _with_claims(rows[s.name], edge, seen.get(edge), poses, verify) if s.name in poses else rows[s.name]
        for s in own.sensors
        for edge in [tie(s, reference)]
    ]
    return [*of_edges, first, *of_sensors]


def _sensor_row(
    empty: StateRow,
    own: VehiclePoses,
    of: tuple[Sensor, SensorDays],
    known: tuple[Sequence[ServiceEvent], Sequence[DriftFinding]],
    mount: Mount | None,
) -> tuple[StateRow, _Pose | None]:
    """The row of one sensor without its claims, and its pose; None if not even its prior is known."""
    (sensor, days), reference = of, own.reference
    first, why = last_restart(sensor, reference, *known, empty.day)
    moved = int(days.moved_within.max(initial=0))
    counted, first, why = _counted(days, first, why, moved, reference)
    base = replace(empty, child_frame=sensor.name, sensor=sensor.name, kind=sensor.kind, since=first or None)
    apart = because("other reference", days=", ".join(own.other_days))
    remarks = [apart] if own.other_days else []
    if mount is None or not len(counted.poses.day):
        day, status, reason = days.last
        last = f"{day} {status}: {reason}" if status != "accepted" else ""
        row = replace(base, reason=_sentences([because("no usable day", why=why).rstrip(), *remarks, last]))
        if days.prior is None:
            return row, None
        T, covariance = days.prior
        pose = _Pose(T, covariance, covariance, covariance, T, covariance)
        return replace(row, **_columns(pose), status="prior"), pose
    drift = drift_per_day(sensor, reference, known[1])
    if drift is not None:  # a step may pass for a drift while it has few days: its days then lie level
        drift = np.minimum(drift, counted.poses.change_per_day())
    moving = mount if drift is None else replace(mount, wander=mount.wander + drift**2)
    found = fuse(counted.poses, moving, dt.date.fromisoformat(empty.day).toordinal() + 1)
    names = [day_name(int(day)) for day in counted.poses.day]
    if found.moved_on is not None:
        base = replace(base, since=day_name(found.moved_on))
        why = because("changed", day=base.since)
    later = np.flatnonzero(days.held.day > counted.poses.day[-1])[-1:]
    doubted = with_held_day(found, days.held.at(later), mount) if len(later) else None
    if doubted is not None:
        found = doubted
        held = day_name(int(days.held.day[later[0]]))
        remarks.append(because("held differs", day=held))
    if moved > counted.poses.day[-1]:
        found = after_a_move(found)
        remarks.append(because("moved in day, drive", other=reference.name, day=day_name(moved)))
    before = counted.poses.T_prior[-1], counted.poses.prior_covariance[-1]
    pose = _Pose(found.T, found.covariance, found.common, found.of_prior, *before)
    left_out = ", ".join(names[k] for k in found.left_out)
    remarks += [because("differ", days=left_out)] if left_out else []
    row = replace(
        base, **_columns(pose), status="current", reason=_sentences([why, *remarks]),
        days=[names[k] for k in found.rows], inputs=sorted({counted.work_keys[k] for k in found.rows}),
    )  # fmt: skip
    return row, pose


def _counted(
    days: SensorDays, first: str, why: str, moved: int, reference: Sensor
) -> tuple[SensorDays, str, str]:
    """Days that count, from which one on, and why: since the last restart, or since it moved within the day `moved`."""
    counted = days.since(dt.date.fromisoformat(first).toordinal() if first else 0)
    anew = counted.since(moved + 1)
    if 0 < len(anew.poses.day) < len(counted.poses.day):
        return anew, day_name(moved + 1), because("moved in day", other=reference.name, day=day_name(moved))
    return counted, first, why


def _edge_row(
    empty: StateRow, edge: Edge, targets: Float[np.ndarray, "3 3"] | None, rows: Mapping[str, StateRow],
    poses: Mapping[str, _Pose], verify: VerifyConfig,
) -> StateRow:  # fmt: skip
    """The row of an edge, composed of the poses of its ends."""
    base = replace(empty, pair=edge.kind, parent_frame=edge.parent.name, child_frame=edge.child.name)
    lacking = [sensor.name for sensor in edge.sensors if sensor.name not in poses]
    if lacking:
        return replace(base, reason=because("no pose", sensors=" and ".join(lacking)))
    # The reference is where it is: the other ends have days.
    ends = [row for s in edge.sensors if (row := rows[s.name]).child_frame != empty.parent_frame]
    resting = [row for row in ends if row.status == "prior"]
    named = [because("at prior", sensor=row.child_frame, reason=row.reason) for row in resting]
    named += [
        f"{row.child_frame} " * (len(ends) > 1) + row.reason
        for row in ends
        if row.since and row.status != "prior"
    ]
    row = replace(
        base,
        **_columns(_between(*(poses[sensor.name] for sensor in edge.sensors))),
        status="prior" if resting else "current",
        reason=_sentences(named),
        since=max((row.since or "" for row in ends), default="") or None,
        days=[] if resting else sorted({day for row in ends for day in row.days}),
        inputs=[] if resting else sorted({key for row in ends for key in row.inputs}),
    )
    return _with_claims(row, edge, targets, poses, verify)


def _with_claims(
    row: StateRow,
    edge: Edge,
    targets: Float[np.ndarray, "3 3"] | None,
    poses: Mapping[str, _Pose],
    verify: VerifyConfig,
) -> StateRow:
    """The row of an edge, or of the sensor that it joins to the reference, with the accuracy at its targets.

    A state at the prior certifies nothing, however sure the prior is.
    """
    pose = _between(*(poses[sensor.name] for sensor in edge.sensors))
    seen = DEFAULT_TARGETS if targets is None else targets
    sigma_rad = target_sigmas(edge.kind, pose.T, pose.covariance, seen)
    reach_deg = float(ndtri(0.5 + verify.confidence / 2)) * np.degrees(sigma_rad)
    limits_deg = np.degrees(verify.limits_rad(edge.kind))
    row = replace(row, azimuth_sigma_rad=float(sigma_rad[0]), elevation_sigma_rad=float(sigma_rad[1]))
    if row.status != "current":
        return replace(row, determined=[])
    certified = [n for n, r, most in zip(_DIRECTIONS, reach_deg, limits_deg, strict=True) if r <= most]
    open_claims = [
        because(
            "too large", direction=name, sigma=np.degrees(sigma), limit=most, percent=100 * verify.confidence
        )
        for name, sigma, most in zip(_DIRECTIONS, sigma_rad, limits_deg, strict=True)
        if name not in certified
    ]
    return replace(row, determined=certified, reason=_sentences([row.reason, *open_claims]))


def _between(parent: _Pose, child: _Pose) -> _Pose:
    """Pose of one sensor in another. Errors of the two poses count as independent."""
    A, A0 = (adjoint(inverse(T)) for T in (parent.T, parent.T_prior))
    return _Pose(
        inverse(parent.T) @ child.T,
        A @ (parent.covariance + child.covariance) @ A.T,
        A @ (parent.common + child.common) @ A.T,
        A @ (parent.of_prior + child.of_prior) @ A.T,
        inverse(parent.T_prior) @ child.T_prior,
        A0 @ (parent.prior_covariance + child.prior_covariance) @ A0.T,
    )


def _columns(pose: _Pose) -> dict[str, Any]:
    """Pose, covariances, prior, and the axes that the days determine."""
    return {
        **pose_columns(pose.T),
        **pose_columns(pose.T_prior, "prior_"),
        "covariance": pose.covariance,
        "common_covariance": pose.common,
        "prior_covariance": pose.prior_covariance,
        "observable": [bool(v) for v in pose.used],
    }


def _sentences(texts: Sequence[str]) -> str:
    return "; ".join(dict.fromkeys(text for text in texts if text))
