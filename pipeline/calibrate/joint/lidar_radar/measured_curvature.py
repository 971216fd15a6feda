"""The cost's own curvature over yaw, x, y, dt and range bias, where soft assignment predicts too much of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.joint.lidar_radar.normal_equations import linearise
from pipeline.calibrate.joint.lidar_radar.problem import (
    AZIMUTH_RANGE_DOF,
    STEP_LIMIT,
    UNKNOWNS,
    RadarProblem,
    RadarState,
)

__all__ = ["with_measured_curvature"]

_MEASURED_SHARE = (0.02, 1.0)  # range of the measured curvature, as a share of the predicted one


def with_measured_curvature(
    problem: RadarProblem, state: RadarState, information: Float[np.ndarray, "F P P"]
) -> Float[np.ndarray, "F P P"]:
    """Information with the cost's measured curvature over yaw, x, y, dt and range bias.

    On days of one speed, x, dt and the range bias share a valley that is far flatter than soft assignment
    predicts.
    """
    dof = AZIMUTH_RANGE_DOF
    total = information.sum(0)[np.ix_(dof, dof)]
    measured = np.zeros_like(total)
    for column, k in enumerate(dof):
        step = np.zeros(UNKNOWNS)
        step[k] = 0.05 * STEP_LIMIT[k]
        ahead, behind = (_gradient(problem, state.moved(s)) for s in (step, -step))
        measured[:, column] = (ahead - behind) / (2 * step[k])
    # A standing car has no information on dt: what is added is far below any prior.
    L = np.linalg.cholesky(total + np.diag(1e-3 / STEP_LIMIT[dof] ** 2))
    W = np.linalg.solve(L, np.linalg.solve(L, 0.5 * (measured + measured.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (W + W.T))
    root = L @ vectors
    out = information.copy()
    out[np.ix_(np.arange(len(out)), dof, dof)] += (
        (root * np.clip(values, *_MEASURED_SHARE)) @ root.T - total
    ) / len(out)
    return out


def _gradient(problem: RadarProblem, state: RadarState) -> np.ndarray:
    g = linearise(problem, state, 1.0).g
    return g.sum(0)[AZIMUTH_RANGE_DOF]
