"""The table of contents: what each stage reads and writes, and where it is.

Stages know nothing of each other; they meet in the tables. Whoever runs them goes through this list, and a
stage's module is imported when it runs.
"""

from __future__ import annotations

from pipeline.runner import Stage
from schemas.calibrations import CALIBRATIONS
from schemas.drift import DRIFT
from schemas.frames import FRAMES
from schemas.observations import OBSERVATIONS
from schemas.states import STATES
from schemas.training import TRAINING

__all__ = ["AUDIT", "CALIBRATE", "INGEST", "PERCEIVE", "PREPARE", "REPORT", "STAGES", "STATE"]

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
STATE = Stage(
    "state", (CALIBRATIONS, DRIFT), (STATES,), "pipeline.audit.state_stage:work", per_vehicle_day=False
)
REPORT = Stage(
    "report",
    (FRAMES, OBSERVATIONS, CALIBRATIONS, DRIFT),
    (),
    "pipeline.report.stage:work",
    per_vehicle_day=False,
)

STAGES = (INGEST, PERCEIVE, PREPARE, CALIBRATE, AUDIT, STATE, REPORT)
