"""Sweeps of a lidar on the car, the car's travel between them, and a vehicle frame by that travel for rigs without one.

Each sensor sees the direction of travel, and lidars the road, in axes of its own. So edges to a frame on which nothing
is mounted are solved as in rigs with one, and the adjustment is free to put it anywhere: what remains is how sensors
stand to each other by motion, a camera without labels. The car's stance is common to all of them and cancels. The frame
is no sensor of the rig: it has no record and no pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from pipeline.calibrate.edges.camera_base import FEWEST
from pipeline.objective.ego_motion import EgoMotion, mean_heading, shown_heading
from pipeline.objective.sweep_registration import Surfaces, register
from pipeline.rig.graph import BASE, RigGraph, edge_between
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import exp_se3, from_rotation_translation, log_se3, transform_points
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = [
    "Sweep", "SweepTravel", "deskewed_again", "sweep_travel", "sweeps_of", "vehicle_sized", "with_travel",
]  # fmt: skip

# --------------------------------------------------------------------------------------------------
# Sweeps of one lidar for the edges, from any table, and repeated de-skewing.


_VEHICLE_M = (0.7, 18.0)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The uniform sample of one sweep, lidar axes, de-skewed to its stamp.

    Args:
        drive: continuous stretch of driving.
        is_ground: N, on the drivable ground.
        may_move: N, on something of a vehicle's size.
        time_s: N, when each point was measured, against the stamp; None if unknown.
    """

    stamp_ns: int
    drive: int
    xyz_m: np.ndarray
    is_ground: np.ndarray
    may_move: np.ndarray
    time_s: np.ndarray | None = None


def sweeps_of(observations: Sequence[Observation]) -> list[Sweep]:
    """One per observation; without points where the lidar is silent."""
    return [
        Sweep(
            o.stamp_ns,
            o.drive,
            o.lidar_map_xyz_m.astype(np.float64),
            o.lidar_map_is_ground.astype(bool),
            vehicle_sized(o.lidar_map_cluster, o.lidar_cluster_min_m, o.lidar_cluster_max_m),
            None if o.lidar_map_time_s is None else o.lidar_map_time_s.astype(np.float64),
        )
        for o in observations
    ]


def vehicle_sized(
    cluster: Int[np.ndarray, " N"], low_m: Float[np.ndarray, "K 3"], high_m: Float[np.ndarray, "K 3"]
) -> Bool[np.ndarray, " N"]:
    """Points of clusters as large as bicycles to lorries: neither posts nor walls and rails."""
    length_m = (high_m - low_m)[:, :2].max(1, initial=0.0)
    is_vehicle = (length_m > _VEHICLE_M[0]) & (length_m < _VEHICLE_M[1])
    return np.asarray(np.append(is_vehicle, False)[cluster])  # of no cluster: the last


def deskewed_again(
    sweeps: Sequence[Sweep], assumed_mps: Float[np.ndarray, "F 3"], velocity_mps: Float[np.ndarray, "F 3"]
) -> list[Sweep]:
    """Points moved along the lidar's velocity in place of that assumed by de-skewing (both in lidar axes).

    A mounting error of a degree lifts one side of a sweep by 5 cm on a motorway: a tenth of a degree of roll.
    Sweeps without times of points stay.
    """
    return [
        s
        if s.time_s is None or not np.isfinite(step).all()
        else replace(s, xyz_m=s.xyz_m + s.time_s[:, None] * step)
        for s, step in zip(sweeps, velocity_mps - assumed_mps, strict=True)
    ]


# --------------------------------------------------------------------------------------------------
# Direction of travel of a lidar in its own axes, from pairs of its sweeps; no radar or heading is needed.
#
# Standing objects are registered from one sweep to the next. The transform is a screw; a car's rear axle does
# not slip sideways or hop, so the direction of travel is the vehicle's x axis. Odometry gives the start of the
# search, and the distance where walls do not determine it (a tunnel).


_LONGEST_S = 1.2  # between sweeps: then too little is seen twice
_LEAST_WAY_M = 3.0  # a centimetre aside is 0.2 deg
_MOST_PAIRS, _MOST_POINTS, _MOST_SURFACES = 60, 1800, 6000
# Of the start: turns [rad]; the way ahead [m] (odometry's scale, and a mean of two speeds); aside and up loose, for
# there the data are asked.
_LOOSE_M = 1.0
_START_SIGMAS = np.array([0.02, 0.02, 0.02, 0.3, _LOOSE_M, _LOOSE_M])
_HELD_SHARE = 0.1  # of the loose sigma: what is not known so much better rests on the start
_NO_SHARE = 1e-6  # for asking what the data alone know
_LEAST_SHARE = 0.05
_BEND_M = 50.0  # simulated cars slip by up to 0.1 deg for so long, and so do real ones in a bend


