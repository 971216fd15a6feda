"""Check signs, units and directions on a sample of frames, before any calibration.

Doppler, odometry and clouds are compared. If they disagree, other signs and units are tried, and those that
fit are reported. The checks are coarse: the faults that they detect change these values by factors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from pipeline.core.rigs import RadarTopics
from pipeline.ingest.reasons import because
from schemas.frames import Frame

__all__ = [
    "MOVING_MPS",
    "AskedRadar",
    "Motion",
    "doppler_speed",
    "motion_of",
    "opposed_signs",
    "prior_transform",
]

MOVING_MPS = 1.0
_FEWEST = 3  # moving frames needed to determine a sign
_MOST = 2 / 3  # share of them that must agree
_EXPLAINED = 1 / 3  # share of a scan's detections that a speed must explain
_KMH = 3.6
_NEAR = 0.1  # relative tolerance of a match with a unit or a simple factor
_OFF = 0.25  # larger relative differences of odometry and Doppler are an error
# Number of occupied cells, and the factor by which more detections must meet them with the radar turned
# round. On logs where cells came from the car's motion, 70 to 93 % met, and at most 29 % the other way round.
_CELL_M, _TALL_M, _LEAST_MET, _TURNED_MORE = 1.0, 0.5, 0.3, 1.5
_FIT_MPS = 0.35  # Doppler residual of static points at the right ego speed, quantisation included


@dataclass(frozen=True, eq=False)
class AskedRadar:
    """A radar whose Doppler is tested.

    Args:
        R_ahead_radar: by log, rotation 3 3 from radar axes to axes whose x points ahead, by the transforms of
            the log; a radar without one is taken to look ahead.
        has_sign: False for messages whose velocities are vectors: no setting turns their sign.
    """

    name: str
    topics: RadarTopics
    R_ahead_radar: Mapping[str, np.ndarray] = field(default_factory=dict)
    has_sign: bool = True

    @property
    def has_setting(self) -> bool:
        """Whether doppler_positive has an effect."""
        return self.has_sign and self.topics.velocity_fields is None

    def directions(self, frame: Frame) -> Float[np.ndarray, "N 3"]:
        """Unit vectors to the detections of a scan, in axes whose x points ahead."""
        R = self.R_ahead_radar.get(frame.log, np.eye(3))
        xyz = frame.radar_xyz_m.astype(np.float64) @ R.T
        return np.asarray(xyz / np.linalg.norm(xyz, axis=1, keepdims=True))


@dataclass(frozen=True)
class Motion:
    """Motion of the car in the frames, and the problems found by source.

    `doppler_positive` is the sign that fits: "" if the frames do not show one, or if a sensor that is turned
    round explains them instead.
    """

    moving_share: float | None  # by odometry or else Doppler; None = unknown
    doppler_problem: str = ""
    doppler_is_wrong: bool = False  # its sign or unit is certainly wrong, and must be corrected first
    wrong: tuple[str, ...] = ()  # other sources that are certainly wrong
    advice: tuple[str, ...] = ()
    doppler_positive: str = ""


def motion_of(frames: Sequence[Frame], radar: AskedRadar | None) -> Motion:
    """Compare odometry, Doppler and clouds of some frames; without a radar, odometry is all there is."""
    scanned = [f for f in frames if "radar" in f.sensors]
    fits = [_fit(f, radar) for f in scanned] if radar is not None else []
    speeds = np.array([s for s, share in fits if share > _EXPLAINED])
    odometry = np.array([f.ego_speed_mps for f in frames if f.ego_speed_mps is not None])
    fitted = speeds if len(speeds) >= len(scanned) / 2 else np.zeros(0)
    known = odometry if len(odometry) else fitted
    moving = float(np.mean(np.abs(known) > MOVING_MPS)) if len(known) else None
    if radar is None:
        return Motion(moving)
    problem = _unfit(scanned, fits, radar)
    moved = speeds[np.abs(speeds) > MOVING_MPS]
    sign = _sign(moved) if not problem else 0
    if sign < 0 and _sign(odometry[np.abs(odometry) > MOVING_MPS]) < 0:
        sign = 1  # odometry too: the car reverses
    turned = _turned_round(scanned, sign)
    wrong: list[str] = []
    if sign < 0:
        problem = turned or _other_sign(radar)
    elif turned:
        wrong.append(turned)
    is_wrong = sign < 0
    both = [
        (f.ego_speed_mps, s)
        for f, (s, share) in zip(scanned, fits, strict=True)
        if f.ego_speed_mps is not None and share > _EXPLAINED and abs(s) > MOVING_MPS
    ]
    by_doppler, by_odometry = _ratio_problem(both) if not is_wrong else ("", "")
    if by_doppler:
        problem, is_wrong = by_doppler, True
    wrong += [by_odometry] if by_odometry else []
    positive = (
        ""
        if turned or not radar.has_setting
        else {1: radar.topics.doppler_positive, -1: _other(radar.topics), 0: ""}[sign]
    )
    return Motion(moving, problem, is_wrong, tuple(wrong), _assumed_sign(radar, sign), positive)


def opposed_signs(positive: Mapping[str, str]) -> list[str]:
    """A sentence if the signs that fit the radars of one car differ; `positive` has "" for an unknown sign."""
    of: dict[str, list[str]] = {
        sign: [n for n, p in positive.items() if p == sign] for sign in ("receding", "approaching")
    }
    if not all(of.values()):
        return []
    named = " and ".join(f'{", ".join(names)} "{sign}"' for sign, names in of.items())
    few = ", ".join(min((len(names), names) for names in of.values())[1])
    return [because("signs differ", signs=named, few=few)]


def prior_transform(frame: Frame, pair: str) -> Float[np.ndarray, "4 4"]:
    """Prior of a pair; identity if the frame has none."""
    return frame.priors.get(pair, np.eye(4))


def _fit(frame: Frame, radar: AskedRadar, factor: float = 1.0) -> tuple[float, float]:
    """Speed from the Doppler times a factor, and the share of detections that it explains."""
    rates = factor * frame.radar_range_rate_mps.astype(np.float64)
    return doppler_speed(radar.directions(frame), rates, radar.topics.doppler_period_mps)


def _unfit(frames: Sequence[Frame], fits: Sequence[tuple[float, float]], radar: AskedRadar) -> str:
    """Reason why the Doppler gives no speed: its period, its unit, or unknown."""
    period = radar.topics.doppler_period_mps
    spans = [float(np.ptp(f.radar_range_rate_mps)) for f in frames]
    if period is not None and spans and max(spans) > 1.05 * period:
        return because("span", span=max(spans), period=period)
    if not frames or np.mean([share > _EXPLAINED for _, share in fits]) >= 0.5:
        return ""
    slower = [_fit(f, radar, 1 / _KMH)[1] > _EXPLAINED for f in frames]
    if np.mean(slower) >= _MOST:
        return because("km/h", share=np.mean(slower))
    return because("no fit")


def _sign(moved_mps: Float[np.ndarray, " N"]) -> int:
    """Direction of travel: 1 = forward, -1 = backward, 0 = cannot be determined."""
    if len(moved_mps) < _FEWEST:
        return 0
    backwards = float(np.mean(moved_mps < 0))
    return -1 if backwards > _MOST else 1 if backwards < 1 - _MOST else 0


def _other(topics: RadarTopics) -> str:
    return "receding" if topics.doppler_positive == "approaching" else "approaching"


def _other_sign(radar: AskedRadar) -> str:
    if radar.topics.velocity_fields is not None:
        return because("backwards", remedy=because("velocity fields"))
    if not radar.has_sign:
        return because("backwards", remedy=because("tracks"))
    whose = "" if radar.name == "radar" else f" of {radar.name}"
    return because("backwards", remedy=because("other sign", whose=whose, sign=_other(radar.topics)))


def _assumed_sign(radar: AskedRadar, sign: int) -> tuple[str, ...]:
    """Advice on a sign that fleet.toml leaves out, with the result of the log."""
    topics = radar.topics
    if not radar.has_setting or "doppler_positive" in topics.model_fields_set:
        return ()
    whose = "" if radar.name == "radar" else f" of {radar.name}"
    shown = because({1: "confirmed", -1: "opposite", 0: "undecided"}[sign])
    return (because("assumed", whose=whose, sign=topics.doppler_positive, shown=shown),)


def _ratio_problem(both: Sequence[tuple[float, float]]) -> tuple[str, str]:
    """Problems of Doppler and of odometry, from their speeds in the same frames."""
    if len(both) < _FEWEST:
        return "", ""
    odometry, doppler = np.array(both).T
    ratio = float(np.median(odometry / doppler))
    agreed = np.abs(odometry - ratio * doppler) < _NEAR * np.abs(ratio * doppler) + MOVING_MPS / 2
    if abs(ratio - 1) < _OFF or agreed.mean() < _MOST:
        return "", ""
    if abs(ratio * _KMH - 1) < _NEAR:
        return because("ratio", ratio=ratio, fits=because("fits", fits="km/h for m/s", source="Doppler")), ""
    sign = "the other sign" if ratio < 0 else ""
    unit = "km/h for m/s" if abs(abs(ratio) / _KMH - 1) < _NEAR else ""
    fits = " and ".join(word for word in (sign, unit) if word)
    hint = because("fits", fits=fits, source="odometry") if fits else because("scale")
    return "", because("ratio", ratio=ratio, fits=hint)


def _turned_round(frames: Sequence[Frame], sign: int) -> str:
    """Problem text if detections meet occupied cells only with one sensor turned round; else empty."""
    whole = [f for f in frames if "lidar" in f.sensors and len(f.radar_xyz_m)]
    if not whole:
        return ""
    given, radar, lidar = np.mean([_met(f) for f in whole], axis=0)
    turned = max(radar, lidar)
    if turned < max(_LEAST_MET, _TURNED_MORE * given):
        return ""
    # If the Doppler confirms the radar's heading, the lidar is turned.
    who = {1: "the lidar", -1: "the radar", 0: "the lidar or the radar"}[sign]
    return because("points back", sensor=who, met=turned, given=given)


def _met(frame: Frame) -> list[float]:
    """Share of a scan's detections in occupied cells: at the prior, with the radar or the lidar turned."""
    points = frame.lidar_xyz_m.astype(np.float64)
    points = points[np.isfinite(points).all(1)]
    cells, index = np.unique(np.floor(points[:, :2] / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    low, high = np.full(len(cells), np.inf), np.full(len(cells), -np.inf)
    np.minimum.at(low, index.ravel(), points[:, 2])
    np.maximum.at(high, index.ravel(), points[:, 2])
    standing = {tuple(cell) for cell in cells[high - low > _TALL_M].tolist()}
    T, turn = prior_transform(frame, "lidar_radar"), np.array([-1.0, -1.0, 1.0])
    xyz = frame.radar_xyz_m.astype(np.float64)
    given, radar = (seen @ T[:3, :3].T + T[:3, 3] for seen in (xyz, xyz * turn))
    places = [
        np.floor(seen[:, :2] / _CELL_M).astype(np.int64).tolist() for seen in (given, radar, given * turn)
    ]
    return [float(np.mean([tuple(place) in standing for place in of])) for of in places]


def doppler_speed(
    directions: Float[np.ndarray, "N 3"], range_rate_mps: Float[np.ndarray, " N"], period_mps: float | None
) -> tuple[float, float]:
    """Forward speed [m/s] at which most detections of a scan fit a static world, and the share that fits.

    The x axis of the directions is assumed to point along the driving direction. If the share is below a
    third, this is not so, or the configuration of the Doppler is wrong. Negative speed = wrong sign, or the
    car reverses.
    """
    speeds = np.arange(-45.0, 45.01, 0.15)
    misfit = range_rate_mps + speeds[:, None] * directions[:, 0]
    if period_mps is not None:
        misfit = (misfit + period_mps / 2) % period_mps - period_mps / 2
    share = np.mean(np.abs(misfit) < _FIT_MPS, axis=1)
    # Among equal fits (aliases, or no detection off the axis) the slowest speed is chosen.
    best = int(np.lexsort((np.abs(speeds), -np.round(share, 2)))[0])
    return float(speeds[best]), float(share[best])
