"""Edge lidar-lidar: registration of standing objects in the overlap of two lidars, all moments at once.

Points of the child are aligned with surfaces of the parent, moved by the car's motion between both stamps;
moving cars determine the clock offset. Every moment has its own robust scale, and the scatter of the
gradients over scenes gives the covariance. Lidars without overlap have no edge: they are connected through
the base, or a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.on_base import DaySources
from pipeline.calibrate.edges.sweep_travel import Sweep, deskewed_again, sweeps_of
from pipeline.calibrate.numerics.frame_blocks import Scenes, parts_of_day
from pipeline.calibrate.numerics.nuisances import SWEEP_S, TYPICAL_RANGE_M, Considered, by_sensor
from pipeline.calibrate.reasons import because
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import EgoMotion
from pipeline.objective.sweep_registration import Surfaces, plane_equations
from pipeline.rig.estimates import Check, DayParts, EdgeEvidence, OtherScenes
from pipeline.rig.graph import BASE, Edge
from pipeline.rig.se3 import (
    adjoint,
    exp_se3,
    exp_so3,
    from_rotation_translation,
    inverse,
    log_se3,
    rotation_angle_rad,
    transform_points,
)

__all__ = ["LidarPair", "estimate_lidar_lidar", "solve"]

_MOST_MOMENTS, _MOST_POINTS, _MOST_SURFACES = 30, 1500, 6000
_MOTORWAY_MPS = 17.0  # faster, what has a vehicle's size drives
_FEWEST_MOMENTS, _LEAST_SHARE = 5, 0.05
_GATES_M = (3.0, 1.5, 0.7, 0.4, 0.25)
_STEPS, _CONVERGED = 6, 2e-5
_TURN_RAD = np.radians(4.0)  # other starts are turned so far, either way
_APART_RAD = np.radians(0.2)  # ends that are two
_NEARLY = 0.97  # of the best end's share of points: another end that reaches it is as good
# Units in which an axis counts as shown or not: a turn moves what is 10 m away, a time offset a car of 10 m/s.
_UNITS = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0, 10.0])
_SHOWN_M = 0.3
# Of the best shown direction: noise of normals curves as much. Along a motorway's rails 1e-5 and 1.5e-4, and the ends
# were half a metre off; in towns 1e-3 and more.
_LEAST_CURVATURE = 7e-4
# Beyond what scenes scatter by, errors of 8 simulated pairs (seeds 41 to 48): 0.01 deg RMS, 1.4 cm along x, where the
# clock trades with it, 1 mm elsewhere; real ranges are good to 3 cm, on surfaces on all sides.
_MATCHING = np.array([*np.radians([0.02, 0.02, 0.02]), 0.014, 0.01, 0.01])
_WHOLLY = 0.99  # of a unit turn within the directions that the scenes determine
_CLOCK_S = 0.002  # likewise, beyond what scenes scatter by: 1 ms RMS on those pairs
_SWEEP_S_PER_RAD = 0.07  # of a lidar that looks ahead; one that looks around takes 0.016


@dataclass(frozen=True, eq=False)
class LidarPair:
    """Two lidars' sweeps of the same moments.

    Args:
        T_base_parent: pose of the parent on the car, accurate to a degree; defines the directions up and
            ahead.
        deskewed: T_base_sensor with which sweeps of parent and child were de-skewed.
        base_sigma_rad: sigma of T_base_parent, which affects de-skewing.
    """

    parent: Sequence[Sweep]
    child: Sequence[Sweep]
    T_base_parent: np.ndarray
    deskewed: tuple[np.ndarray, np.ndarray]
    base_sigma_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class _Moment:
    """The parent's surfaces, the child's points at the start, and the car's motion, all in axes of the base."""

    surfaces: Surfaces
    points_m: np.ndarray
    gap_s: float  # child's stamp less the parent's
    motion: np.ndarray  # twist per second
    frame: int


@dataclass(frozen=True, eq=False)
class _End:
    """Result of one start: rotation and shift of the child in base axes, its clock, and the moments' equations."""

    X: np.ndarray
    dt_s: float
    H: np.ndarray  # M 7 7
    g: np.ndarray  # M 7
    shares: np.ndarray  # M, of the points that meet a surface
    scatter_m: float

    @property
    def share(self) -> float:
        """Mean over the moments."""
        return float(self.shares.mean())


