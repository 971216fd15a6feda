"""The table of contents: what each stage reads and writes, and where it is.

Stages know nothing of each other; they meet in the tables. Whoever runs them goes through this list, and a
stage's module is imported when it runs.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.results import Outcome
from pipeline.work import Task, Work
from schemas.calibrations import CALIBRATIONS
from schemas.columns import TableSchema
from schemas.drift import DRIFT
from schemas.frames import FRAMES
from schemas.observations import OBSERVATIONS
from schemas.training import TRAINING

__all__ = ["AUDIT", "CALIBRATE", "INGEST", "PERCEIVE", "PREPARE", "REPORT", "STAGES", "Stage"]


@dataclass(frozen=True)
class Stage:
    """One step of the night.

    Args:
        name: what its command and its outcomes are called.
        reads: tables that it reads.
        writes: table that it writes; none where it writes files.
        function: import path of `work(task) -> Work`.
        needs_inputs: a vehicle-day without all that the stage reads is an error. False where the stage reads what
            the task's method asks for and answers for its absence itself.
        per_vehicle_day: False where it looks at all vehicles and days of a window.
    """

    name: str
    reads: tuple[TableSchema, ...]
    writes: tuple[TableSchema, ...]
    function: str
    needs_inputs: bool = True
    per_vehicle_day: bool = True

    def load(self) -> Callable[[Task], Work]:
        """The stage's function; its module is imported now."""
        module, name = self.function.split(":")
        function: Callable[[Task], Work] = getattr(importlib.import_module(module), name)
        return function

    def run(self, task: Task) -> Outcome:
        """Do the task unless it is done already; see `pipeline.runner.run_stage`."""
        from pipeline.runner import run_stage  # noqa: PLC0415 - the runner knows this list

        return run_stage(self, task)


INGEST = Stage("ingest", (), (FRAMES,), "pipeline.ingest.stage:work")
PERCEIVE = Stage("perceive", (FRAMES,), (OBSERVATIONS,), "pipeline.perceive.stage:work")
PREPARE = Stage("prepare", (FRAMES, OBSERVATIONS), (TRAINING,), "pipeline.learn.prepare.stage:work")
CALIBRATE = Stage(
    "calibrate",
    (FRAMES, OBSERVATIONS),
    (CALIBRATIONS,),
    "pipeline.calibrate.stage:work",
    needs_inputs=False,
)
AUDIT = Stage("audit", (CALIBRATIONS,), (DRIFT,), "pipeline.audit.stage:work", per_vehicle_day=False)
REPORT = Stage(
    "report",
    (FRAMES, OBSERVATIONS, CALIBRATIONS, DRIFT),
    (),
    "pipeline.report.stage:work",
    per_vehicle_day=False,
)

STAGES = (INGEST, PERCEIVE, PREPARE, CALIBRATE, AUDIT, REPORT)