@dataclass(frozen=True, eq=False)
class SweepTravel:
    """Motion of the base between pairs of sweeps, in axes of the base according to the given pose."""

    moment: np.ndarray  # M, of the earlier sweep
    velocity_mps: np.ndarray  # M 3
    turn_radps: np.ndarray  # M 3
    way_m: np.ndarray  # M
    acceleration_mps2: np.ndarray  # M
    sigma_rad: np.ndarray  # M 2, of the way's azimuth and elevation, by the registration alone

    @property
    def angles_rad(self) -> Float[np.ndarray, "M 2"]:
        """Azimuth and elevation of the motion, or of its opposite in reverse; zero if the pose is right."""
        x, y, z = (self.velocity_mps * np.copysign(1.0, self.velocity_mps[:, :1])).T
        return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], -1)

    @property
    def bend(self) -> Int64[np.ndarray, " M"]:
        """Block of each pair: within one bend, a car has the same slip."""
        return np.asarray(np.cumsum(self.way_m) // _BEND_M, np.int64)

    @property
    def curvature_radpm(self) -> Float[np.ndarray, " M"]:
        """Rotation per distance, positive to the left."""
        return np.asarray(self.turn_radps[:, 2] / self.velocity_mps[:, 0])

    def seen_from(self, T_new_old: Float[np.ndarray, "4 4"]) -> SweepTravel:
        """The motion in axes of the base according to another, rotated pose; a change of the lever arm is neglected."""
        R = T_new_old[:3, :3]
        return replace(self, velocity_mps=self.velocity_mps @ R.T, turn_radps=self.turn_radps @ R.T)


def sweep_travel(
    sweeps: Sequence[Sweep], ego: EgoMotion, T_base_lidar: Float[np.ndarray, "4 4"]
) -> SweepTravel:
    """Register pairs of successive sweeps of moving frames, at most 60 over the day."""
    tried = (_between(sweeps, ego, T_base_lidar, i, j) for i, j in _pairs(sweeps, ego).tolist())
    rows = [row for row in tried if row is not None]
    table = np.array(rows, np.float64).reshape(-1, 11)
    return SweepTravel(
        table[:, 0].astype(np.int64), table[:, 1:4], table[:, 4:7], table[:, 7], table[:, 8], table[:, 9:]
    )


def _pairs(sweeps: Sequence[Sweep], ego: EgoMotion) -> Int64[np.ndarray, "P 2"]:
    """Successive sweeps of one drive between which the car drove some metres."""
    found: list[tuple[int, int]] = []
    for i, (a, b) in enumerate(pairwise(sweeps)):
        gap_s = (b.stamp_ns - a.stamp_ns) * 1e-9
        way_m = gap_s * ego.velocity_mps[i : i + 2, 0].mean()
        if a.drive == b.drive and 0 < gap_s < _LONGEST_S and abs(way_m) > _LEAST_WAY_M:
            found.append((i, i + 1))
    pairs = np.array(found, np.int64).reshape(-1, 2)
    return pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_PAIRS)).astype(int))]


