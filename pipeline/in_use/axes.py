"""Pass, warn, fail or inconclusive: what one log says of the calibration in use, per pair and axis.

The log is calibrated by itself, from the calibration in use; `off` is how far that one lies from the answer, `sigma`
how surely the answer is known. An axis fails where the distance is both measured (beyond three sigmas, once in 370
right calibrations by chance) and of a size that matters (beyond the limit of `[verify]`). What a pass is worth is the
detection power: the probability with which an error of the size asked for would have failed. An axis without it is
inconclusive, however small its distance.

Of a rig of many sensors the log's poses answer, a sensor at a time: all its edges speak in them. So many axes would
make false alarms frequent, so their probability is shared: three sigmas for one axis are 3.9 for 25.

Azimuth and elevation are those of targets 15 to 40 m away (root mean square); roll is the camera's about its own axis,
which turns pictures without moving their middle. Everything else of a pose is told by the record, not judged here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri
from scipy.stats import norm

from pipeline.config import VerifyConfig
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import adjoint, inverse, log_se3
from pipeline.geometry.target_sigmas import target_jacobian, target_sigmas
from pipeline.geometry.targets import DEFAULT_TARGETS
from pipeline.rig.edges import edge_of, words_of
from pipeline.store.current import prior_of, targets_of, transform_of
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

__all__ = [
    "NEEDED_AXES",
    "AxisCheck",
    "AxisLimits",
    "answer_of",
    "answer_of_sensors",
    "answers_by_sensor",
    "check_axes",
    "check_pose",
    "kind_of_pose",
    "limits_of",
    "shared_sigmas",
]

# Once in 370 right calibrations by chance; rarer where the limit, which has to be passed too, is the larger one.
CONTRADICTION_SIGMAS = 3.0
# The smallest error that a log can show is the one that it would have failed with this probability.
SHOWN_POWER = 0.95
_SHOWN_SIGMAS = float(ndtri(SHOWN_POWER))
_ROLL = 2  # of a camera pose's change: about the optical axis

# What a pair is good for; a radar need not know its elevation.
NEEDED_AXES: Mapping[str, tuple[str, ...]] = {
    "camera_lidar": ("azimuth", "elevation"),
    "camera_radar": ("azimuth",),
    "lidar_radar": ("azimuth",),
    "lidar_lidar": ("azimuth", "elevation"),
    "lidar_base": ("azimuth", "elevation"),
    "radar_base": ("azimuth",),
}


@dataclass(frozen=True)
class AxisLimits:
    """Of one axis: an error from which on the calibration is wrong, and one that must not go unseen [rad].

    A pass promises that an error of `asked_rad` would have failed with probability `confidence`.
    """

    limit_rad: float
    asked_rad: float
    confidence: float


@dataclass(frozen=True)
class AxisCheck:
    """One axis of one pair; angles [rad] are nan where the log gives no estimate.

    `pair` is the pair's kind, or names of its sensors where they are called otherwise; of a rig of many sensors the
    sensor's own name.
    """

    pair: str
    kind: str
    axis: str
    status: str  # pass, warn, fail or inconclusive
    reason: str
    off_rad: float
    sigma_rad: float
    limit_rad: float
    asked_rad: float
    power: float  # probability with which an error of `asked_rad` would have failed
    shown_rad: float  # smallest error that would have failed with probability SHOWN_POWER


def limits_of(pair: str, verify: VerifyConfig, asked_deg: tuple[float, float]) -> dict[str, AxisLimits]:
    """What is judged of a pair: azimuth and elevation, and the camera's roll beside the lidar.

    Args:
        pair: kind of it.
        verify: from where on an error matters, and the confidence.
        asked_deg: errors of camera-lidar, and of pairs with the radar, that must not go unseen.
    """
    has_radar = "radar" in pair
    azimuth = verify.radar_limit_deg if has_radar else verify.camera_lidar_limit_deg
    elevation = verify.radar_elevation_limit_deg if has_radar else verify.camera_lidar_limit_deg
    limits = {"azimuth": azimuth, "elevation": elevation} | (
        {"roll": azimuth} if pair == "camera_lidar" else {}
    )
    asked_rad = float(np.radians(asked_deg[has_radar]))
    return {
        axis: AxisLimits(float(np.radians(deg)), asked_rad, verify.confidence) for axis, deg in limits.items()
    }


def check_axes(record: CalibrationRecord, limits: Mapping[str, AxisLimits]) -> list[AxisCheck]:
    """Every axis that `limits` names, from the log's record whose prior is the calibration in use."""
    in_use, found = prior_of(record), transform_of(record)
    blocked = _why_not(record)
    if in_use is None or found is None or record.covariance is None:
        pair = _pair(record), record.pair
        return [_silent(pair, axis, of, blocked or record.reason) for axis, of in limits.items()]
    off = _off(record.pair, in_use, found, np.asarray(record.covariance), targets_of(record))
    of = _pair(record), record.pair
    return [
        _checked(of, axis, limits[axis], off[axis], blocked, CONTRADICTION_SIGMAS)
        for axis in limits
        if axis in off
    ]


