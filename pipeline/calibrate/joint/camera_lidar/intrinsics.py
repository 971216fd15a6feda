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
The principal point needs markings, because they reach the image's lower corners.

A contradiction of CameraInfo must pass two more tests before it holds a record. The first and the second half
of the frames must each show it separately. If a smaller weight of the markings moves the principal point, its
sigma is at least this change. Before, five of 64 days with a right CameraInfo were contradicted: highways
whose halves ended at different ends of the valley, and dusk, when markings alone moved the principal point up
by 40 px.

Source: Triggs et al. 2000, section 4 (Gauss-Newton with robust weights); the sigmas are measured, see their
constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.camera_lidar.observability import CameraLidarProblem
from pipeline.calibrate.joint.camera_lidar.refine import AlignmentState
from pipeline.calibrate.numerics.nuisances import (
    DAY_CENTRE_SIGMAS,
    DAY_FOCAL_FLOOR,
    DAY_FOCAL_SIGMAS,
    INTRINSICS_CONTRADICTION_SIGMAS,
    INTRINSICS_HALF_SIGMAS,
)
from pipeline.calibrate.reasons import because
from pipeline.core.rigs import CameraPrior
from pipeline.objective.camera_lidar.score import KernelSettings, Terms
from pipeline.rig.estimates import Check, Prior
from pipeline.rig.se3 import change_between, change_jacobian

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
# A turn by d/f stands in for a principal point d off on the axis, and leaves sin^2 of the angle to it: here, of targets
# 16 deg to the side. Measured on a day of f = 600 px with 20 px (1.9 deg): .10 at 15 deg, .06 to .08 of 20 px down.
_LEFT_OF_TURN = 0.076
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
        yaw_rad, pitch_rad = self._turn_sigma_rad(known)
        return {
            "day_focal_scale": self.focal,
            "day_focal_sigma": self.focal_sigma,
            "day_focal_observable": float(self.focal_sigma <= known.focal_sigma),
            **{f"day_centre_{n}_px": float(v) for n, v in zip("uv", self.centre_px, strict=True)},
            **{f"day_centre_{n}_sigma_px": float(v) for n, v in zip("uv", self.centre_sigma_px, strict=True)},
            **{
                f"day_centre_{n}_observable": float(v <= known.centre_sigma_px)
                for n, v in zip("uv", self.centre_sigma_px, strict=True)
            },
            "mounting_yaw_sigma_rad": yaw_rad,
            "mounting_pitch_sigma_rad": pitch_rad,
        }

    def notes(self, known: CameraPrior) -> list[str]:
        """Text of the assumption, and the smallest error of it that the day would have detected."""
        yaw, pitch = np.degrees(self._turn_sigma_rad(known))
        source = because("centre stated" if known.centre_is_stated else "centre by day")
        right, down = (
            f"{px:+.0f} +- {sigma:.0f}"
            for px, sigma in zip(self.centre_px, self.centre_sigma_px, strict=True)
        )
        scale = {"focal": self.focal - 1, "sigma": self.focal_sigma}
        return [
            because("in the image", yaw=yaw, pitch=pitch, source=source),
            because("off CameraInfo", **scale, right=right, down=down),
            # By a profile like the time offset's it errs by tens of ms: study `intrinsics.py`.
            because("readout", ms=1e3 * known.readout_s),
        ]

    def _turn_sigma_rad(self, known: CameraPrior) -> tuple[float, float]:
        """Sigma of the camera's yaw and pitch, if the principal point is known; a default value does not count."""
        stated_px = known.centre_sigma_px if known.centre_is_stated else np.inf
        yaw, pitch = _together(self.centre_sigma_px, stated_px) / np.array(self.focal_px)
        return float(yaw), float(pitch)


def contradictions(day: DayIntrinsics, known: CameraPrior) -> list[Check]:
    """One failed check for each intrinsic of CameraInfo that the day, and each half of it separately, contradicts."""
    off = _off_by_sigmas(day, known)
    is_wrong = np.abs(off) > INTRINSICS_CONTRADICTION_SIGMAS
    for half in day.halves:
        is_wrong &= np.sign(off) * _off_by_sigmas(half, known) > INTRINSICS_HALF_SIGMAS
    found = []
    if is_wrong[0]:
        why = because("focal length", off=day.focal - 1, sigma=day.focal_sigma)
        found.append(Check(why, "camera_info"))
    if is_wrong[1:].any():
        right, down = (
            f"{px:+.1f} +- {sigma:.1f}" for px, sigma in zip(day.centre_px, day.centre_sigma_px, strict=True)
        )
        left_rad = [
            float(abs(d) / f * _LEFT_OF_TURN) for d, f in zip(day.centre_px, day.focal_px, strict=True)
        ]
        found.append(
            Check(
                because("principal point", right=right, down=down),
                "camera_info",
                error=(left_rad[1], left_rad[0], 0.0, 0.0, 0.0, 0.0),
            )
        )
    return found