def _between(
    sweeps: Sequence[Sweep], ego: EgoMotion, T_base_lidar: np.ndarray, i: int, j: int
) -> tuple[float, ...] | None:
    """A row of SweepTravel; None if the sweeps do not determine it."""
    gap_s = (sweeps[j].stamp_ns - sweeps[i].stamp_ns) * 1e-9
    before, after = (transform_points(T_base_lidar, sweeps[k].xyz_m) for k in (i, j))
    surfaces = Surfaces.of(before[:: max(1, len(before) // _MOST_SURFACES)])
    if surfaces is None:
        return None
    (vx, vy), turn = ego.velocity_mps[[i, j]].mean(0), ego.yaw_rate_radps[[i, j]].mean()
    start = exp_se3(np.array([0.0, 0.0, turn, vx, vy, 0.0]) * gap_s)
    found = register(after[:: max(1, len(after) // _MOST_POINTS)], surfaces, start, _START_SIGMAS)
    if found is None or found[1].share < _LEAST_SHARE:
        return None
    xi = log_se3(found[0]) / gap_s
    way_m = float(np.linalg.norm(xi[3:])) * gap_s
    aside_m, up_m = _sigmas_m(found[1].information, way_m)
    if max(aside_m, up_m) > _HELD_SHARE * _LOOSE_M or way_m < _LEAST_WAY_M / 2:
        return None
    faster = (ego.velocity_mps[j, 0] - ego.velocity_mps[i, 0]) / gap_s
    return (float(i), *xi[3:], *xi[:3], way_m, faster, aside_m / way_m, up_m / way_m)


def _sigmas_m(information: np.ndarray, way_m: float) -> tuple[float, float]:
    """Sigmas of the end point to the side and up; they include half of the rotation between the sweeps."""
    held = np.diag(_START_SIGMAS**-2.0) * np.diag([1, 1, 1, 1, _NO_SHARE, _NO_SHARE])
    C = np.linalg.inv(information + held)
    aside = np.array([0.0, 0.0, way_m / 2, 0.0, 1.0, 0.0])
    up = np.array([0.0, -way_m / 2, 0.0, 0.0, 0.0, 1.0])
    return float(np.sqrt(aside @ C @ aside)), float(np.sqrt(up @ C @ up))


_NEAR_M, _FEWEST_POINTS = 15.0, 60  # of a sweep's ground that shows where the road is
_BEHIND_M = 1.5  # the rear axle, behind lidars on the roof (1 m) and at the nose (4 m)
# Of the frame before the day [rad, m]: so loose that only edges place it.
_SIGMAS, _ANY_WAY_RAD = (float(np.radians(20.0)), 3.0), np.pi  # no radar may show where its x axis points


def with_travel(
    graph: RigGraph, prior: RigPrior, rows: Callable[[Chosen], list[Observation]]
) -> tuple[RigGraph, RigPrior]:
    """Graph and prior with the frame, and an edge of each sensor to it.

    The same ones where the rig has a frame, no camera shows how it moves, or no lidar shows the road.
    """
    reference, lidar = prior.reference.name, next((s.name for s in graph.of_kind("lidar")), "")
    T = prior.between(reference, lidar)
    if BASE in graph.sensors or T is None:
        return graph, prior
    seen = (rows({"camera": camera.name}) for camera in graph.of_kind("camera"))
    if all(sum(o.motion_turn_rad is not None for o in of_camera) < FEWEST for of_camera in seen):
        return graph, prior
    headings = list[tuple[float, float]]()
    for radar in (r.name for r in graph.of_kind("radar")):
        mounted = prior.between(lidar, radar)
        way = None if mounted is None else shown_heading(rows({"lidar": lidar, "radar": radar}), mounted)
        headings += [] if way is None else [(way, prior.sigmas_between(lidar, radar)[0])]
    T_lidar_base = _on_road(sweeps_of(rows({"lidar": lidar})), (mean_heading(headings) or (0.0, 0.0))[0])
    if T_lidar_base is None:
        return graph, prior
    edges = (*graph.edges, *(edge_between(s, BASE) for s in graph.sensors if s not in prior.untied))
    known = {**prior.T, (reference, BASE.name): T @ T_lidar_base}
    of_base = _SIGMAS if headings else (_ANY_WAY_RAD, _SIGMAS[1])
    nodes, sigmas = (*prior.nodes, BASE), {**prior.sigmas, BASE.name: of_base}
    prior = replace(prior, nodes=nodes, T=known, sigmas=sigmas, is_base_loose=True)
    return RigGraph((*graph.sensors, BASE), edges, graph.reference), prior


def _on_road(sweeps: Sequence[Sweep], heading_rad: float) -> Float[np.ndarray, "4 4"] | None:
    """T_lidar_base on the road under the lidar, x along the heading (azimuth in lidar axes); None without a road."""
    found = []
    for sweep in sweeps:
        p = sweep.xyz_m[sweep.is_ground]
        p = p[np.hypot(p[:, 0], p[:, 1]) < _NEAR_M]
        if len(p) >= _FEWEST_POINTS:
            level = np.column_stack([np.ones(len(p)), p[:, :2]])
            found.append(np.linalg.lstsq(level, p[:, 2], rcond=None)[0])
    if not found:
        return None
    height_m, along, aside = np.median(found, axis=0)
    z = np.array([-along, -aside, 1.0]) / np.hypot(1.0, np.hypot(along, aside))
    y = np.cross(z, [np.cos(heading_rad), np.sin(heading_rad), 0.0])
    y /= np.linalg.norm(y)
    x = np.cross(y, z)
    return from_rotation_translation(np.stack([x, y, z], 1), z * height_m * z[2] - _BEHIND_M * x)