def kind_of_pose(kind: str) -> str:
    """As which kind of pair a sensor's pose to the reference is judged."""
    return {"camera": "camera_lidar", "radar": "lidar_radar", "base": "lidar_base"}.get(kind, "lidar_lidar")


def shared_sigmas(axes: int) -> float:
    """Sigmas beyond which one of so many axes contradicts: together as rare by chance as three of one alone."""
    return float(norm.isf(norm.sf(CONTRADICTION_SIGMAS) / max(axes, 1)))


def check_pose(
    row: PoseRow, in_use: Float[np.ndarray, "4 4"] | None, limits: Mapping[str, AxisLimits], beyond: float
) -> list[AxisCheck]:
    """Every axis that `limits` names of one sensor, from its pose by the log.

    Args:
        row: the pose.
        in_use: T_reference_sensor as the car uses it; None where it has none.
        limits: of the axes.
        beyond: sigmas from which on an axis contradicts, `shared_sigmas`.
    """
    of, found = (row.sensor, kind_of_pose(row.kind)), transform_of(row)
    why = f"the log gives no answer of its own: {row.reason}" if row.faults or found is None else ""
    why = why if in_use is not None else "the calibration in use has no pose of it"
    if in_use is None or found is None or row.covariance is None:
        return [_silent(of, axis, limit, why) for axis, limit in limits.items()]
    T = inverse(found)  # what the sensor's directions are stated by
    A = adjoint(T)
    targets = DEFAULT_TARGETS if row.targets_m is None else np.asarray(row.targets_m)
    off = _off(f"{row.kind}_of", inverse(in_use), T, A @ np.asarray(row.covariance) @ A.T, targets)
    return [_checked(of, axis, limits[axis], off[axis], why, beyond) for axis in limits if axis in off]


def answers_by_sensor(checks: Sequence[AxisCheck]) -> dict[str, str]:
    """right, wrong or undecided, by sensor: right where all that its kind is good for passes or warns."""
    answers: dict[str, str] = {}
    for sensor in dict.fromkeys(c.pair for c in checks):
        own = [c for c in checks if c.pair == sensor]
        needed = [c.status in {"pass", "warn"} for c in own if c.axis in NEEDED_AXES[c.kind]]
        is_wrong = any(c.status == "fail" for c in own)
        answers[sensor] = "wrong" if is_wrong else "right" if needed and all(needed) else "undecided"
    return answers


def answer_of_sensors(answers: Mapping[str, str]) -> str:
    """Of the whole rig: wrong where a sensor is, right where all are."""
    said = set(answers.values())
    return "wrong" if "wrong" in said else "right" if said == {"right"} else "inconclusive"


