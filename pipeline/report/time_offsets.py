"""Time offsets in pictures: motion of the car between sweep, image and scan of a frame.

The time is the gap of the frame's stamps plus the offset of the clocks. At 15 m/s, 30 ms are half a metre:
without offsets, pictures of a calibration look worse than it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.report.overlays import Extrinsics
from pipeline.rig.se3 import exp_so3, from_rotation_translation
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["TimeOffsets", "as_stamped", "time_offsets_of"]


@dataclass(frozen=True)
class TimeOffsets:
    """Time [s] to add to a child's stamp to convert it to the parent's clock; None = unknown, drawn as simultaneous."""

    camera_lidar_s: float | None = None
    lidar_radar_s: float | None = None

    def in_words(self) -> str:
        """Text with both offsets in milliseconds; empty if neither is known."""
        known = (("camera", self.camera_lidar_s), ("radar", self.lidar_radar_s))
        return ", ".join(f"{sensor} {1e3 * dt_s:+.0f} ms" for sensor, dt_s in known if dt_s)


def time_offsets_of(records: Mapping[str, CalibrationRecord]) -> TimeOffsets:
    """The estimated offsets of a run, by pair; None if a method or a day has no estimate."""
    offset_s = {pair: r.time_offset_s for pair, r in records.items()}
    return TimeOffsets(offset_s.get("camera_lidar"), offset_s.get("lidar_radar"))


def as_stamped(state: Extrinsics, observation: Observation, offsets: TimeOffsets) -> Extrinsics:
    """Transforms between data of one frame, for static objects: poses and the car's motion over the offsets.

    T_camera_radar is not changed, because it is used for moving clusters only.
    """
    v, yaw_rate = _velocity_lidar(state, observation), observation.ego_yaw_rate_radps or 0.0
    camera_gap_s, radar_gap_s = (
        (stamp - observation.stamp_ns) * 1e-9
        for stamp in (observation.camera_stamp_ns, observation.radar_stamp_ns)
    )
    image_s = 0.0 if offsets.camera_lidar_s is None else offsets.camera_lidar_s - camera_gap_s
    sweep_s = 0.0 if offsets.lidar_radar_s is None else offsets.lidar_radar_s + radar_gap_s
    to_image, to_sweep = (_way(v, yaw_rate, way_s) for way_s in (image_s, sweep_s))
    return Extrinsics(state.T_camera_lidar @ to_image, state.T_camera_radar, to_sweep @ state.T_lidar_radar)


def _way(
    velocity_mps: Float[np.ndarray, " 3"], yaw_rate_radps: float, dt_s: float
) -> Float[np.ndarray, "4 4"]:
    """Transform of static points to their lidar coordinates dt earlier, p' = Rz(yaw_rate dt) (p + v dt)."""
    R = exp_so3(np.array([0.0, 0.0, yaw_rate_radps * dt_s]))
    return from_rotation_translation(R, R @ velocity_mps * dt_s)


def _velocity_lidar(state: Extrinsics, observation: Observation) -> Float[np.ndarray, " 3"]:
    """Own velocity in lidar axes: the radar's heading, level; straight ahead without a radar velocity."""
    speed_mps = observation.ego_speed_mps or 0.0
    ahead = np.array([1.0, 0.0, 0.0])
    if observation.radar_velocity_mps is not None and speed_mps:
        v = state.T_lidar_radar[:3, :3] @ observation.radar_velocity_mps * np.sign(speed_mps)
        ahead = np.array([v[0], v[1], 0.0]) / max(float(np.hypot(v[0], v[1])), 1e-9)
    return speed_mps * ahead
