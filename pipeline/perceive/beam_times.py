"""Times of a spinning lidar's points from their azimuth, for clouds without a time per point.

A turn takes a tenth of a second, in which a car drives one to three metres. The direction of rotation and the
start of a turn are seldom documented. They are estimated from pairs of sweeps of a moving car: after the best
motion between two sweeps, static points still have residuals where either sweep measured them early or late.
These residuals are linear in the times, so one system over all pairs compares all directions, starts and
durations of a turn.

A time common to all points moves a cloud as a whole, which pairs of sweeps do not show. It is part of the time offset
between sensors, which calibration finds.

Source: Zhang, Singh 2014, "LOAM: Lidar Odometry and Mapping in Real-time" (points to planes, times from azimuths).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from pipeline.perceive.sweep_pairs import Arc, Surfaces, matched, registered

__all__ = ["MOVES_MPS", "BeamTimes", "Found", "beam_times", "velocity_of"]

PERIOD_S: Final = 0.1  # of a turn, unless it is told: drivers set 10 Hz
_SECTORS: Final = 36  # whose points have one time
_SIGMA_M: Final = 0.03  # of points to surfaces; rests beyond weigh less (Cauchy)
_STEPS: Final = 5  # each goes half of the way: neighbours of a skewed point are neighbours as it is skewed
# How long a turn seems to last, over what is told: a good day shows .8, one of a car that hardly moves 2.2. Beyond is
# a cloud that was de-skewed, or a lidar at 20 Hz.
_LASTS: Final = (0.6, 2.5)
_USUAL: Final = 3.0
_CLEARLY: Final = 3.0  # standard errors over pairs, between the best hypothesis and any of another kind
_ANOTHER_RAD: Final = float(np.radians(45.0))  # begins nearer than this differ beside the seam only
_FEWEST_PAIRS, _MOST_PAIRS = 8, 30
MOVES_MPS: Final = 0.3
_LEFT, _RIGHT = 1.0, -1.0


@dataclass(frozen=True)
class BeamTimes:
    """How a lidar turns.

    Args:
        sense: 1 to the left, in the direction of increasing azimuth; -1 to the right (seen from above).
        begin_rad: azimuth of the first beam of a turn.
        stamp_share: share of the turn that is complete at the stamp.
    """

    sense: float
    begin_rad: float
    period_s: float = PERIOD_S
    stamp_share: float = 0.5

    def at(self, azimuth_rad: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Times relative to the stamp [s]."""
        turned = (self.sense * (azimuth_rad - self.begin_rad)) % (2 * np.pi) / (2 * np.pi)
        return np.asarray((turned - self.stamp_share) * self.period_s)

    def of(self, xyz_m: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
        """Times of points relative to the stamp [s]."""
        return self.at(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]).astype(np.float64)).astype(np.float32)


class Found(NamedTuple):
    """Result of a day's sweeps: the lidar's rotation, if determined, and its motion at each sweep.

    For sweeps that do not determine the rotation, their motion may be wrong too (rails match anywhere along
    them); the given motion is then used.
    """

    turn: BeamTimes | None
    motion: Mapping[int, Arc]


_CENTRES: Final = (np.arange(_SECTORS) + 0.5) / _SECTORS * 2 * np.pi - np.pi
_HYPOTHESES: Final = tuple(
    BeamTimes(sense, begin)
    for sense in (_LEFT, _RIGHT)
    for begin in (np.arange(_SECTORS) / _SECTORS * 2 * np.pi - np.pi).tolist()
)
_TIMES: Final = np.array([h.at(_CENTRES) for h in _HYPOTHESES])


def beam_times(
    surfaces: Mapping[int, Surfaces],
    pairs: Sequence[tuple[int, int, float]],
    told: Mapping[int, Arc],
) -> Found:
    """Estimate a lidar's rotation from pairs of its sweeps as logged.

    Args:
        surfaces: surfaces of each sweep, by its number.
        pairs: earlier and later sweep, and the time between their stamps [s].
        told: motion per second at a sweep, if odometry has it.
    """
    arcs = registered(surfaces, pairs, told)
    motion = {**_motions(arcs, pairs), **told}
    moving = [
        (i, j, arc)
        for (i, j, _), arc in zip(pairs, arcs, strict=True)
        if arc is not None and max(motion[i].way, motion[j].way) > MOVES_MPS
    ]
    moving = [
        moving[k] for k in np.unique(np.linspace(0, len(moving) - 1, _MOST_PAIRS).astype(int)) if moving
    ]
    if len(moving) < _FEWEST_PAIRS:
        return Found(None, told)
    times, best = np.zeros(_SECTORS), 0
    for _ in range(_STEPS):
        N, b = _systems(surfaces, moving, motion, times)
        along = np.maximum(_TIMES @ b.sum(0), 0.0)
        curvature = np.einsum("hs,st,ht->h", _TIMES, N.sum(0), _TIMES)
        best = int(np.argmax(along**2 / curvature))
        lasts_s = PERIOD_S * along[best] / curvature[best]
        times = lasts_s / PERIOD_S * _TIMES[best]
    is_one = _LASTS[0] * PERIOD_S < lasts_s < _LASTS[1] * PERIOD_S
    turn = _decided(N, b, best) if is_one else None
    return Found(turn, motion if turn is not None else told)


