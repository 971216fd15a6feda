"""`boresight repair`: record tables that lost their log or files, from what is still there."""

from __future__ import annotations

__all__ = ["repair"]


def repair(*, lake: str) -> int:
    """Make damaged record tables whole again from what their data files hold, and name what is lost.

    A damaged log goes to LAKE/<table>/_damaged and a new one begins; nothing that is recorded doubles. Run it while
    nothing else writes. Lost calibrations are made anew by the next night that is given the logs. Exit code 3 where
    rows are lost.

    Args:
        lake: folder of the tables.
    """
    from jobs.terminal.summary import print_summary
    from pipeline.store.partitions import Lake
    from pipeline.store.repair import repair_table
    from schemas.versions import TABLES

    tables = Lake.existing(lake)
    done = {s.name: repair_table(tables, s) for s in TABLES.values() if s.is_record_table}
    lost = {name: d.lost for name, d in done.items() if d.lost}
    print_summary(
        "repair",
        "done" if any(d.found for d in done.values()) else "cached",
        found={name: d.found for name, d in done.items() if d.found},
        files={name: d.files for name, d in done.items() if d.files},
        lost=lost,
    )
    return 3 if lost else 0
