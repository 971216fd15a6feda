"""Edge lidar-base: mounting of a lidar on the car, from the road under it and its direction of travel.

The road determines roll, pitch and height. The direction of travel determines yaw, and pitch more sharply,
because the rear axle follows the road. Both are means over scenes, so slopes, bends and bumps cancel. Pitch
and roll of the body under acceleration are fitted as functions of the acceleration. x and y have no
information. Base is thus the frame of road and wheels: z up from the road, x along straight driving. A frame
fixed to the body differs by the car's stance (load, springs) and rolling direction (toe); `on_base.STANCE` is the
size of this difference.

The road under the car, per sweep: height, slope and cross slope in axes of the base.

The fit uses a strip as wide as the car. Beyond it are kerbs and pavements: a plane through all ground within
35 m leaned by 0.1 to 0.4 deg towards the nearer pavement on simulated streets, the strip by 0.03. Along the
way the strip is a parabola, because roads bend; it is evaluated at the base's origin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.edges.on_base import (
    CHANGES,
    STANCE,
    DaySources,
    Regression,
    Rows,
    Series,
    changes_by_left,
    first_and_last,
    of_stance_and,
    other_scenes,
    regress,
)
from pipeline.calibrate.edges.sweep_travel import Sweep, SweepTravel, deskewed_again, sweep_travel, sweeps_of
from pipeline.calibrate.numerics.frame_blocks import Scenes
from pipeline.calibrate.numerics.nuisances import Considered, by_sensor, considered_covariance
from pipeline.calibrate.reasons import because
from pipeline.objective.ego_motion import EgoMotion
from pipeline.rig.estimates import EDGE, Check, EdgeEvidence, OtherScenes
from pipeline.rig.graph import Edge
from pipeline.rig.se3 import exp_so3, from_rotation_translation, inverse, transform_points

__all__ = ["estimate_lidar_base", "solve"]

# A lidar's own: ranges are good to 3 cm by data sheets, at 8 m and 1.8 m above the road that is 7 mm of height.
_RANGES_M = 0.007
# Beyond what scenes scatter by, errors of 8 tuning days: roll 0.017 deg RMS, pitch 0.012, yaw 0.016, height 2 mm.
_MATCHING = np.array([*np.radians([0.01, 0.01, 0.01]), 0.001])
# By data sheets; the road alone rests on it: by a real car's 16 rings its pitch was .23 deg from a camera's travel.
_BEAMS = Considered("beams", np.radians(0.1) * np.eye(2, 6))
_PAIRS_OF_TRAVEL = 20  # of sweeps: they show a way to .03 deg, as cameras do, at a third of the cost
_AXLE_SIGMA_M = 1.5  # how far from the base the point may lie that follows the car's way: a wheelbase's half
_NODS_SIGMA = np.radians(0.3)  # per m/s2, along and across: 3 deg/g
# Of a way, beside what its registration states: bodies and roads. Weighed by its length, ways of motorways, some ten
# centimetres off, outweighed those of towns: yaw of 30 days was .11 deg RMS off and at most .55, and is .06 and .14.
_LEAST_RAD = np.radians(0.1)
_AGAIN_RAD = np.radians(2.0)  # so far from the start the sweeps are looked at again
_MEASURED_SIGMAS = 4.0
_AXES = ("roll", "pitch", "yaw", "height")
_ASIDE_M, _ALONG_M = 1.6, (-12.0, 22.0)
_OFF_M = 0.7  # from where the prior expects the road: what lies further off is no road, or no prior
_CELL_M = (2.0, 0.4)  # stretches of road that count alike: rings crowd near the car
_FEWEST_CELLS, _FEWEST_POINTS = 15, 60
_LEAST_LENGTH_M, _LEAST_WIDTH_M = (
    8.0,
    2.0,
)  # of what is seen: less does not separate slope from bend, or left from right
_FLAT_M = 0.01
_PASSES = 8


@dataclass(frozen=True, eq=False)
class RoadUnder:
    """One road per row: z = height + slope x + cross_slope y + bend x^2 in axes of the base."""

    moment: np.ndarray  # R
    height_m: np.ndarray
    slope: np.ndarray
    cross_slope: np.ndarray


@dataclass(frozen=True, eq=False)
class _Shown:
    """Evidence of a lidar's pose in its base; None for parts without data."""

    roll: Regression | None
    pitch_by_road: Regression | None
    pitch_by_way: Regression | None
    yaw: Regression | None
    height: Regression | None

    def axis(self, name: str) -> tuple[float, float] | None:
        """Change of an axis estimated from the data, and its variance."""
        if name != "pitch":
            one = getattr(self, name)
            return None if one is None else (one.value[0], one.covariance[0, 0])
        both = [p for p in (self.pitch_by_road, self.pitch_by_way) if p is not None]
        if not both:
            return None
        weight = np.array([1 / p.covariance[0, 0] for p in both])
        value = np.array([p.value[0] for p in both])
        mean = float(weight @ value / weight.sum())
        apart = float(weight @ (value - mean) ** 2) / max(len(both) - 1, 1)
        return mean, max(1.0, apart) / float(
            weight.sum()
        )  # two that differ by more than both sigmas widen it


