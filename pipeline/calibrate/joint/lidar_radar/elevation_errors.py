"""Errors of a radar's elevations: noise, detections seen low, floors of roll and pitch, sources that contradict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int64

from pipeline.calibrate.numerics.nuisances import PartTurn
from pipeline.calibrate.reasons import because
from pipeline.objective.radar.heights import Heights
from pipeline.objective.radar.registration import RegistrationFrames
from pipeline.objective.radar.travel import TravelDirections
from pipeline.rig.se3 import to_spherical
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, Observation

__all__ = [
    "Contradiction",
    "ElevationSpread",
    "SeenLow",
    "added_share",
    "along_radar",
    "beam_spacing",
    "contradiction",
    "doubted",
    "elevation_spread",
    "following_tilt",
    "own_equations",
    "own_numbers",
    "radar_tilt_axes",
    "seen_low_of",
    "tempered",
    "tilt_of",
]

# --------------------------------------------------------------------------------------------------
# Errors of a radar's elevations: their noise on sparse surfaces, detections seen low, floors of roll and pitch.


# --------------------------------------------------------------------------------------------------
# Distribution of a day's static detections, and the resulting effect of elevation noise on roll, pitch and z.


# How far elevations that are matched to the nearest lidar points bias roll, pitch [rad] and z [m]. Noise removes a part
# `noise^2 / spread^2` of every mismatch (regression dilution), and a mismatch is as large as the spread of the
# elevations: the angle noise^2 / spread. Real logs (3.2 deg of noise, spread 3.9): 2.6 deg where 1-2 deg of pitch and
# 4-5 deg of roll were seen; simulation (0.65 deg, spread 3-6): 0.07-0.16 deg where 0.01-0.12 was seen. A coarse lidar
# adds a share of its beam spacing, for points collapse onto the rings. z is wrong by the same angle at 15 m.
# Pitch alone errs by a fifth of the noise more: on 28 days of drawn worlds and rigs (seeds 6400 to 6435) .30 deg RMS,
# 1.7 of these floors without it (ceilings, crowns and what noise takes from one surface to the next), 1.1 with it.
# Roll errs by as much as the beams are apart. On the real car (beams 2 deg apart) the registration's roll repeats to .2
# deg over halves of the day and is -4.0 deg; boxes have -1.0 +- 1.1, the network +.2. Without it the floor is .8.
_RING_SHARE, _ROLL_RING_SHARE, _NOISE_SHARE = 0.05, 1.0, 0.2
_Z_DISTANCE_M, _Z_FLOOR_M = 15.0, 0.03
_ROLL_FACTOR = 0.7  # of pitch's at an azimuth of one radian: both sides seldom err in opposite directions
_DEFAULT_SPACING_RAD = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class ElevationSpread:
    """Distribution of the static detections: standard deviation of elevations, RMS of azimuths [rad]."""

    elevation_rad: float
    azimuth_rad: float

    def floor(self, noise_rad: float, spacing_rad: float) -> np.ndarray:
        """Sigma of roll, pitch [rad] and z [m] of the registration due to this elevation noise."""
        angle = np.hypot(noise_rad**2 / self.elevation_rad, _RING_SHARE * spacing_rad)
        roll = np.hypot(self.roll_of_day(noise_rad), self._roll(_ROLL_RING_SHARE * spacing_rad))
        z_m = np.hypot(_Z_DISTANCE_M * angle, _Z_FLOOR_M)
        return np.array([roll, np.hypot(angle, _NOISE_SHARE * noise_rad), z_m])

    def roll_of_day(self, noise_rad: float) -> float:
        """Part of the roll's sigma that differs from day to day; points collapse onto the rings every day alike."""
        return self._roll(noise_rad**2 / self.elevation_rad)

    def _roll(self, angle_rad: float) -> float:
        return float(_ROLL_FACTOR * angle_rad / self.azimuth_rad)


def beam_spacing(observations: Sequence[Observation]) -> float:
    """Vertical spacing of the lidar's beams [rad], from its depth jumps between rings."""
    gaps = [
        o.lidar_edge_gap_rad[(o.lidar_edge_side == EDGE_ABOVE) | (o.lidar_edge_side == EDGE_BELOW)]
        for o in observations
    ]
    every = np.concatenate(gaps) if gaps else np.zeros(0)
    return float(np.median(every)) if len(every) else float(_DEFAULT_SPACING_RAD)


def elevation_spread(frames: RegistrationFrames) -> ElevationSpread:
    """Distribution of the static detections of these frames."""
    azimuth, elevation, _ = to_spherical(frames.radar_m).T
    # One degree: below it, noise alone would make as much.
    return ElevationSpread(
        max(float(np.std(elevation)), np.radians(1.0)),
        max(float(np.sqrt(np.mean(azimuth**2))), np.radians(3.0)),
    )


