"""Stages in one line, as tests call them."""

from pipeline.core.results import silent
from pipeline.core.stage_work import Task, Window
from pipeline.core.stages import AUDIT, CALIBRATE, INGEST, PERCEIVE, PREPARE

__all__ = ["audit_fleet", "calibrate_day", "ingest_day", "perceive_day", "prepare_day"]


def ingest_day(logs, partition, fleet, lake, progress=silent):
    """Logs to table frames: the outcome."""
    return INGEST.run(Task(fleet, lake, partition, logs=tuple(logs), progress=progress))


def perceive_day(partition, fleet, lake, progress=silent):
    """Frames to table observations: the outcome."""
    return PERCEIVE.run(Task(fleet, lake, partition, progress=progress))


def prepare_day(partition, fleet, lake, plan, progress=silent):
    """Frames and observations to table training, split as planned: the outcome."""
    return PREPARE.run(Task(fleet, lake, partition, given=plan, progress=progress))


def calibrate_day(partition, fleet, lake, **how):
    """Observations to table calibrations: the outcome; `how` as in `Task`."""
    return CALIBRATE.run(Task(fleet, lake, partition, **how))


def audit_fleet(lake, fleet, from_day=None, to_day=None, method=None):
    """Calibrations to table drift: the findings."""
    return list(AUDIT.run(Task(fleet, lake, Window(from_day, to_day), method)).records)
