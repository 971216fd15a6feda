"""Focal length and principal point of the camera from the day: for report and alarm, not for the pose.

Free intrinsics would make the pose worse: focal length, tz and the time offset share a flat valley, and a
principal point wrong by d pixels has, over most of an image, the effect of a camera rotated by d/f. So the
pose is that for CameraInfo, which is right for all users of image directions with the same CameraInfo. The
intrinsics are measured separately: all unknowns are free, with Gauss-Newton on the points' re-weighted
residuals from the aligned pose. Response surfaces, which solve for the pose, do not converge in that valley;
analytic slopes, which ignore the steps of the maps, do. They may still end in a local maximum, so there are
two starts: CameraInfo's focal length with the expected clock, and the values of the alignment. The edges
select the better end. From the first start alone, a highway whose camera was 60 ms late gave a focal length 6
% off.

Edges alone determine the focal length, with the principal point held. Markings run along the direction of
travel, where motion and focal length have the same effect: with them it was 0.8 % off, by edges 0.5 % off.
The principal point has two sources, weighed by their information. Edges and markings (which reach the image's lower
corners) show that of pinholes. Of a fisheye, a shift is a turn but for some pixels in the corners, where the lidar may
not look; but static points move along epipolar lines, which no turn moves, so tracks between two images of the camera
show it. A fisheye of 116 deg: edges know it to 30 px, tracks to 8; a pinhole of 84 deg: to 4 and 30.

A contradiction of CameraInfo must pass two more tests before it holds a record. The first and the second half
of the frames must each show it separately (highways end at different ends of the valley). If a smaller weight of the
markings moves the principal point, its sigma is at least this change (at dusk markings alone moved it up by 40 px).

Source: Triggs et al. 2000, section 4 (Gauss-Newton with robust weights); the sigmas are measured, see their
constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.observability import CameraLidarProblem
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.nuisances import (
    DAY_CENTRE_SIGMAS,
    DAY_FOCAL_FLOOR,
    DAY_FOCAL_SIGMAS,
    DAY_TRACKS_SIGMAS,
    INTRINSICS_CONTRADICTION_SIGMAS,
    INTRINSICS_HALF_SIGMAS,
)
from pipeline.calibrate.reasons import because
from pipeline.core.rigs import CameraPrior
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.cameras import camera_of
from pipeline.rig.epipolar import Seen, off_lines_px, seen
from pipeline.rig.estimates import Check, Prior
from pipeline.rig.se3 import change_between, change_jacobian
from schemas.image_motion import tracking_scale
from schemas.observations import Observation

__all__ = ["DayIntrinsics", "contradictions", "measure_intrinsics"]

_KERNELS = ((2.5, 1), (1.5, 2))  # px and contrast level: the alignment's last two
_STEPS = 8  # at each kernel: from a focal length 3 % off, later steps are less than a tenth of the sigma
_POINTS = 9000  # twice as many change nothing
# A marking's score is linear in the contrast, so its information is no curvature; steps by it overshoot, to and fro by
# 10 px on the simulated rig `demo`. Three times as much settles them.
_MARKING_DAMPING = 3.0
# Weak priors that keep undetermined directions in place: focal scale, and principal point in shares of the image.
_FOCAL_REACH, _CENTRE_REACH = 0.05, 0.13
_HELD_PX = 1e-3  # sigma of a principal point that stays
_LESS_MARKING = 0.25  # of their weight: enough to let edges decide where they are informative
_DECIDED_SIGMAS = 3.0  # of the frames' scatter: where two ends score alike, half of their distance is sigma
# A pair with fewer tracks is left out. Those that scatter by more pixels at the size of tracking are of mirrors and
# fences, whose errors are no noise: an alley moved the point by 50 px at 7 (another simulator's by 11 at 4: the floor).
_FLOOR_PX, _TRACKS, _MOST_TRACKS, _TRACK_NOISE_PX, _LEAST_NOISE_PX = 3.0, 40, 300, 0.2, 0.05
_PASSES, _LONGER, _STEP, _HELD = 4, 1.5, 1e-5, 1e-9  # steps under a Cauchy loss end short
_FOCAL, _CENTRE, _UNKNOWNS = 7, slice(8, 10), 10


@dataclass(frozen=True, eq=False)
class DayIntrinsics:
    """The day's own measurement, with sigmas that exclude CameraInfo.

    Focal length in units of CameraInfo's; principal point (right, down) minus CameraInfo's [px of the full
    image].
    """

    focal: float
    focal_sigma: float
    centre_px: Float[np.ndarray, " 2"]
    centre_sigma_px: Float[np.ndarray, " 2"]
    focal_px: tuple[float, float]
    # Of either half of the frames by itself, where the whole contradicts CameraInfo.
    halves: tuple[DayIntrinsics, ...] = ()

    def diagnostics(self, known: CameraPrior) -> dict[str, float]:
        """Numbers of the record; `mounting_*` is the camera's rotation sigma due to the principal point."""
        sigmas = tuple(zip("uv", self.centre_sigma_px.tolist(), strict=True))
        yaw_rad, pitch_rad = self._turn_sigma_rad(known)
        return {
            "day_focal_scale": self.focal,
            "day_focal_sigma": self.focal_sigma,
            "day_focal_observable": float(self.focal_sigma <= known.focal_sigma),
            **{f"day_centre_{n}_px": float(v) for n, v in zip("uv", self.centre_px, strict=True)},
            **{f"day_centre_{n}_sigma_px": v for n, v in sigmas},
            **{f"day_centre_{n}_observable": float(v <= known.centre_sigma_px) for n, v in sigmas},
            "mounting_yaw_sigma_rad": yaw_rad,
            "mounting_pitch_sigma_rad": pitch_rad,
        }

    def notes(self, known: CameraPrior) -> list[str]:
        """Text of the assumption, and the smallest error of it that the day would have detected."""
        yaw, pitch = np.degrees(self._turn_sigma_rad(known))
        source = because("centre stated" if known.centre_is_stated else "centre by day")
        scale = {"focal": self.focal - 1, "sigma": self.focal_sigma}
        return [
            because("in the image", yaw=yaw, pitch=pitch, source=source),
            because("off CameraInfo", **scale, **self.centre_text(0)),
            because("readout", ms=1e3 * known.readout_s),
        ]

    def centre_text(self, digits: int) -> dict[str, str]:
        """The principal point in words."""
        both = zip(("right", "down"), self.centre_px, self.centre_sigma_px, strict=True)
        return {name: f"{px:+.{digits}f} +- {sigma:.{digits}f}" for name, px, sigma in both}

    def _turn_sigma_rad(self, known: CameraPrior) -> tuple[float, float]:
        """Sigma of the camera's yaw and pitch, if the principal point is known; a default value does not count."""
        sigma_px = self.centre_sigma_px
        if known.centre_is_stated:
            sigma_px = sigma_px * known.centre_sigma_px / np.hypot(sigma_px, known.centre_sigma_px)
        yaw, pitch = sigma_px / np.array(self.focal_px)
        return float(yaw), float(pitch)


