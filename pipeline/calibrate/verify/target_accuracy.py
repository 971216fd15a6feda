"""The claim of a record: the error at targets 15 to 40 m away, with a probability.

Azimuth and elevation at the targets that both sensors see are linear in the pose. So its
covariance gives their sigmas, with all correlations and all degrees of freedom that the day left to the
prior. A direction is certified if its error, by that sigma, is within the limit of `[verify]` with the
required probability.

Held-out frames can contradict a claim, but never make it stronger. They do not move the pose. Their curvature
once certified a direction that the fit called undetermined: a radar that repeats one scan all day was .55 deg
off at a sigma of 1.19 deg, and accepted. They are not better on good days either. The real car's forward
shift stays at the prior, because it moves points as the clock does; held-out frames call it determined,
because their update starts from independent errors of pose and clock. One of 27 azimuths of good days that
their bound certified exceeded it, at 99.5 %.

Covariance of the mounting pose, from that of the projection, and the reverse.

To first order, a principal point wrong by d pixels has the effect of a camera rotated by d / f. No alignment
separates the two, and users of the same CameraInfo still get the right pixel. This also holds through
camera-radar, where both factors use the same camera, and in lidar-radar, whose boxes come from it. So a
certified direction in the image does not certify the mounting of the camera. The mounting is known only as
well as the principal point: as stated in fleet.toml (`centre_sigma_px`), else as measured by the day, else
not at all. Likewise, a radar's own constant elevation error rotates its detections, which a record describes,
but not its mounting.

Targets in view of both sensors of a pair, at which a pair is certified.

The effect of a pose error depends on the direction of a target. For a camera that looks to the left, a target
ahead of the lidar would turn its pitch into a roll: it would be certified at a target that it never sees. So
targets are placed where the views overlap at the prior. The view of a camera is its image by CameraInfo. The
view of a lidar or radar is the set of directions in which it has points or detections on the day, with holes
of the scene filled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from pipeline.calibrate.numerics.nuisances import RADAR_ELEVATION_BIAS_RAD
from pipeline.calibrate.reasons import because
from pipeline.calibrate.verify.held_out import HeldOutUpdate
from pipeline.core.config import ChecksConfig
from pipeline.core.rigs import CameraPrior
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Check, Prior, Solution
from pipeline.rig.overlap import FRAMES, View, view_of_camera, view_of_clouds
from pipeline.rig.se3 import from_spherical, hat, to_spherical, transform_points, wrap_angle
from pipeline.rig.targets import DEFAULT_TARGETS, target_jacobian, target_sigmas
from schemas.calibrations import FRAMES_OF_PAIR
from schemas.observations import Observation

__all__ = [
    "DIRECTIONS", "Claim", "camera_turn_sigma_rad", "claims_of", "mounting_covariance", "seen_targets",
    "target_jacobian", "target_sigmas", "targets_of", "unseen_failure", "views_of",
]  # fmt: skip

DIRECTIONS = ("azimuth", "elevation")
_CHECK_SIGMAS = 3.0
_BIN_RAD = np.radians(2.0)
_AZIMUTHS = np.radians(np.arange(-179.5, 180.0))
_ELEVATIONS = np.radians(np.array(sorted(range(-40, 41), key=abs), np.float64))  # the flattest first
_SPREAD, _, _RANGES_M = to_spherical(DEFAULT_TARGETS).T  # azimuths about the middle of what both see
_WIDE_RAD = np.radians(12.5)  # half-width from which they lie as far apart as that


@dataclass(frozen=True)
class Claim:
    """Error of one direction at the targets, root mean square over them."""

    sigma_rad: float  # of the estimate, from its covariance
    shift_rad: float  # by how much held-out frames would move it
    shift_sigma_rad: float  # of that shift, if both covariances are right
    remaining_sigma_rad: float  # of the estimate if held-out frames were to update it: for diagnostics
    limit_rad: float  # largest error that the purpose allows
    confidence: float  # probability with which the error must stay within the limit
    contradiction_sigmas: float = ChecksConfig().held_out_contradiction_sigmas
    mounting_sigma_rad: float = (
        np.inf
    )  # of the estimate as the pose of what is mounted: see `mounting_covariance`

    @property
    def bound_rad(self) -> float:
        """Bound of the error with the required probability, by the estimate's own sigma.

        A shift by which held-out frames contradict the estimate counts as error.
        """
        return self._bound_rad(self.sigma_rad)

    @property
    def margin(self) -> float:
        """1 = far inside the limit, 0 = at it, negative = not certified."""
        return 1 - self.bound_rad / self.limit_rad

    @property
    def certifies_mounting(self) -> bool:
        """The mounting's own error is within the limit as well."""
        sigma = self.mounting_sigma_rad
        return bool(np.isfinite(sigma) and self._bound_rad(sigma) <= self.limit_rad)

    @property
    def reason(self) -> str:
        """Why the direction is not certified, if its margin is negative."""
        off, sigma, limit = np.degrees([self.shift_rad, self.sigma_rad, self.limit_rad])
        reason = because("too large", sigma=sigma, limit=limit, percent=100 * self.confidence)
        return because("exceeded", off=off, reason=reason) if self.is_exceeded else reason

    def _bound_rad(self, sigma_rad: float) -> float:
        shift = self.shift_rad if self.is_contradicted else 0.0
        return _quantile(shift, sigma_rad, self.confidence)

    @property
    def is_contradicted(self) -> bool:
        """Held-out frames would move the estimate by more sigmas of that move than chance does."""
        return bool(0 < self.contradiction_sigmas * self.shift_sigma_rad < self.shift_rad)

    @property
    def is_exceeded(self) -> bool:
        """They contradict it, and would move it by more than its sigma."""
        return bool(self.is_contradicted and self.shift_rad > self.sigma_rad)

    def is_exceeded_by(self, error_rad: float, known_to_rad: float | None = None) -> bool:
        """Whether an error that a check shows is not within the limit with the required probability.

        Args:
            error_rad: the error if the check is right.
            known_to_rad: its sigma. None where the check fails from three sigmas on: it is a third, at most, and
                an error below the claim's own sigma is in the claim already.
        """
        if known_to_rad is None:
            if error_rad <= self.sigma_rad:
                return False
            known_to_rad = error_rad / _CHECK_SIGMAS
        sigma_rad = float(np.hypot(self.sigma_rad, known_to_rad))
        return bool(_quantile(error_rad, sigma_rad, self.confidence) > self.limit_rad)

    @property
    def agrees_with_held_out(self) -> bool:
        """By held-out frames alone the error is within the limit with the required probability.

        Their share of an update is that of its variance; what they find alone is the shift without the rest.
        """
        share = min(self.shift_sigma_rad / self.sigma_rad, 1.0) ** 2 if self.sigma_rad > 0 else 0.0
        if share == 0:
            return False
        own_rad = self.sigma_rad * float(np.sqrt((1 - share) / share))
        return bool(_quantile(self.shift_rad / share, own_rad, self.confidence) <= self.limit_rad)

    @property
    def without_sigma(self) -> Claim:
        """The limit alone."""
        return replace(self, sigma_rad=0.0)


