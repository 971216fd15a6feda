"""Check of the calibration in use against one log: pass, warn, fail or inconclusive per pair and axis.

The log is calibrated independently, starting from the calibration in use; `off` is the distance between the
two, `sigma` the uncertainty of the log's result. An axis fails if the distance is significant (beyond three
sigmas, which a correct calibration exceeds by chance once in 370 times) and large enough to matter (beyond
the limit of `[verify]`). The detection power is the probability that an error of the requested size would
have failed (`one_axis.py`). Without enough power an axis is inconclusive, however small its distance.

For a rig of many sensors, poses are compared, one sensor at a time; each pose combines all edges of its
sensor. To keep the false-alarm rate over all axes constant, the threshold grows: three sigmas for one axis
become 3.9 for 25.

Azimuth and elevation are those of targets 15 to 40 m away (root mean square); roll is the camera's about its
optical axis, which rotates the image about its centre. Other components of the pose are in the record, but
not judged here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from pipeline.core.config import VerifyConfig
from pipeline.core.stage_work import Probes
from pipeline.rig.graph import edge_of, words_of
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.se3 import adjoint, change_between, change_covariance, inverse, log_se3
from pipeline.rig.targets import DEFAULT_TARGETS, target_jacobian, target_sigmas
from pipeline.store.current import prior_of, targets_of, transform_of
from pipeline.verify.one_axis import AxisCheck, AxisLimits, HeldOut, checked
from schemas.calibrations import PROBE_Z, CalibrationRecord
from schemas.poses import PoseRow

__all__ = [
    "NOT_IN_USE", "answer_of", "answers_by_sensor", "check_axes", "check_pose", "errors_in_words",
    "held_out_of", "kind_of_pose", "limits_of", "probes", "shared_sigmas", "wrong_sensors",
]  # fmt: skip

# False alarm once in 370 correct calibrations; rarer if the limit, which must be exceeded too, is larger than
# that.
CONTRADICTION_SIGMAS = 3.0
NOT_IN_USE = "the calibration in use has no pose of it"
_NO_ESTIMATE = "this log gives no usable estimate"
# By axis: in which direction the second sensor of an edge is set wrong where `off_rad` is positive, and where it is
# negative; the first the other way round. Roll as seen from behind the camera.
_TOWARD = {
    "azimuth": ("left", "right"),
    "elevation": ("up", "down"),
    "roll": ("clockwise", "counterclockwise"),
}
_ROLL = 2  # component of a camera pose's change: about the optical axis


def limits_of(pair: str, verify: VerifyConfig, asked_deg: tuple[float, float]) -> dict[str, AxisLimits]:
    """Limits of a pair's axes: azimuth and elevation, and the camera's roll for camera-lidar.

    `asked_deg` are errors of camera-lidar, and of pairs with the radar, that must be detected.
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


def check_axes(
    record: CalibrationRecord, limits: Mapping[str, AxisLimits], verify: VerifyConfig | None = None
) -> list[AxisCheck]:
    """Check every axis in `limits`, from the log's record, whose prior is the calibration in use."""
    of = words_of(edge_of(record)), record.pair, (record.parent_frame, record.child_frame)
    held_out = {axis: held_out_of([record], verify or VerifyConfig(), axis) for axis in limits}
    of_log = transform_of(record), record.covariance, targets_of(record), _why_not(record)
    return _checks(of, record.pair, prior_of(record), of_log, limits, CONTRADICTION_SIGMAS, held_out)


def probes(asked_deg: tuple[float, float]) -> Probes:
    """Turns for `Task.probe_deg`: the errors asked for, half and twice as large."""
    of_camera, of_radar = (tuple(deg * size for size in (0.5, 1.0, 2.0)) for deg in asked_deg)
    return of_camera, of_radar