def measure_intrinsics(
    problem: CameraLidarProblem,
    state: AlignmentState,
    kernel: KernelSettings,
    label_scale: float,
    rng: np.random.Generator,
) -> DayIntrinsics:
    """Solve for pose, time offset, focal length and principal point together, from an aligned pose.

    Args:
        kernel: kernel with the weights of edges and markings.
        label_scale: label pixels per image pixel.
    """
    day = _measured(problem, state, kernel, label_scale, rng)
    if not contradictions(day, problem.prior.camera):
        return day
    edges_decide = replace(kernel, marking_weight=_LESS_MARKING * kernel.marking_weight)
    moved = _measured(problem, state, edges_decide, label_scale, rng).centre_px - day.centre_px
    # By time: neighbouring frames see the same scene, and share what it does to the valley.
    by_time = np.array_split(np.arange(problem.terms.frames), 2)
    halves = tuple(
        _measured(replace(problem, terms=problem.terms.of_frames(f)), state, kernel, label_scale, rng)
        for f in by_time
    )
    return replace(day, centre_sigma_px=np.hypot(day.centre_sigma_px, moved), halves=halves)


def _measured(
    problem: CameraLidarProblem,
    state: AlignmentState,
    kernel: KernelSettings,
    label_scale: float,
    rng: np.random.Generator,
) -> DayIntrinsics:
    """The measurement from the problem's frames; arguments as of `measure_intrinsics`."""
    some = replace(problem, terms=problem.terms.at_most(_POINTS, rng))
    expected, aligned = (
        _focal_end(some, start, kernel, rng) for start in (AlignmentState(state.T_camera_lidar), state)
    )
    lead, is_decided = _lead(some, aligned, expected)
    best, other = (aligned, expected) if lead > 0 else (expected, aligned)
    focal, dt_s = best.at.alignment.focal, best.at.alignment.dt_s
    apart = 0.0 if is_decided else focal - other.at.alignment.focal
    reach_px = _CENTRE_REACH * problem.terms.maps.camera.width_px
    # From the aligned pose again: the edges of 16 rings do not determine pitch.
    begin = _State(AlignmentState(state.T_camera_lidar, dt_s, focal), np.zeros(2))
    end = _solved(some, begin, kernel, reach_px, rng)
    centre_sigma = DAY_CENTRE_SIGMAS * np.sqrt(np.diag(np.linalg.inv(end.information))[_CENTRE])
    formal = float(np.linalg.inv(best.information)[_FOCAL, _FOCAL])
    fx, fy = problem.terms.maps.camera.focal_px
    return DayIntrinsics(
        focal,
        float(np.sqrt(DAY_FOCAL_SIGMAS**2 * formal + DAY_FOCAL_FLOOR**2 + apart**2 / 4)),
        end.at.centre_px / label_scale,
        centre_sigma / label_scale,
        (fx / label_scale, fy / label_scale),
    )


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


def _focal_end(
    problem: CameraLidarProblem, start: AlignmentState, weights: KernelSettings, rng: np.random.Generator
) -> _End:
    """The end by edges alone, with the principal point fixed."""
    only_edges = replace(weights, marking_weight=0.0)
    return _solved(problem, _State(start, np.zeros(2)), only_edges, _HELD_PX, rng)


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
    problem: CameraLidarProblem,
    at: _State,
    weights: KernelSettings,
    centre_sigma_px: float,
    rng: np.random.Generator,
) -> _End:
    """Gauss-Newton steps at each kernel."""
    terms, prior = problem.terms, problem.prior
    sigma = np.array(
        [prior.rotation_sigma_rad] * 3
        + [prior.translation_sigma_m] * 3
        + [problem.config.time_offset_sigma_s, _FOCAL_REACH]
        + [centre_sigma_px] * 2
    )
    for sigma_px, contrast in _KERNELS:
        fitted = at.seen(terms).fitted(at.alignment.alone, KernelSettings.wide(sigma_px, contrast), rng)
        kernel = replace(
            fitted,
            edge_weight=weights.edge_weight,
            marking_weight=weights.marking_weight,
            wide_share=weights.wide_share,
        )
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


def _together(day_px: Float[np.ndarray, " 2"], stated_px: float) -> Float[np.ndarray, " 2"]:
    """Sigma of the principal point from the stated value (infinite: none) and the day together."""
    return day_px / np.hypot(1.0, day_px / stated_px) if stated_px else np.zeros(2)
