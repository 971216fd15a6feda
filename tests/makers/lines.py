"""Model lines with a known truth: mounts, shared errors, and what each vehicle's days show of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.fleet_model.line import LineEvidence, LinePrior

__all__ = ["DEG", "Line", "make_line"]

DEG = np.pi / 180
# Per axis (rx ry rz [rad], tx ty tz [m]): what the mean of a vehicle's days varies by, and what records say that all
# days have in common.
NOISE = np.array([0.06 * DEG, 0.06 * DEG, 0.06 * DEG, 0.01, 0.01, 0.01])
COMMON = np.array([0.04 * DEG, 0.04 * DEG, 0.04 * DEG, 0.01, 0.01, 0.01])
DRAWING = np.array([2 * DEG] * 3 + [0.05] * 3)  # sigma of a line's mean mount about its drawing


@dataclass(frozen=True, eq=False)
class Line:
    """A line: true mounts as changes from the drawing, its evidence, and the prior and records' common parts."""

    mounts: np.ndarray
    evidence: LineEvidence
    prior: LinePrior
    common: np.ndarray


def make_line(
    vehicles: int,
    scatter: float,
    seed: int,
    *,
    bias: np.ndarray | None = None,
    mean: np.ndarray | None = None,
    remounted: int = 0,
    witness_sigma: float | None = None,
    drawing: np.ndarray = DRAWING,
) -> Line:
    """A line whose mounts scatter by `scatter` times the noise of a vehicle's answer.

    Args:
        vehicles: number of them.
        scatter: of mounts, in NOISE.
        seed: of the draw.
        bias: shared error of sensors.
        mean: common error of the factory's mounts.
        remounted: vehicles, the first ones, whose mounts workshops set: each with an error of `drawing` of its own.
        witness_sigma: sigma [rad] with which every vehicle shows its rotation about y without the shared error.
        drawing: prior sigma of the common error of mounts.
    """
    rng = np.random.default_rng(seed)
    bias = np.zeros(6) if bias is None else bias
    own = np.arange(vehicles) < remounted
    mounts = scatter * NOISE * rng.normal(size=(vehicles, 6))
    mounts += np.where(own[:, None], drawing * rng.normal(size=(vehicles, 6)), 0.0 if mean is None else mean)
    value = mounts + bias + NOISE * rng.normal(size=(vehicles, 6))
    noise = np.broadcast_to(np.diag(NOISE**2), (vehicles, 6, 6)).copy()
    A = B = np.eye(6)
    if witness_sigma is not None:
        value = np.column_stack([value, mounts[:, 1] + witness_sigma * rng.normal(size=vehicles)])
        whole = np.zeros((vehicles, 7, 7))
        whole[:, :6, :6], whole[:, 6, 6] = noise, witness_sigma**2
        noise, A, B = whole, np.vstack([A, A[1]]), np.vstack([B, np.zeros(6)])
    evidence = LineEvidence(value, np.linalg.inv(noise), A, B, own)
    common = np.maximum(COMMON, np.abs(bias))
    prior = LinePrior(np.diag(drawing**2), np.diag(common**2))
    return Line(mounts, evidence, prior, np.broadcast_to(prior.bias, (vehicles, 6, 6)).copy())
