"""Whose prior pose is wrong: that of the sensor which all edges share that lie far from the prior.

Such an edge is left out, for it may have found a wrong minimum. Where it is the prior that is wrong, all that still
rests on that prior is as far off, with the prior's small sigma: on a van whose reference lidar was logged .3 m too far
ahead, three edges said so, and three radars whose day shows no position were accepted half a degree off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

__all__ = ["hold_doubted"]

_FAULT = "prior"


def hold_doubted(rows: Sequence[PoseRow], records: Sequence[CalibrationRecord]) -> list[PoseRow]:
    """Poses, held where edges contradict the prior of their sensor, or of the reference that all are told by.

    Args:
        rows: of a vehicle-day.
        records: of its edges.
    """
    against = [r for r in records if _FAULT in r.faults]
    ends = [{r.parent_frame, r.child_frame} for r in against]
    if not ends:
        return list(rows)
    shared = set.intersection(*ends) if len(ends) > 1 else set[str]()
    edges = ", ".join(f"{r.parent_frame}-{r.child_frame}" for r in against)
    return [_held(row, shared or set.union(*ends) - {row.reference}, edges) for row in rows]


def _held(row: PoseRow, doubted: set[str], edges: str) -> PoseRow:
    if row.status != "accepted" or row.sensor == row.reference or not doubted & {row.sensor, row.reference}:
        return row
    whose = " or ".join(sorted(doubted))
    said = f"the prior pose of {whose}, on which it rests, is contradicted by {edges}"
    reason = f"{said}; {row.reason}" if row.reason else said
    return replace(row, status="held", reason=reason, faults=[*row.faults, _FAULT], determined=[])
