"""Quadratic response surfaces over a ball: gradients and curvatures of scores that are rough at small scale.

Source: Box & Wilson 1951; antithetic pairs make gradient and curvature errors independent.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.numerics.covariance import spread_to_covariance

__all__ = ["DESIGN", "at_least", "fit_quadratics"]

_DIMENSIONS = 8


def _design() -> Float[np.ndarray, "P 8"]:
    """Centre and antithetic pairs in the unit ball, the same for every call."""
    rng = np.random.default_rng(7)
    x = rng.normal(size=(66, _DIMENSIONS))
    x *= (rng.random((66, 1)) ** (1 / 3)) / np.linalg.norm(x, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, _DIMENSIONS)), x, -x])


DESIGN = _design()
_UPPER = np.triu_indices(_DIMENSIONS)
_FIT = np.linalg.pinv(
    np.column_stack([np.ones(len(DESIGN)), DESIGN, DESIGN[:, _UPPER[0]] * DESIGN[:, _UPPER[1]]])
)


def fit_quadratics(
    value: Float[np.ndarray, "P F"],
) -> tuple[Float[np.ndarray, "F 8"], Float[np.ndarray, "F 8 8"]]:
    """Gradient and Hessian of the least-squares quadratic through each frame's values on the design."""
    c = (_FIT @ value).T
    H = np.zeros((value.shape[1], _DIMENSIONS, _DIMENSIONS))
    H[:, _UPPER[0], _UPPER[1]] = c[:, 1 + _DIMENSIONS :]
    return c[:, 1 : 1 + _DIMENSIONS], H + H.transpose(0, 2, 1)


def at_least(
    curvature: Float[np.ndarray, "8 8"], least: Float[np.ndarray, "8 8"]
) -> Float[np.ndarray, "8 8"]:
    """The larger of two symmetric matrices in every direction; `least` must be positive definite."""
    return spread_to_covariance(0.5 * (curvature + curvature.T), least)
