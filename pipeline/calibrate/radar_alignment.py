"""Rows of table `radar_alignments`: alignment stated by radars, with the day's edges."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.calibrate.records import Inputs
from pipeline.extrinsics.radar_turn import turn_of_radar
from pipeline.geometry.changes import change_between
from pipeline.rig.edges import edge_of
from pipeline.store.current import prior_of, transform_of
from pipeline.store.tables import Manifest
from schemas.calibrations import CalibrationRecord
from schemas.moments import RADAR_ALIGNMENT
from schemas.poses import PoseRow
from schemas.radar_alignments import RadarAlignment

__all__ = ["with_alignments"]

# Edge that determines a radar's direction best, of those with the radar.
_BEST_FIRST = ("lidar_radar", "radar_base", "camera_radar")
_STATUSES = ("accepted", "held")


def with_alignments(
    found: Sequence[CalibrationRecord | PoseRow], manifest: Manifest | None, about: Inputs
) -> list[CalibrationRecord | PoseRow | RadarAlignment]:
    """Rows of a day with those of its radars' own alignment; a step within the day is noted at the radar."""
    stated = {} if manifest is None else manifest.extra.get(RADAR_ALIGNMENT, {})
    records = [r for r in found if isinstance(r, CalibrationRecord)]
    rows = [_row(about, name, columns, records) for name, columns in stated.items()]
    noted = [_noted(row, [a for a in rows if a.step_stamp_ns is not None]) for row in found]
    return [*noted, *rows]


def _row(
    about: Inputs, name: str, columns: dict[str, Any], records: Sequence[CalibrationRecord]
) -> RadarAlignment:
    row = RadarAlignment(
        vehicle=about.partition.vehicle,
        day=about.partition.day,
        method=about.method,
        sensor=name,
        work_key=about.work_key,
        inputs=list(about.inputs),
        **columns,
    )
    own = [r for r in records if r.status in _STATUSES and name in (r.parent_frame, r.child_frame)]
    order = sorted(own, key=lambda r: (_BEST_FIRST.index(r.pair), _STATUSES.index(r.status)))
    for record in order:
        T, T_prior = transform_of(record), prior_of(record)
        if T is None or T_prior is None or record.covariance is None:
            continue
        A = turn_of_radar(edge_of(record), T)
        azimuth, elevation = (float(v) for v in A @ change_between(T_prior, T)[:3])
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", A, record.covariance[:3, :3], A))
        return replace(
            row,
            own_edge=f"{record.parent_frame}-{record.child_frame}",
            own_azimuth_rad=azimuth,
            own_azimuth_sigma_rad=float(sigmas[0]),
            own_elevation_rad=elevation,
            own_elevation_sigma_rad=float(sigmas[1]),
        )
    return row


def _noted(
    row: CalibrationRecord | PoseRow, stepped: Sequence[RadarAlignment]
) -> CalibrationRecord | PoseRow:
    """The row, with a note of each step within the day of a radar that it is about."""
    sensors = {row.sensor} if isinstance(row, PoseRow) else {row.parent_frame, row.child_frame}
    notes = [_step_in_words(a) for a in stepped if a.sensor in sensors]
    return replace(row, notes=[*row.notes, *notes]) if notes else row


def _step_in_words(row: RadarAlignment) -> str:
    assert row.step_stamp_ns is not None, "only asked of a day with a step"
    at = dt.datetime.fromtimestamp(row.step_stamp_ns * 1e-9, dt.UTC)
    sizes = {"azimuth": row.azimuth_step_rad, "elevation": row.elevation_step_rad}
    turned = [f"{np.degrees(size):+.2f} deg in {axis}" for axis, size in sizes.items() if size is not None]
    return f"the {row.sensor}'s own software changed its alignment at {at:%H:%M} UTC: {', '.join(turned)}"
