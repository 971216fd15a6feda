"""Detection of corner reflectors near a guess: lidar by intensity and shape, radar by power.

The phase centre of a trihedral corner is its apex, where its three plates meet. A radar measures the apex,
and a person marks it. Lidar beams do not hit the apex itself, so it is fitted from the ranges on the plates.
Source: paper, section 2.1 (three trihedral reflectors, 150 frames, positions in each sensor's own
coordinates).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from pipeline.rig.se3 import exp_so3, to_spherical

__all__ = ["Found", "find_in_lidar", "find_in_radar", "robust_mean"]

Echoes = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]  # points [m], intensity or power [dB]

_CLIP_SIGMAS: Final = 3.5
_FEWEST_FRAMES: Final = 8  # with fewer frames the standard error is unreliable
_RADAR_REACH_M, _LIDAR_REACH_M = 1.5, 1.0  # search radius about the guess: in top view, and in space
_BRIGHT: Final = 0.5  # of the brightest echo near the guess
# Intensity of bare metal over the median of the scene, asphalt; a tripod reaches half of that.
_OVER_MEDIAN: Final = 4.0
_CELL_RAD: Final = np.radians(0.1)  # returns of one beam of a standing sensor are in one cell
_RANGE_SIGMA_M: Final = 0.02  # of a beam's mean range on a plate: mixed returns, range quantisation
# Alignment of a reflector to the car by hand, and tilt of the lidar.
_FACING_SIGMA_RAD: Final = np.radians(2.0)
_BLOCKS: Final = 8


@dataclass(frozen=True, eq=False)
class Found:
    """One reflector in one sensor's frame."""

    position_m: np.ndarray  # 3
    sigma_m: np.ndarray  # 3, standard error of the position, per axis
    spread_m: np.ndarray  # 3, standard deviation of one frame's position
    frames: int  # number of frames used


def robust_mean(
    samples: Float[np.ndarray, "N 3"],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], int]:
    """Mean, standard deviation and number of samples within 3.5 robust sigmas of the median on every axis.

    Robust sigma is 1.4826 times the median absolute deviation; each sample is the position in one frame.
    """
    off = np.abs(samples - np.median(samples, axis=0))
    sigma = 1.4826 * np.median(off, axis=0)
    kept = samples[np.all(off <= _CLIP_SIGMAS * np.maximum(sigma, 1e-6), axis=1)]
    if len(kept) < 2:
        return np.median(samples, axis=0), np.std(samples, axis=0), len(samples)
    return kept.mean(axis=0), kept.std(axis=0, ddof=1), len(kept)


def find_in_radar(frames: Sequence[Echoes], guess_m: Float[np.ndarray, " 3"]) -> Found | None:
    """Robust mean of the strongest detection near the guess in every frame, in top view.

    Elevation is ignored, because ground reflections change a radar's elevation by metres. At equal range the
    strongest echo has the largest radar cross-section. None if fewer than 8 frames have one.
    """
    strongest = []
    for points, power_db in frames:
        near = np.flatnonzero(np.linalg.norm(points[:, :2] - guess_m[:2], axis=1) < _RADAR_REACH_M)
        if near.size:
            strongest.append(points[near[np.argmax(power_db[near])]])
    if len(strongest) < _FEWEST_FRAMES:
        return None
    mean, spread, count = robust_mean(np.array(strongest, np.float64))
    return Found(mean, spread / np.sqrt(count), spread, count)


