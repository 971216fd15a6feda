"""Bias of the camera's time offset: how far it moves, and the pose with it, without either half of the image.

Other road users move between a lidar's point and the image, and edges on them are taken for static ones.
Oncoming cars move the time offset one way, cars ahead the other, by up to the time between point and image. In
a tunnel most edges lie on them: one time offset was 99 ms off at a sigma of 9. Rails and walls match anywhere
along them and move it too. All frames share this error, so resampled frames do not show it. But oncoming traffic
is on one half of the image, so the two halves disagree. Leaving out sides of objects or ranges as well did not
fit the errors of 140 known days better. What moves both halves alike, such as cars ahead in all lanes, is not
seen here.

The changes are read off the profile, for the score is far from quadratic over decimetres of way.

Source: jackknife over few clusters: MacKinnon, Nielsen, Webb 2023, https://doi.org/10.1002/jae.2969.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.calibrate.joint.camera_lidar.initialise import difference
from pipeline.calibrate.joint.camera_lidar.time_offset import (
    DT,
    TimeOffsetProfile,
    compared_terms,
    frame_scores,
    maximum,
)

__all__ = ["left_out_in_time"]

_SHARE = np.sqrt(1 - 1 / 2)  # of a jackknife over two clusters


def left_out_in_time(profile: TimeOffsetProfile, fixed: Bool[np.ndarray, " 8"]) -> Float[np.ndarray, "K 8"]:
    """Changes of the profile's best state without the right and without the left half of the image's edges.

    Args:
        profile: with its ends.
        fixed: unknowns that the solution has at the prior.

    Returns:
        A row per half, in coordinates of `AlignmentState.changed` [rad, m, s]: sigmas of the bias. None if one
        half has no edges.
    """
    if profile.scored is None or len(profile.ends) < 2:
        return np.zeros((0, 8))
    terms, middle = compared_terms(profile.scored), profile.ends[len(profile.ends) // 2]
    T = middle.T_camera_lidar
    is_right = terms.edges.xyz_m @ T[0, :3] + T[0, 3] > 0
    if is_right.all() or not is_right.any():
        return np.zeros((0, 8))
    changes = np.array([difference(end, middle) for end in profile.ends])
    changes[:, fixed & (np.arange(8) != DT)] = 0.0

    def at_best(values: np.ndarray) -> np.ndarray:
        step = float(maximum(values[None])[0])
        return np.array([np.interp(step, np.arange(len(changes)), column) for column in changes.T])

    best, rows = at_best(profile.values), []
    for half in (is_right, ~is_right):
        alone = replace(profile.scored, terms=replace(terms, edges=terms.edges.chosen(half)))
        own = np.array([frame_scores(alone, end, with_prior=False).sum() for end in profile.ends])
        rows.append(_SHARE * (at_best(profile.values - own) - best))
    return np.array(rows)