# --------------------------------------------------------------------------------------------------
# A common error of all sources of pitch: detections measured too low, by an unknown share of their height.
#
# A radar measures an object between its true position and its mirror image in the road. If this is ignored, all
# sources rotate the estimated radar upwards at once. The registration does so by the share times the mean ratio
# of height to range of the objects it uses; the Doppler velocity does so by the share times its own sensitivity.
# Therefore the share is one unknown, common to both.
#
# Nothing is measured too high, so the prior of the share is a half-normal distribution. Its sigma is the
# fraction of detections below the road, without those that noise, full mirror images and strays explain
# (`heights`).


# Mean and sigma of the positive half of a normal distribution, in its sigmas.
_MEAN, _SIGMA = np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)
_LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class SeenLow:
    """Prior mean and sigma of the share, and its effect on each source of pitch."""

    mean: float = 0.0
    sigma: float = _LEAST_SHARE
    # By how much the whole share would turn the radar up [rad].
    per_share_rad: Mapping[str, float] = field(default_factory=dict)

    def expected(self, source: PartTurn) -> PartTurn:
        """The source's pitch, corrected for the prior mean of the share."""
        per_rad = self.per_share_rad.get(source.name, 0.0)
        moved = replace(source, offset_rad=source.offset_rad + per_rad * self.mean)
        return moved.wider(per_rad * self.sigma)


def seen_low_of(travel: TravelDirections | None, heights: Heights | None) -> SeenLow:
    """The prior of the share, from the moving frames; no share without moving frames."""
    if travel is None or not travel.count:
        return SeenLow()
    below = float(np.mean(travel.below)) if heights is None else heights.seen_low(travel.below)
    by_height = max(float(np.mean(travel.height_rad)), 0.0)
    by_velocity = max(-float(np.median(travel.per_displaced)), 0.0)
    per_share = {"registration": by_height, "doppler": by_velocity}
    return SeenLow(float(_MEAN * below), max(float(_SIGMA * below), _LEAST_SHARE), per_share)


def added_share(
    axis: Float[np.ndarray, " 2"], per_share_rad: float, unknowns: int
) -> Float[np.ndarray, "P Q"]:
    """Derivative of a source's unknowns with respect to themselves and the share; the first two are rotations.

    Args:
        axis: axis of the radar's pitch.
        per_share_rad: rotation upwards that this source gives per unit of the share.
        unknowns: number of unknowns of the source.
    """
    J = np.eye(unknowns, unknowns + 1)
    J[:2, -1] = -per_share_rad * axis
    return J


# --------------------------------------------------------------------------------------------------
# Roll and pitch of a radar in any direction: floors of elevations, and errors that follow from them.
#
# Elevations determine a radar's pitch, the tilt of its viewing direction, three times better than its roll
# about that direction, and floors are stated so. Along the lidar's axes the two are mixed by the radar's yaw: a
# corner radar's weak roll is not its roll about the car's axis.
#
# Azimuths and ranges are solved with roll, pitch and z from elevations, and err with them: a roll that is a
# degree off rotates yaw by 0.1 deg and shifts y by 3 cm if the matched objects are below the radar.


def radar_tilt_axes(T_lidar_radar: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "2 2"]:
    """Columns: the axes of roll (where the radar looks, level) and pitch (to its left), along the lidar's x and y."""
    c, s = T_lidar_radar[:2, 0] / np.hypot(*T_lidar_radar[:2, 0])
    return np.array([[c, -s], [s, c]])


def along_radar(
    T_lidar_radar: Float[np.ndarray, "4 4"], floor: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "P P"]:
    """Covariance along the lidar's axes of floors whose first two are of the radar's own roll and pitch."""
    axes = np.eye(len(floor))
    axes[:2, :2] = radar_tilt_axes(T_lidar_radar)
    covariance: np.ndarray = (axes * floor**2) @ axes.T
    return covariance


def tilt_of(
    T_lidar_radar: Float[np.ndarray, "4 4"], H: Float[np.ndarray, "P P"], g: Float[np.ndarray, " P"]
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, " P"]]:
    """Equations whose first two unknowns are turns about the lidar's x and y, as of the radar's own roll and pitch."""
    axes = np.eye(len(g))
    axes[:2, :2] = radar_tilt_axes(T_lidar_radar)
    return axes.T @ H @ axes, g @ axes


