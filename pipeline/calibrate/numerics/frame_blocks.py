"""Scenes of a day, and blocks of frames for resampling and scatter: scenes are counted instead of frames.

A car that waits at a traffic light for a minute shows one scene, however many frames it logs. A scene ends
when the car has driven or turned on, by its own speed and yaw rate. Speeds can be wrong (missing, or wrapped
by an ambiguous Doppler), so the lidar's depth edges are compared as well. For a standing car they stay in
place; after one metre, most of them have moved. If a view returns, because the car stands there again or
because a log was copied, it belongs to its earlier scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int, Int64
from scipy import sparse

from pipeline.rig.estimates import DayParts, PairEstimate
from schemas.observations import Observation

__all__ = [
    "FEWEST_SCENES", "SCENE_DEGREES", "Scenes", "blocks_of", "bootstrap_blocks", "likeliest_cut",
    "parts_of_day", "scene_blocks", "scenes_of", "with_parts",
]  # fmt: skip

FEWEST_SCENES = 3  # two blocks only show that they differ

# What is known of a scene's frames before the day shows it: how much their gradients correlate, with so many degrees of
# freedom. On fourteen tuning days .0 to .2 where the car drives on within a scene, .30 and .38 of cars that stand, .7
# in single unknowns of those.
_CORRELATION, SCENE_DEGREES = 0.4, 4.0
_FEWEST_BLOCKS = 8  # fewer are too few for a bootstrap or a scatter over blocks
# A street looks otherwise after this way, or from a turn that brings in a third of a camera's view.
_SCENE_M, _SCENE_RAD = 10.0, float(np.radians(20.0))
# Share of a frame's depth edges that lie where those of another do. On eleven days of nine sensors (simulated, Astyx,
# KITTI, another simulator) a standing car's were 0.42 to 0.82; after 0.3 to 1 m 0.14 to 0.5, after 1 to 2 m 0.05 to
# 0.43, after 2 m and more below 0.25, but up to 0.75 along the rails of a motorway. No two places had more.
_STANDING, _CREEPING, _COPIED = 0.4, 0.15, 0.85
_CREPT_M, _DROVE_M = 1.0, 3.0  # since the frame before, at least, by its edges
_STANDING_MPS = 0.5
_CELL_M, _NEAR_M, _SPAN = 0.5, 40.0, 256  # of edges to compare; so many cells a side, beyond `_NEAR_M` none
_FEWEST_CELLS = 20  # with edges in fewer, a frame is not compared


@dataclass(frozen=True, eq=False)
class Scenes:
    """Scenes and blocks of frames: a standing car is one scene; errors of different blocks are independent."""

    scene: Int64[np.ndarray, " F"]
    block: Int64[np.ndarray, " F"]

    @staticmethod
    def of(observations: Sequence[Observation], most: int = 24) -> Scenes:
        """Scenes and blocks of a day's frames."""
        scene = scenes_of(observations)
        return Scenes(scene, bootstrap_blocks(np.array([o.drive for o in observations]), scene, most))

    def of_frames(self, frames: Int[np.ndarray, " G"]) -> Scenes:
        """The scenes and blocks of a selection of the frames, renumbered."""
        scene, block = (
            np.unique(of[frames], return_inverse=True)[1].ravel() for of in (self.scene, self.block)
        )
        return Scenes(scene, block)

    @property
    def weight(self) -> Float[np.ndarray, " F"]:
        """Weight of each frame: one over the number of frames of its scene, so that scenes have equal weight."""
        return np.asarray(1 / np.bincount(self.scene)[self.scene])

    def scatter(self, gradient: Float[np.ndarray, "F P"]) -> float:
        """Variance of the sum of gradients, over all unknowns, with the errors of a block's frames correlated.

        A few blocks determine it badly, so it is combined with the variance of independent frames times the
        usual inflation by scenes (Smyth 2004, moderated variances); it is at least that of independent frames.
        """
        return self.inflation(gradient) * _apart(gradient)

    def inflation(self, gradient: Float[np.ndarray, "F P"]) -> float:
        """Ratio of `scatter` to the same variance for frames with independent errors."""
        apart = gradient - gradient.mean(0)
        size, blocks = np.bincount(self.scene), int(self.block.max()) + 1
        known = 1 + _CORRELATION * (float((size**2).sum()) / len(self.scene) - 1)
        known /= max(1 - known / len(self.scene), 1e-3)  # what all frames share, their mean has taken out
        sums = np.zeros((blocks, gradient.shape[1]))
        np.add.at(sums, self.block, apart)
        shown = blocks * float((sums**2).sum()) / max(_apart(gradient), 1e-300)  # times degrees, over as many
        return max(1.0, (SCENE_DEGREES * known + shown) / (SCENE_DEGREES + blocks - 1))


def scenes_of(observations: Sequence[Observation]) -> Int64[np.ndarray, " F"]:
    """Scene of each frame, counted from 0 in order of time; equal numbers show the same view."""
    F = len(observations)
    if F == 0:
        return np.zeros(0, np.int64)
    alike = _alike(observations)
    way_m, turn_rad = _moved(observations, np.r_[1.0, np.diag(alike, -1)])
    stands = np.array([o.ego_speed_mps is None or abs(o.ego_speed_mps) < _STANDING_MPS for o in observations])
    scene, began, count = np.zeros(F, np.int64), 0, 1
    way, turn = np.cumsum(way_m), np.cumsum(turn_rad)
    for f in range(1, F):
        if way[f] - way[began] < _SCENE_M and abs(turn[f] - turn[began]) < _SCENE_RAD:
            scene[f] = scene[began]
            continue
        began = f
        same = (alike[f, :f] >= _COPIED) | ((alike[f, :f] >= _STANDING) & stands[:f] & stands[f])
        scene[f] = scene[int(np.argmax(same))] if same.any() else count
        count = max(count, int(scene[f]) + 1)
    return scene


