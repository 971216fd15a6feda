"""Motion of a camera between two of its images: rotation, and direction of translation, from tracks of corners.

Neither labels nor depths are used, and no scale is found. Corners of the later image are tracked back to the
earlier one and forth again (pyramid Lucas-Kanade). Of bearings m0, m1 of a static point, in axes midway between both
orientations, and the direction u of translation: u . (m1 x m0) = 0. An essential matrix by RANSAC is the start;
then the Sampson residual, an angle, is minimised with a Cauchy loss over all tracks: any camera model that has
bearings will do, and its distortion plays no part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.rig.cameras import Camera
from pipeline.rig.se3 import exp_so3, log_so3

__all__ = [
    "ImageMotion",
    "MotionReason",
    "NoMotionError",
    "Tracks",
    "motion_of_tracks",
    "solve_motion",
    "track",
]

# A small window: one of 15 px lies across edges of depth, and on the real car's pairs a direction scattered by .12 deg
# at any number of corners; by .09 at 400 corners and .05 at 1000 with one of 9 px, in a third of the time a corner.
_CORNERS, _QUALITY, _APART_PX = 1000, 0.004, 5
_WINDOW_PX, _LEVELS, _BACK_PX = 9, 4, 0.3
_FEWEST = 35
_STILL_PX = 0.3  # a track that moves less is far away, or on the car itself
_NOISE_PX = 0.15  # of a track at the size of tracking: the threshold and the first scale of the loss
_LEAST_NOISE_PX, _MOST_NOISE_PX = 0.05, 0.4
# Errors of simulated tracks over their sigma: directions are not linear in tracks of near points.
_WIDER = 1.3
_RANSAC_PX = 0.7
_WIDEST = np.cos(np.radians(75.0))  # bearings that RANSAC takes: it works on a plane
_PASSES = 5
_STRONGEST = 400  # tracks that the start is found from
_STANDING = 0.1  # share of moving tracks below which the whole image stands still
_CELLS = np.array([8, 6])
_LEAST_PARALLAX_PX = 1.0
_LEAST_INLIERS = 0.5
_IN_FRONT = 0.65
_MOST_SIGMA_RAD = np.radians(2.0)  # of the direction: a worse one is none
_MOST_TURN_RAD = np.radians(20.0)


class MotionReason(StrEnum):
    """Reasons why two images show no motion; the value ends the key of the counts."""

    NO_EARLIER = "no_earlier_image"
    TOO_FAR = "images_too_far_apart"
    STAMPS_JUMP = "stamps_jump"
    SAME_IMAGE = "same_image_again"
    STANDING = "standing"
    FEW_TRACKS = "few_tracks"
    STATIC_TRACKS = "static_tracks"
    NO_PARALLAX = "no_parallax"
    NO_COMMON_MOTION = "no_common_motion"
    BEHIND = "points_behind_the_camera"


class NoMotionError(Exception):
    """Two images show no motion of the camera, for `reason`; handled within the stage."""

    def __init__(self, reason: MotionReason) -> None:
        self.reason = reason
        super().__init__(reason.value)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corners seen in both images.

    Args:
        before_px, now_px: pixels at the size of tracking.
        before, now: their bearings, unit vectors in camera axes.
        pixel_rad: angle of a pixel there.
    """

    before_px: Float[np.ndarray, "N 2"]
    now_px: Float[np.ndarray, "N 2"]
    before: Float[np.ndarray, "N 3"]
    now: Float[np.ndarray, "N 3"]
    pixel_rad: Float[np.ndarray, " N"]

    def some(self, of: Bool[np.ndarray, " N"]) -> Tracks:
        """Some of the tracks."""
        return Tracks(self.before_px[of], self.now_px[of], self.before[of], self.now[of], self.pixel_rad[of])


@dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion from the earlier image to the later one, in camera axes midway between both orientations.

    Args:
        turn: 3, rotation vector: R_before_now = exp(turn) [rad].
        direction: 3, unit vector of the translation.
        covariance: 6 6, of turn and direction, of rank 5: the direction has no length.
        inlier: N, tracks that follow the motion.
        spread: share of the image's eighths by sixths that have such a track.
        parallax_px: median shift of the inliers that rotation does not explain, at the size of tracking.
    """

    turn: np.ndarray
    direction: np.ndarray
    covariance: np.ndarray
    inlier: np.ndarray
    spread: float
    parallax_px: float


def track(
    before: UInt8[np.ndarray, "H W"],
    now: UInt8[np.ndarray, "H W"],
    camera: Camera,
    is_left_out: Bool[np.ndarray, "H W"] | None = None,
) -> Tracks:
    """Tracks of the later image's corners; `camera` is at the size of these images.

    Args:
        is_left_out: where no corner is to be taken: road users, sky.
    """
    mask = None if is_left_out is None else np.where(is_left_out, 0, 255).astype(np.uint8)
    found = cv2.goodFeaturesToTrack(now, _CORNERS, _QUALITY, _APART_PX, mask=mask)
    if found is None:
        nothing = np.zeros((0, 2))
        return Tracks(nothing, nothing, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    window = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": _LEVELS}
    there, ok, _ = cv2.calcOpticalFlowPyrLK(now, before, found, None, **window)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(before, now, there, None, **window)
    kept = (ok & ok_back)[:, 0].astype(bool)
    kept &= np.linalg.norm((back - found)[:, 0], axis=1) < _BACK_PX
    uv, uv_before = found[:, 0].astype(np.float64), there[:, 0].astype(np.float64)
    kept &= camera.contains(uv_before)
    uv, uv_before = uv[kept], uv_before[kept]
    rays, rays_before = camera.unproject(uv), camera.unproject(uv_before)
    known = np.isfinite(rays).all(1) & np.isfinite(rays_before).all(1)
    return Tracks(uv_before, uv, rays_before, rays, _pixel_rad(rays, camera)).some(known)


def _pixel_rad(rays: np.ndarray, camera: Camera) -> np.ndarray:
    """Mean angle of a pixel along and across the radius; distortion is left out of account."""
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    cosine = np.clip(rays[:, 2], 0.05, 1.0)
    return np.full(len(rays), 1 / focal) if camera.model == "equidistant" else cosine**1.5 / focal


def motion_of_tracks(tracks: Tracks, size_px: tuple[int, int], readout: float = 0.0) -> ImageMotion:
    """Motion that most tracks follow.

    Tracks that do not move may be of the car itself: they take part only where they fit what the others show.

    Args:
        size_px: width and height of the images of tracking.
        readout: from the first row to the last of a rolling shutter, as a share of the time between both images.

    Raises:
        NoMotionError: with the reason why there is none.
    """
    moving = _moving(tracks)
    strongest = tracks.some(moving & (np.cumsum(moving) <= _STRONGEST))
    turn, direction, noise_px, _ = solve_motion(strongest, *_by_ransac(strongest))
    tracks = _at_once(tracks, turn, size_px[1], readout)
    used = moving | _follows(tracks, turn, direction, noise_px)
    turn, direction, noise_px, H = solve_motion(tracks.some(used), turn, direction)
    inlier = used & _follows(tracks, turn, direction, noise_px)
    if np.count_nonzero(inlier & moving) < _LEAST_INLIERS * np.count_nonzero(moving):
        raise NoMotionError(MotionReason.NO_COMMON_MOTION)
    m0, m1 = _midway(tracks, turn)
    parallax_px = np.linalg.norm(_cross(m1, m0), axis=1) / tracks.pixel_rad
    if np.median(parallax_px[inlier & moving]) < _LEAST_PARALLAX_PX:
        raise NoMotionError(MotionReason.NO_PARALLAX)
    shown = inlier & (parallax_px > 4 * _NOISE_PX)
    J = np.zeros((6, 5))
    sign = _towards(direction, m0[shown], m1[shown])
    J[:3, :3], J[3:, 3:] = np.eye(3), sign * _across(direction)
    covariance = J @ np.linalg.inv(H) @ J.T * (_WIDER * noise_px) ** 2
    if np.linalg.eigvalsh(covariance[3:, 3:])[-1] > _MOST_SIGMA_RAD**2:
        raise NoMotionError(MotionReason.NO_PARALLAX)
    cells = np.floor(tracks.now_px[inlier] / size_px * _CELLS).astype(int)
    return ImageMotion(
        turn,
        sign * direction,
        covariance,
        inlier,
        len(np.unique(cells, axis=0)) / float(np.prod(_CELLS)),
        float(np.median(parallax_px[inlier])),
    )


def _at_once(tracks: Tracks, turn: np.ndarray, height_px: int, readout: float) -> Tracks:
    """Bearings as if all rows were exposed with the middle one: turns are even, and ways keep their direction."""
    rows = np.stack([tracks.before_px, tracks.now_px])[..., 1:]
    turns = ((rows + 0.5) / height_px - 0.5) * readout * turn
    before, now = (
        rays + np.cross(by, rays) for by, rays in zip(turns, (tracks.before, tracks.now), strict=True)
    )
    return replace(tracks, before=before, now=now)


def _follows(
    tracks: Tracks, turn: np.ndarray, direction: np.ndarray, noise_px: float
) -> Bool[np.ndarray, " N"]:
    """Tracks that a motion explains."""
    off_px = np.abs(_residuals(tracks, turn, direction)[0]) / tracks.pixel_rad
    return np.asarray(off_px < 4 * max(noise_px, _NOISE_PX))


def _moving(tracks: Tracks) -> Bool[np.ndarray, " N"]:
    """Tracks that move; raises NoMotionError for too few."""
    if len(tracks.pixel_rad) < _FEWEST:
        raise NoMotionError(MotionReason.FEW_TRACKS)
    moving = np.linalg.norm(tracks.now_px - tracks.before_px, axis=1) > _STILL_PX
    if np.mean(moving) < _STANDING:
        raise NoMotionError(MotionReason.STANDING)
    if np.count_nonzero(moving) < _FEWEST:
        raise NoMotionError(MotionReason.STATIC_TRACKS)
    return np.asarray(moving)


def _towards(direction: np.ndarray, m0: np.ndarray, m1: np.ndarray) -> float:
    """Sign of the direction that has points in front of the camera; raises NoMotionError if neither has most."""
    is_ahead = np.sum(_cross(direction, m1) * _cross(m0, m1), axis=1) > 0
    share = float(np.mean(is_ahead))
    if max(share, 1 - share) < _IN_FRONT:
        raise NoMotionError(MotionReason.BEHIND)
    return 1.0 if share >= _IN_FRONT else -1.0


def _by_ransac(tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Turn and direction (of either sign) of the essential matrix that most tracks follow; else NoMotionError."""
    narrow = (tracks.before[:, 2] > _WIDEST) & (tracks.now[:, 2] > _WIDEST)
    if np.count_nonzero(narrow) < _FEWEST:
        raise NoMotionError(MotionReason.FEW_TRACKS)
    at = tracks.some(narrow)
    a, b = (rays[:, :2] / rays[:, 2:] for rays in (at.before, at.now))
    threshold = _RANSAC_PX * float(np.median(at.pixel_rad))
    E, _ = cv2.findEssentialMat(b, a, np.eye(3), cv2.USAC_ACCURATE, 0.999, threshold)
    if E is None or E.shape != (3, 3):
        raise NoMotionError(MotionReason.NO_COMMON_MOTION)
    R_1, R_2, t = cv2.decomposeEssentialMat(E)
    R = max((R_1, R_2), key=np.trace)  # P_before = R P_now + t: the other one turns the camera about
    turn = log_so3(R)
    if np.linalg.norm(turn) > _MOST_TURN_RAD:
        raise NoMotionError(MotionReason.NO_COMMON_MOTION)
    return turn, exp_so3(-turn / 2) @ t[:, 0]