def tempered(
    H: Float[np.ndarray, "F P P"], g: Float[np.ndarray, "F P"], floor: Float[np.ndarray, "P P"]
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"]]:
    """Equations of all frames as one measurement with covariance `H^-1 + floor`, shared out among the frames."""
    # (H^-1 + F)^-1 = (1 + H F)^-1 H, which also holds where H is singular (a radar without elevation).
    W = np.linalg.inv(np.eye(len(floor)) + H.sum(0) @ floor)
    product = W @ H
    return 0.5 * (product + np.swapaxes(product, 1, 2)), g @ W.T


def following_tilt(
    H: Float[np.ndarray, "P P"],
    prior_information: Float[np.ndarray, "P P"],
    follows: Int64[np.ndarray, " A"],
    given: Int64[np.ndarray, " B"],
) -> Float[np.ndarray, "P P"]:
    """Errors of all unknowns from errors of the `given` ones, which the equations H take as exact.

    `follows` are the unknowns that these equations solve for. Source: Schmidt 1966 (parameters considered,
    not solved for).
    """
    out = np.eye(len(H))
    block = np.ix_(follows, follows)
    out[np.ix_(follows, given)] = -np.linalg.solve(
        H[block] + prior_information[block], H[np.ix_(follows, given)]
    )
    return out


# --------------------------------------------------------------------------------------------------
# Independent sources of radar pitch: the pitch from each alone, and a larger sigma if they are inconsistent.


_SIGMAS = 2.0  # from which two sources contradict each other
_SINGULAR = 1e-9


@dataclass(frozen=True)
class Contradiction:
    """Sources of pitch that differ by more than their sigmas allow."""

    factor: float  # to add to their combined sigma of pitch
    sentence: str


def own_equations(
    name: str, H: Float[np.ndarray, "P P"], g: Float[np.ndarray, " P"], floor_rad: float
) -> PartTurn | None:
    """Pitch correction from these equations alone, with sigma; None if pitch is unconstrained.

    Pitch is the first unknown, the others are nuisances; `floor_rad` is the sigma of errors common to all
    frames.
    """
    scale = np.sqrt(np.maximum(np.diag(H), _SINGULAR))
    if H[0, 0] <= _SINGULAR or np.linalg.eigvalsh(H / np.outer(scale, scale))[0] < _SINGULAR:
        return None
    covariance = np.linalg.inv(H)
    return PartTurn(name, float(-(covariance @ g)[0]), float(np.sqrt(covariance[0, 0])), floor_rad)


def doubted(sources: Sequence[PartTurn]) -> dict[str, float]:
    """Sigmas [rad] to add to sources of pitch that are biased by detections measured too low.

    Such detections rotate the estimated radar upwards. `heights` models them. If another source gives a
    higher pitch than both sigmas allow, its difference from `heights` is taken as its error.
    """
    right = next((w for w in sources if w.name == "heights"), None)
    if right is None:
        return {}
    apart = {w: w.offset_rad - right.offset_rad for w in sources if w is not right}
    beyond = {w.name: a**2 - w.sigma_rad**2 - right.sigma_rad**2 for w, a in apart.items() if a < 0}
    return {name: float(np.sqrt(variance)) for name, variance in beyond.items() if variance > 0}


def contradiction(sources: Sequence[PartTurn]) -> Contradiction | None:
    """Sources that are inconsistent with the mean of the others, and the factor on pitch's sigma; None if all agree.

    The factor is the square root of chi-squared per degree of freedom, at least one.

    Source: Birge 1932, "The calculation of errors by the method of least squares".
    """
    apart = [w for w in sources if _is_contradicted(w, [o for o in sources if o is not w])]
    if not apart:
        return None
    mean, _ = _mean(sources)
    chi2 = sum(((w.offset_rad - mean) / w.sigma_rad) ** 2 for w in sources)
    factor = max(1.0, float(np.sqrt(chi2 / (len(sources) - 1))))
    found = ", ".join(
        f"{w.name} {np.degrees(w.offset_rad):+.2f} +- {np.degrees(w.sigma_rad):.2f} deg" for w in sources
    )
    return Contradiction(factor, because("radar pitch", sources=found, factor=factor))


def own_numbers(sources: Sequence[PartTurn]) -> dict[str, float]:
    """Offset and sigma of each source, for the diagnostics of a record."""
    numbers: dict[str, float] = {}
    for w in sources:
        numbers |= {f"{w.name}_pitch_offset_rad": w.offset_rad, f"{w.name}_pitch_sigma_rad": w.sigma_rad}
    return numbers


def _is_contradicted(source: PartTurn, others: Sequence[PartTurn]) -> bool:
    if not others:
        return False
    mean, sigma = _mean(others)
    return bool(abs(source.offset_rad - mean) > _SIGMAS * np.hypot(source.sigma_rad, sigma))


def _mean(sources: Sequence[PartTurn]) -> tuple[float, float]:
    """Weighted mean and its sigma."""
    weight = np.array([w.sigma_rad**-2 for w in sources])
    offset = np.array([w.offset_rad for w in sources])
    return float(weight @ offset / weight.sum()), float(weight.sum() ** -0.5)