def answer_of(checks: Sequence[AxisCheck]) -> str:
    """Of all pairs: "wrong" where an axis fails, "right" where all that they are good for passes or warns.

    Of sensors with names, several pairs see the same sensor: there it is right where the pairs of which that is so tie
    all sensors to each other.
    """
    if any(c.status == "fail" for c in checks):
        return "wrong"
    good: dict[str, bool] = {}
    for c in checks:
        if c.axis in NEEDED_AXES[c.kind]:
            good[c.pair] = good.get(c.pair, True) and c.status in {"pass", "warn"}
    edges = [set(pair.split("-")) for pair in good if "-" in pair]
    if len(edges) < len(good):  # sensors are called by their kinds
        return "right" if all(good.values()) else "inconclusive"
    tied: set[str] = set()
    for ends in len(edges) * [set(pair.split("-")) for pair, is_good in good.items() if is_good]:
        tied |= ends if not tied or tied & ends else set()
    return "right" if good and tied == set().union(*edges) else "inconclusive"


def _off(
    pair: str,
    in_use: Float[np.ndarray, "4 4"],
    found: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    targets: Float[np.ndarray, "N 3"],
) -> dict[str, tuple[float, float]]:
    """Distance of the calibration in use from the answer, and the answer's sigma, by axis [rad]."""
    xi = log_se3(in_use @ inverse(found))
    distance = np.sqrt(np.mean((target_jacobian(pair, found, targets) @ xi) ** 2, axis=1))
    sigma = target_sigmas(pair, found, covariance, targets)
    off = {name: (float(distance[i]), float(sigma[i])) for i, name in enumerate(("azimuth", "elevation"))}
    if pair.startswith("camera"):
        roll_sigma = np.sqrt(change_covariance(found, covariance)[_ROLL, _ROLL])
        off["roll"] = abs(float(change_between(found, in_use)[_ROLL])), float(roll_sigma)
    return off


def _checked(
    of: tuple[str, str], axis: str, limits: AxisLimits, off: tuple[float, float], blocked: str, beyond: float
) -> AxisCheck:
    """One axis of a pair or sensor: its words and its kind; `off` is the distance and its sigma."""
    off_rad, sigma_rad = off
    threshold = max(limits.limit_rad, beyond * sigma_rad)
    power = float(ndtr((limits.asked_rad - threshold) / sigma_rad))
    shown = threshold + _SHOWN_SIGMAS * sigma_rad
    measured = off_rad > beyond * sigma_rad
    status, reason = (
        ("inconclusive", blocked)
        if blocked
        else _status(off_rad, sigma_rad, limits, power, measured=measured)
    )
    numbers = (off_rad, sigma_rad, limits.limit_rad, limits.asked_rad)
    return AxisCheck(*of, axis, status, reason, *numbers, 0.0 if blocked else power, shown)


def _status(
    off_rad: float, sigma_rad: float, limits: AxisLimits, power: float, *, measured: bool
) -> tuple[str, str]:
    distance = f"{_deg(off_rad)} off, known to {_deg(sigma_rad)}"
    if measured and off_rad > limits.limit_rad:
        return "fail", f"{distance}: beyond {_deg(limits.limit_rad)} and beyond chance"
    if power < limits.confidence:
        return "inconclusive", (
            f"{distance}: an error of {_deg(limits.asked_rad)} would have been seen with probability {power:.1%}"
        )
    if measured:
        return "warn", f"{distance}: beyond chance, within {_deg(limits.limit_rad)}"
    return "pass", distance


def _silent(of: tuple[str, str], axis: str, limits: AxisLimits, reason: str) -> AxisCheck:
    nan = float("nan")
    return AxisCheck(
        *of, axis, "inconclusive", reason, nan, nan, limits.limit_rad, limits.asked_rad,
        0.0, nan,
    )  # fmt: skip


def _pair(record: CalibrationRecord) -> str:
    return words_of(edge_of(record))


def _why_not(record: CalibrationRecord) -> str:
    """Why the log's answer cannot be held against anything; empty where it can.

    A record that is held only because its sigma is too large for its own limits is as good as that sigma says.
    """
    if record.status == "accepted" or (record.status == "held" and record.diagnostics.get("unsure_only")):
        return ""
    return f"the log gives no answer of its own: {record.reason}"


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2f} deg"
