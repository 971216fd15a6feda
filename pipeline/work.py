"""What a stage is asked (`Task`), what it answers (`Work`), and what it counts while it works (`Run`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

from pipeline.config import FleetConfig
from pipeline.results import Progress, silent
from pipeline.store.partitions import Lake, Partition
from pipeline.store.remote_logs import LogPath
from pipeline.store.tables import Manifest
from schemas.outcomes import OutcomeRow

__all__ = ["NothingUsable", "Records", "Run", "Task", "Told", "Window", "Work"]


@dataclass(frozen=True)
class Window:
    """Days that a stage of the whole fleet looks at, both included; None = as far as the records go."""

    first: str | None = None
    last: str | None = None


@dataclass(frozen=True)
class Task:
    """One call of a stage.

    Args:
        fleet: the whole configuration, which knows its file.
        lake: where the tables are.
        of: a vehicle-day, or the window of days of a stage of the whole fleet.
        method: of calibration records; None = the stage's default.
        seed: of everything random; None = `solve.seed`.
        perturb: of calibrate: exact angle [deg] and shift [m] by which the prior is moved on purpose.
        logs: of ingest: files, ROS 2 bag folders or objects of a bucket, of the day, in any order.
        given: what one stage alone is given; its function says what.
        progress: told how far it is.
        inputs: manifests of the tables that the stage reads, by name; the runner fills them in.
        commit: False where who gave the task commits the outcome's records, together with those of other tasks.
        recorded: what the lake has of the vehicle-day's records, where the giver of the task has read it already.
        before: what became of the vehicle-day's stages before: a refusal of the same inputs is not worked out again.
    """

    fleet: FleetConfig
    lake: Lake
    of: Partition | Window
    method: str | None = None
    seed: int | None = None
    perturb: tuple[float, float] | None = None
    logs: tuple[LogPath, ...] = ()
    given: Any = None
    progress: Progress = silent
    inputs: Mapping[str, Manifest] = field(default_factory=dict)
    commit: bool = True
    recorded: Sequence[Any] | None = None
    before: Sequence[OutcomeRow] = ()

    @property
    def partition(self) -> Partition:
        """The vehicle-day of a stage that works on one."""
        assert isinstance(self.of, Partition), "only stages of the whole fleet are given a window"
        return self.of


@dataclass(frozen=True)
class Told:
    """What an outcome says of record rows: how many of which status, what was left out, why."""

    kept: dict[str, int]
    rejected: dict[str, int] = field(default_factory=dict)
    reason: str = ""
    refused: bool = False
    faults: tuple[str, ...] = ()


@dataclass
class Run:
    """One run of a stage: its work key and inputs, and what it counts for the manifest and the outcome."""

    work_key: str
    inputs: tuple[str, ...]
    progress: Progress
    kept: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    extra: dict[str, Any] = field(default_factory=dict)  # into the manifest as it is
    remarks: str = ""  # what the outcome says although the work is done


@dataclass(frozen=True)
class Records:
    """Rows of a record table that are written together; None = under the task's own key, inputs and partition."""

    rows: Sequence[Any]
    partition: Partition | None = None
    work_key: str | None = None
    inputs: Sequence[str] | None = None


@dataclass(frozen=True)
class Work:
    """What a stage would do for a task. The runner asks for `rows` only where the work is not done already.

    Args:
        settings: all of the configuration that the answer depends on, for the work key.
        rows: the stage itself: yields, while it is asked, rows of the table that the stage writes (`Records` of a
            record table, paths of files where it writes no table). It raises `NothingUsable` where nothing shall
            be written.
        inputs: work keys of what is read; None = those of all tables of `task.inputs`.
        nothing: what the outcome says of a partition without a row, before the counted reasons.
        tell: what the outcome says of record rows.
        wider: settings under which the partition would hold all of this one and more: where it was made under one of
            them, nothing is to do.
        again: True where work that is recorded already is recorded once more, so that it becomes current.
    """

    settings: tuple[BaseModel | dict[str, Any], ...]
    rows: Callable[[Run], Generator[Any, None, None]]
    inputs: tuple[str, ...] | None = None
    nothing: str = ""
    tell: Callable[[Sequence[Any]], Told] = lambda rows: Told({"rows": len(rows)})
    wider: tuple[tuple[BaseModel | dict[str, Any], ...], ...] = ()
    again: bool = False


class NothingUsable(Exception):  # noqa: N818 - an outcome, not an error: the day is refused with this reason
    """Nothing of the input can be used: nothing is written, and what was written before stays.

    Args:
        reason: in words.
        faults: that it states, keys of `schemas.faults.FAULTS`.
    """

    def __init__(self, reason: str, *faults: str) -> None:
        self.faults = faults
        super().__init__(reason)
