"""Calibration methods by name: import paths, resolved on use, so that torch loads only where it is needed."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from pipeline.config import SolveConfig
from pipeline.errors import ConfigError
from pipeline.extrinsics.estimates import Prior, Solution
from pipeline.results import Progress
from schemas.calibrations import METHODS
from schemas.observations import Observation

__all__ = ["COMPOSED", "METHOD", "PAPER_METHODS", "UNTHINNED", "Solver", "solver_of"]

METHOD: dict[str, str] = {
    "joint": "pipeline.calibrate.joint.solve:solve_joint",
    "tracking": "pipeline.calibrate.tracking.solve:solve_tracking",
    "pairwise-optimisation": "pipeline.calibrate.paper.pairwise:solve_pairwise",
    "joint-optimisation": "pipeline.calibrate.paper.joint_optimisation:solve_joint_optimisation",
}
# Pairs that a method composes of the other two instead of estimating them.
COMPOSED: dict[str, tuple[str, ...]] = {
    "joint": ("camera_radar",),
    "tracking": ("camera_radar",),
}
# Methods that take the paper's frame conditions and judge by the paper's losses.
PAPER_METHODS = ("pairwise-optimisation", "joint-optimisation")


# Methods that follow objects from frame to frame: they take all frames that are not held out.
UNTHINNED = ("tracking",)


@runtime_checkable
class Solver(Protocol):
    """What a method is: selected frames per pair and a prior in, a solution out."""

    def __call__(  # noqa: D102
        self,
        observations: Mapping[str, Sequence[Observation]],
        prior: Prior,
        config: SolveConfig,
        *,
        seed: int,
        triggered: Sequence[str],
        progress: Progress,
    ) -> Solution: ...


def solver_of(method: str) -> Solver:
    """The function of a method.

    Raises:
        ConfigError: no such method, or one that this version does not have yet.
    """
    if method not in METHOD:
        known = "does not exist" if method not in METHODS else "is not in this version"
        raise ConfigError("command line", "method", f"{method!r} {known}; choose from {', '.join(METHOD)}")
    module, _, name = METHOD[method].partition(":")
    solver: Solver = getattr(importlib.import_module(module), name)
    return solver
