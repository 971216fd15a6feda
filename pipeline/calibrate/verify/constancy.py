"""Check that sensors stayed in place over the day, by comparing its first and last part, and which sensor moved.

Other checks mix the hours of a day: even frames against odd ones, held-out blocks between the others. A knock
at noon affects both sides equally. Each pair is therefore also solved from the first and the last part of the
day (`numerics/change_point`). Two pairs that shift and one that does not identify the sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import UTC, datetime

import numpy as np

from pipeline.rig.attribution import PairShift, attribute
from pipeline.rig.changes import change_between, change_jacobian
from pipeline.rig.checks import Check
from pipeline.rig.edges import EDGE_OF_PAIR
from pipeline.rig.estimates import DayParts, PairEstimate
from pipeline.rig.graph import BASE, Edge
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["MOVED_SIGMAS", "PART_FLOOR_RAD", "constancy_failures", "moved_failures"]

# Of a step between two parts of a day that are cut where they differ most.
MOVED_SIGMAS = 4.0
# By which parts differ though nothing moved: their scenes and masks do (camera-lidar's bias floor in each of them).
PART_FLOOR_RAD = float(np.radians(0.03) * np.sqrt(2))
# Of what the parts are not compared in, or do not know, when the sensor is looked for.
_ANY_RAD, _ANY_M = np.radians(20.0), 0.05
_OF_CAMERA, _OF_OTHERS = ("pitch", "yaw", "roll"), ("roll", "pitch", "yaw")  # turns about the parent's axes


def constancy_failures(estimates: Mapping[str, PairEstimate]) -> dict[str, list[Check]]:
    """`moved_failures` of the pairs of three sensors, by pair."""
    of_edge = {EDGE_OF_PAIR[pair]: estimate for pair, estimate in estimates.items()}
    parts = {edge: e.parts for edge, e in of_edge.items() if e.parts is not None and e.observable.any()}
    return {edge.kind: checks for edge, checks in moved_failures(parts, of_edge).items()}


def moved_failures(parts: Mapping[Edge, DayParts], edges: Collection[Edge]) -> dict[Edge, list[Check]]:
    """Edges whose parts contradict each other, and the other edges of the sensors that may have moved."""
    size = {edge: float(np.abs(p.sigmas(PART_FLOOR_RAD)).max()) for edge, p in parts.items()}
    moved = [edge for edge in parts if size[edge] > MOVED_SIGMAS]
    if not moved:
        return {}
    surest = max(moved, key=size.__getitem__)
    found = attribute(
        {
            edge: _shift_on_base(p)
            if edge.child == BASE
            else _shift(p, edge in moved or KIND_OF_EDGE[edge.kind].has_tilt)
            for edge, p in parts.items()
        }
    )
    ends = [s.name for s in surest.sensors]
    rivals = [s for s, share in found.probability.items() if share > 0.05] or ends
    sensors = [found.sensor] if found.sensor else [s for s in ends if s in rivals]
    failed = {edge: [_failure(edge, parts[edge], size[edge], sensors)] for edge in moved}
    # Which of two moved may stay open, as with a tilt that the radar hardly sees: then no edge of either is sure.
    for edge in edges:
        if edge not in failed and {s.name for s in edge.sensors} & set(sensors):
            sentence = f"the {' or '.join(sensors)} moved during the day, as {surest.name} shows"
            failed[edge] = [Check(sentence, "moved_in_day")]
    return failed


def _failure(edge: Edge, parts: DayParts, sigmas: float, sensors: list[str]) -> Check:
    axis = int(np.argmax(np.abs(parts.sigmas(PART_FLOOR_RAD))))
    first, last = (datetime.fromtimestamp(ns / 1e9, UTC).strftime("%H:%M:%S") for ns in parts.cut_ns)
    names = _OF_CAMERA if edge.parent.kind == "camera" else _OF_OTHERS
    size = f"{names[axis]} turned by about {np.degrees(parts.step[axis]):+.2f} deg ({sigmas:.1f} sigma)"
    ends = [s.name for s in edge.sensors]
    who = " or ".join([s for s in ends if s in sensors] or ends)
    return Check(f"{size} within the day, between {first} and {last} UTC: the {who} moved", "moved_in_day")


def _shift(parts: DayParts, is_tilt_known: bool) -> PairShift:
    """The step as a twist; positions have the uncertainty of the shift by a rotation in a bracket.

    Args:
        parts: first and last part of a pair.
        is_tilt_known: False for a radar, whose sources of elevation show only a part of a tilt.
    """
    change, covariance = np.zeros(6), np.eye(6) * _ANY_M**2
    change[:3] = parts.step
    covariance[:3, :3] = parts.spread[0] + parts.spread[1] + np.eye(3) * PART_FLOOR_RAD**2
    if not is_tilt_known:
        covariance[:2, :2] += np.eye(2) * _ANY_RAD**2
    to_twist = np.linalg.inv(change_jacobian(parts.T[0]))
    return PairShift(parts.T[0], to_twist @ change, to_twist @ covariance @ to_twist.T)


def _shift_on_base(parts: DayParts) -> PairShift:
    """The step of a sensor that turned in its bracket on the car, as a twist of T_sensor_base."""
    T, covariance = parts.T[0], np.eye(6) * _ANY_M**2
    R = T[:3, :3].T
    untested = np.diag(~np.isin(range(3), parts.tested) * _ANY_RAD**2)
    covariance[:3, :3] = R @ (sum(parts.spread) + untested) @ R.T + np.eye(3) * PART_FLOOR_RAD**2
    change = change_between(inverse(T), inverse(parts.T[1]))
    to_twist = -adjoint(T) @ np.linalg.inv(change_jacobian(inverse(T)))
    return PairShift(T, to_twist @ change, to_twist @ covariance @ to_twist.T)