def solve(edge: Edge, sources: DaySources) -> tuple[EdgeEvidence, int]:
    """Evidence of a day, and its number of moments; raises SolveError if there are too few."""
    name = edge.parent.name
    rows, T = sources.sweeps(name), sources.on_base(name)
    if sources.prior.is_base_loose:
        rows = [o for k, o in enumerate(rows) if k % max(2, len(rows) // _PAIRS_OF_TRAVEL) < 2]
    ego, heights = sources.ego_at(rows), sources.heights.get(name)
    found = estimate_lidar_base(
        edge, sweeps_of(rows), ego, T, Scenes.of(rows), road_z_m=sources.road_z_m, height_m=heights
    )
    if sources.prior.is_base_loose and "pitch_road_less_way_deg" not in found.diagnostics:
        found = replace(found, bias={**found.bias, EDGE: found.bias[EDGE] + considered_covariance([_BEAMS])})
    return found, len(rows)


def estimate_lidar_base(
    edge: Edge,
    sweeps: Sequence[Sweep],
    ego: EgoMotion,
    T_base_lidar: Float[np.ndarray, "4 4"],
    scenes: Scenes,
    *,
    T_base_lidar_deskewed: Float[np.ndarray, "4 4"] | None = None,
    road_z_m: float = 0.0,
    height_m: tuple[float, float] | None = None,
) -> EdgeEvidence:
    """Evidence of a day on T_lidar_base.

    Args:
        ego: motion of the base at these moments.
        T_base_lidar: the start; it does not contribute to the information.
        T_base_lidar_deskewed: pose with which sweeps were de-skewed; None = the start.
        road_z_m: height of the road in axes of the base; 0 for a base on the ground.
        height_m: the lidar's measured height over the road, and its sigma.
    """
    assumed = T_base_lidar if T_base_lidar_deskewed is None else T_base_lidar_deskewed
    T, travel, roads, rows = _solved(sweeps, ego, T_base_lidar, assumed, scenes, road_z_m)
    shown = _Shown(**{name: regress(of) for name, of in rows.items()})
    change, variance = np.zeros(4), np.full(4, np.inf)
    for k, name in enumerate(_AXES):
        found = shown.axis(name)
        if found is not None:
            change[k], variance[k] = found
    checks = list[Check]()
    if height_m is not None:
        off_m = height_m[0] + road_z_m - T[2, 3]
        change[3], variance[3], contradicts = _with_measured(change[3], variance[3], off_m, height_m[1])
        checks += contradicts
    information, gradient = _by_left_perturbation(T, change, variance)
    return EdgeEvidence(
        edge, inverse(T), 0.0, information, gradient, _errors(edge, T),
        frames_used=len(set(roads.moment) | set(travel.moment)),
        checks=tuple(checks), diagnostics=_numbers(travel, roads, shown), notes=_notes(variance),
        others=_others(T, shown), parts=first_and_last(T, _series(travel, rows["yaw"], sweeps, scenes)),
    )  # fmt: skip


def _solved(
    sweeps: Sequence[Sweep],
    ego: EgoMotion,
    T: np.ndarray,
    assumed: np.ndarray,
    scenes: Scenes,
    road_z_m: float,
) -> tuple[np.ndarray, SweepTravel, RoadUnder, dict[str, Rows]]:
    """Pose from road and direction of travel, and their evidence there: rows by the names of `_Shown`."""
    start = T
    skewed = ego.at_sensor(assumed)
    travel = sweep_travel(deskewed_again(sweeps, skewed, ego.at_sensor(T)), ego, T)
    for again in range(3):
        # The road is fitted again after de-skewing along the way; the way hardly depends on that.
        now = deskewed_again(sweeps, skewed, ego.at_sensor(T))
        if again and _angle(start, T) > _AGAIN_RAD:
            start, travel = T, sweep_travel(now, ego, T)
        roads = road_under(now, T, road_z_m)
        rows = _rows(travel.seen_from(T @ inverse(start)), roads, ego, scenes, road_z_m)
        if again < 2:
            shown = _Shown(**{name: regress(of) for name, of in rows.items()})
            T = _moved(T, [0.0 if (found := shown.axis(name)) is None else found[0] for name in _AXES])
    return T, travel, roads, rows


def _rows(
    travel: SweepTravel, roads: RoadUnder, ego: EgoMotion, scenes: Scenes, road_z_m: float
) -> dict[str, Rows]:
    """Regressions on longitudinal and lateral acceleration and curvature; signs are those of the pose's change."""
    azimuth, elevation = travel.angles_rad.T
    one, free = np.ones(len(azimuth)), np.inf
    block, sigma = travel.bend, np.hypot(_LEAST_RAD, travel.sigma_rad)
    turning = np.stack([one, travel.curvature_radpm], 1)
    nodding = np.stack([one, travel.acceleration_mps2], 1)
    yaw = Rows(turning, -azimuth, sigma[:, 0], block, np.array([free, _AXLE_SIGMA_M]), one)
    by_way = Rows(nodding, elevation, sigma[:, 1], block, np.array([free, _NODS_SIGMA]), one)
    block, share = scenes.block[roads.moment], scenes.weight[roads.moment]
    one, sigma = np.ones((len(block), 1)), np.ones(len(block))
    across = (ego.velocity_mps[:, 0] * ego.yaw_rate_radps)[roads.moment]
    known = np.isfinite(across)
    leaning = np.stack([one[:, 0], np.where(known, across, 0.0)], 1)
    roll = Rows(leaning, -roads.cross_slope, sigma, block, np.array([free, _NODS_SIGMA]), share)
    by_road = Rows(one, roads.slope, sigma, block, np.array([free]), share)
    height = Rows(one, road_z_m - roads.height_m, sigma, block, np.array([free]), share)
    return {"roll": roll, "pitch_by_road": by_road, "pitch_by_way": by_way, "yaw": yaw, "height": height}


def _moved(T: np.ndarray, change: Sequence[float]) -> np.ndarray:
    """The pose with the lidar rotated about its own origin, and lifted by the last number [m]."""
    return from_rotation_translation(
        exp_so3(np.array(change[:3])) @ T[:3, :3], T[:3, 3] + [0.0, 0.0, change[3]]
    )


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1.0, 1.0)))


