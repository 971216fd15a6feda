"""Cameras without semantics: which pairs need labels, and what records and poses of the others state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from pipeline.core.errors import SolveError
from schemas.calibrations import FRAMES_OF_PAIR, CalibrationRecord
from schemas.faults import FAULTS
from schemas.observations import WITHOUT_LABELS, Observation
from schemas.poses import PoseRow

__all__ = ["noted", "notes_of_pair", "unlabelled_pairs"]

# Checks of camera-lidar with labels that need what such a camera lacks.
_UNCHECKED: Final = "no road users were detected: neither boxes nor a radar confirm the pose"


def unlabelled_pairs(
    observations: Sequence[Observation], chosen: Mapping[str, str], *, needs_labels: bool
) -> dict[str, SolveError]:
    """Pairs of a camera without semantics that need labels or road users, and why they are refused.

    `chosen` has the names of the sensors by kind. Camera-radar compares moving clusters with the boxes of road
    users. Camera-lidar can do with steps of brightness, unless the method `needs_labels`.
    """
    if not any(o.is_unlabelled for o in observations):
        return {}
    camera = chosen.get("camera", "camera")
    why = {"camera_radar": "boxes of road users"} | ({"camera_lidar": "labels"} if needs_labels else {})
    return {
        pair: SolveError(
            f"{FAULTS['no_labels']}, {camera}: {pair.replace('_', '-')} needs {what}", "no_labels"
        )
        for pair, what in why.items()
    }


def notes_of_pair(pair: str, observations: Sequence[Observation]) -> list[str]:
    """Notes for the record of a pair: how its camera was aligned, and by what it was not checked."""
    is_unlabelled = "camera" in FRAMES_OF_PAIR[pair] and any(o.is_unlabelled for o in observations)
    return [WITHOUT_LABELS, _UNCHECKED] if is_unlabelled else []


def noted(poses: Sequence[PoseRow], records: Sequence[CalibrationRecord]) -> list[PoseRow]:
    """The poses, with the note of cameras whose records state that they have no labels."""
    unlabelled = {r.parent_frame for r in records if WITHOUT_LABELS in r.notes}
    return [
        replace(row, notes=[WITHOUT_LABELS, *row.notes]) if row.sensor in unlabelled else row for row in poses
    ]
