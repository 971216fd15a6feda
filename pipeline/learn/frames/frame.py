"""A frame for export: data of each sensor at a moment, poses of the sensors, and their sigmas."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float, Float32

from pipeline.rig.se3 import from_quaternion, perturb_exactly
from pipeline.store.moments import joined
from pipeline.store.partitions import Lake, Partition
from schemas.captures import Image, Scan, Sweep
from schemas.features import ImageFeatureColumns
from schemas.moments import MOMENTS, PERCEIVED, Moment

__all__ = [
    "LIDAR_FIELDS", "RADAR_FIELDS", "Frame", "Mounting", "Perturbation", "Place", "day_key", "facts_of",
    "points_of", "read_frames", "to_json",
]  # fmt: skip

LIDAR_FIELDS = ("x", "y", "z", "intensity")
RADAR_FIELDS = ("x", "y", "z", "range_rate", "power")


@dataclass(frozen=True, eq=False)
class Mounting:
    """Poses of the sensors of a vehicle-day by one calibration."""

    source: str
    reference: str
    T: Mapping[str, Float[np.ndarray, "4 4"]]
    about: Mapping[str, Mapping[str, Any]]
    T_base_reference: Float[np.ndarray, "4 4"] | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """A hash that changes where any number does."""
        T_base = [] if self.T_base_reference is None else self.T_base_reference.tolist()
        T = {name: pose.tolist() for name, pose in self.T.items()}
        told = (self.source, self.reference, T_base, T, dict(self.about), dict(self.left_out))
        return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Perturbation:
    """By how much poses are moved on purpose: every sensor but the reference, in a direction drawn from the seed."""

    rotation_deg: float
    translation_m: float
    seed: int
    per: str  # "frame" or "day": what has one draw

    def moved(self, mounting: Mounting, *names: str) -> dict[str, Float[np.ndarray, "4 4"]]:
        """T_reference_sensor, moved by a draw that depends on the names (vehicle, day, frame) only."""
        out, angle_rad = dict(mounting.T), float(np.radians(self.rotation_deg))
        for sensor in out.keys() - {mounting.reference}:
            text = "\0".join((str(self.seed), *names, sensor))
            rng = np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big"))
            out[sensor] = perturb_exactly(out[sensor], angle_rad, self.translation_m, rng)
        return out


@dataclass(frozen=True)
class Place:
    """A moment that is wanted: its row, and the keys that it was split by."""

    moment: int
    split: str
    place: str
    environment: str


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a vehicle-day.

    Args:
        at: split and place.
        seen: labels and boxes of cameras, by name.
        T: T_reference_sensor as it is given out, of these sensors.
        answer: the unperturbed poses of the calibration; None if `T` has them.
    """

    partition: Partition
    at: Place
    moment: Moment
    captures: Mapping[str, Image | Sweep | Scan]
    seen: Mapping[str, ImageFeatureColumns]
    mounting: Mounting
    T: Mapping[str, Float[np.ndarray, "4 4"]]
    answer: Mapping[str, Float[np.ndarray, "4 4"]] | None

    @property
    def key(self) -> str:
        """A name that no other frame has, without a dot."""
        return f"{day_key(self.partition)}_{self.moment.moment:06d}"

    @property
    def T_odom_vehicle(self) -> Float[np.ndarray, "4 4"] | None:
        """The car's pose at the moment by odometry, or None."""
        m = self.moment
        values = (m.ego_qw, m.ego_qx, m.ego_qy, m.ego_qz, m.ego_tx_m, m.ego_ty_m, m.ego_tz_m)
        if any(v is None for v in values):
            return None
        return from_quaternion(np.array(values[:4], np.float64), np.array(values[4:], np.float64))


def day_key(partition: Partition) -> str:
    """A name that no other vehicle-day has, without a dot: file names end a key at the first one."""
    return f"{quote(partition.vehicle, safe=' ').replace('.', '%2E')}_{partition.day}"


def points_of(capture: Sweep | Scan) -> Float32[np.ndarray, "N C"]:
    """Columns LIDAR_FIELDS or RADAR_FIELDS; NaN where the log has no intensity or power."""
    if isinstance(capture, Sweep):
        columns = [*capture.lidar_xyz_m.T, capture.lidar_intensity]
    else:
        columns = [*capture.radar_xyz_m.T, capture.radar_range_rate_mps, capture.radar_power_db]
    unknown = np.full(len(columns[0]), np.nan)
    return np.stack([unknown if c is None else c for c in columns], axis=-1).astype(np.float32)


def read_frames(
    lake: Lake, partition: Partition, places: Sequence[Place], mounting: Mounting,
    perturbation: Perturbation | None,
) -> Iterator[Frame | None]:  # fmt: skip
    """Wanted frames of a vehicle-day in order; None for a frame with fewer than two posed sensors."""
    moments, sensors = [p.moment for p in places], list(mounting.T)
    logged, seen = (joined(lake, table, partition, sensors, moments) for table in (MOMENTS, PERCEIVED))
    for at, (moment, captures), (_, found) in zip(places, logged, seen, strict=True):
        if len(captures) < 2:
            yield None
            continue
        T, answer = {n: mounting.T[n] for n in captures}, None
        if perturbation is not None:
            frame = (str(at.moment),) if perturbation.per == "frame" else ()
            moved = perturbation.moved(mounting, partition.vehicle, partition.day, *frame)
            T, answer = {n: moved[n] for n in captures}, T
        labels = {n: f for n, f in found.items() if isinstance(f, ImageFeatureColumns)}
        yield Frame(partition, at, moment, captures, labels, mounting, T, answer)


def facts_of(frame: Frame) -> dict[str, Any]:
    """Plain values of a frame; 4x4 matrices are row-major, T_a_b takes coordinates in b to a."""
    moment, at, mounting = frame.moment, frame.at, frame.mounting
    T_base, T_odom = mounting.T_base_reference, frame.T_odom_vehicle
    return {
        "key": frame.key, "vehicle": frame.partition.vehicle, "day": frame.partition.day,
        "log": moment.log, "drive": moment.drive, "moment": moment.moment, "stamp_ns": moment.stamp_ns,
        "split": at.split, "place": at.place, "environment": at.environment,
        "calibration": mounting.source, "reference": mounting.reference,
        "T_base_reference": None if T_base is None else T_base.tolist(),
        "T_odom_vehicle": None if T_odom is None else T_odom.tolist(),
        "ego_speed_mps": moment.ego_speed_mps, "ego_yaw_rate_radps": moment.ego_yaw_rate_radps,
        "sensors": {name: _sensor(frame, name) for name in frame.captures},
    }  # fmt: skip


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
        told |= {
            "kind": "camera", "camera_model": capture.camera_model,
            "camera_K": capture.camera_K.tolist(), "camera_D": capture.camera_D.tolist(),
            "width_px": capture.image_width_px, "height_px": capture.image_height_px,
        }  # fmt: skip
        if (found := frame.seen.get(name)) is not None:
            told |= {
                "label_scale": found.label_scale, "boxes_px": found.road_user_boxes_px.tolist(),
                "box_classes": found.road_user_classes, "box_scores": found.road_user_scores.tolist(),
            }  # fmt: skip
    return told
