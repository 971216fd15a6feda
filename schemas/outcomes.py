"""Table `outcomes`: what became of each vehicle-day in each stage, when, how long it took, what it read and wrote."""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["OUTCOMES", "OUTCOME_STATUSES", "OutcomeRow"]

OUTCOME_STATUSES = ("done", "refused", "failed")


@row(eq=True)
class OutcomeRow(Recorded):
    """One row of `outcomes`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("YYYY-MM-DD")
    stage: str = column("ingest, perceive or calibrate")
    method: str = column("of calibrate; empty for the others")
    status: str = column(
        "done, refused (the same inputs are not tried again) or failed (tried again every night)"
    )
    reason: str = column("why, in words; empty where there is nothing to say")
    faults: list[str] = column(
        "faults that the reason states, keys of schemas/faults.py", default_factory=list
    )
    rows: int = column("frames, observations or records that it made", default=0)
    kept: dict[str, int] = column(
        "how many of which kind; of calibrate by status of the pair", default_factory=dict
    )
    rejected: dict[str, int] = column("what was left out, by reason", default_factory=dict)
    began_at: str = column("UTC, ISO 8601 with microseconds", default="")
    seconds: float = column("how long it took", default=0.0)
    bytes_read: int | None = column("bytes that the worker read meanwhile; null where unknown", default=None)
    bytes_written: int | None = column("and wrote", default=None)
    code_version: str = column("boresight version", default="")
    inputs: list[str] = column("work keys or names and hashes of what was read", default_factory=list)


OUTCOMES = TableSchema(
    OutcomeRow,
    "outcomes",
    3,
    "What was up to date already adds no row: rows tell of work.",
    made_by="nightly",
    reads_versions=(1, 2),
    about=("vehicle", "day", "stage", "method"),
)
