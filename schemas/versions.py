"""All tables with their versions, and their export as JSON Schema."""

from __future__ import annotations

import json
from pathlib import Path

from schemas.calibrations import CALIBRATIONS
from schemas.captures import CAPTURES
from schemas.columns import TableSchema
from schemas.drift import DRIFT
from schemas.features import FEATURES
from schemas.moments import MOMENTS, PERCEIVED
from schemas.outcomes import OUTCOMES
from schemas.poses import POSES
from schemas.service_events import SERVICE_EVENTS
from schemas.sign_offs import SIGN_OFFS
from schemas.states import STATES
from schemas.training import TRAINING

__all__ = ["CODE_VERSION", "TABLES", "write_json_schemas"]

# Part of every work key: increment it with every change that alters a number, so that old partitions are
# replaced.
CODE_VERSION = "1.0.0"

TABLES: dict[str, TableSchema] = {
    t.name: t
    for t in (
        MOMENTS, *CAPTURES.values(), PERCEIVED, *FEATURES.values(), TRAINING, CALIBRATIONS, POSES, DRIFT,
        STATES, SIGN_OFFS, OUTCOMES, SERVICE_EVENTS,
    )
}  # fmt: skip


def write_json_schemas(folder: Path) -> list[Path]:
    """Write `<table>.schema.json` for every table into `folder` and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for table in TABLES.values():
        path = folder / f"{table.name}.schema.json"
        path.write_text(json.dumps(table.json_schema(), indent=2) + "\n")
        paths.append(path)
    return paths