def held_out_of(records: Sequence[CalibrationRecord], verify: VerifyConfig, axis: str) -> HeldOut:
    """Held-out test of turns about an axis, from the pair with the strongest test."""
    start = f"{PROBE_Z}{axis}_"
    found = [
        z
        for r in records
        if (z := {float(k.removeprefix(start)): z for k, z in r.diagnostics.items() if k.startswith(start)})
    ]
    best = min(found, key=lambda z: sum(z.values()), default={})
    return HeldOut(best, verify.checks.better_alignment_z, verify.checks.prior_agreement_sigmas)


def kind_of_pose(kind: str) -> str:
    """Kind of pair whose limits apply to a sensor's pose relative to the reference."""
    return {"camera": "camera_lidar", "radar": "lidar_radar", "base": "lidar_base"}.get(kind, "lidar_lidar")


def shared_sigmas(axes: int) -> float:
    """Threshold in sigmas for several axes, with the false-alarm probability of three sigmas for one."""
    return float(-ndtri(ndtr(-CONTRADICTION_SIGMAS) / max(axes, 1)))


def check_pose(
    row: PoseRow,
    in_use: Float[np.ndarray, "4 4"] | None,
    limits: Mapping[str, AxisLimits],
    beyond: float,
    held_out: Mapping[str, HeldOut] | None = None,
) -> list[AxisCheck]:
    """Check every axis in `limits` of one sensor, from its pose in the log.

    Args:
        row: the pose.
        in_use: T_reference_sensor of the calibration in use; None if it has none.
        limits: by axis.
        beyond: threshold in sigmas, from `shared_sigmas`.
        held_out: by axis, the held-out test of turns; None = there is none.
    """
    of, found = (row.sensor, kind_of_pose(row.kind), (row.sensor,)), transform_of(row)
    is_wrong = row.faults and row.status != "accepted" and not row.unsure_only
    why = f"{_NO_ESTIMATE}: {row.reason}" if is_wrong or found is None else ""
    why = why if in_use is not None else NOT_IN_USE
    # The sensor's directions are in its own frame.
    T, A = (None, np.eye(6)) if found is None else (inverse(found), adjoint(inverse(found)))
    covariance = None if row.covariance is None else A @ np.asarray(row.covariance) @ A.T
    targets = DEFAULT_TARGETS if row.targets_m is None else np.asarray(row.targets_m)
    before = None if in_use is None else inverse(in_use)
    return _checks(
        of, f"{row.kind}_of", before, (T, covariance, targets, why), limits, beyond, held_out or {}
    )


def _checks(
    of: tuple[str, str, tuple[str, ...]], pair: str, in_use: Float[np.ndarray, "4 4"] | None,
    of_log: tuple[np.ndarray | None, np.ndarray | None, np.ndarray, str], limits: Mapping[str, AxisLimits],
    beyond: float, held_out: Mapping[str, HeldOut],
) -> list[AxisCheck]:  # fmt: skip
    """Checks by axis, from the log's estimate, its covariance and targets, and why it is not usable (or empty)."""
    found, covariance, targets, why = of_log
    off = dict.fromkeys(limits, (float("nan"), float("nan")))
    if in_use is not None and found is not None and covariance is not None:
        off = _off(pair, in_use, found, np.asarray(covariance), targets)
    return [checked(of, a, limit, off[a], why, beyond, held_out.get(a)) for a, limit in limits.items()]


def answers_by_sensor(checks: Sequence[AxisCheck]) -> dict[str, str]:
    """Answers by sensor, right, wrong or undecided: right if all axes required of its kind pass or warn."""
    answers: dict[str, str] = {}
    for sensor in dict.fromkeys(c.pair for c in checks):
        own = [c for c in checks if c.pair == sensor]
        needed = [c.status in {"pass", "warn"} for c in own if c.axis in KIND_OF_EDGE[c.kind].needed]
        is_wrong = any(c.status == "fail" for c in own)
        answers[sensor] = "wrong" if is_wrong else "right" if needed and all(needed) else "undecided"
    return answers


