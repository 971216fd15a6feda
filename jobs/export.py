"""`boresight export`: the contracts of the tables, for whoever reads the lake without Boresight."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

__all__ = ["export"]


def export(what: Literal["schemas"], *, out: Path) -> int:
    """Write the JSON Schema of every table.

    Args:
        what: "schemas", one JSON Schema (2020-12) of a row per table.
        out: folder to write into; made where it is missing.
    """
    from jobs.summary import print_summary
    from schemas.versions import write_json_schemas

    paths = write_json_schemas(out)
    print_summary("export", "done", what=what, outputs=paths)
    return 0
