"""Directed edges: depth jumps of the lidar against mask boundaries of the same direction.

Each projected jump has a nearest boundary of its own direction class at the signed distance r along that
boundary's axis. Only some jumps match (on real logs one in five more than by chance), so the score is not a
sum of squares but the log likelihood ratio of a mixture, `pi k(r; s) + (1 - pi) c(r)`, against chance alone,
`c(r)`: the density of distances from random pixels to their nearest boundary. k is the kernel (1 +
(r/s)^2)^-2, normalised. The share of matches pi is estimated per kind of edge: a kind that matches no better
than chance gets a small pi and so loses its weight.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float32, Float64, Int8, UInt8

from pipeline.objective.camera_lidar.kernel_settings import CHANCE_BINS, KernelSettings
from pipeline.objective.camera_lidar.points import Points
from pipeline.objective.camera_lidar.projection_loops import (
    along_motion,
    most_points,
    project_point,
    project_points,
    project_with_jacobian,
)

__all__ = ["chance_of", "edge_gradients", "edge_residuals", "edge_scores", "fit_match_share"]

_FEWEST_OF_KIND = 40  # fewer do not separate a share from chance


def edge_scores(
    camera: Float32[np.ndarray, " 18"], offsets: Int8[np.ndarray, "I 4 H W"], edges: Points,
    poses: Float32[np.ndarray, "P F 12"], focal: Float32[np.ndarray, " P"], settings: KernelSettings,
) -> Float32[np.ndarray, "P F"]:  # fmt: skip
    """Log likelihood ratio of each frame at each pose; points outside the image count 0.

    Args:
        camera: `camera_parameters` at label size.
        offsets: `boundary_offsets` of each frame.
        edges: depth jumps of all frames. The angle between a jump's two beams, `gap_rad`, widens its kernel
            by the standard deviation of an even distribution over it.
        poses: rows of the 3x4 transform into the camera, per pose and frame (frames differ by time offset
            times speed).
        focal: focal length in units of the camera's, by pose.
        settings: scale of the kernel (1 + (r/s)^2)^-2, share of matching jumps and chance density by kind.
    """
    width_px = np.hypot(
        np.float32(settings.sigma_px), edges.gap_rad * camera[1] * np.float32(1 / np.sqrt(12))
    )
    # 2/pi makes (1 + x^2)^-2 a density
    gain = settings.match[:, None] * np.float32(2 / np.pi) / settings.chance
    return _edge_loop(
        camera, offsets, np.ascontiguousarray(edges.xyz_m.T), edges.side, edges.kind, 1 / width_px,
        edges.start, edges.image, poses, focal, 1 - settings.match, gain,
    )  # fmt: skip


def edge_gradients(
    camera: Float32[np.ndarray, " 18"], offsets: Int8[np.ndarray, "I 4 H W"], edges: Points,
    poses: Float64[np.ndarray, "F 12"], focal: float, motion: Float64[np.ndarray, "F 4"],
    settings: KernelSettings,
) -> tuple[Float64[np.ndarray, "F 11"], Float64[np.ndarray, "F 11 11"]]:  # fmt: skip
    """Gradient of each frame's score at ONE pose, and its information.

    By left perturbation of T_camera_lidar (rotation [rad], translation [m]), time offset [s], focal scale,
    principal point [px of the label image] and readout time [s]. The information is Gauss-Newton's: residuals
    weighted by how likely they are matches (iterated re-weighting).

    Args:
        camera: as for `edge_scores`.
        offsets: as for `edge_scores`.
        edges: as for `edge_scores`.
        poses: rows of the 3x4 transform by frame.
        focal: focal length in units of the camera's.
        motion: of each frame, as for `along_motion`.
        settings: as for `edge_scores`.
    """
    return _gradient_loop(
        camera, offsets, edges.xyz_m, edges.side, edges.kind, edges.gap_rad, edges.start, edges.image, poses,
        focal, motion, settings.match, settings.chance, settings.sigma_px,
    )  # fmt: skip


def edge_residuals(
    camera: Float32[np.ndarray, " 18"], offsets: Int8[np.ndarray, "I 4 H W"], edges: Points,
    poses: Float32[np.ndarray, "F 12"], focal: np.float32, shift_px: Float32[np.ndarray, "N 2"],
) -> Float32[np.ndarray, " N"]:  # fmt: skip
    """Signed distance [px] of each jump, moved by `shift_px`, to its boundary at ONE pose; 127 without one.

    NaN outside the image.
    """
    at = (edges.xyz_m, edges.side, edges.start, edges.image)
    return _residual_loop(camera, offsets, *at, poses, focal, shift_px)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, fastmath=True, nogil=True, error_model="numpy")
def _edge_loop(
    camera: np.ndarray, offsets: np.ndarray, xyz: np.ndarray, side: np.ndarray, kind: np.ndarray,
    sharpness: np.ndarray, start: np.ndarray, image: np.ndarray, poses: np.ndarray, focal: np.ndarray,
    base: np.ndarray, gain: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The sum of log(base + gain sharpness (1 + (r sharpness)^2)^-2) over each frame's points.

    Steps over few arrays without branches become vector instructions; unpredictable branches took two thirds
    of the time.
    """
    count, frames = poses.shape[0], poses.shape[1]
    height, width = offsets.shape[2], offsets.shape[3]
    out = np.zeros((count, frames), np.float32)
    most = most_points(start)
    us, vs, found = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    rest, place = np.empty(most, np.float32), np.empty(most, np.int32)
    floor, row = base[kind], kind.astype(np.int32) * gain.shape[1]
    gains = gain.reshape(-1)
    for f in range(frames):
        a, b = start[f], start[f + 1]
        n = b - a
        map_ = offsets[image[f]].reshape(-1)
        for p in range(count):
            project_points(camera, xyz, a, b, poses[p, f], focal[p], us, vs)
            _places(us[:n], vs[:n], side[a:b], width, height, place, rest)
            for i in range(n):
                found[i] = map_[place[i]]
            _ratios(found[:n], rest, sharpness[a:b], floor[a:b], row[a:b], gains, us)
            out[p, f] = _sum_of_logs(us[:n])
    return out


