"""Checks of a solved day, listed in `DAY_CHECKS`: each looks at the day as a whole and fails some of its edges."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.frame_blocks import FEWEST_SCENES, scenes_of
from pipeline.calibrate.reasons import because
from pipeline.calibrate.select.frames import Selection
from pipeline.calibrate.verify.motion_sources import MotionFindings
from pipeline.core.config import ChecksConfig, FleetConfig
from pipeline.rig.attribution import PairShift, attribute
from pipeline.rig.estimates import Check, DayParts, PairEstimate, Prior, Solution
from pipeline.rig.graph import BASE, EDGE_OF_PAIR, Edge
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.se3 import adjoint, change_between, change_jacobian, inverse
from schemas.calibrations import DOF_NAMES, PAIRS
from schemas.observations import Observation
from schemas.words import AXIS_NAMES

__all__ = [
    "DAY_CHECKS", "MOVED_SIGMAS", "PART_FLOOR_RAD", "DayCheck", "FoundDay", "checks_of_day", "clock_alarms",
    "constancy_failures", "far_positions", "moved_failures", "own_positions", "prior_alarms",
    "scene_failures",
]  # fmt: skip

# --------------------------------------------------------------------------------------------------
# Whether a day shows enough different scenes for anything to be certified: frames of a standing car are one.


def scene_failures(fitted: Sequence[Observation]) -> list[Check]:
    """A failed check for a fit to few scenes: errors common to them are in held-out frames too."""
    scenes = len(np.unique(scenes_of(fitted)))
    if scenes >= FEWEST_SCENES or not fitted:
        return []
    why = because("few scenes", used=len(fitted), scenes=scenes, needed=FEWEST_SCENES)
    return [Check(why, "few_scenes")]


# --------------------------------------------------------------------------------------------------
# Alarms: a mounting or a clock that the day puts many sigmas from its prior.
#
# A degree of freedom that the day leaves at the prior has the prior's error, even if that exceeds the stated
# sigma. The pair's own day without the prior is too uncertain to be a result, but may still be ten sigmas away.
# What another edge of the same sensor shows of its prior is in `wrong_priors`.


# By which the day's own position must differ as well, where frames confirm it; else as many as of the prior.
_OF_DAY_SIGMAS = 2.0
# Normal deviates by which frames align better at the radar's own position than at the prior, and than as far beyond.
# On 43 good days of ten rigs one of the two was above -0.9: the cost slopes there, and does not dip.
_CLEARLY_Z = 1.5
# By which a time offset beyond all that is searched must stand out more than the solution's own. On 42 good days the
# one more than 0.12 s from the solution did so by 0.7; where clocks were 0.5 s off it was 0.8 to 5, in lidar-radar 3 to
# 6.
_ELSEWHERE_Z = 2.0


def prior_alarms(
    pairs: Mapping[str, PairEstimate], prior: Prior, limits: ChecksConfig
) -> dict[str, list[Check]]:
    """Positions left at the prior that the day's data contradict."""
    sigma_m = prior.translation_sigma_m
    return {
        pair: [
            Check(_far_position(pair, k, shift, own_positions(estimate)[k][1], sigma_m), "prior")
            for k, shift in far_positions(estimate, np.full(6, sigma_m), limits).items()
        ]
        for pair, estimate in pairs.items()
    }


def _far_position(pair: str, k: int, shift_m: float, own_m: float, prior_m: float) -> str:
    axis = AXIS_NAMES[pair.partition("_")[0]][k]
    return because("far position", shift=shift_m, sigma=own_m, axis=axis, prior=prior_m)


def own_positions(estimate: PairEstimate) -> dict[int, tuple[float, float]]:
    """The day's own shift from a prior that it could not improve, and its sigma [m], by index."""
    d = estimate.diagnostics
    keys = {k: f"own_{DOF_NAMES[k]}" for k in range(3, 6)}
    return {k: (d[f"{name}_m"], d[f"{name}_sigma_m"]) for k, name in keys.items() if f"{name}_m" in d}


def far_positions(
    estimate: PairEstimate, sigma_m: Float[np.ndarray, " 6"], limits: ChecksConfig
) -> dict[int, float]:
    """The day's own shifts that differ from the prior by many sigmas (of prior and day) [m], by index."""
    z = [estimate.diagnostics[n] for n in ("own_z_prior", "own_z_beyond") if n in estimate.diagnostics]
    many = limits.max_move_prior_sigmas
    of_day = _OF_DAY_SIGMAS if z else many
    return {
        k: shift
        for k, (shift, own) in own_positions(estimate).items()
        if abs(shift) > np.hypot(many * sigma_m[k], of_day * own) and all(value < -_CLEARLY_Z for value in z)
    }


