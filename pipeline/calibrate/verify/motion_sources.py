"""Comparison of odometry, the radar's Doppler and the lidar's own sweeps: speed, sign, yaw rate and lag.

Motion compensation between two sensors, and within a sweep, depends on the car's motion. A wrong source has
the effect of a wrong time offset, range or CameraInfo, so this check comes first. Of three sources, the one
that differs is reported. Of two, it is the one that drives backwards or is wrong by the factor of a unit,
else the odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int64

from pipeline.calibrate.reasons import because
from pipeline.objective.ego_motion import is_same, motion_of
from pipeline.objective.sweep_registration import arc_between, occupied_share, one_per_cell
from pipeline.rig.estimates import Check
from pipeline.rig.se3 import exp_so3, from_rotation_translation, transform_points
from schemas.observations import Observation

__all__ = ["MotionFindings", "compared_sources", "sweep_motion"]

_GAP_S, _LONGEST_GAP_S = 0.5, 0.8  # as long as scenes still overlap: at 0.1 s half a cell is 2.5 m/s
_MOST_PAIRS = 30
_FEWEST = 6  # frames, or pairs of them
_SIGMAS = 4.0
_MOVING_MPS, _TURNING_RADPS, _ACCELERATING_MPS2 = 3.0, 0.03, 0.3
_ADJACENT_S = 1.5  # across three frames: the acceleration between them
# Shares of moments in which two speeds are the same (`objective/ego_motion`).
_MET, _AGREED, _FEWEST_PAIRS = 0.4, 0.5, 8
_TURN_SHARE = 0.5
_LAG_S = 0.1  # radars measure tens of milliseconds beside their stamps
# Of the scans with detections enough, those that are explained: much of them stands still, or so many times more fits
# the velocity than by chance.
_MOST_SILENT, _EXPLAINED, _PEAKED, _DETECTIONS = 0.6, 0.3, 5.0, 30
_SAMPLE = 20  # frames in which detections are held against the lidar
# So many of them meet it, and so many times more, where a sensor is turned round or mirrored. On ten days of seven rigs
# 51 to 93 % met it as given, 43 % at most otherwise; where the prior's yaw is 5 deg off, 40 % and 1.6 times as many.
_LEAST_MET, _MORE = 0.45, 2.0
_FACTORS = ((3.6, "km/h for m/s"), (1 / 3.6, "m/s for km/h"), (180 / np.pi, "deg/s for rad/s"))
_NEAR = 0.1
_SPEEDS = ("odometry_by_lidar", "doppler_by_lidar", "odometry_by_doppler")
_NAMED_FACTORS = tuple(sign * f for f in (1.0, 3.6, 1 / 3.6, 2.0, 0.5) for sign in (-1, 1) if sign * f != 1)
_NAMES = {"odometry": "odometry", "doppler": "the radar's Doppler", "lidar": "the lidar's sweeps"}


@dataclass(frozen=True, eq=False)
class MotionFindings:
    """Wrong sources of motion with reasons, and the numbers."""

    wrong: list[Check] = field(default_factory=list)
    numbers: dict[str, float] = field(default_factory=dict)
    # Those of `wrong` that cost camera-lidar nothing: the radar's own, where odometry moves camera and lidar.
    of_radar: list[Check] = field(default_factory=list)

    def of(self, pair: str) -> list[Check]:
        """Reasons against a pair."""
        return [c for c in self.wrong if "radar" in pair or c not in self.of_radar]


@dataclass(frozen=True)
class _Slope:
    """y = slope x."""

    slope: float
    sigma: float
    points: int
    same: float  # share of points for which y = x
    agreed: float  # and y = slope x
    fits: float  # a factor with a name that most points agree to, else the slope

    def is_off(self, expected: float, allowed: float) -> bool:
        """Whether it differs from the expectation, beyond the tolerance and its own sigma."""
        return abs(self.slope - expected) > allowed + _SIGMAS * self.sigma


@dataclass(frozen=True, eq=False)
class _Sources:
    """The day's motion by each source, by frame; NaN if missing. Speeds along the lidar's x axis."""

    odometry_mps: Float[np.ndarray, " F"]
    yaw_rate_radps: Float[np.ndarray, " F"]
    doppler_mps: Float[np.ndarray, " F"]


def compared_sources(
    observations: Sequence[Observation], T_lidar_radar: Float[np.ndarray, "4 4"]
) -> MotionFindings:
    """Compare speeds and yaw rates of the day's observations, in order of time.

    `T_lidar_radar` is the prior; it rotates Doppler velocities into lidar axes, whose x points ahead. Of
    observations without a lidar it is T_base_radar.
    """
    if not observations:
        return MotionFindings()
    sources = _sources(observations, T_lidar_radar)
    slopes = _slopes(observations, sources)
    wrong = _wrong_axes(observations, T_lidar_radar) or _wrong_speeds(slopes, sources.doppler_mps)
    wrong = wrong or _silent_doppler(observations)
    is_radars = {"doppler": _has_odometry(observations), "orientation": _lidar_agrees(slopes)}
    of_radar = [check for check in wrong if is_radars.get(check.fault, False)]
    turning, lag = slopes.get("yaw_rate_by_lidar"), slopes.get("odometry_lag_s")
    if not wrong and turning is not None and turning.is_off(1.0, _TURN_SHARE):
        why = because("turning", ratio=turning.slope, hint=_hint(turning.slope))
        wrong.append(Check(why, "odometry"))
    if lag is not None and not wrong and lag.is_off(0.0, _LAG_S):
        order = "behind" if lag.slope > 0 else "ahead of"
        wrong.append(Check(because("lag", lag=abs(1e3 * lag.slope), order=order), "odometry"))
    numbers = {f"motion_{name}": s.slope for name, s in slopes.items()}
    same = {f"motion_{n}_same": s.same for n, s in slopes.items() if n in _SPEEDS}
    return MotionFindings(wrong, numbers | same, of_radar)


def _sources(observations: Sequence[Observation], T_lidar_radar: np.ndarray) -> _Sources:
    doppler, odometry = motion_of(observations, T_lidar_radar, np.inf)
    return _Sources(odometry.speed_mps, odometry.yaw_rate_radps, doppler.velocity_mps @ T_lidar_radar[0, :3])


def _slopes(observations: Sequence[Observation], sources: _Sources) -> dict[str, _Slope]:
    """Ratios and lag of the sources, from moving and turning frames."""
    pairs, speed_mps, yaw_rate_radps = sweep_motion(observations)
    odometry, turn, doppler = (
        np.array([values[i : j + 1].mean() for i, j in pairs], np.float64)
        for values in (sources.odometry_mps, sources.yaw_rate_radps, sources.doppler_mps)
    )
    found = {
        "odometry_by_lidar": _slope(odometry, speed_mps, _MOVING_MPS),
        "doppler_by_lidar": _slope(doppler, speed_mps, _MOVING_MPS),
        "odometry_by_doppler": _slope(sources.odometry_mps, sources.doppler_mps, _MOVING_MPS),
        "yaw_rate_by_lidar": _slope(turn, yaw_rate_radps, _TURNING_RADPS),
        "odometry_lag_s": _lag(observations, sources),
    }
    return {name: slope for name, slope in found.items() if slope is not None}


def _wrong_speeds(slopes: dict[str, _Slope], doppler_mps: np.ndarray) -> list[Check]:
    """The source whose speed differs from the others."""
    by_lidar = {n: s for n in ("odometry", "doppler") if (s := slopes.get(f"{n}_by_lidar")) is not None}
    off = {name: s for name, s in by_lidar.items() if s.same < _MET and s.points >= _FEWEST_PAIRS}
    between = slopes.get("odometry_by_doppler")
    if len(off) == 2:
        return _against_the_lidar(off["odometry"], agreed=between is not None and between.same >= _AGREED)
    if off:
        return [_wrong_speed(name, "lidar", s) for name, s in off.items()]
    forward = doppler_mps[np.abs(doppler_mps) > _MOVING_MPS]
    is_backwards = len(forward) >= _FEWEST and bool(np.mean(forward < 0) > 2 / 3)
    if between is None and is_backwards and "doppler" not in by_lidar:
        # Without other evidence: no car drives backwards for most of a day.
        return [Check(because("backwards", hint=because("doppler sign", hint=_hint(-1.0))), "doppler")]
    if between is None or between.same >= _AGREED:
        return []
    if (between.fits < 0 and is_backwards) or abs(abs(between.fits) * 3.6 - 1) < _NEAR:
        return [_wrong_speed("doppler", "odometry", replace(between, fits=1 / between.fits))]
    return [_wrong_speed("odometry", "doppler", between)]


def _against_the_lidar(odometry: _Slope, *, agreed: bool) -> list[Check]:
    """Reasons if the lidar contradicts odometry and Doppler, which may agree with each other or not."""
    if agreed and odometry.fits == -1:
        return [Check(because("lidar backwards"), "orientation")]
    # A Doppler is searched where odometry expects it, and may fit there. Sweeps that are mistaken (posts that meet the
    # next posts) show no constant factor.
    return [_wrong_speed("odometry", "lidar", odometry)] if odometry.agreed >= _AGREED else []


def _wrong_speed(name: str, against: str, found: _Slope) -> Check:
    hint = _hint(found.fits)
    if name == "doppler" and found.fits < 0:
        hint = because("doppler sign", hint=hint)
    numbers = {"share": found.same, "ratio": found.fits, "hint": hint}
    return Check(because("speed", source=_NAMES[name], other=_NAMES[against], **numbers), name)


def _hint(ratio: float) -> str:
    """An explanation that fits: a sign, a unit, or none."""
    fits = ["the other sign"] if ratio < 0 else []
    fits += [unit for factor, unit in _FACTORS if abs(abs(ratio) / factor - 1) < _NEAR]
    return because("fits", fits=" and ".join(fits)) if fits else because("scale")


def _silent_doppler(observations: Sequence[Observation]) -> list[Check]:
    """Scans with many detections that no velocity explains."""
    explained = [_is_explained(o) for o in observations if len(o.radar_xyz_m) >= _DETECTIONS]
    silent = len(explained) - sum(explained)
    if len(explained) < _FEWEST or silent <= _MOST_SILENT * len(explained):
        return []
    return [Check(because("no velocity", silent=silent, all=len(explained)), "doppler")]


def _is_explained(o: Observation) -> bool:
    """Whether the velocity of a scan is significant.

    In a convoy few objects stand still. But residuals of static detections concentrate at the velocity, while
    chance matches have the same density around it.
    """
    stands = o.radar_motion == 0
    if o.radar_velocity_mps is None or np.mean(stands) > _EXPLAINED:
        return o.radar_velocity_mps is not None
    off_mps = np.abs(o.radar_residual_mps)
    width_mps = off_mps[stands].max(initial=0.0)
    beside = (off_mps > width_mps) & (off_mps <= 3 * width_mps)  # twice as wide
    by_chance = max(float(np.sum(beside)) / 2, 1.0)
    return bool(np.sum(stands) > _PEAKED * by_chance)


def _wrong_axes(observations: Sequence[Observation], T_lidar_radar: np.ndarray) -> list[Check]:
    """A sensor that is turned round or mirrored, if its detections match the lidar only then."""
    swap = np.diag([1.0, -1.0, 1.0, 1.0])
    turn = from_rotation_translation(exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    tried = {
        "left and right of the lidar are swapped": swap @ T_lidar_radar,
        "left and right of the radar are swapped": T_lidar_radar @ swap,
        "the lidar is turned by 180 deg": turn @ T_lidar_radar,
        "the radar is turned by 180 deg": T_lidar_radar @ turn,
    }
    as_given = _met(observations, T_lidar_radar)
    if _MORE * as_given > 1.0:  # no other can meet so much more
        return []
    met, how = max((_met(observations, T), how) for how, T in tried.items())
    if met < max(_LEAST_MET, _MORE * as_given):
        return []
    return [Check(because("axes", met=met, how=how, given=as_given), "orientation")]


def _lidar_agrees(slopes: dict[str, _Slope]) -> bool:
    """Whether odometry drives and turns as the lidar's sweeps do."""
    speed, turning = slopes.get("odometry_by_lidar"), slopes.get("yaw_rate_by_lidar")
    return (
        speed is not None and speed.same >= _MET and (turning is None or not turning.is_off(1.0, _TURN_SHARE))
    )