_UNSEEN = np.float32(1e6)  # px: no distance in an image


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
def _places(
    us: np.ndarray, vs: np.ndarray, side: np.ndarray, width: int, height: int, place: np.ndarray,
    rest: np.ndarray,
) -> None:  # fmt: skip
    """Where in its frame's flat map each point looks, and from there to the point along its axis [px]."""
    half, zero = np.float32(0.5), np.float32(0)
    u_max, v_max = np.float32(width - 1), np.float32(height - 1)
    across = np.int32(width)
    down = np.int32(width * height)
    for i in range(us.shape[0]):
        u, v = us[i], vs[i]
        seen = (u >= zero) & (v >= zero) & (u <= u_max) & (v <= v_max)
        u, v = u if seen else zero, v if seen else zero
        iu, iv = np.int32(u + half), np.int32(v + half)
        place[i] = np.int32(side[i]) * down + iv * across + iu
        along = np.float32(iu) - u if side[i] < 2 else np.float32(iv) - v
        rest[i] = along if seen else _UNSEEN


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
def _ratios(
    found: np.ndarray, rest: np.ndarray, sharpness: np.ndarray, floor: np.ndarray, row: np.ndarray,
    gains: np.ndarray, ratio: np.ndarray,
) -> None:  # fmt: skip
    """Likelihood ratio of each point; 1 outside the image."""
    one, last = np.float32(1), np.float32(CHANCE_BINS - 1)
    for i in range(found.shape[0]):
        r = found[i] + np.float32(0.5) + rest[i]
        x = r * sharpness[i]
        q = one + x * x
        gain = gains[row[i] + np.int32(min(abs(r), last))]
        gain = gain * sharpness[i] / (q * q)
        matched = floor[i] + (gain if found[i] > np.float32(-128) else np.float32(0))
        ratio[i] = matched if rest[i] < _UNSEEN else one


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, forceinline=True, fastmath=True, nogil=True, error_model="numpy")
def _sum_of_logs(x: np.ndarray) -> float:
    """One logarithm for eight factors: each is above 1e-4 and below 1e4."""
    total, eighths = np.float32(0), x.shape[0] // 8
    for b in range(eighths):
        i = 8 * b
        total += np.log(
            ((x[i] * x[i + 1]) * (x[i + 2] * x[i + 3])) * ((x[i + 4] * x[i + 5]) * (x[i + 6] * x[i + 7]))
        )
    product = np.float32(1)
    for i in range(8 * eighths, x.shape[0]):
        product *= x[i]
    return total + np.log(product)


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _gradient_loop(
    camera: np.ndarray, offsets: np.ndarray, points: np.ndarray, side: np.ndarray, kind: np.ndarray,
    gap_rad: np.ndarray, start: np.ndarray, image: np.ndarray, poses: np.ndarray, focal: float,
    motion: np.ndarray, match: np.ndarray, chance: np.ndarray, sigma_px: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Sums over each frame's points of weighted gradients and their outer products."""
    frames = poses.shape[0]
    height, width = offsets.shape[2], offsets.shape[3]
    gradient, information = np.zeros((frames, 11)), np.zeros((frames, 11, 11))
    s2, beam = sigma_px * sigma_px, camera[1] * camera[1] / 12
    row = np.zeros(11)
    for f in range(frames):
        m = poses[f]
        for i in range(start[f], start[f + 1]):
            x0, y0, z0 = points[i, 0], points[i, 1], points[i, 2]
            x = m[0] * x0 + m[1] * y0 + m[2] * z0 + m[3]
            y = m[4] * x0 + m[5] * y0 + m[6] * z0 + m[7]
            z = m[8] * x0 + m[9] * y0 + m[10] * z0 + m[11]
            u, v, valid, jux, juy, juz, jvx, jvy, jvz = project_with_jacobian(camera, x, y, z)
            ou, ov = u - camera[3], v - camera[4]
            u, v = camera[3] + focal * ou, camera[4] + focal * ov
            if not valid or u < 0 or v < 0 or u > width - 1 or v > height - 1:
                continue
            c = side[i]
            iu, iv = int(u + 0.5), int(v + 0.5)
            k = offsets[image[f], c, iv, iu]
            if k == -128:
                continue
            r = k + 0.5 + (iu - u if c < 2 else iv - v)
            dx, dy, dz = (
                (focal * jux, focal * juy, focal * juz) if c < 2 else (focal * jvx, focal * jvy, focal * jvz)
            )
            si2 = s2 + gap_rad[i] * gap_rad[i] * beam
            q = 1 + r * r / si2
            pi = match[kind[i]]
            part = pi * 0.63661977 / (np.sqrt(si2) * q * q) / chance[kind[i], min(int(abs(r)), 127)]
            weight = part / (1 - pi + part) * 4 / (si2 * q)  # -d score / d r = weight r, and dr = -du
            row[0], row[1], row[2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
            row[3], row[4], row[5] = dx, dy, dz
            row[6] = along_motion(m, motion[f], x, y, z, dx, dy, dz)
            row[7] = ou if c < 2 else ov
            row[8], row[9] = (1.0, 0.0) if c < 2 else (0.0, 1.0)
            row[10] = (0.5 - (v + 0.5) / height) * row[6]
            for a in range(11):
                gradient[f, a] += weight * r * row[a]
                for b in range(11):
                    information[f, a, b] += weight * row[a] * row[b]
    return gradient, information


@no_type_check  # keeps the tests' shape checks out of compiled code
@numba.njit(cache=True, nogil=True)
def _residual_loop(
    camera: np.ndarray, offsets: np.ndarray, points: np.ndarray, side: np.ndarray, start: np.ndarray,
    image: np.ndarray, poses: np.ndarray, focal: float, shift_px: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The loop of `edge_residuals`."""
    height, width = offsets.shape[2], offsets.shape[3]
    out = np.full(points.shape[0], np.nan, np.float32)
    for f in range(start.shape[0] - 1):
        m = poses[f]
        for i in range(start[f], start[f + 1]):
            x0, y0, z0 = points[i, 0], points[i, 1], points[i, 2]
            x = m[0] * x0 + m[1] * y0 + m[2] * z0 + m[3]
            y = m[4] * x0 + m[5] * y0 + m[6] * z0 + m[7]
            z = m[8] * x0 + m[9] * y0 + m[10] * z0 + m[11]
            u, v, valid = project_point(camera, x, y, z)
            u = camera[3] + focal * (u - camera[3]) + shift_px[i, 0]
            v = camera[4] + focal * (v - camera[4]) + shift_px[i, 1]
            if not valid or u < 0 or v < 0 or u > width - 1 or v > height - 1:
                continue
            iu, iv = int(u + 0.5), int(v + 0.5)
            k = offsets[image[f], side[i], iv, iu]
            out[i] = 127.0 if k == -128 else k + 0.5 + (iu - u if side[i] < 2 else iv - v)
    return out


def chance_of(
    residual_px: Float32[np.ndarray, " N"], kind: UInt8[np.ndarray, " N"], kinds: int
) -> Float32[np.ndarray, "K B"]:
    """Histogram density of |residual_px| at random image positions, per kind; the last bin is "no boundary"."""
    out = np.empty((kinds, CHANCE_BINS), np.float32)
    kernel = np.ones(9) / 9
    for c in range(kinds):
        r = np.abs(residual_px[(kind == c) & np.isfinite(residual_px)])
        histogram = np.bincount(
            np.minimum(r.astype(np.int64), CHANCE_BINS - 1), minlength=CHANCE_BINS
        ).astype(float)
        mirrored = np.concatenate([histogram[:4][::-1], histogram[:-1], np.full(4, histogram[-6:-1].mean())])
        histogram[:-1] = np.convolve(mirrored, kernel, "valid")
        # r has a sign, so a bin of |r| is two pixels wide. One part in 3000: the floor of what a small kind can show.
        out[c] = np.maximum(histogram / max(len(r), 1), 3e-4) / 2
    return out


def fit_match_share(
    residual_px: Float32[np.ndarray, " N"],
    kind: UInt8[np.ndarray, " N"],
    sigma_px: np.ndarray,
    chance: Float32[np.ndarray, "K B"],
) -> Float32[np.ndarray, " K"]:
    """Share of matching jumps by kind: the likelihood's maximum over pi, by expectation-maximisation."""
    out = np.full(len(chance), 1e-4, np.float32)
    for c in range(len(chance)):
        mine = (kind == c) & np.isfinite(residual_px)
        if np.count_nonzero(mine) < _FEWEST_OF_KIND:
            continue
        r, s = residual_px[mine].astype(np.float64), sigma_px[mine]
        at_chance = chance[c, np.minimum(np.abs(r).astype(np.int64), CHANCE_BINS - 1)]
        ratio = 0.63661977 / s / (1 + (r / s) ** 2) ** 2 / at_chance
        pi = 0.2
        for _ in range(60):
            matched = pi * ratio
            pi = float(np.mean(matched / (matched + 1 - pi)))
        out[c] = np.clip(pi, 1e-4, 0.9)
    return out