def clock_alarms(
    pairs: Mapping[str, PairEstimate], sigmas_s: Mapping[str, float], limits: ChecksConfig
) -> dict[str, list[Check]]:
    """Time offsets beyond their prior sigmas, estimated or at the end of the search range."""
    out = {}
    for pair, estimate in pairs.items():
        sigma_s = sigmas_s[pair]
        dt_s, own_s, found = estimate.time_offset_s, estimate.time_offset_sigma_s or 0.0, estimate.diagnostics
        if dt_s is None:
            continue
        many = limits.max_move_prior_sigmas * float(np.hypot(sigma_s, own_s))
        far_s = found.get("own_dt_s", dt_s)
        is_elsewhere = abs(far_s - dt_s) > many and abs(found.get("own_dt_z", 0.0)) > _ELSEWHERE_Z
        if is_elsewhere:
            why = because("other clock", shift=1e3 * far_s, sigma=1e3 * sigma_s)
        elif abs(dt_s) > many:
            why = because("far clock", shift=1e3 * dt_s, sigma=1e3 * sigma_s)
        else:
            continue
        out[pair] = [Check(why, "time_offset")]
    return out


# --------------------------------------------------------------------------------------------------
# Checks of a solved day, in one table: each looks at the day as a whole and fails some of its pairs.
#
# A new check is a function in a module of this folder and a line in `DAY_CHECKS`.


@dataclass(frozen=True, eq=False)
class FoundDay:
    """A solved day before its verdict."""

    observations: Sequence[Observation]
    selection: Selection
    prior: Prior
    solution: Solution
    fleet: FleetConfig
    limits: ChecksConfig
    motion: MotionFindings


DayCheck = Callable[[FoundDay], Mapping[str, Sequence[Check]]]


def _motion(day: FoundDay) -> Mapping[str, Sequence[Check]]:
    """Sweeps are de-skewed, and stamps bridged, by the car's motion: a pair is right where its source of it is."""
    return {pair: day.motion.of(pair) for pair in PAIRS}


def _solver(day: FoundDay) -> Mapping[str, Sequence[Check]]:
    """Failed checks of the solver."""
    return day.solution.failed_checks


def _scenes(day: FoundDay) -> Mapping[str, Sequence[Check]]:
    fitted = day.selection.fit.items()
    return {pair: scene_failures([day.observations[i] for i in frames]) for pair, frames in fitted}


def _constancy(day: FoundDay) -> Mapping[str, Sequence[Check]]:
    return constancy_failures(day.solution.pairs)


def _alarms(day: FoundDay) -> Mapping[str, Sequence[Check]]:
    """Mountings and clocks many sigmas from their priors."""
    pairs = {p: e for p, e in day.solution.pairs.items() if e.frames_used}
    sigmas_s = dict.fromkeys(PAIRS, day.fleet.solve.time_offset_sigma_s)
    sigmas_s["camera_lidar"] = day.prior.camera.stamp_sigma_s or sigmas_s["camera_lidar"]
    found = [prior_alarms(pairs, day.prior, day.limits), clock_alarms(pairs, sigmas_s, day.limits)]
    return {pair: [check for of in found for check in of.get(pair, ())] for pair in pairs}


# In the order in which a record states them.
DAY_CHECKS: tuple[DayCheck, ...] = (_motion, _solver, _scenes, _constancy, _alarms)


def checks_of_day(day: FoundDay) -> dict[str, list[Check]]:
    """Failed checks of every pair, each once."""
    found = [check(day) for check in DAY_CHECKS]
    return {
        pair: list(dict.fromkeys(c for by_pair in found for c in by_pair.get(pair, ()))) for pair in PAIRS
    }


# --------------------------------------------------------------------------------------------------
# Check that sensors stayed in place over the day, by comparing its first and last part, and which sensor moved.
#
# Other checks mix the hours of a day: even frames against odd ones, held-out blocks between the others. A knock
# at noon affects both sides equally. Each pair is therefore also solved from the first and the last part of the
# day (`parts_of_day`). Two pairs that shift and one that does not identify the sensor.

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
            why = because("moved, other", sensor=" or ".join(sensors), edge=surest.name)
            failed[edge] = [Check(why, "moved_in_day")]
    return failed


def _failure(edge: Edge, parts: DayParts, sigmas: float, sensors: list[str]) -> Check:
    axis = int(np.argmax(np.abs(parts.sigmas(PART_FLOOR_RAD))))
    first, last = (datetime.fromtimestamp(ns / 1e9, UTC).strftime("%H:%M:%S") for ns in parts.cut_ns)
    names = _OF_CAMERA if edge.parent.kind == "camera" else _OF_OTHERS
    size = {"axis": names[axis], "step": np.degrees(parts.step[axis]), "sigmas": sigmas}
    ends = [s.name for s in edge.sensors]
    who = " or ".join([s for s in ends if s in sensors] or ends)
    return Check(because("moved", **size, first=first, last=last, sensor=who), "moved_in_day")


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