def _has_odometry(observations: Sequence[Observation]) -> bool:
    """Whether a speed is logged, with a yaw rate, or without a speed by the radar's Doppler."""
    return any(
        o.ego_speed_mps is not None and (o.ego_yaw_rate_radps is not None or o.radar_velocity_mps is None)
        for o in observations
    )


def _met(observations: Sequence[Observation], T_lidar_radar: np.ndarray) -> float:
    """Share of the static detections of some frames near the lidar's standing objects."""
    picked = np.unique(np.linspace(0, len(observations) - 1, _SAMPLE).astype(int))
    shares = []
    for o in (observations[i] for i in picked):
        xyz = o.radar_xyz_m[o.radar_motion == 0].astype(np.float64)
        if len(xyz):
            shares.append(occupied_share(_standing(o), transform_points(T_lidar_radar, xyz)[:, :2]))
    return float(np.mean(shares)) if shares else 0.0


def _lag(observations: Sequence[Observation], sources: _Sources) -> _Slope | None:
    """Delay of odometry after the Doppler [s]: their difference over the acceleration."""
    stamps_s = np.array([o.stamp_ns for o in observations], np.int64) * 1e-9
    drives = np.array([o.drive for o in observations])
    span_s, speed = stamps_s[2:] - stamps_s[:-2], sources.odometry_mps
    adjacent = (drives[2:] == drives[:-2]) & (span_s < _ADJACENT_S)
    acceleration = np.where(adjacent, (speed[2:] - speed[:-2]) / np.maximum(span_s, 1e-3), np.nan)
    behind = (sources.doppler_mps - speed)[1:-1]
    both = np.isfinite(acceleration) & np.isfinite(behind)
    acceleration, behind = acceleration[both], behind[both]
    if not len(behind):
        return None
    # A slightly wrong scale is no lag: only the variation of both counts.
    return _slope(behind - np.median(behind), acceleration - np.median(acceleration), _ACCELERATING_MPS2)


