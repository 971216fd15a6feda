"""Registration of a sampled cloud to the surfaces of another: point to plane, robust, from a near start.

Ground and ceilings constrain height and tilt only. Otherwise their noisy normals would keep points at the
start, which looks like information on horizontal motion on an empty square.

Source: Chen and Medioni 1992, "Object modelling by registration of multiple range images"; Geman-McClure
weights with a scale that follows the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from pipeline.rig.se3 import exp_se3, inverse, log_se3, transform_points

__all__ = ["PlaneEquations", "Registration", "Surfaces", "plane_equations", "register"]

_NEIGHBOURS = 10
_PLANAR = 0.1  # a patch's smallest variance over its middle one: beyond it there is no plane
_LEVEL = 0.8  # cosine between a normal and the vertical from which on a surface is ground, roof or ceiling
_FEWEST = 6 * _NEIGHBOURS
_GATES_M = (2.0, 1.0, 0.5, 0.3)  # pairs of points, from the start's errors down to the maps' spacing
_STEPS = 6
_CONVERGED = 1e-4  # rad, m
_LEAST_SCATTER_M = 0.01  # no car lidar measures better


class Surfaces:
    """Points with the normals of their surfaces."""

    def __init__(self, xyz_m: Float[np.ndarray, "N 3"]) -> None:
        self.xyz_m = xyz_m
        self.tree = cKDTree(xyz_m)
        near = xyz_m[self.tree.query(xyz_m, k=_NEIGHBOURS)[1]]
        near = near - near.mean(1, keepdims=True)
        variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
        self.normal = np.ascontiguousarray(axes[:, :, 0])
        self.is_planar = variance[:, 0] < _PLANAR * variance[:, 1]

    @classmethod
    def of(cls, xyz_m: Float[np.ndarray, "N 3"]) -> Surfaces | None:
        """The surfaces of a cloud; None for a cloud with too few points."""
        return cls(xyz_m) if len(xyz_m) >= _FEWEST else None


@dataclass(frozen=True, eq=False)
class PlaneEquations:
    """Equations of points near surfaces, for a left perturbation (rotation, shift)."""

    information: np.ndarray  # 6 6
    gradient: np.ndarray  # 6, downhill
    scatter_m: float  # of points from the surfaces
    share: float  # of the points that lie on a surface


@dataclass(frozen=True, eq=False)
class Registration:
    """T_target_source, and the equations of the data alone there."""

    T: np.ndarray  # 4 4
    found: PlaneEquations


def register(
    source_m: Float[np.ndarray, "N 3"],
    target: Surfaces,
    start: Float[np.ndarray, "4 4"],
    sigmas: Float[np.ndarray, " 6"],
    gates_m: tuple[float, ...] = _GATES_M,
) -> Registration | None:
    """Find T_target_source.

    Args:
        sigmas: sigmas of the start, for left perturbations; directions that no surface constrains stay at the
            start.
        gates_m: points farther than this from all others are not used; one round for each gate.

    Returns:
        None if hardly any point meets a surface.
    """
    T, held = start, np.diag(sigmas**-2.0)
    found = None
    for gate in gates_m:
        for _ in range(_STEPS):
            found = plane_equations(transform_points(T, source_m), target, gate)
            if found is None:
                return None
            downhill = found.gradient + held @ log_se3(start @ inverse(T))
            step = np.linalg.solve(found.information + held, downhill)
            T = exp_se3(step) @ T
            if np.abs(step).max() < _CONVERGED:
                break
    return None if found is None else Registration(T, found)


def plane_equations(
    moved_m: Float[np.ndarray, "N 3"], target: Surfaces, gate_m: float
) -> PlaneEquations | None:
    """Robust equations of the points with a plane within the gate; None if there are too few."""
    distance, index = target.tree.query(moved_m, distance_upper_bound=gate_m)
    meets = np.isfinite(distance)
    meets[meets] = target.is_planar[index[meets]]
    if meets.sum() < _FEWEST:
        return None
    p, n, q = moved_m[meets], target.normal[index[meets]], target.xyz_m[index[meets]]
    r = np.einsum("ij,ij->i", n, p - q)
    # Of level surfaces only the vertical part is believed.
    level = np.abs(n[:, 2]) > _LEVEL
    n[level, :2] = 0.0
    J = np.concatenate([np.cross(p, n), n], 1)
    scatter = max(1.4826 * float(np.median(np.abs(r))), _LEAST_SCATTER_M)
    w = (1 + (r / (2 * scatter)) ** 2) ** -2 / scatter**2
    return PlaneEquations((J.T * w) @ J, -(J.T * w) @ r, scatter, float(meets.mean()))