def _quantile(shift: float, sigma: float, probability: float) -> float:
    """Quantile of |x| for a normal x of mean `shift` and standard deviation `sigma`."""
    if sigma == 0:
        return shift
    m, tail = shift / sigma, 1 - probability
    # Between one tail (all of it on the side of the shift) and two (no shift at all).
    low, high = m + float(ndtri(1 - tail)), m + float(ndtri(1 - tail / 2))
    return sigma * float(brentq(lambda x: ndtr(m - x) + ndtr(-m - x) - tail, low - 1e-9, high + 1e-9))


def claims_of(
    pair: str, T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"],
    update: HeldOutUpdate | None, limit_rad: float, confidence: float,
    contradiction_sigmas: float = ChecksConfig().held_out_contradiction_sigmas,
    elevation_limit_rad: float | None = None, mounting: Float[np.ndarray, "6 6"] | None = None,
    targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS,
) -> dict[str, Claim]:  # fmt: skip
    """Claim for each direction, by name.

    Args:
        pair: name of the pair.
        T: the estimate.
        covariance: covariance of its left perturbation.
        update: update of the estimate by held-out frames; None if they do not determine one.
        limit_rad: largest error that the purpose allows.
        confidence: probability with which an error has to stay within it.
        contradiction_sigmas: sigmas of the shift from which held-out frames contradict the estimate.
        elevation_limit_rad: limit for elevation, if it differs from that for azimuth.
        mounting: covariance of the estimate as a mounting pose; None if unknown.
        targets: targets in view of both sensors, in the child's frame.
    """
    limits_rad = (limit_rad, limit_rad if elevation_limit_rad is None else elevation_limit_rad)
    own = target_sigmas(pair, T, covariance, targets)
    mounted = np.full(2, np.inf) if mounting is None else target_sigmas(pair, T, mounting, targets)
    claims = {}
    for d, name in enumerate(DIRECTIONS):
        sigma = float(own[d])
        if update is None:
            shift, shift_sigma, remaining = 0.0, 0.0, sigma
        else:
            J = target_jacobian(pair, T, targets)[d]
            shift_sigma, updated, bias = (
                float(np.sqrt(np.einsum("ni,ij,nj->n", J, C, J).mean()))
                for C in (update.shift_covariance, update.covariance, update.bias)
            )
            # Held-out frames share the method's bias: no sigma becomes smaller than their common bias.
            remaining = min(sigma, max(updated, bias))
            shift = float(np.sqrt(np.mean((J @ update.shift) ** 2)))
        claims[name] = Claim(
            sigma, shift, shift_sigma, remaining, limits_rad[d], confidence, contradiction_sigmas,
            float(mounted[d]),
        )  # fmt: skip
    return claims


