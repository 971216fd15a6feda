"""Outcomes of vehicle-days as a night's stages would give them, for who is told of them."""

from pipeline.core.results import Effort, Outcome
from pipeline.fleet.nightly import DayOutcome

__all__ = ["DAY", "day_outcome", "stage_outcome"]

DAY = "2026-03-02"


def stage_outcome(stage, vehicle, status="done", seconds=2.0, **values):
    key = "" if status == "failed" else f"key of {stage}"
    effort = Effort("2026-03-03T01:00:00.000000Z", seconds, 1000, 100)
    return Outcome(stage, vehicle, DAY, status, key, effort=effort, **values)


def day_outcome(vehicle, status="done", pairs=None, results=()):
    return DayOutcome(vehicle, DAY, status, pairs=pairs or {}, results=tuple(results))
