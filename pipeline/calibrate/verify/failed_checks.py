"""Checks of what a method solved: lidar-radar by restarts, halves and registration; all pairs by loop and heading.

Each states by how much a pose would be wrong if it is right, so that only what matters holds a record.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.tilt_floors import radar_tilt_axes
from pipeline.core.config import ChecksConfig
from pipeline.objective.stamp_gaps import camera_gaps_s, constant_gap_s
from pipeline.rig.changes import change_between
from pipeline.rig.checks import Change, FailedCheck, change_of
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.se3 import adjoint, compose_covariance, inverse
from schemas.observations import Observation

__all__ = ["heading_failures", "lidar_radar_failures", "loop_failures", "loop_sigmas"]

_SIGMAS = 3.0
# Restarts end before the last steps: only another basin counts, and only in certified axes.
_RESTART_ROTATION_RAD, _RESTART_SHIFT_M = np.radians(0.15), 0.05
_HALVES_FACTOR = 2  # two halves differ by twice the error of the whole, if their errors are independent
_NAMES = ("roll", "pitch", "yaw", "x", "y", "z")
_KEYS = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")


def loop_failures(solution: Solution, limits: ChecksConfig | None = None) -> dict[str, list[FailedCheck]]:
    """A loop of independent estimates that does not close within its sigma, by pair: any of them may be wrong.

    Each would have to move by what closes the loop.
    """
    limits = limits or ChecksConfig()
    found = loop_sigmas(solution)
    if found is None or solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return {}
    rotation, translation = found
    sentences = []
    if solution.loop_rotation_rad > limits.max_loop_sigmas * rotation:
        open_deg, sigma_deg = np.degrees(solution.loop_rotation_rad), np.degrees(rotation)
        sentences.append(f"the loop is open by {open_deg:.2f} deg, its sigma is {sigma_deg:.2f} deg")
    if solution.loop_translation_m > limits.max_loop_sigmas * translation:
        open_m = solution.loop_translation_m
        sentences.append(f"the loop is open by {open_m:.3f} m, its sigma is {translation:.3f} m")
    return {
        pair: [
            FailedCheck(s, "witnesses_disagree", error=_change(solution, pair, T), covariance=covariance)
            for s in sentences
        ]
        for pair, (T, covariance) in (_by_others(solution) if sentences else {}).items()
    }


def _change(solution: Solution, pair: str, T: Float[np.ndarray, "4 4"]) -> Change:
    return change_of(change_between(solution.pairs[pair].T, T))


def _by_others(
    solution: Solution,
) -> dict[str, tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]]:
    """Pose of each pair that the other two give, which would close the loop, and its covariance."""
    cl, lr, cr = (solution.pairs[p] for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    of_camera, back = cr.T @ inverse(lr.T), adjoint(inverse(cl.T))
    return {
        "camera_lidar": (of_camera, compose_covariance(of_camera, cr.covariance, lr.covariance)),
        "camera_radar": (cl.T @ lr.T, compose_covariance(cl.T, cl.covariance, lr.covariance)),
        "lidar_radar": (inverse(cl.T) @ cr.T, back @ (cl.covariance + cr.covariance) @ back.T),
    }


def heading_failures(
    solution: Solution,
    prior: Prior,
    observations: Sequence[Observation],
    limits: ChecksConfig | None = None,
) -> list[FailedCheck]:
    """Failed check of camera-lidar if the heading that it was solved with contradicts the prior.

    A camera's time offset moves the cloud along the car's heading, which the radar's mounting gives. If
    lidar-radar rotates the radar by many of the prior's sigmas, one of the two is wrong. Camera-lidar may then
    have a lateral error of time offset times speed times this rotation.

    Args:
        prior: prior whose T_lidar_radar lidar-radar moved.
        limits: threshold for a wrong heading; None = the default.
    """
    limits = limits or ChecksConfig()
    if not {"camera_lidar", "lidar_radar"} <= solution.pairs.keys():
        return []
    found = solution.pairs["camera_lidar"]
    turn = abs(float(change_between(prior.T_lidar_radar, solution.pairs["lidar_radar"].T)[2]))
    speeds = [abs(o.ego_speed_mps) for o in observations if o.ego_speed_mps is not None]
    if not speeds or turn < limits.heading_change_prior_sigmas * prior.rotation_sigma_rad:
        return []
    # What lies between sweep and image on the way, where the stamps' constant gap is the clock's.
    expected_s = constant_gap_s(camera_gaps_s(observations))
    way_s = 0.0 if found.time_offset_s is None else abs(found.time_offset_s - expected_s)
    lateral_m = round(turn * way_s * float(np.mean(speeds)), 2)  # less than a centimetre is nothing
    off = f"heading off by {np.degrees(turn):.1f} deg between prior and lidar-radar"
    sentence = f"{off}: up to {lateral_m:.2f} m lateral error through the camera's time offset"
    error = change_of([0.0, 0.0, 0.0, *(lateral_m * found.T[:3, 1])])  # along the lidar's y
    return [FailedCheck(sentence, error=error)] if lateral_m else []


def loop_sigmas(solution: Solution) -> tuple[float, float] | None:
    """Sigma of the loop's angle [rad] and translation [m] if all three pairs were estimated independently."""
    if solution.loop_rotation_rad is None or solution.loop_translation_m is None:
        return None
    covariance = _loop_covariance(solution)
    return float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(np.trace(covariance[3:, 3:])))


