"""Calibration methods: one line each. Import paths are resolved on use, so that networks load only where needed."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from pipeline.core.config import SolveConfig
from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress
from pipeline.core.stage_work import Task
from pipeline.rig.estimates import Prior, Solution
from schemas.observations import Observation

__all__ = ["METHODS", "Method", "Solver", "method_named", "resolved"]


@runtime_checkable
class Solver(Protocol):
    """Interface of a method: from selected frames per pair and a prior to a solution."""

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


@dataclass(frozen=True)
class Method:
    """Properties of a method.

    Args:
        run: import path of its `Solver`; of `(method's name, task, chosen) -> Solver` where it needs images.
        composed: pairs that it composes of the other two instead of estimating them.
        frames: "selected" takes `select.frames` of a day; "all" takes all frames that are not held out, to
            track objects from frame to frame.
        paper_selection: takes the paper's frame conditions (section 4.5.1).
        needs_images: uses images and sweeps (table frames) in networks, not only observations.
        needs_all: estimates all three pairs or none; else a pair without frames costs the others nothing.
        needs_labels: of cameras in all their pairs; else camera-lidar can do with steps of brightness.
        of_three: works on one camera, one lidar and one radar, and its records are the answer; else on all edges of a
            rig, each from its own data, which the adjustment combines.
        settings: import path of `(method's name, task) -> dict`: further inputs of its result.
    """

    name: str
    run: str
    composed: tuple[str, ...] = ()
    frames: Literal["selected", "all"] = "selected"
    paper_selection: bool = False
    needs_images: bool = False
    needs_all: bool = False
    needs_labels: bool = True
    of_three: bool = True
    settings: str | None = None

    def solver(self) -> Solver:
        """The solver of a method that uses observations alone."""
        assert not self.needs_images, f"{self.name} needs frames: ask `solver_of` a task"
        solver: Solver = resolved(self.run)
        return solver

    def solver_of(self, task: Task, chosen: Mapping[str, str] | None = None) -> Solver:
        """The solver for one vehicle-day; `chosen` are names of its sensors by kind, if the rig has several.

        Raises:
            ConfigError: a network that the method needs does not exist.
        """
        if not self.needs_images:
            return self.solver()
        solver: Solver = resolved(self.run)(self.name, task, chosen)
        return solver

    def settings_of(self, task: Task) -> dict[str, Any]:
        """Inputs of the result other than observations and sections of fleet.toml, for the work key."""
        return {} if self.settings is None else dict(resolved(self.settings)(self.name, task))


_NETWORKS, _FILES = "pipeline.calibrate.networks:ssl_solver", "pipeline.calibrate.networks:ssl_settings"
METHODS = (
    Method("joint", "pipeline.calibrate.joint.solve:solve_joint", needs_labels=False, of_three=False),
    Method(
        "tracking",
        "pipeline.calibrate.tracking.solve:solve_tracking",
        composed=("camera_radar",),
        frames="all",
        needs_all=True,
    ),
    Method("pairwise-optimisation", "pipeline.calibrate.paper_methods:solve_pairwise", paper_selection=True),
    Method(
        "joint-optimisation",
        "pipeline.calibrate.paper_methods:solve_joint_optimisation",
        paper_selection=True,
        needs_all=True,
    ),
    Method("pairwise-ssl", _NETWORKS, needs_images=True, needs_all=True, settings=_FILES),
    Method("joint-ssl", _NETWORKS, needs_images=True, needs_all=True, settings=_FILES),
)


def method_named(name: str) -> Method:
    """The method of a name; raises ConfigError if there is none."""
    for method in METHODS:
        if method.name == name:
            return method
    known = ", ".join(m.name for m in METHODS)
    raise ConfigError("command line", "method", f"{name!r} does not exist; choose from {known}")


def resolved(path: str) -> Any:
    """What an import path `module:name` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
