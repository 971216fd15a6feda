"""Estimates of one edge by all vehicles of a line, as information without prior; each night adds to it.

Days of a few frames determine few directions, mostly none along an axis. So evidence is information, which is zero
along directions that days leave open, and a vehicle is compared with others by the score of a shift along one axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["LineEvidence", "LinePrior", "OwnPriors", "evidence_of_days", "shifts_in_sigmas", "with_witness"]

_DETERMINED = 0.5  # of the prior's variance: an axis that a vehicle's days leave at less
_SHOWN = 0.05  # of the prior's information along an axis: with less a vehicle shows nothing of it
_NOTHING = 1e-9  # of the prior's information: a direction with less is open


@dataclass(frozen=True, eq=False)
class LineEvidence:
    """Observations of N vehicles.

    Args:
        value: changes from the line's drawing (rotation vector [rad], shift [m]), then further observations; of what
            a vehicle does not determine any number.
        information: of what varies, without what all vehicles have in common and without a prior; zero along
            directions that a vehicle does not determine.
        to_mount: A, from a mount to what is observed of it.
        to_bias: B, from shared errors to what is observed.
        remounted: a workshop set the mount, not the factory.
    """

    value: Float[np.ndarray, "N O"]
    information: Float[np.ndarray, "N O O"]
    to_mount: Float[np.ndarray, "O M"]
    to_bias: Float[np.ndarray, "O P"]
    remounted: Bool[np.ndarray, " N"]

    def at(self, rows: np.ndarray) -> LineEvidence:
        """The evidence of a selection of the vehicles."""
        return replace(
            self, value=self.value[rows], information=self.information[rows], remounted=self.remounted[rows]
        )

    def weights(self, spread: Float[np.ndarray, "*N O O"]) -> Float[np.ndarray, "N O O"]:
        """Inverse covariances of observations whose expected value scatters by `spread` besides."""
        return np.linalg.solve(np.eye(self.value.shape[1]) + self.information @ spread, self.information)

    def alone(
        self, prior: LinePrior, own: OwnPriors | None = None
    ) -> tuple[Float[np.ndarray, "N M"], Float[np.ndarray, "N M M"]]:
        """Each vehicle's mount by its own estimates and its prior, and what it varies by.

        The first M observations are its estimates. `own`: each vehicle's prior; None = all have the line's.
        """
        M = len(prior.mount)
        own_information = self.information[:, :M, :M]
        before = np.linalg.inv(prior.mount if own is None else own.covariance)
        covariance = np.linalg.inv(own_information + before)
        pull = np.einsum("nkj,nj->nk", own_information, self.value[:, :M])
        if own is not None:
            pull = pull + np.einsum("nkj,nj->nk", before, own.change)
        return np.einsum("nmk,nk->nm", covariance, pull), covariance

    def determined(self, prior: LinePrior) -> Bool[np.ndarray, "N M"]:
        """Axes along which a vehicle's estimates are more accurate than the drawing."""
        _, covariance = self.alone(prior)
        return np.asarray(np.einsum("nmm->nm", covariance) < _DETERMINED * np.diag(prior.mount))


@dataclass(frozen=True, eq=False)
class LinePrior:
    """Covariance of the common error of all mounts (about the drawing) and of the shared errors of sensors.

    `stated`: of the shared errors by the records, if data show them to be larger; None = `bias`.
    """

    mount: Float[np.ndarray, "M M"]
    bias: Float[np.ndarray, "P P"]
    stated: Float[np.ndarray, "P P"] | None = None


@dataclass(frozen=True, eq=False)
class OwnPriors:
    """Priors of N vehicles: change from the line's drawing, and covariance of it."""

    change: Float[np.ndarray, "N M"]
    covariance: Float[np.ndarray, "N M M"]