def solve_motion(
    tracks: Tracks, turn: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Turn and direction by least squares with a Cauchy loss, noise of a track [px], information at a noise of 1 px."""
    noise_px = _NOISE_PX
    for k in range(_PASSES):
        r, J = _residuals(tracks, turn, direction)
        r, J = r / tracks.pixel_rad, J / tracks.pixel_rad[:, None]
        if k:
            near = np.abs(r[np.abs(r) < 6 * noise_px])
            scale = 1.4826 * float(np.median(near)) if len(near) else noise_px
            noise_px = float(np.clip(scale, _LEAST_NOISE_PX, _MOST_NOISE_PX))
        weight = 1 / (1 + (r / (2 * noise_px)) ** 2)
        H = (J.T * weight) @ J
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(5), (J.T * weight) @ r)
        turn, direction = _moved(turn, direction, step)
    return turn, direction, noise_px, H


def _moved(turn: np.ndarray, direction: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motion changed by five numbers: a turn in axes midway, and the direction along two axes across it."""
    half, more = exp_so3(turn / 2), exp_so3(step[:3] / 2)
    u = direction + _across(direction) @ step[3:]
    to_before = half @ more  # from the old middle to the axes before
    now = log_so3(to_before @ more @ half)
    return now, exp_so3(-now / 2) @ to_before @ (u / np.linalg.norm(u))


def _midway(tracks: Tracks, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bearings before and now, in axes midway."""
    half = exp_so3(turn / 2)
    return tracks.before @ half, tracks.now @ half.T


def _residuals(tracks: Tracks, turn: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sampson residuals [rad] and their derivative by a step of `_moved`.

    Their size takes part in the derivative: with it held, noise of the tracks drew the direction of a side camera .1 to
    .5 deg outward.
    """
    m0, m1 = _midway(tracks, turn)
    across, normal = _across(direction), _cross(m1, m0)
    at_0, at_1 = _cross(direction, m1), _cross(m0, direction)
    e = normal @ direction
    # |a|^2 less its part along the bearing; both such parts are e.
    square = np.maximum((at_0**2).sum(1) + (at_1**2).sum(1) - 2 * e**2, 1e-12)
    u0, u1 = (m0 @ direction)[:, None], (m1 @ direction)[:, None]
    by_turn = 0.5 * (m0 * u1 + m1 * u0) - np.outer((m0 * m1).sum(1), direction)
    J = np.concatenate([by_turn, normal @ across], 1)
    grown = np.concatenate([u1 * at_0 + u0 * at_1, -2 * (u1 * m1 + u0 * m0) @ across], 1) - 4 * e[:, None] * J
    return e / np.sqrt(square), (J - (e / (2 * square))[:, None] * grown) / np.sqrt(square)[:, None]


def _across(direction: np.ndarray) -> np.ndarray:
    """Two axes across a direction, as columns."""
    first = _cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, _cross(direction, first)], 1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """As `np.cross` of vectors of three, without its checks: a third of the time that a motion took."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)