def _slope(y: np.ndarray, x: np.ndarray, least: float) -> _Slope | None:
    """Slope by the weighted median over values with sufficiently large x; None for too few."""
    use = np.isfinite(y) & np.isfinite(x)
    use[use] &= np.abs(x[use]) >= least
    if use.sum() < _FEWEST:
        return None
    y, x = y[use], x[use]
    order = np.argsort(y / x)
    weight = np.cumsum(np.abs(x)[order])
    slope = float((y / x)[order][np.searchsorted(weight, 0.5 * weight[-1])])
    scatter = 1.4826 * float(np.median(np.abs(y - slope * x)))
    shares = {f: _share(y, f * x) for f in (1.0, slope, *_NAMED_FACTORS)}
    named = max(_NAMED_FACTORS, key=lambda f: shares[f])
    fits = named if shares[named] >= max(_MET, shares[slope]) else slope
    # A median costs 1.25 times the sigma of a mean.
    sigma = 1.25 * scatter / float(np.sqrt(np.sum(x**2)))
    return _Slope(slope, sigma, len(x), shares[1.0], shares[slope], fits)


def _share(y: np.ndarray, expected: np.ndarray) -> float:
    return float(np.mean(is_same(y, expected)))


# -- the lidar's own sweeps, without odometry, Doppler or calibration --------------


