"""The claim of a record: the error at targets 15 to 40 m away, with a probability.

Azimuth and elevation at the targets that both sensors see (`seen_targets.py`) are linear in the pose. So its
covariance gives their sigmas, with all correlations and all degrees of freedom that the day left to the
prior. A direction is certified if its error, by that sigma, is within the limit of `[verify]` with the
required probability.

Held-out frames can contradict a claim, but never make it stronger. They do not move the pose. Their curvature
once certified a direction that the fit called undetermined: a radar that repeats one scan all day was .55 deg
off at a sigma of 1.19 deg, and accepted. They are not better on good days either. The real car's forward
shift stays at the prior, because it moves points as the clock does; held-out frames call it determined,
because their update starts from independent errors of pose and clock. One of 27 azimuths of good days that
their bound certified exceeded it, at 99.5 %.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from pipeline.calibrate.verify.held_out_update import HeldOutUpdate
from pipeline.core.config import ChecksConfig
from pipeline.rig.targets import DEFAULT_TARGETS, target_jacobian, target_sigmas

__all__ = ["DIRECTIONS", "Claim", "claims_of", "target_jacobian", "target_sigmas"]

DIRECTIONS = ("azimuth", "elevation")
_CHECK_SIGMAS = 3.0


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
    mounting_sigma_rad: float = np.inf  # of the estimate as the pose of what is mounted: see `mounting.py`

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
    pair: str,
    T: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
    update: HeldOutUpdate | None,
    limit_rad: float,
    confidence: float,
    contradiction_sigmas: float = ChecksConfig().held_out_contradiction_sigmas,
    elevation_limit_rad: float | None = None,
    mounting: Float[np.ndarray, "6 6"] | None = None,
    targets: Float[np.ndarray, "N 3"] = DEFAULT_TARGETS,
) -> dict[str, Claim]:
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
            sigma,
            shift,
            shift_sigma,
            remaining,
            limits_rad[d],
            confidence,
            contradiction_sigmas,
            float(mounted[d]),
        )
    return claims
