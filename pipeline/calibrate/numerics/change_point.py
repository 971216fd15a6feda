"""A day in two parts, cut where a sensor may have moved, and the difference between the parts.

At the solution of the whole day, the gradients of all frames sum to zero. If a sensor moved, gradients before
and after the change have opposite signs, so the running sum is farthest from zero at the change. Each part is
then solved by itself; where the two contradict each other, the cut is moved to where the frames begin to
score better at the last part's solution.

Source: Page 1954 (cumulative sums); Hinkley 1970 (one step at an unknown time, and its likelihood).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.numerics.frame_blocks import FEWEST_SCENES
from pipeline.rig.estimates import DayParts, PairEstimate

__all__ = ["likeliest_cut", "parts_of_day", "with_parts"]

# Of the frames, on either side of a cut. With .2 a radar's turn of 1 deg after .15 of the day was 3.5 to 16 sigmas on
# three days, with .08 to .12 20 to 22; on 46 good days of eight rigs no parts differed by more than 2.6 with any.
_LEAST_SHARE = 0.1
_SUSPICIOUS_SIGMAS = 2.0  # of a step: from there on its cut is looked for again
_MOST_CUTS = 3
# A step of so many of the whole day's sigmas proves nothing where a part shows few scenes, and yet the pose may be
# half of it off. On 20 good days of nine rigs pitch and yaw differed by 2.2 at most, on another one by 4.9; a knock of
# .3 deg by 6.7.
_WIDENING_SIGMAS = 6.0

State = TypeVar("State")
# Rows of frames -> their solution, its pose (4 4) and the covariance of its rotation (3 3).
_Solve = Callable[[Int[np.ndarray, " R"]], tuple[State, np.ndarray, np.ndarray]]


def parts_of_day(
    gradient: Float[np.ndarray, "F P"],
    stamp_ns: Sequence[int],
    solve: _Solve[State],
    score: Callable[[State], Float[np.ndarray, " F"]],
    tested: tuple[int, ...],
    scene: Int[np.ndarray, " F"],
) -> DayParts | None:
    """First and last part of a day; None if the day is too short or has too few scenes.

    Args:
        score: score of each frame at a solution; higher is better.
        tested: rotations (0, 1, 2) that are compared.
        scene: scene of each frame; a part of fewer than three scenes has no estimate of its spread.
    """
    cut = likeliest_cut(gradient, scene)
    if cut is None:
        return None
    for _ in range(_MOST_CUTS):
        first, last = (solve(rows) for rows in np.split(np.arange(len(stamp_ns)), [cut]))
        cut_ns = int(stamp_ns[cut - 1]), int(stamp_ns[cut])
        parts = DayParts((first[1], last[1]), (first[2], last[2]), cut_ns, tested)
        if np.abs(parts.sigmas(0.0)).max() < _SUSPICIOUS_SIGMAS:
            break
        allowed = _cuts(scene)
        lost = np.cumsum(score(last[0]) - score(first[0]))[allowed - 1]
        again = int(allowed[np.argmin(lost)])
        if again == cut:
            break
        cut = again
    return parts


def with_parts(estimate: PairEstimate, parts: DayParts | None) -> PairEstimate:
    """The estimate with its parts; sigmas grow to half of the distance if the parts are far apart."""
    if parts is None:
        return estimate
    covariance, tested = estimate.covariance.copy(), list(parts.tested)
    step, variance = parts.step[tested], np.diag(covariance)[tested]
    is_far = step**2 > _WIDENING_SIGMAS**2 * variance
    covariance[tested, tested] += np.where(is_far, (step / 2) ** 2, 0.0)
    return replace(estimate, parts=parts, covariance=covariance)


def likeliest_cut(gradient: Float[np.ndarray, "F P"], scene: Int[np.ndarray, " F"]) -> int | None:
    """Number of frames before the likeliest change; None if there are too few frames or scenes on a side."""
    F, k = len(gradient), _cuts(scene)
    if not len(k):
        return None
    apart = gradient - gradient.mean(axis=0)
    apart = apart / np.maximum(np.sqrt((apart**2).mean(axis=0)), 1e-300)
    correlation = apart.T @ apart / F + 1e-6 * np.eye(gradient.shape[1])
    run = np.cumsum(apart, axis=0)[k - 1]
    pull = np.einsum("ki,ij,kj->k", run, np.linalg.inv(correlation), run) / (k * (1 - k / F))
    return int(k[np.argmax(pull)])


def _cuts(scene: Int[np.ndarray, " F"]) -> Int[np.ndarray, " K"]:
    """Possible numbers of frames before a cut."""
    frames = len(scene)
    least = max(FEWEST_SCENES, int(np.ceil(_LEAST_SHARE * frames)))
    cuts = np.arange(least, frames - least + 1)
    before, after = _seen(scene), _seen(scene[::-1])[::-1]
    return cuts[(before[cuts - 1] >= FEWEST_SCENES) & (after[cuts] >= FEWEST_SCENES)]


def _seen(scene: Int[np.ndarray, " F"]) -> Int[np.ndarray, " F"]:
    """Number of different scenes up to each frame."""
    is_new = np.zeros(len(scene), np.int64)
    is_new[np.unique(scene, return_index=True)[1]] = 1
    return np.cumsum(is_new)
