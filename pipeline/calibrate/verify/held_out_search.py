"""Search of camera-lidar on held-out frames: another place that they fit better than the result.

Ten frames can match best in a wrong place, a degree or more from the right one. The other checks by held-out
frames look near the result, and there they find a place as well. Where held-out frames are more than those of
the fit, a search on them is more reliable than the result that they judge. It shares labels, CameraInfo and
prior with the fit: it shows a wrong place, and nothing of errors that all frames have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.joint.camera_lidar.estimate import align_camera_lidar
from pipeline.calibrate.verify.held_out_test import paired_test
from pipeline.calibrate.verify.target_accuracy import Claim
from pipeline.core.config import SolveConfig
from pipeline.core.errors import SolveError
from pipeline.rig.changes import change_between
from pipeline.rig.checks import FailedCheck, change_of
from pipeline.rig.estimates import PairEstimate, Prior
from pipeline.rig.targets import errors_at_targets
from schemas.observations import Observation

__all__ = ["found_elsewhere", "held_out_place"]

_SIGMAS = 3.0  # of the result in azimuth or elevation: nearer is no other place


def held_out_place(
    held_out: Sequence[Observation], prior: Prior, config: SolveConfig
) -> Float[np.ndarray, "4 4"] | None:
    """T_camera_lidar where a search on held-out frames ends; None if they show nothing to align."""
    try:
        return align_camera_lidar(held_out, prior, config, np.random.default_rng(0)).state.T_camera_lidar
    except SolveError:
        return None


def found_elsewhere(
    estimate: PairEstimate,
    place: Float[np.ndarray, "4 4"],
    cost: Callable[[np.ndarray], np.ndarray],
    claims: Mapping[str, Claim],
    blocks: Int[np.ndarray, " F"],
    targets: Float[np.ndarray, "N 3"],
    worse_z: float,
) -> list[FailedCheck]:
    """A failed check if held-out frames align better at a place that the result's sigma excludes.

    Args:
        estimate: the result.
        place: where a search on the held-out frames ended.
        cost: of each held-out frame at a pose.
        claims: the result's azimuth and elevation.
        blocks: block of each held-out frame.
        targets: in the child's frame [m].
        worse_z: significance from which one alignment is worse than another.
    """
    off_rad = errors_at_targets(estimate.pair, estimate.T, place, targets)[:2]
    sigma_rad = np.array([claims[name].sigma_rad for name in ("azimuth", "elevation")])
    test = paired_test(cost(estimate.T), cost(place), blocks)
    if test is None or test.z > -worse_z or (off_rad <= _SIGMAS * sigma_rad).all():
        return []
    azimuth, elevation = np.degrees(off_rad)
    sentence = (
        f"the held-out frames, which are more than those of the fit, align better {azimuth:.2f} deg in azimuth "
        f"and {elevation:.2f} deg in elevation from it (z = {test.z:.1f})"
    )
    error = change_of(change_between(estimate.T, place))
    return [FailedCheck(sentence, disproves=True, error=error)]