def camera_turn_sigma_rad(
    solution: Solution, known: CameraPrior, K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, " 2"] | None:
    """Sigmas of the camera's pitch and yaw (about its x and y) due to the principal point.

    As measured on the day, else as stated in fleet.toml, else None.
    """
    camera_lidar = solution.pairs.get("camera_lidar")
    measured = {} if camera_lidar is None else camera_lidar.diagnostics
    names = ("mounting_pitch_sigma_rad", "mounting_yaw_sigma_rad")
    if all(name in measured for name in names):
        return np.array([measured[name] for name in names])
    return known.centre_sigma_px / np.diag(K)[[1, 0]] if known.centre_is_stated else None


def mounting_covariance(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    turn_sigma_rad: Float[np.ndarray, " 2"] | None,
) -> Float[np.ndarray, "6 6"] | None:
    """Covariance of an estimate as a mounting pose; None if the camera's principal point is unknown.

    `covariance` is for users of the same CameraInfo and of the radar's detections; `turn_sigma_rad` is the
    camera's.
    """
    wider = np.array(covariance, np.float64)
    if pair.startswith("camera"):
        if turn_sigma_rad is None:
            return None
        wider[[0, 1], [0, 1]] += turn_sigma_rad**2
    if pair.endswith("radar"):
        # A turn about the radar's own y, as a twist about the parent's origin.
        axis = T[:3, 1]
        twist = RADAR_ELEVATION_BIAS_RAD * np.concatenate([axis, hat(T[:3, 3]) @ axis])
        wider += np.outer(twist, twist)
    return wider


def views_of(observations: Sequence[Observation]) -> dict[str, View]:
    """View of each sensor, for points in its own frame; a sensor without data is left out."""
    some = observations[:: max(len(observations) // FRAMES, 1)]
    clouds = {
        "lidar": [o.lidar_map_xyz_m for o in some if "lidar" in o.sensors],
        "radar": [o.radar_xyz_m for o in some if "radar" in o.sensors],
    }
    views = {sensor: view_of_clouds(own) for sensor, own in clouds.items()}
    camera = next((camera_of(o) for o in some if "camera" in o.sensors), None)
    views["camera"] = None if camera is None else view_of_camera(camera)
    return {sensor: view for sensor, view in views.items() if view is not None}


def seen_targets(pair: str, prior: Prior, views: dict[str, View]) -> Float[np.ndarray, "3 3"] | None:
    """Targets of a pair of camera, lidar and radar; a sensor without a view is taken to see everything."""
    parent, child = FRAMES_OF_PAIR[pair]
    return targets_of(prior.of(pair), views.get(parent), views.get(child))


def targets_of(
    T_parent_child: Float[np.ndarray, "4 4"], parent: View | None, child: View | None
) -> Float[np.ndarray, "3 3"] | None:
    """Three targets 15, 25 and 40 m away, in the child's frame; None if the views do not overlap.

    They surround the middle of the common view, as level as the views allow. Their spacing is that of sensors
    that look ahead, or less in narrow views. A view None sees everything.
    """
    # Near and far: a sensor a metre aside sees them two to four degrees apart.
    ranges_m = [_RANGES_M.min(), _RANGES_M.max()]
    points = from_spherical(np.stack(np.meshgrid(_AZIMUTHS, _ELEVATIONS, ranges_m, indexing="ij"), -1))
    seen = np.ones(points.shape[:2], bool)
    for view, T in ((child, np.eye(4)), (parent, T_parent_child)):
        if view is not None:
            seen &= view(transform_points(T, points)).all(axis=2)
    columns = np.flatnonzero(seen.any(axis=1))
    if not len(columns):
        return None
    azimuth = _AZIMUTHS[columns]
    # Of a sensor that sees all around, ahead is as good as any.
    around = len(columns) == len(_AZIMUTHS)
    middle = 0.0 if around else float(np.angle(np.exp(1j * azimuth).mean()))
    apart = np.abs(wrap_angle(azimuth - middle))
    narrow = min(1.0, float(np.quantile(apart, 0.9)) / _WIDE_RAD)
    targets = []
    for offset, range_m in zip(_SPREAD * narrow, _RANGES_M, strict=True):
        away = wrap_angle(azimuth - (middle + offset))
        k = int(np.argmin(np.abs(away)))
        # Where both see it, a target is where it should be and not on the grid.
        target = middle + offset if abs(away[k]) <= _BIN_RAD else azimuth[k]
        targets.append([target, _ELEVATIONS[int(np.argmax(seen[columns[k]]))], range_m])
    return from_spherical(np.array(targets))


def unseen_failure(pair: str) -> Check:
    """Reason why a pair without overlapping views cannot be accepted."""
    parent, child = FRAMES_OF_PAIR[pair]
    return Check(because("no view", parent=parent, child=child))
