"""Mount of each vehicle, estimated from its own days with the other vehicles of its production line as prior.

The effect of the line is limited: it moves no axis by more than one sigma of the vehicle's own days (limited
translation, Efron and Morris 1971, JASA 66), and what it is kept from moving widens the sigma. A vehicle outside of its
line answers as it does alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from pipeline.fleet_model.apart import told_apart
from pipeline.fleet_model.evidence import LineEvidence, LinePrior, OwnPriors, shifts_in_sigmas
from pipeline.fleet_model.line import DOUBTED, OUTSIDE, LineModel, without_each

__all__ = ["DIFFERS_SIGMAS", "Answers", "largest_change_without_one", "with_line"]

_MOST_SIGMAS = 1.0  # that the line moves an axis by
# A vehicle differs from its line from here on, in its largest of six axes: one in 1,000 does by chance.
DIFFERS_SIGMAS = float(ndtri(1 - 1e-3 / 12))
# Sigmas from the line; one further on, the line's part of the answer counts as unsure.
_DOUBTED = 2.0
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers of N vehicles with their line.

    Args:
        change: of the mount from the line's drawing.
        covariance: of it, common errors included.
        shared: answers that the line has a part in; the others are those of the vehicle alone.
        distance: largest shift along an axis from the line, in sigmas.
        axis: the axis of it.
    """

    change: Float[np.ndarray, "N M"]
    covariance: Float[np.ndarray, "N M M"]
    shared: Bool[np.ndarray, " N"]
    distance: Float[np.ndarray, " N"]
    axis: np.ndarray


def with_line(
    model: LineModel,
    evidence: LineEvidence,
    common: Float[np.ndarray, "N M M"],
    own: OwnPriors | None = None,
) -> Answers:
    """Each vehicle's mount, with the other vehicles of its model line as prior.

    Args:
        model: of the line.
        evidence: of the vehicles; the first M observations are their own estimates, A and B are identities there.
        common: covariance of what all days of each vehicle have in common, by its records.
        own: prior of each vehicle; None = all have the line's. It decides along axes that the days of too few vehicles
            determine.
    """
    mean, covariance = told_apart(model)
    M, B, own_mean = len(model.variance), evidence.to_bias, ~evidence.remounted[:, None]
    expected = np.where(own_mean, mean[:M], 0.0)
    residual = evidence.value - expected @ evidence.to_mount.T - B @ mean[M:]
    distance, axis = _distances(model, evidence, residual, covariance)
    open_variance = np.diag(model.prior.mount) if own is None else np.einsum("nmm->nm", own.covariance)
    mounts = np.where(model.learnt, model.safe_variance, open_variance)
    change, spread = _on_the_line((model, mounts), evidence, residual, covariance, distance)
    change = change + expected
    corrected = replace(evidence, value=evidence.value - B @ mean[M:])
    alone, own_spread = corrected.alone(model.prior, own)
    change = np.where(model.learnt, change, alone)
    allowed = _limited(change - alone, own_spread + common, model.prior)
    kept = change - alone - allowed
    doubt = np.clip(distance - _DOUBTED, 0.0, 1.0)[:, None] * allowed
    stated = model.prior.bias if model.prior.stated is None else model.prior.stated
    spread = spread + _square(kept) + _square(doubt) + _beyond(common, stated[:M, :M])
    shared = distance < OUTSIDE
    change = np.where(shared[:, None], alone + allowed, evidence.alone(model.prior, own)[0])
    spread = np.where(shared[:, None, None], spread, own_spread + common)
    return Answers(change, 0.5 * (spread + spread.swapaxes(1, 2)), shared, distance, axis)