def velocity_of(xyz_m: Float[np.ndarray, "N 3"], motion: Arc) -> Float[np.ndarray, "N 3"]:
    """Velocity of standing points relative to the lidar; with it, points are moved by their time to the stamp."""
    x = motion.x - motion.yaw_rad * xyz_m[:, 1]
    return np.stack([x, motion.yaw_rad * xyz_m[:, 0], np.zeros(len(xyz_m))], axis=1)


def _decided(N: Float[np.ndarray, "P S S"], b: Float[np.ndarray, "P S"], best: int) -> BeamTimes | None:
    """The best hypothesis, if it is better than those of the other direction, of other starts, and of no rotation."""
    found = _HYPOTHESES[best]
    gain = _gain(N, b, _TIMES[best])
    others = [
        _gain(N, b, t)
        for h, t in zip(_HYPOTHESES, _TIMES, strict=True)
        if h.sense != found.sense or abs(_wrapped(h.begin_rad - found.begin_rad)) >= _ANOTHER_RAD
    ]
    surely = all(_z(gain - other) >= _CLEARLY for other in [np.zeros(len(b)), *others])
    return found if surely else None


def _gain(
    N: Float[np.ndarray, "P S S"], b: Float[np.ndarray, "P S"], times: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " P"]:
    """Decrease of the sum of squared residuals of each pair by these times."""
    return np.asarray(2 * b @ times - np.einsum("pst,s,t->p", N, times, times))


def _z(gain: Float[np.ndarray, " P"]) -> float:
    """Sum over pairs in units of its standard error; a pair counts at most like three typical ones."""
    most = _USUAL * np.median(np.abs(gain))
    held = np.clip(gain, -most, most)
    return float(held.sum() / max(held.std(ddof=1) * np.sqrt(len(held)), 1e-9))


def _systems(
    surfaces: Mapping[int, Surfaces],
    pairs: Sequence[tuple[int, int, Arc]],
    motion: Mapping[int, Arc],
    times: Float[np.ndarray, " S"],
) -> tuple[Float[np.ndarray, "P S S"], Float[np.ndarray, "P S"]]:
    """Normal equations of the sectors' times, pair by pair, about `times`; motion between the sweeps is free."""
    skew = {k: velocity_of(surfaces[k].xyz_m, motion[k]) for pair in pairs for k in pair[:2]}
    moved = {k: surfaces[k].moved(times[_sector(surfaces[k].xyz_m)][:, None] * v) for k, v in skew.items()}
    N, b = np.zeros((len(pairs), _SECTORS, _SECTORS)), np.zeros((len(pairs), _SECTORS))
    for p, (i, j, arc) in enumerate(pairs):
        found = matched(moved[i], moved[j], arc)
        sectors = [_sector(surfaces[k].xyz_m[at]) for k, at in ((i, found.first), (j, found.last))]
        along = [np.einsum("nd,nd->n", found.normal, skew[i][found.first])]
        along.append(-np.einsum("nd,nd->n", found.normal, skew[j][found.last] @ found.arc.rotation.T))
        A = np.zeros((len(found.rest_m), _SECTORS + 3))
        for sector, by in zip(sectors, along, strict=True):
            np.add.at(A, (np.arange(len(A)), sector), by)
        A[:, _SECTORS:] = found.jacobian
        weight = 1 / (_SIGMA_M**2 + found.rest_m**2)
        full = A.T @ (A * weight[:, None])
        right = A.T @ (weight * (found.rest_m + A[:, :_SECTORS] @ times))
        free = full[:_SECTORS, _SECTORS:] @ np.linalg.pinv(full[_SECTORS:, _SECTORS:])
        N[p] = full[:_SECTORS, :_SECTORS] - free @ full[_SECTORS:, :_SECTORS]
        b[p] = right[:_SECTORS] - free @ right[_SECTORS:]
    return N, b


def _motions(arcs: Sequence[Arc | None], pairs: Sequence[tuple[int, int, float]]) -> dict[int, Arc]:
    """Motion per second at each sweep of a pair: the mean of its pairs."""
    held: dict[int, list[Arc]] = {}
    for arc, (i, j, gap_s) in zip(arcs, pairs, strict=True):
        if arc is not None:
            per_second = Arc(arc.x / gap_s, arc.y / gap_s, arc.yaw_rad / gap_s)
            for k in (i, j):
                held.setdefault(k, []).append(per_second)
    return {k: Arc(*np.mean(of, axis=0)) for k, of in held.items()}


def _sector(xyz_m: Float[np.ndarray, "N 3"]) -> np.ndarray:
    turn = (np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) + np.pi) / (2 * np.pi)
    return np.asarray((turn * _SECTORS).astype(np.int64) % _SECTORS)


def _wrapped(angle_rad: float) -> float:
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)
