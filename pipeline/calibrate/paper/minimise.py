"""Differential evolution, then Nelder-Mead: the paper's optimiser (section 4.5.3) over poses about a start.

A pose is six numbers about its start: a rotation vector in the parent's axes [rad] on the rotation part
alone, and a shift of the origin [m]. The search range has the same meaning for any lever arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import differential_evolution, minimize

from pipeline.core.config import SolveConfig

__all__ = ["Minimum", "at_border", "half_widths", "minimise"]

# Costs of a batch of parameter vectors: (S, D) -> (S,)
Objective = Callable[[np.ndarray], np.ndarray]


_BORDER = 0.98  # of the half-width: a minimum beyond it counts as at the border
_SIMPLEX = 0.05  # edge of Nelder-Mead's first simplex, as a share of the half-width
_EVALUATIONS_PER_PARAMETER = 150


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the search ended."""

    x: np.ndarray
    value: float
    evaluations: int
    at_border: bool  # within 2 % of the box: the true minimum may lie outside


def half_widths(config: SolveConfig, poses: int) -> Float[np.ndarray, " D"]:
    """Half the search box along each parameter of `poses` poses."""
    return np.tile([np.radians(config.search_rotation_deg)] * 3 + [config.search_translation_m] * 3, poses)


def minimise(
    objective: Objective,
    config: SolveConfig,
    start: Float[np.ndarray, " D"],
    rng: np.random.Generator,
    *,
    spread: float = 1.0,
) -> Minimum:
    """Minimise over the box: differential evolution (best1bin) on whole generations, then Nelder-Mead from its best.

    Args:
        start: member of the first population, and its centre.
        spread: size of the first population as a share of the box, 1 = all of it.
    """
    half = half_widths(config, len(start) // 6)
    members = start + spread * half * (2 * _latin_hypercube(config.paper_population, len(start), rng) - 1)
    members = np.clip(members, -half, half)
    members[0] = np.clip(start, -half, half)
    evaluations = 0

    def counted(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += len(x)
        return objective(np.clip(x, -half, half))

    found = differential_evolution(
        lambda x: counted(x.T),
        list(zip(-half, half, strict=True)),
        init=members,
        maxiter=config.paper_generations,
        mutation=(0.5, 0.9),
        recombination=0.8,
        tol=1e-4,
        polish=False,
        vectorized=True,
        updating="deferred",
        rng=rng,
    )
    simplex = np.vstack([found.x, found.x + np.diag(_SIMPLEX * half)])
    finished = minimize(
        lambda x: float(counted(x[None])[0]),
        found.x,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "xatol": 1e-5,  # 0.0006 deg, 0.01 mm
            "fatol": 1e-7,
            "maxfev": _EVALUATIONS_PER_PARAMETER * len(start),
            "adaptive": len(start) > 6,
        },
    )
    x = np.clip(finished.x, -half, half)
    return Minimum(x, float(finished.fun), evaluations, at_border(x, half))


def at_border(x: Float[np.ndarray, " D"], half_widths: Float[np.ndarray, " D"]) -> bool:
    """Whether a minimum is so near the border of the box that the true one may be outside."""
    return bool(np.any(np.abs(x) > _BORDER * half_widths))


def _latin_hypercube(members: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    strata = np.argsort(rng.random((dimensions, members)), axis=1).T
    return (strata + rng.random((members, dimensions))) / members