def find_in_lidar(
    frames: Sequence[Echoes], guess_m: Float[np.ndarray, " 3"], edge_m: float | None = None
) -> Found | None:
    """Apex of a trihedral from the bright echoes near the guess; if its edge is unknown, their centre.

    Args:
        frames: points and intensities of each standing frame, lidar frame.
        edge_m: length of the edges that meet in the apex. The reflector opens towards the sensor with one
            edge upright, to 2 deg per axis; the fit may rotate it within that.

    Returns:
        None if fewer than 8 frames have a bright echo, or if the sigma of the apex is above a quarter of an
        edge. sigma_m includes the scatter between frames and the geometry of the few standing beams. Without
        edge_m the apex is deeper than the returned centre.
    """
    bright = [b for points, intensity in frames if len(b := _bright(points, intensity, guess_m))]
    if len(bright) < _FEWEST_FRAMES:
        return None
    mean, spread, count = robust_mean(np.array([b.mean(axis=0) for b in bright]))
    everything = np.concatenate(bright)
    if edge_m is None:
        of_beams = everything.std(axis=0) / np.sqrt(len(everything) / len(bright))
        return Found(mean, np.hypot(spread / np.sqrt(count), of_beams), spread, count)
    apex, sigma = _fit_apex(everything, edge_m)
    if sigma.max() > edge_m / 4:
        return None
    parts = [np.concatenate(bright[i::_BLOCKS]) for i in range(_BLOCKS)]
    between = np.std([_fit_apex(part, edge_m)[0] for part in parts], axis=0, ddof=1) / np.sqrt(_BLOCKS)
    return Found(apex, np.hypot(sigma, between), spread, len(bright))


def _bright(points: np.ndarray, intensity: np.ndarray, guess_m: np.ndarray) -> np.ndarray:
    near = np.linalg.norm(points - guess_m, axis=1) < _LIDAR_REACH_M
    p, v = points[near].astype(np.float64), intensity[near]
    return p[v > max(_BRIGHT * v.max(), _OVER_MEDIAN * np.median(intensity))] if len(p) else p


def _fit_apex(points: np.ndarray, edge_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Apex and its sigma, fitted so that each ray leaves the corner of three planes at its measured range."""
    rays, range_m = _by_beam(points)
    centre = (rays * range_m[:, None]).mean(axis=0)
    # The centroid of the plates is 2/3 of the corner's depth in front of the apex: edge / sqrt(3) * 2/3.
    start = centre * (1 + edge_m * 2 / np.sqrt(27) / np.linalg.norm(centre))
    edges = _facing(start)

    def residuals(x: np.ndarray) -> np.ndarray:
        plates = edges @ exp_so3(x[3:]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (plates @ (start + x[:3])) / (rays @ plates.T)
        at = np.where(t > 0, t, np.inf).min(axis=1)
        miss = np.where(np.isfinite(at), at - range_m, 10.0) / _RANGE_SIGMA_M
        # With too few beams, the centre of the echoes limits the apex: half an edge across.
        return np.concatenate([miss, x[:3] / (edge_m / 2), x[3:] / _FACING_SIGMA_RAD])

    found = least_squares(residuals, np.zeros(6), loss="soft_l1", x_scale=0.05)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return start + found.x[:3], np.sqrt(np.diag(covariance)[:3])


def _by_beam(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean direction and median range of each cell of directions with a sufficient share of the returns."""
    spherical = to_spherical(points)
    _, cell, counts = np.unique(
        np.round(spherical[:, :2] / _CELL_RAD), axis=0, return_inverse=True, return_counts=True
    )
    often = np.flatnonzero(counts >= 0.2 * counts.max())
    members = [np.flatnonzero(cell.ravel() == k) for k in often]
    middle = np.array([np.median(points[m], axis=0) for m in members])
    rays = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    return rays, np.array([np.median(spherical[m, 2]) for m in members])


def _facing(apex: np.ndarray) -> np.ndarray:
    """Unit edges (rows) of a trihedral that opens level towards the sensor, with one edge vertical."""
    towards = -apex * [1, 1, 0] / np.linalg.norm(apex[:2])
    side, up = np.array([-towards[1], towards[0], 0.0]), np.array([0.0, 0.0, 1.0])
    turns = np.radians([90.0, 210.0, 330.0])
    across = np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * up
    return towards / np.sqrt(3) + across * np.sqrt(2 / 3)
