"""A frame's metadata as JSON: stamps, poses with sigmas, intrinsics, boxes."""

from __future__ import annotations

import json
from typing import Any

from pipeline.learn.frames.frame import LIDAR_FIELDS, RADAR_FIELDS, Frame
from schemas.captures import Image, Scan, Sweep
from schemas.features import ImageFeatureColumns

__all__ = ["facts_of", "to_json"]


def facts_of(frame: Frame) -> dict[str, Any]:
    """Plain values of a frame; 4x4 matrices are row-major, T_a_b takes coordinates in b to a."""
    moment, T_odom = frame.moment, frame.T_odom_vehicle
    T_base = frame.mounting.T_base_reference
    return {
        "key": frame.key,
        "vehicle": frame.partition.vehicle,
        "day": frame.partition.day,
        "log": moment.log,
        "drive": moment.drive,
        "moment": moment.moment,
        "stamp_ns": moment.stamp_ns,
        "split": frame.at.split,
        "place": frame.at.place,
        "environment": frame.at.environment,
        "calibration": frame.mounting.source,
        "reference": frame.mounting.reference,
        "T_base_reference": None if T_base is None else T_base.tolist(),
        "T_odom_vehicle": None if T_odom is None else T_odom.tolist(),
        "ego_speed_mps": moment.ego_speed_mps,
        "ego_yaw_rate_radps": moment.ego_yaw_rate_radps,
        "sensors": {name: _sensor(frame, name) for name in frame.captures},
    }


def to_json(value: Any) -> bytes:
    """Strict JSON with sorted keys: the same bytes for the same value."""
    return json.dumps(value, sort_keys=True, allow_nan=False).encode()


def _sensor(frame: Frame, name: str) -> dict[str, Any]:
    capture = frame.captures[name]
    told: dict[str, Any] = {
        "stamp_ns": capture.stamp_ns,
        "T_reference_sensor": frame.T[name].tolist(),
        **frame.mounting.about.get(name, {}),
    }
    if frame.answer is not None:
        told["answer_T_reference_sensor"] = frame.answer[name].tolist()
    if isinstance(capture, Sweep):
        told |= {"kind": "lidar", "fields": LIDAR_FIELDS, "deskewed": capture.lidar_deskewed}
    elif isinstance(capture, Scan):
        told |= {"kind": "radar", "fields": RADAR_FIELDS, "has_elevation": capture.radar_has_elevation}
        told["doppler_period_mps"] = capture.doppler_period_mps
    else:
        told |= {"kind": "camera"} | _camera(capture) | _seen(frame.seen.get(name))
    return told


def _camera(image: Image) -> dict[str, Any]:
    return {
        "camera_model": image.camera_model,
        "camera_K": image.camera_K.tolist(),
        "camera_D": image.camera_D.tolist(),
        "width_px": image.image_width_px,
        "height_px": image.image_height_px,
    }


def _seen(found: ImageFeatureColumns | None) -> dict[str, Any]:
    if found is None:
        return {}
    return {
        "label_scale": found.label_scale,
        "boxes_px": found.road_user_boxes_px.tolist(),
        "box_classes": found.road_user_classes,
        "box_scores": found.road_user_scores.tolist(),
    }
