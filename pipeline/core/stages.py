"""The stages: tables that each one reads and writes, and its function.

Stages do not import each other; they exchange data through tables. Runners iterate over this list, and a
stage's module is imported when it runs.
"""

from __future__ import annotations

from pipeline.core.runner import Stage
from schemas.calibrations import CALIBRATIONS
from schemas.captures import CAPTURES
from schemas.drift import DRIFT
from schemas.features import FEATURES
from schemas.moments import MOMENTS, PERCEIVED
from schemas.poses import POSES
from schemas.states import STATES
from schemas.training import TRAINING

__all__ = ["AUDIT", "CALIBRATE", "INGEST", "PERCEIVE", "PREPARE", "REPORT", "STAGES", "STATE"]

_INGESTED, _PERCEIVED = (MOMENTS, *CAPTURES.values()), (PERCEIVED, *FEATURES.values())

INGEST = Stage("ingest", (), _INGESTED, "pipeline.ingest.stage:work")
PERCEIVE = Stage("perceive", _INGESTED, _PERCEIVED, "pipeline.perceive.stage:work")
PREPARE = Stage("prepare", (*_INGESTED, *_PERCEIVED), (TRAINING,), "pipeline.learn.prepare.stage:work")
CALIBRATE = Stage(
    "calibrate",
    (*_INGESTED, *_PERCEIVED),
    (CALIBRATIONS, POSES),
    "pipeline.calibrate.stage:work",
    needs_inputs=False,
)
AUDIT = Stage("audit", (CALIBRATIONS,), (DRIFT,), "pipeline.audit.stage:work", per_vehicle_day=False)
STATE = Stage(
    "state",
    (CALIBRATIONS, POSES, DRIFT),
    (STATES,),
    "pipeline.audit.state_stage:work",
    per_vehicle_day=False,
)
REPORT = Stage(
    "report",
    (*_INGESTED, *_PERCEIVED, CALIBRATIONS, DRIFT),
    (),
    "pipeline.report.stage:work",
    per_vehicle_day=False,
)

STAGES = (INGEST, PERCEIVE, PREPARE, CALIBRATE, AUDIT, STATE, REPORT)