def _on_the_line(
    line: tuple[LineModel, np.ndarray],
    evidence: LineEvidence,
    residual: np.ndarray,
    covariance: np.ndarray,
    distance: np.ndarray,
) -> tuple[Float[np.ndarray, "N M"], Float[np.ndarray, "N M M"]]:
    """Posterior mounts of the vehicles relative to the line's mean, and their covariance (the mean's included).

    `line`: with the variances by which mounts scatter, of all or of each vehicle.
    """
    model, variance = line
    A, B, M = evidence.to_mount, evidence.to_bias, len(model.variance)
    remounted = evidence.remounted[:, None, None]
    weight = np.clip((OUTSIDE - distance) / (OUTSIDE - DOUBTED), _LEAST_WEIGHT, 1.0)
    S = (np.eye(M) * variance[..., None] + remounted * model.prior.mount) / weight[:, None, None]
    K = S @ A.T @ evidence.weights(A @ S @ A.T)
    keep = np.eye(M) - K @ A
    to_answer = np.concatenate([keep * ~remounted, -K @ np.broadcast_to(B, (len(S), *B.shape))], axis=2)
    spread = keep @ S + to_answer @ covariance @ to_answer.swapaxes(1, 2)
    return np.einsum("nmo,no->nm", K, residual), spread


def _limited(
    move: Float[np.ndarray, "N M"], covariance: Float[np.ndarray, "N M M"], prior: LinePrior
) -> Float[np.ndarray, "N M"]:
    """A move by at most one sigma along every axis and every principal direction of what is known alone."""
    unit = np.sqrt(np.diag(prior.mount))
    size, directions = np.linalg.eigh(covariance / np.outer(unit, unit))
    root = np.sqrt(size.clip(min=1e-18))
    along = np.einsum("nmk,nm->nk", directions, move / unit, optimize=True) / root
    along = np.clip(along, -_MOST_SIGMAS, _MOST_SIGMAS) * root
    allowed = unit * np.einsum("nmk,nk->nm", directions, along, optimize=True)
    most = _MOST_SIGMAS * np.sqrt(np.einsum("nmm->nm", covariance))
    beyond = (np.abs(allowed) / most).max(axis=1, keepdims=True)
    return np.asarray(allowed / np.maximum(beyond, 1.0))


def _square(vector: Float[np.ndarray, "N M"]) -> Float[np.ndarray, "N M M"]:
    return vector[:, :, None] * vector[:, None, :]


def _distances(
    model: LineModel, evidence: LineEvidence, residual: np.ndarray, covariance: np.ndarray
) -> tuple[Float[np.ndarray, " N"], np.ndarray]:
    """Largest distance of a mount from the line along an axis, in sigmas, and the axis; 0 for a remounted vehicle."""
    both = np.concatenate([evidence.to_mount, evidence.to_bias], axis=1)
    line = evidence.to_mount @ np.diag(model.variance) @ evidence.to_mount.T + both @ covariance @ both.T
    unit = np.sqrt(np.diag(model.prior.mount))
    z = np.abs(shifts_in_sigmas(evidence.weights(line), residual, evidence.to_mount, unit))
    z[evidence.remounted] = 0.0
    return z.max(axis=1), z.argmax(axis=1)


def _beyond(common: np.ndarray, of_line: np.ndarray) -> np.ndarray:
    """Positive part of the vehicle's common covariance minus the line's."""
    size, directions = np.linalg.eigh(common - of_line)
    return np.asarray((directions * size.clip(min=0.0)[:, None, :]) @ directions.swapaxes(1, 2))


_TRIED = 16  # vehicles whose removal is tried: those that move mean and scatter most


def largest_change_without_one(
    model: LineModel, evidence: LineEvidence, common: Float[np.ndarray, "N M M"]
) -> float:
    """Largest change of an axis of any other vehicle's answer, in its sigmas, if any one vehicle is left out."""
    answers = with_line(model, evidence, common)
    sigma = np.sqrt(np.einsum("nmm->nm", answers.covariance))
    mean, variance = without_each(evidence, model)
    unit = np.sqrt(np.diag(model.covariance)), np.maximum(model.variance_sigma, 1e-18)
    size = np.abs(mean / unit[0]).max(axis=1) + np.abs(variance / unit[1]).max(axis=1)
    largest = 0.0
    for j in np.argsort(-size)[:_TRIED]:
        other = replace(model, mean=model.mean + mean[j], variance=model.variance + variance[j])
        change = np.abs(with_line(other, evidence, common).change - answers.change) / sigma
        change[j] = 0.0
        largest = max(largest, float(change[answers.shared].max(initial=0.0)))
    return largest