def contradictions(day: DayIntrinsics, known: CameraPrior) -> list[Check]:
    """One failed check for each intrinsic of CameraInfo that the day, and each half of it separately, contradicts."""
    off = _off_by_sigmas(day, known)
    is_wrong = np.abs(off) > INTRINSICS_CONTRADICTION_SIGMAS
    for half in day.halves:
        is_wrong &= np.sign(off) * _off_by_sigmas(half, known) > INTRINSICS_HALF_SIGMAS
    found = []
    if is_wrong[0]:
        found.append(Check(because("focal length", off=day.focal - 1, sigma=day.focal_sigma), "camera_info"))
    if is_wrong[1:].any():
        yaw, pitch = (np.abs(day.centre_px) / day.focal_px).tolist()  # the pose is turned by so much
        why = because("principal point", **day.centre_text(1))
        found.append(Check(why, "camera_info", error=(pitch, yaw, 0.0, 0.0, 0.0, 0.0)))
    return found


def measure_intrinsics(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, frames: Sequence[Observation],
    rng: np.random.Generator,
) -> DayIntrinsics:  # fmt: skip
    """Solve for pose, time offset, focal length and principal point together, from an aligned pose.

    Args:
        kernel: kernel with the weights of edges and markings.
        frames: those of the problem.
    """
    day = _measured(problem, state, kernel, frames, rng)
    if not contradictions(day, problem.prior.camera):
        return day
    edges_decide = replace(kernel, marking_weight=_LESS_MARKING * kernel.marking_weight)
    moved = _measured(problem, state, edges_decide, frames, rng).centre_px - day.centre_px
    # By time: neighbouring frames see the same scene, and share what it does to the valley.
    by_time = np.array_split(np.arange(len(frames)), 2)
    parts = [(replace(problem, terms=problem.terms.of_frames(f)), [frames[k] for k in f]) for f in by_time]
    halves = tuple(_measured(part, state, kernel, own, rng) for part, own in parts)
    return replace(day, centre_sigma_px=np.hypot(day.centre_sigma_px, moved), halves=halves)