def answer_of(checks: Sequence[AxisCheck]) -> str:
    """Answer for all sensors or pairs: "wrong" if an axis fails, "right" if all required axes pass or warn.

    For pairs whose sensors have names, several share a sensor: right if the right pairs connect all sensors.
    """
    if any(c.status == "fail" for c in checks):
        return "wrong"
    good: dict[str, bool] = {}
    for c in checks:
        if c.axis in KIND_OF_EDGE[c.kind].needed:
            good[c.pair] = good.get(c.pair, True) and c.status in {"pass", "warn"}
    edges = {c.pair: set(c.sensors) for c in checks if c.pair != c.kind and len(c.sensors) > 1}
    if len(edges) < len(good):  # sensors, or pairs whose sensors are named after their kinds
        return "right" if all(good.values()) else "inconclusive"
    tied: set[str] = set()
    for ends in len(edges) * [edges[pair] for pair, is_good in good.items() if is_good]:
        tied |= ends if not tied or tied & ends else set()
    return "right" if good and tied == set().union(*edges.values()) else "inconclusive"


def wrong_sensors(checks: Sequence[AxisCheck]) -> list[str]:
    """Sensors that may be the wrong one: ends of all failing edges, without ends of edges that pass."""
    failing = [c for c in checks if c.status == "fail"]
    ends = [set(c.sensors) for c in failing]
    among = set.intersection(*ends) or set.union(*ends) if ends else set()
    failed, axes = {c.pair for c in failing}, {c.axis for c in failing}
    good = [c for c in checks if c.status in {"pass", "warn"} and c.axis in axes and c.pair not in failed]
    return sorted(among - {sensor for c in good for sensor in c.sensors} or among)


def errors_in_words(checks: Sequence[AxisCheck]) -> list[str]:
    """A sentence per wrong sensor and axis, by its failing edge of smallest sigma."""
    wrong = wrong_sensors(checks)
    failing = sorted((c for c in checks if c.status == "fail"), key=lambda c: -c.sigma_rad)
    found = {(tuple(s for s in c.sensors if s in wrong), c.axis): c for c in failing}
    return [_sentence(sensors, c) for (sensors, _), c in sorted(found.items()) if sensors]


def _sentence(sensors: tuple[str, ...], check: AxisCheck) -> str:
    size, limit = (f"{np.degrees(abs(rad)):.2f} deg" for rad in (check.off_rad, check.limit_rad))
    is_left = {s: (check.off_rad > 0) == (s != check.sensors[0]) for s in sensors}
    set_so = [f"{s}: set {size} too far {_TOWARD[check.axis][not is_left[s]]}" for s in sensors]
    return f"{', or '.join(set_so)} (limit {limit})"


def _off(
    pair: str,
    in_use: Float[np.ndarray, "4 4"],
    found: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    targets: Float[np.ndarray, "N 3"],
) -> dict[str, tuple[float, float]]:
    """Signed distance of the calibration in use from the log's estimate, and its sigma, by axis [rad]."""
    moved = target_jacobian(pair, found, targets) @ log_se3(in_use @ inverse(found))  # N 2
    distance = np.sqrt(np.mean(moved**2, axis=1)) * np.sign(np.mean(moved, axis=1))
    sigma = target_sigmas(pair, found, covariance, targets)
    off = {name: (float(distance[i]), float(sigma[i])) for i, name in enumerate(("azimuth", "elevation"))}
    if pair.startswith("camera"):
        roll_sigma = np.sqrt(change_covariance(found, covariance)[_ROLL, _ROLL])
        off["roll"] = float(change_between(found, in_use)[_ROLL]), float(roll_sigma)
    return off


def _why_not(record: CalibrationRecord) -> str:
    """Reason why the log's estimate cannot be compared; empty if it can.

    A record that is held only because its sigma exceeds its limits can be compared: its sigma is valid.
    """
    if record.status == "accepted" or (record.status == "held" and record.diagnostics.get("unsure_only")):
        return ""
    return f"{_NO_ESTIMATE}: {record.reason}"