def _with_measured(
    change: float, variance: float, off_m: float, sigma_m: float
) -> tuple[float, float, list[Check]]:
    """The height from the road combined with a measured one."""
    if not np.isfinite(variance):
        return off_m, sigma_m**2, []
    apart = abs(off_m - change) / np.sqrt(variance + sigma_m**2 + STANCE[3] ** 2 + _RANGES_M**2)
    why = because("height", off=100 * (change - off_m))
    checks = [Check(why, "witnesses_disagree")] if apart > _MEASURED_SIGMAS else []
    total = 1 / (1 / variance + 1 / sigma_m**2)
    return total * (change / variance + off_m / sigma_m**2), total, checks


def _others(T: np.ndarray, shown: _Shown) -> OtherScenes:
    """Halves of the scenes, beyond the car's stance; pitch by the way, which is sharper than that by the road."""
    fits = (shown.roll, shown.pitch_by_way, shown.yaw, shown.height)
    return other_scenes(T, list(zip(CHANGES, fits, STANCE.tolist(), strict=True)))


def _series(travel: SweepTravel, yaw: Rows, sweeps: Sequence[Sweep], scenes: Scenes) -> Series:
    """Yaw over the day. Roll and pitch are not compared: a car of two drives stood .66 deg apart on its road."""
    stamp_ns = np.array([s.stamp_ns for s in sweeps], np.int64)[travel.moment]
    return Series(2, yaw, scenes.scene[travel.moment], stamp_ns, float(STANCE[2]))


