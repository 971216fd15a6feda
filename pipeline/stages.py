"""The table of contents: what each stage reads and writes, and where its function is.

Stages know nothing of each other; they meet in the tables. Whoever runs them goes through this list, and a
stage's module is imported when it runs.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from schemas.calibrations import CALIBRATIONS
from schemas.columns import TableSchema
from schemas.drift import DRIFT
from schemas.frames import FRAMES
from schemas.observations import OBSERVATIONS
from schemas.training import TRAINING

__all__ = ["AUDIT", "CALIBRATE", "INGEST", "PERCEIVE", "PREPARE", "REPORT", "STAGES", "Stage"]


@dataclass(frozen=True)
class Stage:
    """One step of the night: tables read, tables written, and the import path of its function."""

    name: str
    reads: tuple[TableSchema, ...]
    writes: tuple[TableSchema, ...]
    function: str
    per_vehicle_day: bool = True

    def load(self) -> Callable[..., Any]:
        """The stage's function; its signature is its module's."""
        module, name = self.function.split(":")
        function: Callable[..., Any] = getattr(importlib.import_module(module), name)
        return function


INGEST = Stage("ingest", (), (FRAMES,), "pipeline.ingest.stage:ingest_day")
PERCEIVE = Stage("perceive", (FRAMES,), (OBSERVATIONS,), "pipeline.perceive.stage:perceive_day")
PREPARE = Stage("prepare", (FRAMES, OBSERVATIONS), (TRAINING,), "pipeline.learn.prepare.stage:prepare_day")
CALIBRATE = Stage("calibrate", (OBSERVATIONS,), (CALIBRATIONS,), "pipeline.calibrate.stage:calibrate_day")
AUDIT = Stage("audit", (CALIBRATIONS,), (DRIFT,), "pipeline.audit.stage:audit_fleet", per_vehicle_day=False)
REPORT = Stage(
    "report",
    (FRAMES, OBSERVATIONS, CALIBRATIONS, DRIFT),
    (),
    "pipeline.report.stage:write_fleet_report",
    per_vehicle_day=False,
)

STAGES = (INGEST, PERCEIVE, PREPARE, CALIBRATE, AUDIT, REPORT)
