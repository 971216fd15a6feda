"""Detection of a wrong prior pose: the one of the sensor common to all edges that differ greatly from the prior.

An edge far from the prior is left out, because it may be in a wrong minimum. But if the prior is wrong, all
poses that depend on it have the same error, with the prior's small sigma. On a van whose reference lidar was
logged .3 m too far ahead, three edges showed the error, and three radars without a measured position were
accepted half a degree off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

__all__ = ["hold_doubted"]

_FAULT = "prior"


def hold_doubted(
    rows: Sequence[PoseRow], records: Sequence[CalibrationRecord]
) -> tuple[list[PoseRow], list[CalibrationRecord]]:
    """Poses, held if edges contradict the prior of their sensor or of the reference.

    Records of such a sensor's edges are held too, if their own data do not determine its position.
    """
    against = [r for r in records if _FAULT in r.faults]
    ends = [{r.parent_frame, r.child_frame} for r in against]
    if not ends:
        return list(rows), list(records)
    shared = set.intersection(*ends) if len(ends) > 1 else set[str]()
    edges = ", ".join(f"{r.parent_frame}-{r.child_frame}" for r in against)
    middle = {row.reference for row in rows}
    doubted = shared or set.union(*ends) - middle
    said = f"the prior pose of {' or '.join(sorted(doubted))}, on which it rests, is contradicted by {edges}"
    return (
        [_held(row, said) if {row.sensor, *middle} & doubted else row for row in rows],
        [_held_record(r, said) if {r.parent_frame, r.child_frame} & doubted else r for r in records],
    )


def _held(row: PoseRow, said: str) -> PoseRow:
    if row.status == "refused" or row.sensor == row.reference:
        return row
    reason = f"{said}; {row.reason}" if row.reason else said
    faults = list(dict.fromkeys([*row.faults, _FAULT]))
    return replace(row, status="held", reason=reason, faults=faults, determined=[], unsure_only=False)


def _held_record(record: CalibrationRecord, said: str) -> CalibrationRecord:
    """Record of an edge, held unless its own data determine x and y."""
    if record.status == "refused" or _FAULT in record.faults or all((record.observable or [False] * 6)[3:5]):
        return record
    return replace(
        record,
        status="held",
        reason=f"{said}; {record.reason}" if record.reason else said,
        faults=[*record.faults, _FAULT],
        determined=[],
        mounting_determined=[],
        diagnostics=record.diagnostics | {"unsure_only": 0.0},
    )