@dataclass(frozen=True, eq=False)
class _Seen:
    """An end, with the directions in which the scenes determine it, in units of _UNITS.

    Args:
        V: 7 K, these directions.
        block: of each moment.
    """

    end: _End
    V: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, end: _End, block: np.ndarray) -> _Seen:
        """The directions in which the scenes curve enough."""
        curvature, axes = np.linalg.eigh(end.H.sum(0) / np.outer(_UNITS, _UNITS))
        keep = curvature > max(_SHOWN_M**-2, _LEAST_CURVATURE * curvature[-1])
        return cls(end, axes[:, keep], block)

    def step(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton step of some moments (7), and its covariance (7 7) by the scatter of their blocks."""
        V, unit = self.V, _UNITS
        H, g, block = self.end.H[some].sum(0), self.end.g[some], self.block[some]
        names = np.unique(block)
        scores = np.stack([g[block == b].sum(0) for b in names]) / unit @ V
        spread = scores.T @ scores * len(names) / max(len(names) - 1, 1)
        inverse_curvature = np.linalg.inv(V.T @ (H / np.outer(unit, unit)) @ V)
        C = inverse_curvature @ spread @ inverse_curvature + inverse_curvature
        C += np.outer(V[6], V[6]) * (_CLOCK_S * unit[6]) ** 2
        B = V / unit[:, None]
        return B @ (inverse_curvature @ scores.sum(0)), B @ C @ B.T

    def evidence(self, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Information and gradient for T_parent_child."""
        step, C = self.step(np.arange(len(self.block)))
        B = self.V * _UNITS[:, None]
        information = B @ np.linalg.inv(B.T @ C @ B) @ B.T
        J = np.eye(7)  # exp(xi_base) A T = A exp(Ad(A)^-1 xi_base) T
        J[:6, :6] = adjoint(A)
        return J.T @ information @ J, J.T @ information @ step


def solve(edge: Edge, sources: DaySources) -> tuple[EdgeEvidence, int]:
    """Evidence of a day, and its number of common moments; raises SolveError if there are too few."""
    parent, child = (s.name for s in edge.sensors)
    of_child = {o.frame_index: o for o in sources.sweeps(child)}
    rows = [o for o in sources.sweeps(parent) if o.frame_index in of_child]
    T = sources.on_base(parent), sources.on_base(child)
    sigma_rad = sources.prior.sigmas_between(parent, BASE.name)[0]
    of_child_rows = [of_child[o.frame_index] for o in rows]
    pair = LidarPair(sweeps_of(rows), sweeps_of(of_child_rows), T[0], T, sigma_rad)
    found = estimate_lidar_lidar(edge, pair, sources.ego_at(rows), inverse(T[0]) @ T[1], Scenes.of(rows))
    return found, len(rows)


def estimate_lidar_lidar(
    edge: Edge, pair: LidarPair, ego: EgoMotion, T_parent_child: Float[np.ndarray, "4 4"], scenes: Scenes
) -> EdgeEvidence:
    """Evidence on T_parent_child and the child's clock, from a start accurate to 5 deg and a metre.

    Raises:
        SolveError: too few moments with overlap.
    """
    block_of, A = scenes.block, pair.T_base_parent
    moments = _moments(pair, ego, T_parent_child, scenes)
    starts = [_turned(turn) for turn in (0.0, _TURN_RAD, -_TURN_RAD)]
    ends = sorted((_climbed(moments, X) for X in starts), key=lambda e: -e.share)
    if ends[0].share < _LEAST_SHARE:
        raise SolveError(because("few surfaces", edge=edge.name, share=ends[0].share))
    # De-skewed along the pose that was found, the child is laid on once more.
    T = inverse(A) @ ends[0].X @ A @ T_parent_child
    moments = _moments(pair, ego, T, scenes)
    end = _climbed(moments, np.eye(4))
    frames = [m.frame for m in moments]
    at_prior = _equations(moments, A @ T_parent_child @ inverse(A @ T), 0.0, _GATES_M[-1])
    T = inverse(A) @ end.X @ A @ T
    seen = _Seen.of(end, block_of[frames])
    information, gradient = seen.evidence(A)
    floor = _floor(pair, moments)
    numbers = {"share": end.share, "scatter_m": end.scatter_m, "moments": float(len(moments))}
    return EdgeEvidence(
        edge, T, end.dt_s, information, gradient, by_sensor([Considered("matching", np.diag(floor))], edge),
        frames_used=len(moments), checks=_other_ends(ends), diagnostics=numbers, notes=_notes(information),
        others=_others(seen, moments, at_prior, A, np.diag(floor**2)),
        parts=_parts(seen, moments, T, A, [pair.parent[k].stamp_ns for k in frames], scenes.scene[frames]),
    )  # fmt: skip


def _moments(pair: LidarPair, ego: EgoMotion, T_parent_child: np.ndarray, scenes: Scenes) -> list[_Moment]:
    """At most thirty moments, spread over the day's scenes."""
    A = pair.T_base_parent
    parents = deskewed_again(pair.parent, ego.at_sensor(pair.deskewed[0]), ego.at_sensor(A))
    children = deskewed_again(pair.child, ego.at_sensor(pair.deskewed[1]), ego.at_sensor(A @ T_parent_child))
    found = []
    for k in _chosen(pair, scenes):
        vx, vy, turn = np.nan_to_num(np.r_[ego.velocity_mps[k], ego.yaw_rate_radps[k]])
        surfaces = Surfaces.of(_standing(parents[k], A, _MOST_SURFACES, vx))
        points = _standing(children[k], A @ T_parent_child, _MOST_POINTS, vx)
        if surfaces is not None and len(points):
            gap_s = (children[k].stamp_ns - parents[k].stamp_ns) * 1e-9
            motion = np.array([0.0, 0.0, turn, vx, vy, 0.0])
            found.append(_Moment(surfaces, points, gap_s, motion, k))
    if len(found) < _FEWEST_MOMENTS:
        raise SolveError(because("few common", needed=_FEWEST_MOMENTS, used=len(found)))
    return found


def _chosen(pair: LidarPair, scenes: Scenes) -> list[int]:
    """One moment of each scene, evenly."""
    both = [
        k
        for k, (a, b) in enumerate(zip(pair.parent, pair.child, strict=True))
        if len(a.xyz_m) and len(b.xyz_m)
    ]
    first = (
        np.array(both, np.int64)[np.unique(scenes.scene[both], return_index=True)[1]] if both else np.zeros(0)
    )
    picked = np.unique(np.linspace(0, len(first) - 1, min(len(first), _MOST_MOMENTS)).astype(int))
    return [int(first[i]) for i in picked] if len(first) else []


def _standing(sweep: Sweep, T_base_lidar: np.ndarray, most: int, speed_mps: float) -> np.ndarray:
    """Some points in axes of the base; on motorways without vehicles, because passing ones shift the clock."""
    keep = ~sweep.may_move if speed_mps > _MOTORWAY_MPS else np.ones(len(sweep.xyz_m), bool)
    xyz_m = sweep.xyz_m[keep]
    return transform_points(T_base_lidar, xyz_m[:: max(1, -(-len(xyz_m) // most))])


def _turned(turn_rad: float) -> np.ndarray:
    return from_rotation_translation(exp_so3(np.array([0.0, 0.0, turn_rad])), np.zeros(3))


def _climbed(
    moments: Sequence[_Moment], X: np.ndarray, dt: float = 0.0, gates_m: Sequence[float] = _GATES_M
) -> _End:
    """Registration from a start, with decreasing gates."""
    # Nothing holds a direction that the scenes do not show but a damping that never decides between ends.
    damped = np.diag(_UNITS**2) * 1e-3
    for gate in gates_m:
        for _ in range(_STEPS):
            end = _equations(moments, X, dt, gate)
            step = np.linalg.solve(end.H.sum(0) + damped, end.g.sum(0))
            X, dt = exp_se3(step[:6]) @ X, dt + float(step[6])
            if np.abs(step).max() < _CONVERGED:
                break
    return _equations(moments, X, dt, _GATES_M[-1])


def _equations(moments: Sequence[_Moment], X: np.ndarray, dt_s: float, gate_m: float) -> _End:
    """Information and gradient of each moment for (xi, dt), left perturbation of X in axes of the base."""
    H, g, scatter = np.zeros((len(moments), 7, 7)), np.zeros((len(moments), 7)), list[float]()
    shares = np.zeros(len(moments))
    for k, m in enumerate(moments):
        # The child measured when the car was further on: its points lie where the base then was.
        M = exp_se3(m.motion * (m.gap_s + dt_s))
        moved = transform_points(M @ X, m.points_m)
        found = plane_equations(moved, m.surfaces, gate_m)
        if found is None:
            continue
        J = np.eye(6, 7)
        J[:, :6] = adjoint(M)
        J[:, 6] = m.motion
        H[k], g[k] = J.T @ found.information @ J, J.T @ found.gradient
        shares[k] = found.share
        scatter.append(found.scatter_m)
    return _End(X, dt_s, H, g, shares, float(np.median(scatter)) if scatter else float("nan"))


def _other_ends(ends: Sequence[_End]) -> tuple[Check, ...]:
    """Whether another start leads to a different pose with an equally good fit."""
    best = ends[0]
    apart = [
        other
        for other in ends[1:]
        if rotation_angle_rad(inverse(best.X) @ other.X) > _APART_RAD and other.share > _NEARLY * best.share
    ]
    return (Check(because("other start"), "witnesses_disagree"),) if apart else ()


def _floor(pair: LidarPair, moments: Sequence[_Moment]) -> np.ndarray:
    """Sigmas of errors common to all moments: ranges, and de-skewing with a wrong base."""
    speed = float(np.sqrt(np.mean([m.motion[3] ** 2 + m.motion[4] ** 2 for m in moments])))
    lifted = (
        speed
        * pair.base_sigma_rad
        * np.array([*[_SWEEP_S_PER_RAD / TYPICAL_RANGE_M] * 3, *[SWEEP_S / 2] * 3])
    )
    return np.hypot(_MATCHING, lifted)


def _refitted(end: _End, moments: Sequence[_Moment], some: np.ndarray) -> _End:
    """The end of some moments, from that of all of them."""
    return _climbed([moments[k] for k in some], end.X, end.dt_s, _GATES_M[2:])


def _others(
    seen: _Seen, moments: Sequence[_Moment], at_prior: _End, A: np.ndarray, floor: np.ndarray
) -> OtherScenes:
    """Moments of even blocks at the fit of the odd ones, and the other way round; `floor` of either, 6 6."""
    is_even = np.unique(seen.block, return_inverse=True)[1] % 2 == 0
    halves = [np.flatnonzero(is_even), np.flatnonzero(~is_even)]
    if min(len(half) for half in halves) < _FEWEST_MOMENTS // 2:
        return OtherScenes(np.zeros(6), np.zeros((6, 6)))
    one, other = (_refitted(seen.end, moments, half) for half in halves)
    after = np.where(is_even, *(_equations(moments, e.X, e.dt_s, _GATES_M[-1]).shares for e in (other, one)))
    to_parent, covariance = adjoint(inverse(A)), seen.step(np.arange(len(moments)))[1][:6, :6]
    apart = np.append(log_se3(one.X @ inverse(other.X)), one.dt_s - other.dt_s) / 2
    shift = to_parent @ (seen.V @ (seen.V.T @ (apart * _UNITS)) / _UNITS)[:6]
    spread = to_parent @ covariance @ to_parent.T + floor
    return OtherScenes(shift, spread, (1 - at_prior.shares, 1 - after, seen.block))


def _parts(
    seen: _Seen,
    moments: Sequence[_Moment],
    T: np.ndarray,
    A: np.ndarray,
    stamp_ns: Sequence[int],
    scene: np.ndarray,
) -> DayParts | None:
    """First and last part of the day."""
    end, to_parent = seen.end, adjoint(inverse(A))

    def solve(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own = _refitted(end, moments, rows)
        _, C = replace(seen, end=own, block=seen.block[rows]).step(np.arange(len(rows)))
        turn = inverse(A) @ own.X @ inverse(end.X) @ A
        return own.X, turn @ T, (to_parent @ C[:6, :6] @ to_parent.T)[:3, :3]

    def score(X: np.ndarray) -> np.ndarray:
        return _equations(moments, X, end.dt_s, _GATES_M[-1]).shares

    turns = tuple(k for k in range(3) if np.linalg.norm(A[:3, k] @ seen.V[:3]) > _WHOLLY)
    return parts_of_day(end.g, stamp_ns, solve, score, turns, scene) if turns else None


def _notes(information: np.ndarray) -> tuple[str, ...]:
    return () if information[6, 6] > 1.0 else (because("lidar clocks"),)
