"""Input of a stage (`Task`), its answer (`Work`), and the counts of a run (`Run`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

from pipeline.core.config import FleetConfig
from pipeline.core.results import Progress, silent
from pipeline.store.partitions import Lake, Partition
from pipeline.store.remote_logs import LogPath
from pipeline.store.tables import Manifest
from schemas.outcomes import OutcomeRow

__all__ = ["NO_PROBES", "NothingUsable", "Probes", "Run", "Task", "Told", "Window", "Work"]


Probes = tuple[tuple[float, ...], tuple[float, ...]]
NO_PROBES: Probes = ((), ())


@dataclass(frozen=True)
class Window:
    """First and last day of a fleet stage, both included; None = no limit."""

    first: str | None = None
    last: str | None = None


@dataclass(frozen=True)
class Task:
    """One call of a stage.

    Args:
        of: a vehicle-day, or the window of days for a stage of the whole fleet.
        method: of calibration records; None = the stage's default.
        seed: for all random numbers; None = `solve.seed`.
        perturb: calibrate only: rotation [deg] and shift [m] that are added to the prior on purpose, exact in
            size.
        probe_deg: calibrate only: turns [deg] of the result at which held-out frames are compared with it, of
            camera-lidar and of lidar-radar. For `verify`; they change no verdict, so no work key has them.
        logs: ingest only: files, ROS 2 bag folders or bucket objects of the day, in any order.
        given: input of one particular stage; documented at its function.
        progress: called with the progress of the stage.
        inputs: manifests of the tables that the stage reads, by name; the runner fills them in.
        commit: False if the caller commits the outcome's records, together with those of other tasks.
        recorded: records of the vehicle-day in the lake, if the caller has read them already.
        before: earlier outcomes of the vehicle-day: a refusal of the same inputs is not computed again.
    """

    fleet: FleetConfig
    lake: Lake
    of: Partition | Window
    method: str | None = None
    seed: int | None = None
    perturb: tuple[float, float] | None = None
    probe_deg: Probes = NO_PROBES
    logs: tuple[LogPath, ...] = ()
    given: Any = None
    progress: Progress = silent
    inputs: Mapping[str, Manifest] = field(default_factory=dict)
    commit: bool = True
    recorded: Sequence[Any] | None = None
    before: Sequence[OutcomeRow] = ()

    @property
    def partition(self) -> Partition:
        """The vehicle-day; only for stages that work on one."""
        assert isinstance(self.of, Partition), "only stages of the whole fleet are given a window"
        return self.of


@dataclass(frozen=True)
class Told:
    """Summary of record rows for an outcome: counts by status, counts of rejections, and the reason."""

    kept: dict[str, int]
    rejected: dict[str, int] = field(default_factory=dict)
    reason: str = ""
    refused: bool = False
    faults: tuple[str, ...] = ()


@dataclass
class Run:
    """One run of a stage: its work key, its inputs, and its counts for the manifest and the outcome."""

    work_key: str
    inputs: tuple[str, ...]
    progress: Progress
    kept: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    extra: dict[str, Any] = field(default_factory=dict)  # copied to the manifest
    remarks: str = ""  # text for the outcome of work that is done


@dataclass(frozen=True)
class Work:
    """Work of a stage for a task. The runner calls `rows` only if the work is not done already.

    Args:
        settings: all parts of the configuration that affect the result; they enter the work key.
        rows: the stage itself, a generator of rows of its tables (paths of files if it writes no table). It raises
            `NothingUsable` if nothing can be written.
        inputs: work keys of the inputs; None = those of all tables of `task.inputs`.
        nothing: first words of the reason for a partition without rows; the counted rejections follow.
        tell: summarises record rows for the outcome.
        wider: settings that produce a superset of this work: a partition made with one of them is kept.
        again: True if recorded work is recorded again, so that it becomes the current record.
    """

    settings: tuple[BaseModel | dict[str, Any], ...]
    rows: Callable[[Run], Generator[Any, None, None]]
    inputs: tuple[str, ...] | None = None
    nothing: str = ""
    tell: Callable[[Sequence[Any]], Told] = lambda rows: Told({"rows": len(rows)})
    wider: tuple[tuple[BaseModel | dict[str, Any], ...], ...] = ()
    again: bool = False


class NothingUsable(Exception):  # noqa: N818 - an outcome, not an error: the day is refused with this reason
    """No part of the input is usable: nothing is written, and existing tables stay.

    Args:
        reason: in words.
        faults: faults named in the reason, keys of `schemas.faults.FAULTS`.
    """

    def __init__(self, reason: str, *faults: str) -> None:
        self.faults = faults
        super().__init__(reason)