def _measured(
    problem: CameraLidarProblem, state: AlignmentState, kernel: KernelSettings, frames: Sequence[Observation],
    rng: np.random.Generator,
) -> DayIntrinsics:  # fmt: skip
    """The measurement from the problem's frames; arguments as of `measure_intrinsics`."""
    some = replace(problem, terms=problem.terms.at_most(_POINTS, rng))
    only_edges = replace(kernel, marking_weight=0.0)
    expected, aligned = (
        _solved(some, _State(start, np.zeros(2)), only_edges, _HELD_PX, rng)
        for start in (AlignmentState(state.T_camera_lidar), state)
    )
    lead, is_decided = _lead(some, aligned, expected)
    best, other = (aligned, expected) if lead > 0 else (expected, aligned)
    focal, dt_s = best.at.alignment.focal, best.at.alignment.dt_s
    apart = 0.0 if is_decided else focal - other.at.alignment.focal
    reach_px = _CENTRE_REACH * problem.terms.maps.camera.width_px
    # From the aligned pose again: the edges of 16 rings do not determine pitch.
    begin = _State(AlignmentState(state.T_camera_lidar, dt_s, focal), np.zeros(2))
    end = _solved(some, begin, kernel, reach_px, rng)
    scale, (fx, fy) = frames[0].label_scale, problem.terms.maps.camera.focal_px
    by_edges = np.linalg.inv(np.linalg.inv(end.information)[_CENTRE, _CENTRE])
    by_edges *= (scale / DAY_CENTRE_SIGMAS) ** 2
    shown_px, by_tracks = _by_tracks(frames, problem.prior.camera.readout_s, reach_px / scale)
    covariance = np.linalg.inv(by_edges + by_tracks)
    formal = float(np.linalg.inv(best.information)[_FOCAL, _FOCAL])
    return DayIntrinsics(
        focal,
        float(np.sqrt(DAY_FOCAL_SIGMAS**2 * formal + DAY_FOCAL_FLOOR**2 + apart**2 / 4)),
        covariance @ (by_edges @ end.at.centre_px / scale + by_tracks @ shown_px),
        np.sqrt(np.diag(covariance)),
        (fx / scale, fy / scale),
    )


def _by_tracks(
    frames: Sequence[Observation], readout_s: float, reach_px: float
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "2 2"]]:
    """Principal point minus CameraInfo's [px] by tracks, each pair of images with its own motion; its information."""
    shown = [o for o in frames if o.motion_tracks_px is not None and len(o.motion_tracks_px) >= _TRACKS]
    motions = [np.concatenate([o.motion_turn_rad, o.motion_direction]) for o in shown]
    weak, centre, known = np.eye(2) / reach_px**2, np.zeros(2), []
    for _ in range(_PASSES):
        information, gradient = weak.copy(), -weak @ centre
        for k, o in enumerate(shown):
            views = _views(o, centre, readout_s)
            for _ in range(2):  # first the motion alone: steps of both wander off along what no track shows
                r = off_lines_px(*views[0], motions[k])
                ends = [off_lines_px(*views[0], motions[k] + s) for s in _STEP * np.eye(6)]
                J = (np.stack(ends, 1) - r[:, None]) / _STEP
                noise_px = max(1.4826 * float(np.median(np.abs(r))), _LEAST_NOISE_PX)
                sigma_px = noise_px * max(1.0, noise_px * tracking_scale(o.image_width_px) / _TRACK_NOISE_PX)
                weight = 1 / (1 + (r / (2 * noise_px)) ** 2) / sigma_px**2
                H = (J.T * weight) @ J
                by = np.linalg.solve(H + _HELD * np.trace(H) * np.eye(6), J.T * weight)
                motions[k] = motions[k] - by @ r
            right, left, down, up = (off_lines_px(*view, motions[k]) for view in views[1:])
            J_centre = np.stack([right - left, down - up], 1) / 2
            J_centre -= J @ (by @ J_centre)
            information += (J_centre.T * weight) @ J_centre
            gradient -= (J_centre.T * weight) @ r
        centre = centre + _LONGER * np.linalg.solve(information, gradient)
        known.append((information - weak) / DAY_TRACKS_SIGMAS**2)
    # Where tracks hardly show the point, it drifts to where their information seems larger.
    H = min(known, key=np.linalg.det)
    return centre, H @ np.linalg.inv(np.eye(2) + _FLOOR_PX**2 * H)