def blocks_of(observations: Sequence[Observation], most: int = 24) -> Int64[np.ndarray, " F"]:
    """`bootstrap_blocks` for the frames of a day."""
    return Scenes.of(observations, most).block


def bootstrap_blocks(
    drive: Int[np.ndarray, " F"], scene: Int[np.ndarray, " F"], most: int = 24
) -> Int64[np.ndarray, " F"]:
    """Block of each frame for resampling, about `most` blocks of equal size: long drives are cut, short ones joined.

    All frames of a scene are in one block; there are at least 8 blocks if there are as many scenes.
    """
    F = len(drive)
    if F == 0:
        return np.zeros(0, np.int64)
    size = max(1, F // max(most, _FEWEST_BLOCKS))
    block_of = np.full(int(scene.max()) + 1, -1)
    number, filled = 0, 0
    for f in range(F):
        if block_of[scene[f]] < 0:
            # End a full block where the drive ends, or anyway at twice its size.
            if filled >= size and (drive[f] != drive[f - 1] or filled >= 2 * size):
                number, filled = number + 1, 0
            block_of[scene[f]] = number
        filled += 1
    return block_of[scene]


def scene_blocks(observations: Sequence[Observation]) -> Int[np.ndarray, " F"]:
    """Block name of each frame, for scatter over scenes: its drive, of any length.

    A day of few drives is cut between scenes into stretches with equal numbers of frames.
    """
    drives, scene = np.array([o.drive for o in observations]), scenes_of(observations)
    first = np.unique(scene, return_index=True)[1]  # frame that each scene begins with
    if len(np.unique(drives)) >= _FEWEST_BLOCKS:
        return drives[first][scene]
    return first[scene] * _FEWEST_BLOCKS // max(len(observations), 1)


def _apart(gradient: Float[np.ndarray, "F P"]) -> float:
    """Sum of squares about the mean, over all unknowns."""
    return float(((gradient - gradient.mean(0)) ** 2).sum())


def _moved(
    observations: Sequence[Observation], alike: Float[np.ndarray, " F"]
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, " F"]]:
    """Distance [m] and rotation [rad] since the previous frame, the larger of the values by speed and by edges.

    `alike` is the share of edges that stayed in place; not finite for a frame with hardly any.
    """
    stamp_s = np.array([o.stamp_ns for o in observations]) * 1e-9
    speed = np.array([np.nan if o.ego_speed_mps is None else abs(o.ego_speed_mps) for o in observations])
    rate = np.array([0.0 if o.ego_yaw_rate_radps is None else o.ego_yaw_rate_radps for o in observations])
    drive, gap_s = np.array([o.drive for o in observations]), np.diff(stamp_s, prepend=stamp_s[0])
    by_speed_m = np.fmax(speed, np.r_[speed[0], speed[:-1]]) * gap_s
    by_speed_m[(speed < _STANDING_MPS) & (by_speed_m < _CREPT_M)] = 0.0  # noise of a speed is no way
    by_edges_m = np.select(
        [alike >= _STANDING, alike >= _CREEPING, alike >= 0], [0.0, _CREPT_M, _DROVE_M], np.nan
    )
    way_m = np.fmax(by_speed_m, by_edges_m)
    another = (np.diff(drive, prepend=drive[0]) != 0) & (alike < _STANDING)
    return np.where(another | np.isnan(way_m), _SCENE_M, way_m), rate * np.where(another, 0.0, gap_s)


def _alike(observations: Sequence[Observation]) -> Float[np.ndarray, "F F"]:
    """Share of the edges of any two frames in the same cells; not finite for frames with hardly any."""
    edges = [np.asarray(o.lidar_edge_xyz_m, np.float64).reshape(-1, 3) for o in observations]
    frame = np.repeat(np.arange(len(edges)), [len(e) for e in edges])
    points = np.concatenate(edges)
    near = np.einsum("ij,ij->i", points, points) < _NEAR_M**2
    x, y, z = (np.floor(points[near] / _CELL_M).astype(np.int64) + _SPAN // 2).T
    frame, cell = np.divmod(np.unique(((frame[near] * _SPAN + x) * _SPAN + y) * _SPAN + z), _SPAN**3)
    column = np.unique(cell, return_inverse=True)[1].ravel()
    size = np.bincount(frame, minlength=len(edges))
    shape = (len(edges), int(column.max(initial=0)) + 1)
    held = sparse.csr_matrix((np.ones(len(frame), np.int32), (frame, column)), shape)
    fewer = np.minimum.outer(size, size).astype(np.float64)
    return np.asarray((held @ held.T).toarray() / np.where(fewer < _FEWEST_CELLS, np.nan, fewer))


# --------------------------------------------------------------------------------------------------
# A day in two parts, cut where a sensor may have moved, and the difference between the parts.
#
# At the solution of the whole day, the gradients of all frames sum to zero. If a sensor moved, gradients before
# and after the change have opposite signs, so the running sum is farthest from zero at the change. Each part is
# then solved by itself; where the two contradict each other, the cut is moved to where the frames begin to
# score better at the last part's solution.
#
# Source: Page 1954 (cumulative sums); Hinkley 1970 (one step at an unknown time, and its likelihood).

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
    gradient: Float[np.ndarray, "F P"], stamp_ns: Sequence[int], solve: _Solve[State],
    score: Callable[[State], Float[np.ndarray, " F"]], tested: tuple[int, ...], scene: Int[np.ndarray, " F"],
) -> DayParts | None:  # fmt: skip
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
