"""Changes of a record's estimate before and after a sensor moved within the day."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.rig.changes import change_between
from pipeline.rig.estimates import PairEstimate
from pipeline.rig.se3 import inverse
from schemas.calibrations import PAIRS

__all__ = ["half_days_of"]


def half_days_of(
    pair: str, estimates: Mapping[str, PairEstimate], faults: Mapping[str, Sequence[str]]
) -> Float[np.ndarray, "2 2 6"] | None:
    """Changes of a pair from its estimate to its first and last part, with sigmas; None if it did not move.

    Camera_radar changes as the other two do. `faults` are those of each pair's verdict.
    """
    parts, own = (
        {p: _parts(e, "moved_in_day" in faults.get(p, ())) for p, e in estimates.items()},
        estimates[pair],
    )
    poses, sigmas = parts[pair]
    if pair == "camera_radar" and own.parts is None and len(parts) == len(PAIRS):
        (T_cl, s_cl), (T_lr, s_lr) = parts["camera_lidar"], parts["lidar_radar"]
        # From where the other two have it, for its own pose is of all three.
        back = inverse(estimates["camera_lidar"].T @ estimates["lidar_radar"].T) @ own.T
        poses, sigmas = [a @ b @ back for a, b in zip(T_cl, T_lr, strict=True)], np.hypot(s_cl, s_lr)
    change = np.array([change_between(own.T, T) for T in poses])
    if not sigmas.any():
        return None
    # A turn of the parent carries the child's origin along.
    shift = np.where(np.abs(change[:, 3:]).max() > 0, sigmas.max(axis=1) * np.linalg.norm(own.T[:3, 3]), 0.0)
    return np.stack([change, np.column_stack([sigmas, *[shift] * 3])], axis=1)


def _parts(estimate: PairEstimate, has_moved: bool) -> tuple[list[np.ndarray], Float[np.ndarray, "2 3"]]:
    """Poses of the two parts and sigmas of their rotations; the estimate itself if it did not move."""
    if estimate.parts is None or not has_moved:
        return [estimate.T, estimate.T], np.zeros((2, 3))
    compared = np.isin(np.arange(3), estimate.parts.tested)
    sigma = [np.where(compared, np.sqrt(np.diag(s)), 0.0) for s in estimate.parts.spread]
    return list(estimate.parts.T), np.array(sigma)
