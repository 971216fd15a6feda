"""Table `outcomes`: what became of each vehicle-day in each stage, when, how long it took, what it read and wrote."""

from __future__ import annotations

from dataclasses import dataclass, field

from schemas.columns import DEFAULT_TRIO, TableSchema, record_columns, scalar

__all__ = ["OUTCOMES", "OUTCOME_STATUSES", "OutcomeRow"]

OUTCOME_STATUSES = ("done", "refused", "failed")

OUTCOMES = TableSchema(
    "outcomes",
    2,
    (
        scalar("vehicle", "string", "vehicle id"),
        scalar("day", "string", "YYYY-MM-DD"),
        scalar("stage", "string", "ingest, perceive or calibrate"),
        scalar("method", "string", "of calibrate; empty for the others"),
        scalar(
            "status",
            "string",
            "done, refused (the same inputs are not tried again) or failed (tried again every night)",
        ),
        scalar("reason", "string", "why, in words; empty where there is nothing to say"),
        scalar("faults", "list<string>", "faults that the reason states, keys of schemas/faults.py"),
        scalar("rows", "int64", "frames, observations or records that it made"),
        scalar("kept", "map<string,int64>", "how many of which kind; of calibrate by status of the pair"),
        scalar("rejected", "map<string,int64>", "what was left out, by reason"),
        scalar("began_at", "string", "UTC, ISO 8601 with microseconds"),
        scalar("seconds", "float64", "how long it took"),
        scalar(
            "bytes_read", "int64", "bytes that the worker read meanwhile; null where unknown", nullable=True
        ),
        scalar("bytes_written", "int64", "and wrote", nullable=True),
        scalar("code_version", "string", "boresight version"),
        scalar("inputs", "list<string>", "work keys or names and hashes of what was read"),
        *record_columns(),
    ),
    "What was up to date already adds no row: rows tell of work.",
    made_by="nightly",
    reads_versions=(1,),
    about=("vehicle", "day", "trio", "stage", "method"),
)


@dataclass(frozen=True)
class OutcomeRow:
    """One row of `outcomes`; fields are the columns of the same name."""

    vehicle: str
    day: str
    stage: str
    method: str
    status: str
    reason: str
    work_key: str
    rows: int = 0
    kept: dict[str, int] = field(default_factory=dict)
    rejected: dict[str, int] = field(default_factory=dict)
    began_at: str = ""
    seconds: float = 0.0
    bytes_read: int | None = None
    bytes_written: int | None = None
    code_version: str = ""
    inputs: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    trio: str = DEFAULT_TRIO
    recorded_at: str = ""  # written when the row is
    asserted_at: str = ""