def _views(o: Observation, centre: Float[np.ndarray, " 2"], readout_s: float) -> list[tuple[Seen, Seen]]:
    """Tracks of a pair of images, by `seen`: as if all rows were exposed with the middle one."""
    assert o.motion_tracks_px is not None
    camera = replace(camera_of(o), K=o.camera_K + np.outer(np.append(centre, 0.0), [0.0, 0.0, 1.0]))
    turn = readout_s / (o.motion_span_s or np.inf) * np.array(o.motion_turn_rad)
    fewer = slice(None, None, 1 + len(o.motion_tracks_px) // _MOST_TRACKS)
    both = np.split(o.motion_tracks_px[fewer].astype(np.float64), 2, axis=1)
    late = [((uv[:, 1:] + 0.5) / o.image_height_px - 0.5) * turn for uv in both]
    return list(zip(*(seen(camera, uv, by) for uv, by in zip(both, late, strict=True)), strict=True))


@dataclass(frozen=True, eq=False)
class _State:
    """An alignment and a shift of the principal point [label px]."""

    alignment: AlignmentState
    centre_px: np.ndarray

    def off(self, prior: Prior) -> Float[np.ndarray, " 10"]:
        """All unknowns minus their expected values, in the coordinates of `AlignmentState.changed`."""
        a = self.alignment
        pose = change_between(prior.T_camera_lidar, a.T_camera_lidar)
        return np.concatenate([pose, [a.dt_s, a.focal - 1], self.centre_px])

    def stepped(self, x: Float[np.ndarray, " 10"]) -> _State:
        """The state one change on."""
        return _State(self.alignment.stepped(x[:8]), self.centre_px + x[_CENTRE])

    def seen(self, terms: Terms) -> Terms:
        """The terms with the principal point shifted as in this state."""
        camera = terms.camera.copy()
        camera[3:5] += self.centre_px.astype(np.float32)
        return replace(terms, camera=camera)


@dataclass(frozen=True, eq=False)
class _End:
    """End of the steps, the information there, prior included, and the kernel of the last step."""

    at: _State
    information: np.ndarray
    kernel: KernelSettings


def _lead(problem: CameraLidarProblem, end: _End, other: _End) -> tuple[float, bool]:
    """Lead of the edges' score at one end over another, and whether it is significant over frames."""
    apart = np.zeros(problem.terms.frames)
    for kernel in (end.kernel, other.kernel):  # each was fitted at its own end
        here, there = (
            problem.terms.edge_score(e.at.alignment.alone, kernel)[0].astype(np.float64) for e in (end, other)
        )
        apart += 0.5 * kernel.edge_weight * (here - there)
    scatter = float(np.sqrt(np.sum((apart - apart.mean()) ** 2)))
    return float(apart.sum()), abs(float(apart.sum())) > _DECIDED_SIGMAS * scatter


def _solved(
    problem: CameraLidarProblem, at: _State, weights: KernelSettings, centre_sigma_px: float,
    rng: np.random.Generator,
) -> _End:  # fmt: skip
    """Gauss-Newton steps at each kernel."""
    terms, prior = problem.terms, problem.prior
    of_pose = [*[prior.rotation_sigma_rad] * 3, *[prior.translation_sigma_m] * 3]
    sigma = np.array([*of_pose, problem.config.time_offset_sigma_s, _FOCAL_REACH, *[centre_sigma_px] * 2])
    for sigma_px, contrast in _KERNELS:
        fitted = at.seen(terms).fitted(at.alignment.alone, KernelSettings.wide(sigma_px, contrast), rng)
        kernel = replace(
            fitted, edge_weight=weights.edge_weight, marking_weight=weights.marking_weight,
            wide_share=weights.wide_share,
        )  # fmt: skip
        for _ in range(_STEPS):
            gradient, information = _equations(terms, at, kernel)
            information = information + np.diag(1 / sigma**2)
            at = at.stepped(np.linalg.solve(information, gradient - at.off(prior) / sigma**2))
    return _End(at, information, kernel)


def _equations(
    terms: Terms, at: _State, kernel: KernelSettings
) -> tuple[Float[np.ndarray, " 10"], Float[np.ndarray, "10 10"]]:
    """Gradient and information of the score, in the coordinates of `AlignmentState.changed`."""
    seen, alone = at.seen(terms), at.alignment.alone
    gradient, information = np.zeros(_UNKNOWNS), np.zeros((_UNKNOWNS, _UNKNOWNS))
    for only, damping in (
        (replace(kernel, marking_weight=0.0), 1.0),
        (replace(kernel, edge_weight=0.0), _MARKING_DAMPING),
    ):
        by_frame, of_frame = seen.camera_gradient(alone, only)
        gradient += by_frame.sum(0)[:_UNKNOWNS]
        information += damping * of_frame.sum(0)[:_UNKNOWNS, :_UNKNOWNS]
    to_left = np.eye(_UNKNOWNS)
    to_left[:6, :6] = np.linalg.inv(change_jacobian(at.alignment.T_camera_lidar))
    return gradient @ to_left, to_left.T @ information @ to_left


def _off_by_sigmas(day: DayIntrinsics, known: CameraPrior) -> Float[np.ndarray, " 3"]:
    """Focal length and principal point (right, down) minus CameraInfo's, in combined sigmas of day and CameraInfo."""
    off = np.concatenate([[day.focal - 1], day.centre_px])
    sigma = np.concatenate([[day.focal_sigma], day.centre_sigma_px])
    return off / np.hypot(sigma, [known.focal_sigma, known.centre_sigma_px, known.centre_sigma_px])
