"""Checks of a solved day, in one table: each looks at the day as a whole and fails some of its pairs.

A new check is a function in a module of this folder and a line in `DAY_CHECKS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.calibrate.select.frames import Selection
from pipeline.calibrate.verify.constancy import constancy_failures
from pipeline.calibrate.verify.failed_checks import heading_failures, loop_failures
from pipeline.calibrate.verify.motion_sources import MotionFindings
from pipeline.calibrate.verify.prior_alarms import clock_alarms, edge_alarms, prior_alarms
from pipeline.calibrate.verify.scene_count import scene_failures
from pipeline.core.config import ChecksConfig, FleetConfig
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import Prior, Solution
from schemas.calibrations import PAIRS
from schemas.observations import Observation

__all__ = ["DAY_CHECKS", "DayCheck", "FoundDay", "checks_of_day"]


@dataclass(frozen=True, eq=False)
class FoundDay:
    """A solved day before its verdict."""

    observations: Sequence[Observation]
    selection: Selection
    prior: Prior
    solution: Solution
    fleet: FleetConfig
    limits: ChecksConfig
    motion: MotionFindings


DayCheck = Callable[[FoundDay], Mapping[str, Sequence[FailedCheck]]]


def _motion(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    """Sweeps are de-skewed, and stamps bridged, by the car's motion: a pair is right where its source of it is."""
    return {pair: day.motion.of(pair) for pair in PAIRS}


def _solver(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    """Failed checks of the solver."""
    return day.solution.failed_checks


def _heading(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    return {"camera_lidar": heading_failures(day.solution, day.prior, day.observations, day.limits)}


def _loop(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    return loop_failures(day.solution, day.limits)


def _scenes(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    fitted = day.selection.fit.items()
    return {pair: scene_failures([day.observations[i] for i in frames]) for pair, frames in fitted}


def _constancy(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    return constancy_failures(day.solution.pairs)


def _alarms(day: FoundDay) -> Mapping[str, Sequence[FailedCheck]]:
    """Mountings and clocks many sigmas from their priors."""
    pairs = {p: e for p, e in day.solution.pairs.items() if e.frames_used}
    sigma_s = day.fleet.solve.time_offset_sigma_s
    found = [
        prior_alarms(pairs, day.prior, day.limits),
        clock_alarms(pairs, sigma_s, day.limits),
        edge_alarms(pairs, day.prior, day.limits),
    ]
    return {pair: [check for of in found for check in of.get(pair, ())] for pair in pairs}


# In the order in which a record states them.
DAY_CHECKS: tuple[DayCheck, ...] = (
    _motion,
    _solver,
    _heading,
    _loop,
    _scenes,
    _constancy,
    _alarms,
)


def checks_of_day(day: FoundDay) -> dict[str, list[FailedCheck]]:
    """Failed checks of every pair, each once."""
    found = [check(day) for check in DAY_CHECKS]
    return {
        pair: list(dict.fromkeys(c for by_pair in found for c in by_pair.get(pair, ()))) for pair in PAIRS
    }
