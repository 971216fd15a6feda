"""What a record may claim: how far off targets 15 to 40 m away can be, and how sure that is.

An error of the pose matters by where it puts things. Azimuth and elevation at the targets of
`pipeline.geometry.targets` are linear in the pose, so its covariance gives their sigmas, with every
correlation and every unknown that the day left to the prior. A direction is vouched for where, by all evidence, its
error stays within what the purpose bears
with the probability asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from pipeline.calibrate.verify.held_out_update import SecondOpinion
from pipeline.geometry.se3 import exp_se3, transform_points
from pipeline.geometry.spherical import camera_direction_angles, to_spherical, wrap_angle
from pipeline.geometry.targets import DEFAULT_TARGETS

__all__ = ["DIRECTIONS", "Claim", "claims_of", "target_jacobian", "target_sigmas"]

DIRECTIONS = ("azimuth", "elevation")
_STEP = 1e-5  # rad and m


@dataclass(frozen=True)
class Claim:
    """One direction at the targets, root mean square over them [rad]."""

    sigma: float  # of the estimate, from its covariance
    shift: float  # by how much held-out frames would move it
    shift_sigma: float  # of that shift, if estimate and held-out frames are as good as they say
    remaining: float  # sigma left with both
    limit: float  # what the purpose bears
    confidence: float  # probability that it has to have

    @property
    def reach(self) -> float:
        """The error is smaller than this with the probability asked for [rad].

        By the estimate's own sigma, where held-out frames do not contradict it, or by both together, shift and all:
        whichever says more.
        """
        own = _quantile(0.0, self.sigma, self.confidence) if self.agreement >= 0 else np.inf
        return min(own, _quantile(self.shift, self.remaining, self.confidence))

    @property
    def margin(self) -> float:
        """1 = far inside the limit, 0 = at it, negative = not vouched for."""
        return 1 - self.reach / self.limit

    @property
    def agreement(self) -> float:
        """1 = held-out frames agree, 0 = they would move the estimate by three of that shift's sigmas."""
        return 1 - self.shift / (3 * self.shift_sigma) if self.shift_sigma > 0 else 1.0


def _quantile(shift: float, sigma: float, probability: float) -> float:
    """Of the absolute value of a normal deviate about `shift`."""
    if sigma == 0:
        return shift
    m, tail = shift / sigma, 1 - probability
    # Between one tail (all of the doubt lies on the side that the shift shows) and two (no shift at all).
    low, high = m + float(ndtri(1 - tail)), m + float(ndtri(1 - tail / 2))
    return sigma * float(brentq(lambda x: ndtr(m - x) + ndtr(-m - x) - tail, low - 1e-9, high + 1e-9))


def target_jacobian(
    pair: str, T: Float[np.ndarray, "4 4"], targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS
) -> Float[np.ndarray, "2 N 6"]:
    """d(azimuth, elevation of each target) / d(left perturbation of T) [rad per rad and m]."""
    angles = to_spherical if pair == "lidar_radar" else camera_direction_angles
    points = transform_points(T, targets)
    columns = []
    for axis in np.eye(6):
        ahead, behind = (angles(transform_points(exp_se3(sign * _STEP * axis), points)) for sign in (1, -1))
        columns.append(wrap_angle(ahead[:, :2] - behind[:, :2]) / (2 * _STEP))
    return np.stack(columns, -1).transpose(1, 0, 2)


def target_sigmas(
    pair: str, T: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, " 2"]:
    """One sigma of azimuth and elevation [rad] at the targets, root mean square over them."""
    J = target_jacobian(pair, T)
    return np.sqrt(np.einsum("dni,ij,dnj->dn", J, covariance, J).mean(axis=1))


def claims_of(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    opinion: SecondOpinion | None,
    limit_rad: float,
    confidence: float,
) -> dict[str, Claim]:
    """What can be claimed of each direction.

    Args:
        pair: which one.
        T: the estimate.
        covariance: of its left perturbation.
        opinion: what held-out frames say of it; None where they say nothing.
        limit_rad: what the purpose bears.
        confidence: probability with which an error has to stay within it.
    """
    own = target_sigmas(pair, T, covariance)
    claims = {}
    for d, name in enumerate(DIRECTIONS):
        if opinion is None:
            claims[name] = Claim(float(own[d]), 0.0, 0.0, float(own[d]), limit_rad, confidence)
            continue
        J = target_jacobian(pair, T)[d]
        moved, remaining, bias = (
            float(np.sqrt(np.einsum("ni,ij,nj->n", J, C, J).mean()))
            for C in (opinion.shift_covariance, opinion.covariance, opinion.bias)
        )
        # Held-out frames have the method's own blind spots: they make nothing surer than their bias lets them.
        remaining = min(float(own[d]), max(remaining, bias))
        shift = float(np.sqrt(np.mean((J @ opinion.shift) ** 2)))
        claims[name] = Claim(float(own[d]), shift, moved, remaining, limit_rad, confidence)
    return claims
