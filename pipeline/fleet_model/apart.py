"""Shared errors of sensors in the sensor's own terms, and whether data separate them from a common error of all mounts.

Records of one kind determine only the sum of both: every camera of a line mounted 0.2 deg too low looks like a
segmenter whose labels lie 0.2 deg too high. A direction of the shared error is told apart where its sigma is less than
half of what was known before; in the others its prior is kept, and nobody's answer gets surer there.

The prior of a shared error is what records state of it. If data tell it apart, or contradict the statement, and it is
larger than stated, the statement is too small: the line's prior becomes as wide as data show. Otherwise the error would
be estimated too small, and the rest of it would move the mounts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.fleet_model.evidence import LinePrior
from pipeline.fleet_model.line import LineModel

__all__ = ["SharedError", "shared_axes", "shared_errors", "told_apart", "widened"]

_TOLD = 0.5  # of the prior's sigma
_SHOWN = 0.98  # of the prior's sigma: with more data show nothing of an error
_CONTRADICTED = 3.0  # sigmas of data and statement together


@dataclass(frozen=True)
class SharedError:
    """An error that all vehicles of a line share, along one direction.

    Args:
        name: in the sensor's own terms.
        value: estimate [rad or m]; of what is not told apart, mostly its prior.
        sigma: of it.
        total: the error with the common error of mounts along the same direction: what records determine.
        total_sigma: of it.
        prior_sigma: before any data.
        told: data tell it from a common error of mounts.
    """

    name: str
    value: float
    sigma: float
    total: float
    total_sigma: float
    prior_sigma: float
    told: bool


def shared_axes(kind: str, R_parent_child: Float[np.ndarray, "3 3"]) -> dict[str, Float[np.ndarray, " 6"]]:
    """Directions of shared errors of an edge: the change of T_parent_child that an error of one looks like.

    A radar that measures elevations too high looks like one mounted too low: points of its own are moved, so that a
    child's error shows with the opposite sign, in the parent's axes, and a parent's error as it is. Positive: too
    high, too far left, too far away; of labels and principal point: too far down, too far right.

    Args:
        kind: of the edge, as camera_lidar.
        R_parent_child: rotation of the drawing.
    """
    zero = np.zeros(3)
    axes: dict[str, np.ndarray] = {}
    parent, child = kind.split("_")
    for name, R in ((parent, np.eye(3)), (child, -R_parent_child)):
        if name == "radar":
            axes["radar elevation"] = np.r_[-R[:, 1], zero]
            axes["radar azimuth"] = np.r_[R[:, 2], zero]
            axes["radar range"] = np.r_[zero, R[:, 0]]
        elif name == "camera":
            axes["camera labels or principal point, vertical"] = np.r_[-R[:, 0], zero]
            axes["camera labels or principal point, horizontal"] = np.r_[R[:, 1], zero]
    return axes


def shared_errors(model: LineModel, axes: dict[str, Float[np.ndarray, " 6"]]) -> list[SharedError]:
    """Shared errors along named directions."""
    M, P = len(model.prior.mount), len(model.prior.bias)
    found = []
    for name, h in axes.items():
        if not P:
            continue
        of_bias = np.r_[h, np.zeros(P - M)]  # witnesses have errors of their own behind it
        both = np.r_[h, of_bias]
        sigma = _root(of_bias @ model.covariance[M:, M:] @ of_bias)
        before = _root(of_bias @ model.prior.bias @ of_bias)
        found.append(
            SharedError(
                name, float(of_bias @ model.mean[M:]), sigma, float(both @ model.mean),
                _root(both @ model.covariance @ both), before, sigma < _TOLD * before,
            )
        )  # fmt: skip
    return found


def widened(model: LineModel, axes: dict[str, Float[np.ndarray, " 6"]]) -> LinePrior:
    """The line's prior, as wide along shared errors that exceed what records state as the data alone show them to be.

    The same prior if none is. The variance is the likeliest one of the error's only draw (type II maximum likelihood).
    """
    prior, M = model.prior, len(model.prior.mount)
    bias = prior.bias.copy()
    for error in shared_errors(model, axes):
        if error.sigma > _SHOWN * error.prior_sigma:
            continue
        u = np.r_[axes[error.name], np.zeros(len(bias) - M)]
        variance = 1 / (1 / error.sigma**2 - 1 / error.prior_sigma**2)  # of the data alone, and their value
        value = error.value * variance / error.sigma**2
        before = float(u @ bias @ u)
        if not error.told and abs(value) < _CONTRADICTED * np.sqrt(variance + before):
            continue
        if (larger := value**2 - variance) > before:
            bias += (larger - before) * np.outer(bias @ u, bias @ u) / before**2
    return prior if (bias == prior.bias).all() else replace(prior, bias=bias, stated=prior.bias)


def told_apart(model: LineModel) -> tuple[Float[np.ndarray, " G"], Float[np.ndarray, "G G"]]:
    """Mean and covariance of the line's mount and bias; along directions that data do not separate, of the data alone.

    In these the shared error keeps its prior, zero and as unsure as records say, whatever the prior of mounts is: the
    distribution of all else given it stays (Jeffrey's rule).
    """
    M, P = len(model.prior.mount), len(model.prior.bias)
    if not P:
        return model.mean, model.covariance
    root = np.linalg.cholesky(model.prior.bias)
    white = np.linalg.solve(root, np.linalg.solve(root, model.covariance[M:, M:]).T)
    size, directions = np.linalg.eigh(0.5 * (white + white.T))
    unknown = directions[:, size >= _TOLD**2]
    if not unknown.shape[1]:
        return model.mean, model.covariance
    pick = np.zeros((unknown.shape[1], M + P))
    pick[:, M:] = np.linalg.solve(root.T, unknown).T  # whitened coordinates of the untold directions
    of_pick = model.covariance @ pick.T
    gain = np.linalg.solve(pick @ of_pick, of_pick.T).T
    mean = model.mean - gain @ (pick @ model.mean)
    covariance = model.covariance - gain @ of_pick.T + gain @ gain.T
    return mean, 0.5 * (covariance + covariance.T)


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))