def sweep_motion(
    observations: Sequence[Observation],
) -> tuple[Int64[np.ndarray, "P 2"], Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Motion between sweeps about half a second apart that determine it, of at most 30 pairs over the day.

    Returns:
        Places of the earlier and the later observation, speed [m/s] and yaw rate [rad/s] in lidar axes: x ahead,
        positive yaw to the left.
    """
    pairs = _pairs(observations)
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_PAIRS)).astype(int))]
    found = []
    for i, j in pairs:
        a, b = observations[i], observations[j]
        arc = arc_between(_standing(a), _standing(b), (b.stamp_ns - a.stamp_ns) * 1e-9)
        found += [] if arc is None else [(i, j, *arc)]
    table = np.array(found, np.float64).reshape(-1, 4)
    return table[:, :2].astype(np.int64), table[:, 2], table[:, 3]


def _pairs(observations: Sequence[Observation]) -> Int64[np.ndarray, "P 2"]:
    """Indices of observations of one drive whose sweeps are nearest to half a second apart."""
    stamps_s = np.array([o.stamp_ns for o in observations], np.int64) * 1e-9
    drives = np.array([o.drive for o in observations], np.int64)
    out = []
    for i in range(len(observations) - 1):
        gap = np.where(drives[i + 1 :] == drives[i], stamps_s[i + 1 :] - stamps_s[i], np.inf)
        j = int(np.argmin(np.abs(gap - _GAP_S)))
        if 0 < gap[j] <= _LONGEST_GAP_S:
            out.append((i, i + 1 + j))
    return np.array(out, np.int64).reshape(-1, 2)


def _standing(o: Observation) -> Float[np.ndarray, "N 2"]:
    """Standing objects around the lidar, one point per cell."""
    return one_per_cell(o.lidar_map_xyz_m[o.lidar_map_is_ground == 0, :2].astype(np.float64))