def evidence_of_days(
    information: Float[np.ndarray, "N M M"],
    pull: Float[np.ndarray, "N M"],
    days: Float[np.ndarray, " N"],
    scale: Float[np.ndarray, "N M"],
    autocorrelation: Float[np.ndarray, "N M"],
    prior: LinePrior,
) -> LineEvidence:
    """Evidence of vehicles whose mounts the factory set, from sums over their days.

    Days scatter by more than they say, and err alike: information shrinks by both, direction by direction, so that
    what days leave open stays open.

    Args:
        information: sum over days, of changes from the line's drawing.
        pull: sum over days of information times change.
        days: number of them.
        scale: factor on the days' sigmas, by axis.
        autocorrelation: of the errors of neighbouring days, by axis.
        prior: of the line; its sigmas are the units.
    """
    unit = np.sqrt(np.diag(prior.mount))
    size, directions = np.linalg.eigh(information * np.outer(unit, unit))
    open_ = size < _NOTHING
    inverse = np.where(open_, 0.0, 1 / np.where(open_, 1.0, size))
    value = np.einsum("nmk,nk,njk,nj->nm", directions, inverse, directions, pull * unit, optimize=True) * unit
    variance = scale**2 * _mean_of(days[:, None], autocorrelation)
    along = np.einsum("nmk,nm->nk", directions**2, variance, optimize=True)
    left = np.where(open_, 0.0, size) / along
    whole = np.einsum("nmk,nk,njk->nmj", directions, left, directions, optimize=True) / np.outer(unit, unit)
    M = len(unit)
    return LineEvidence(value, whole, np.eye(M), np.eye(M), np.zeros(len(days), bool))


def with_witness(
    evidence: LineEvidence,
    axis: Float[np.ndarray, " M"],
    value: Float[np.ndarray, " N"],
    information: Float[np.ndarray, " N"],
    *,
    of_its_own: bool,
) -> LineEvidence:
    """Evidence with one more observation of each vehicle's mount, without the shared errors of sensors.

    Args:
        evidence: so far.
        axis: direction of a change along which the mount is observed.
        value: change along it [rad].
        information: inverse variance; zero for vehicles without the observation.
        of_its_own: all observations of this kind have an error in common, another than the sensors': a further shared
            error, the last one, as a radar that reports its mount in the vehicle does not know the lidar's.
    """
    N, O = evidence.value.shape
    P = evidence.to_bias.shape[1]
    whole = np.zeros((N, O + 1, O + 1))
    whole[:, :O, :O], whole[:, O, O] = evidence.information, information
    to_bias = np.zeros((O + 1, P + of_its_own))
    to_bias[:O, :P] = evidence.to_bias
    to_bias[O, P:] = 1.0
    return replace(
        evidence,
        value=np.column_stack([evidence.value, np.where(information > 0, value, 0.0)]),
        information=whole,
        to_mount=np.vstack([evidence.to_mount, axis]),
        to_bias=to_bias,
    )


def _mean_of(days: Float[np.ndarray, "N 1"], phi: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M"]:
    """Variance of the mean of AR(1) errors, divided by that of independent errors."""
    n = np.maximum(days, 1.0)
    return np.asarray((1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2))


def shifts_in_sigmas(
    W: Float[np.ndarray, "N O O"],
    residual: Float[np.ndarray, "N O"],
    A: Float[np.ndarray, "O M"],
    unit: Float[np.ndarray, "*N M"],
) -> Float[np.ndarray, "N M"]:
    """Score of a shift of each vehicle's mount along each axis alone, in sigmas; zero where it shows nothing.

    Args:
        W: inverse covariances of what is observed.
        residual: of what is observed.
        A: from a mount to what is observed.
        unit: sigmas of the prior, against which information along an axis counts or does not. Rounding leaks a
            thousandth of a millionth of one axis into another, where a score divided by its sigma would be as large.
    """
    score = np.einsum("om,nop,np->nm", A, W, residual, optimize=True)
    size = np.einsum("om,nop,pm->nm", A, W, A, optimize=True)
    shown = size * unit**2 > _SHOWN
    return np.where(shown, score / np.sqrt(np.where(shown, size, 1.0)), 0.0)