def _loop_covariance(solution: Solution) -> np.ndarray:
    """Covariance (6 6) of T_camera_lidar T_lidar_radar T_radar_camera, with independent factors (first order)."""
    cl, lr, cr = (solution.pairs[p] for p in ("camera_lidar", "lidar_radar", "camera_radar"))
    A = adjoint(cl.T)
    B = adjoint(cl.T @ lr.T @ inverse(cr.T))
    return cl.covariance + A @ lr.covariance @ A.T + B @ cr.covariance @ B.T


def lidar_radar_failures(estimate: PairEstimate) -> list[FailedCheck]:
    """Restarts, halves, and the registration against the camera's boxes."""
    if not estimate.diagnostics:
        return []
    failed = [_restarts(estimate), _halves(estimate), *_registration(estimate)]
    return [check for check in failed if check is not None]


def _restarts(estimate: PairEstimate) -> FailedCheck | None:
    """Ends of the search in different basins: if another one is right, the pose is off by all of their distance."""
    least = np.array([np.inf, np.inf, _RESTART_ROTATION_RAD, _RESTART_SHIFT_M, _RESTART_SHIFT_M, np.inf])
    apart = _known(estimate, "restarts")
    return _difference("restarts", apart, np.maximum(least, _SIGMAS * _sigma(estimate)), apart)


def _halves(estimate: PairEstimate) -> FailedCheck | None:
    """The pose lies between those of the halves."""
    apart = _known(estimate, "halves")
    return _difference("disjoint halves", apart, _SIGMAS * _HALVES_FACTOR * _sigma(estimate), apart / 2)


def _difference(
    who: str, apart: Float[np.ndarray, " 6"], allowed: Float[np.ndarray, " 6"], error: Float[np.ndarray, " 6"]
) -> FailedCheck | None:
    beyond = np.flatnonzero(np.abs(apart) > allowed)
    if not len(beyond):
        return None
    sizes = " and ".join(f"{_NAMES[k]} by {_size(k, float(apart[k]))}" for k in beyond.tolist())
    return FailedCheck(f"{who} disagree in {sizes}", "witnesses_disagree", error=change_of(error))


def _registration(estimate: PairEstimate) -> list[FailedCheck]:
    """What turns the radar's roll or pitch if the registration alone is right."""
    d, failed = estimate.diagnostics, []
    for axis, name in zip(radar_tilt_axes(estimate.T).T, ("roll", "pitch"), strict=True):
        offset, floor = d[f"registration_{name}_offset_rad"], d[f"registration_{name}_sigma_rad"]
        known = estimate.observable[int(np.argmax(np.abs(axis)))]
        own = float(np.sqrt(axis @ estimate.covariance[:2, :2] @ axis))
        if known and abs(offset) > _SIGMAS * np.hypot(floor, own):
            turned = f"would turn {name} by {np.degrees(offset):+.1f} deg, camera and prior would not"
            error = change_of([*(axis * offset), 0.0, 0.0, 0.0, 0.0])
            failed.append(FailedCheck(f"the registration {turned}", "witnesses_disagree", error=error))
    return failed


def _known(estimate: PairEstimate, of: str) -> Float[np.ndarray, " 6"]:
    """A change in the diagnostics, 0 where it is not there or the day did not determine it."""
    change = np.array([estimate.diagnostics.get(f"{of}_{key}", 0.0) for key in _KEYS])
    return np.where(estimate.observable, change, 0.0)


def _sigma(estimate: PairEstimate) -> Float[np.ndarray, " 6"]:
    return np.sqrt(np.diag(estimate.covariance))


def _size(k: int, value: float) -> str:
    return f"{np.degrees(value):+.2f} deg" if k < 3 else f"{value:+.3f} m"
