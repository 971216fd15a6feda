"""Hierarchical model of one edge of a model line, by empirical Bayes.

    o_i = A x_i + B b + noise_i            what vehicle i shows of its mount x_i, with information J_i
    x_i ~ N(m, S)                          a mount as the factory makes it
    x_i ~ N(0, S + D)                      a mount that a workshop set, relative to the drawing
    m ~ N(0, D),  b ~ N(0, P)              what all mounts of the line, and all its sensors, have in common

S = diag(scatter^2) is learnt by Fisher scoring of the restricted likelihood (Patterson and Thompson 1971), m and b
are solved with it. Vehicles far from their line have no weight. Where only records are there (A = B = I), data
determine m + b; what separates m from b is a second kind of observation: A and B then have further rows.

Days of a few frames determine few directions, mostly none along an axis. So all is computed from information, where
an undetermined direction is zero, and a vehicle is compared with its line by the score of a shift along one axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.fleet_model.evidence import LineEvidence, LinePrior, shifts_in_sigmas

__all__ = [
    "DOUBTED",
    "FEWEST_VEHICLES",
    "OUTSIDE",
    "LineEvidence",
    "LineModel",
    "LinePrior",
    "learn_line",
    "without_each",
]

# With fewer the scatter of mounts is known to a factor of two at best; three knocked ones may have met one kerb.
FEWEST_VEHICLES = 6
# Largest shift of a vehicle along an axis in sigmas: from the first on it loses weight, from the second on it has none.
# Of Gaussian vehicles 1.6 % and 4 in 100,000 lie beyond.
DOUBTED, OUTSIDE = 3.0, 4.5
_ROUNDS = 40
_CONVERGED = 1e-4  # of a scatter's own sigma
_NOTHING = 1e-3  # of the prior's variance as a sigma of a scatter's variance: less is rounding


@dataclass(frozen=True, eq=False)
class LineModel:
    """What a line has in common.

    Args:
        mean: common mount error, then shared errors.
        covariance: of `mean`; as wide along what data do not tell apart as the priors are.
        variance: of mounts by axis: S.
        variance_sigma: its uncertainty.
        prior: of the common parts.
        weight: by vehicle, 1 = one of the line, 0 = outside of it.
        distance: by vehicle, largest shift along an axis from the line in sigmas.
        axis: the axis of that shift.
    """

    mean: Float[np.ndarray, " G"]
    covariance: Float[np.ndarray, "G G"]
    variance: Float[np.ndarray, " M"]
    variance_sigma: Float[np.ndarray, " M"]
    prior: LinePrior
    weight: Float[np.ndarray, " N"]
    distance: Float[np.ndarray, " N"]
    axis: np.ndarray

    @property
    def learnt(self) -> Bool[np.ndarray, " M"]:
        """Axes whose scatter was learnt, because the days of enough vehicles determine them."""
        return self.variance_sigma > 0

    @property
    def safe_variance(self) -> Float[np.ndarray, " M"]:
        """Variance of mounts for the answers: estimate plus one sigma, so that a line of few vehicles counts less."""
        return self.variance + self.variance_sigma


@dataclass(frozen=True, eq=False)
class _Terms:
    """Sums of one round: inverse covariances W, weighted normal equations and residuals."""

    W: np.ndarray
    design: np.ndarray
    information: np.ndarray
    mean: np.ndarray
    residual: np.ndarray


def learn_line(
    evidence: LineEvidence, prior: LinePrior, at_least: Float[np.ndarray, " M"] | None = None
) -> LineModel:
    """What the vehicles of a line share.

    Args:
        evidence: of FEWEST_VEHICLES or more vehicles.
        prior: of what they have in common.
        at_least: variance of mounts that is certain to be there, as where days err less alike than `evidence` has it:
            what days do not err by, mounts scatter by.

    Raises:
        ValueError: fewer vehicles.
    """
    if len(evidence.value) < FEWEST_VEHICLES:
        raise ValueError(f"{len(evidence.value)} vehicles, a line needs {FEWEST_VEHICLES}")
    value, known = evidence.value, evidence.determined(prior)
    seen = known.sum(axis=0) >= FEWEST_VEHICLES
    most = np.diag(prior.mount)
    variance = np.where(seen, _start(evidence, prior, known), most)
    weight = _first_weights(evidence, prior, known, variance)
    for _ in range(_ROUNDS):
        terms = _solved(evidence, prior, value, variance, weight)
        distance, axis = _distances(evidence, terms, prior)
        weight = _weights(distance)
        score, information = _scatter_equations(evidence, terms, weight)
        sigma = np.sqrt(np.diag(_inverse(information, prior)))
        new = np.where(seen, _nonnegative_step(variance, score.sum(axis=0), information, seen), most)
        new = np.minimum(new, most)
        moved, variance = np.abs(new - variance), new
        if (moved <= _CONVERGED * sigma + 1e-18)[seen].all():
            break
    if at_least is not None:
        variance = np.where(seen, np.clip(at_least, variance, most), variance)
    terms = _solved(evidence, prior, value, variance, weight)
    distance, axis = _distances(evidence, terms, prior)
    sigma = np.sqrt(np.diag(_inverse(_scatter_equations(evidence, terms, weight)[1], prior)))
    return LineModel(
        terms.mean, np.linalg.inv(terms.information), variance, np.where(seen, np.minimum(sigma, most), 0.0),
        prior, _weights(distance), distance, axis,
    )  # fmt: skip


def _start(evidence: LineEvidence, prior: LinePrior, known: np.ndarray) -> Float[np.ndarray, " M"]:
    """Variance of mounts by what the middle half of all vehicles shows, axis by axis."""
    value, covariance = evidence.alone(prior)
    out = np.zeros(known.shape[1])
    for k, rows in enumerate(known.T):
        if rows.any():
            off = value[rows, k] - np.median(value[rows, k])
            own = np.median(covariance[rows, k, k])
            out[k] = max((1.4826 * np.median(np.abs(off))) ** 2 - own, 0.01 * own)
    return out


def _first_weights(
    evidence: LineEvidence, prior: LinePrior, known: np.ndarray, variance: np.ndarray
) -> Float[np.ndarray, " N"]:
    """Weights by the distance from the median, so that no far vehicle enters the first mean."""
    value, covariance = evidence.alone(prior)
    middle = np.array([np.median(value[rows, k]) if rows.any() else 0.0 for k, rows in enumerate(known.T)])
    spread = np.sqrt(np.einsum("nmm->nm", covariance) + variance)
    return _weights(np.where(known, np.abs(value - middle) / spread, 0.0).max(axis=1))


def _weights(distance: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    return np.asarray(np.clip((OUTSIDE - distance) / (OUTSIDE - DOUBTED), 0.0, 1.0))


def _mount_variance(
    variance: Float[np.ndarray, " M"], prior: LinePrior, remounted: Bool[np.ndarray, " N"]
) -> Float[np.ndarray, "N M M"]:
    """Covariance of each vehicle's mount; that of a remounted one has the prior's covariance of a whole line added."""
    return np.diag(variance) + remounted[:, None, None] * prior.mount


def _design_of(evidence: LineEvidence) -> Float[np.ndarray, "N O G"]:
    """Jacobian of observations by the line's mean mount and bias; 0 by the mount of a vehicle that was remounted."""
    N, M = len(evidence.value), evidence.to_mount.shape[1]
    both = np.concatenate([evidence.to_mount, evidence.to_bias], axis=1)
    design = np.broadcast_to(both, (N, *both.shape)).copy()
    design[evidence.remounted, :, :M] = 0.0
    return design