def _by_left_perturbation(
    T: np.ndarray, change: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient of T_lidar_base, from changes of T_base_lidar: roll, pitch, yaw, height."""
    J = np.zeros((4, 7))
    J[:, :6] = changes_by_left(T)[list(CHANGES)]
    weight = 1 / variance
    return (J.T * weight) @ J, J.T @ (weight * change)


def _errors(edge: Edge, T: np.ndarray) -> Mapping[str, np.ndarray]:
    """Biases by owner: the car's stance, the lidar's ranges, the matching."""
    up = inverse(T)[:3, :3] @ [0.0, 0.0, 1.0]
    ranges = Considered("ranges", _RANGES_M * np.append(np.zeros(3), up)[None])
    matching = np.diag(_MATCHING) @ np.eye(6)[list(CHANGES)]
    return by_sensor([*of_stance_and(T, matching=matching), ranges], edge)


def _numbers(travel: SweepTravel, roads: RoadUnder, shown: _Shown) -> dict[str, float]:
    numbers = {
        "way_m": float(travel.way_m.sum()),
        "sweep_pairs": len(travel.moment),
        "roads": len(roads.moment),
    }
    if shown.yaw is not None:
        numbers |= {"axle_behind_base_m": float(shown.yaw.value[1])}
    if shown.pitch_by_road is not None and shown.pitch_by_way is not None:
        apart = shown.pitch_by_road.value[0] - shown.pitch_by_way.value[0]
        numbers |= {"pitch_road_less_way_deg": float(np.degrees(apart))}
    return {name: float(value) for name, value in numbers.items()}


def _notes(variance: np.ndarray) -> tuple[str, ...]:
    missing = [name for name, v in zip(_AXES, variance, strict=True) if not np.isfinite(v)]
    reasons = ["lidar base, yaw" if axis == "yaw" else "lidar base, road" for axis in missing]
    notes = [because(reason, axis=axis) for axis, reason in zip(missing, reasons, strict=True)]
    return (*notes, because("lidar base, shift"))


def road_under(sweeps: Sequence[Sweep], T_base_lidar: Float[np.ndarray, "4 4"], road_z_m: float) -> RoadUnder:
    """Fit the road in each sweep that shows enough of it; `T_base_lidar` is good to a few degrees."""
    rows = [
        (float(k), *fit) for k, s in enumerate(sweeps) if (fit := _fit(s, T_base_lidar, road_z_m)) is not None
    ]
    table = np.array(rows, np.float64).reshape(-1, 4)
    return RoadUnder(table[:, 0].astype(np.int64), *table[:, 1:].T)


def _fit(sweep: Sweep, T_base_lidar: np.ndarray, road_z_m: float) -> tuple[float, float, float] | None:
    p = transform_points(T_base_lidar, sweep.xyz_m[sweep.is_ground])
    off = np.abs(p[:, 2] - road_z_m) < _OFF_M
    p = p[off & (np.abs(p[:, 1]) < _ASIDE_M) & (p[:, 0] > _ALONG_M[0]) & (p[:, 0] < _ALONG_M[1])]
    if len(p) < _FEWEST_POINTS or (np.ptp(p[:, :2], axis=0) < (_LEAST_LENGTH_M, _LEAST_WIDTH_M)).any():
        return None
    cell = np.floor(p[:, :2] / _CELL_M).astype(np.int64) @ [1000, 1]
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    if len(count) < _FEWEST_CELLS:
        return None
    even = 1 / count[cell]
    x, y, z = p.T
    A = np.stack([np.ones_like(x), x, y, x * x], 1)
    weight, road = even, np.zeros(4)
    for _ in range(_PASSES):
        road = np.linalg.solve((A.T * weight) @ A, (A.T * weight) @ z)
        r = z - A @ road
        sigma = max(1.4826 * float(np.median(np.abs(r))), _FLAT_M)
        weight = even * (1 + (r / (2 * sigma)) ** 2) ** -2
    return float(road[0]), float(road[1]), float(road[2])
