"""Reference of a vehicle-day's samples: what `joint` found there, which no network has a part in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from pipeline.learn.sample.frame_sample import Reference
from pipeline.rig.estimates import Prior
from pipeline.rig.graph import pose_of
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from schemas.calibrations import CALIBRATIONS, FRAMES_OF_PAIR, CalibrationRecord

__all__ = ["reference_of", "usable_records"]


def usable_records(
    lake: Lake, partition: Partition, chosen: Mapping[str, str]
) -> dict[str, CalibrationRecord]:
    """By pair, the day's records of `joint` that are accepted, or held for nothing but their sigma.

    Args:
        chosen: names of the camera, lidar and radar.
    """
    edges = {(chosen.get(a), chosen.get(b)): pair for pair, (a, b) in FRAMES_OF_PAIR.items()}
    rows = read_records(lake, CALIBRATIONS, CalibrationRecord, vehicle=partition.vehicle, day=partition.day)
    return {
        edges[edge]: row
        for row in current_records(rows)
        if row.method == "joint" and (edge := (row.parent_frame, row.child_frame)) in edges
        if row.status == "accepted" or row.diagnostics.get("unsure_only")
    }


def reference_of(records: Mapping[str, CalibrationRecord], prior: Prior) -> Reference:
    """Poses and clocks of the records; without one of camera-lidar, the prior."""
    camera, radar = (records.get(pair) for pair in ("camera_lidar", "lidar_radar"))
    if camera is None:
        return Reference(prior)
    T_camera_lidar = transform_of(camera)
    T_lidar_radar = prior.T_lidar_radar if radar is None else transform_of(radar)
    assert T_camera_lidar is not None and T_lidar_radar is not None  # noqa: PT018 - usable records have poses
    dt_s, own = camera.time_offset_s or 0.0, pose_of(partial(getattr, camera), "own_")
    if camera.diagnostics.get("own_dt_z") == 0.0 and own is not None:
        # Where the edge's own borders match, pose and offset of one solution: the adjusted offset of an unsure day is
        # drawn to the prior's.
        T_camera_lidar, dt_s = own, camera.diagnostics["own_dt_s"]
    poses = replace(prior, T_camera_lidar=T_camera_lidar, T_lidar_radar=T_lidar_radar)
    return Reference(poses, "joint", dt_s, 0.0 if radar is None else radar.time_offset_s or 0.0)