def _prior_information(prior: LinePrior) -> np.ndarray:
    M, P = len(prior.mount), len(prior.bias)
    out = np.zeros((M + P, M + P))
    out[:M, :M] = np.linalg.inv(prior.mount)
    if P:
        out[M:, M:] = np.linalg.inv(prior.bias)
    return out


def _solved(
    evidence: LineEvidence, prior: LinePrior, value: np.ndarray, variance: np.ndarray, weight: np.ndarray
) -> _Terms:
    A = evidence.to_mount
    W = evidence.weights(A @ _mount_variance(variance, prior, evidence.remounted) @ A.T)
    design = _design_of(evidence)
    WG = W @ design
    information = _prior_information(prior) + np.einsum("n,nog,noh->gh", weight, design, WG, optimize=True)
    mean = np.linalg.solve(information, np.einsum("n,nog,no->g", weight, WG, value, optimize=True))
    return _Terms(W, design, information, mean, value - design @ mean)


def _distances(evidence: LineEvidence, terms: _Terms, prior: LinePrior) -> tuple[np.ndarray, np.ndarray]:
    """By vehicle, the largest shift along an axis in sigmas, and the axis."""
    unit = np.sqrt(np.diag(prior.mount))
    z = np.abs(shifts_in_sigmas(terms.W, terms.residual, evidence.to_mount, unit))
    return z.max(axis=1), z.argmax(axis=1)


