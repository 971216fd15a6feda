"""Table `outcomes`: result, duration, inputs and outputs of each stage on each vehicle-day."""

from __future__ import annotations

from schemas.columns import FAULTS_DOC, Recorded, TableSchema, column, row

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
    reason: str = column("reason for the status; may be empty")
    faults: list[str] = column(FAULTS_DOC, default_factory=list)
    rows: int = column("number of frames, observations or records written", default=0)
    kept: dict[str, int] = column(
        "number kept, by kind; for calibrate by status of the pair", default_factory=dict
    )
    rejected: dict[str, int] = column("number rejected, by reason", default_factory=dict)
    began_at: str = column("UTC, ISO 8601 with microseconds", default="")
    seconds: float = column("duration", default=0.0)
    bytes_read: int | None = column("bytes that the worker read in this stage; null if unknown", default=None)
    bytes_written: int | None = column("and wrote", default=None)
    code_version: str = column("boresight version", default="")
    inputs: list[str] = column("work keys, or names and hashes, of the inputs", default_factory=list)


OUTCOMES = TableSchema(
    OutcomeRow, "outcomes", 4, "Stages that were up to date add no row.", made_by="nightly",
    about=("vehicle", "day", "stage", "method"),
)  # fmt: skip