def _scatter_equations(
    evidence: LineEvidence, terms: _Terms, weight: np.ndarray
) -> tuple[Float[np.ndarray, "N M"], Float[np.ndarray, "M M"]]:
    """Score of the restricted likelihood in the variances, by vehicle, and Fisher's information."""
    A = evidence.to_mount
    WA = terms.W @ A
    AWA = A.T @ WA
    fit = np.linalg.inv(terms.information)
    GWA = terms.design.swapaxes(1, 2) @ WA
    explained = np.einsum("ngm,gh,nhm->nm", GWA, fit, GWA, optimize=True) * weight[:, None]
    square = np.einsum("no,nom->nm", terms.residual, WA) ** 2
    score = 0.5 * weight[:, None] * (square - np.einsum("nmm->nm", AWA) + explained)
    return score, 0.5 * np.einsum("n,nmk->mk", weight, AWA**2)


def _inverse(information: np.ndarray, prior: LinePrior) -> np.ndarray:
    """Inverse along the axes that have information, whatever their units; zero along the others.

    Rounding leaves some along axes that no vehicle determines, whose correlations with the others are random.
    """
    size = np.sqrt(np.diag(information))
    told = size * np.diag(prior.mount) > _NOTHING
    unit = np.where(told, 1 / np.where(told, size, 1.0), 0.0)
    return np.asarray(np.linalg.pinv(information * np.outer(unit, unit), rcond=1e-10) * np.outer(unit, unit))


def _nonnegative_step(
    variance: np.ndarray, score: np.ndarray, information: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """One step of Fisher scoring of variances; a variance of zero with a negative score stays zero."""
    free = ~((variance <= 0) & (score <= 0)) & (np.diag(information) > 0) & seen
    step = np.zeros(len(variance))
    if free.any():
        step[free] = np.linalg.lstsq(information[np.ix_(free, free)], score[free], rcond=1e-12)[0]
    return np.maximum(variance + step, 0.0)


def without_each(
    evidence: LineEvidence, model: LineModel
) -> tuple[Float[np.ndarray, "N G"], Float[np.ndarray, "N M"]]:
    """Change of mean and of variances if one vehicle is left out: the mean's exact, the variances' to first order."""
    terms = _solved(evidence, model.prior, evidence.value, model.variance, model.weight)
    w, G, W = model.weight, terms.design, terms.W
    own = np.einsum("n,nog,nop,nph->ngh", w, G, W, G, optimize=True)
    pull = np.einsum("n,nog,nop,np->ng", w, G, W, evidence.value, optimize=True)
    total = terms.information @ terms.mean
    mean = np.linalg.solve(terms.information - own, (total - pull)[..., None])[..., 0] - terms.mean
    score, information = _scatter_equations(evidence, terms, w)
    left = score.sum(axis=0) - score
    # Where the variance is not the likeliest but one that is certain to be there, only the vehicle's own part counts.
    step = (left - np.where(model.variance > 0, score.sum(axis=0), 0.0)) @ _inverse(information, model.prior)
    step = np.where((model.variance_sigma <= 0) | (model.variance <= 0) & (left <= 0), 0.0, step)
    return mean, np.maximum(step, -model.variance)
