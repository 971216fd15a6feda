"""Logs of a car with radars alone: each looks where tf_static has it look, and the world stands still."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.makers.written_logs import ODOMETRY, START_NS, Kit

__all__ = ["CORNER", "FRONT", "REAR", "Mounted", "radar_drive", "radar_log", "with_sign"]

PERIOD_NS = 400_000_000  # so that a short day passes many places
_FIELD_RAD, _DETECTIONS = np.radians(60.0), 90
_SPEED_MPS, _SWING_MPS, _TURN_RADPS = 11.0, 3.0, 0.1


@dataclass(frozen=True)
class Mounted:
    """A radar on the car.

    Args:
        yaw_deg: where it looks, to the left of the way ahead.
        positive: sign of the Doppler that it logs.
        told_yaw_deg: where tf_static has it look; None = where it looks.
        is_tracking: it logs RadarTracks, whose velocities need no sign.
        noise_mps: of the Doppler.
    """

    yaw_deg: float
    xyz_m: tuple[float, float, float]
    positive: str = "receding"
    told_yaw_deg: float | None = None
    is_tracking: bool = False
    noise_mps: float = 0.05


FRONT = Mounted(0.0, (3.6, 0.1, 0.5))
REAR = Mounted(180.0, (-1.0, -0.1, 0.6))
CORNER = Mounted(135.0, (-0.9, 0.9, 0.6))


def radar_drive(
    radars: Mapping[str, Mounted], *, frames: int = 60, odometry: bool = True, start_ns: int = START_NS
) -> Kit:
    """A drive of a car that speeds up, brakes and turns; a topic `/radar/NAME/points` per radar."""
    made, rng = Kit(frames=frames), np.random.default_rng(start_ns % 1000 + 5)
    half = {name: np.radians(r.yaw_deg if r.told_yaw_deg is None else r.told_yaw_deg) / 2
            for name, r in radars.items()}  # fmt: skip
    mounted = [
        made.transform(start_ns, "base_link", name, (np.cos(half[name]), 0, 0, np.sin(half[name])), r.xyz_m)
        for name, r in radars.items()
    ]
    made.add("/tf_static", "tf2_msgs/msg/TFMessage", start_ns, made.tf(*mounted))
    for i in range(-1, frames + 1):
        stamp, (speed, turn) = start_ns + i * PERIOD_NS, _motion(i)
        if odometry:
            made.add(ODOMETRY, "nav_msgs/msg/Odometry", stamp, made.odometry(stamp, 0.0, 0.0, speed, turn))
        for name, radar in radars.items() if 0 <= i < frames else ():
            columns = _scan(radar, speed, turn, rng)
            scan = _tracks(made, stamp, name, columns) if radar.is_tracking else made.cloud(
                stamp, columns, frame_id=name)  # fmt: skip
            made.add(f"/radar/{name}/points", scan.__msgtype__, stamp, scan)
    return made


def _tracks(made: Kit, stamp_ns: int, name: str, columns: Mapping[str, np.ndarray]) -> Any:
    """Detections as tracks, whose velocities are along the line of sight."""
    xyz = np.stack([columns[n] for n in "xyz"], -1).astype(float)
    velocity = columns["doppler"][:, None] * xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    uuid = made.new("unique_identifier_msgs/msg/UUID", uuid=np.zeros(16, np.uint8))
    zero = made.vector("Vector3", 0, 0, 0)
    found = [
        made.new(
            "radar_msgs/msg/RadarTrack", uuid=uuid, position=made.vector("Point", *p),
            velocity=made.vector("Vector3", *v), acceleration=zero, size=zero, classification=0,
        )
        for p, v in zip(xyz, velocity, strict=True)
    ]  # fmt: skip
    return made.new("radar_msgs/msg/RadarTracks", header=made.header(stamp_ns, name), tracks=found)


def radar_log(path: Path, radars: Mapping[str, Mounted], **drive: Any) -> Path:
    """`radar_drive` as an MCAP file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return radar_drive(radars, **drive).mcap(path)


def with_sign(fleet: Path, radar: str, positive: str) -> Path:
    """The fleet.toml, with another sign of one radar."""
    text = fleet.read_text()
    begin = text.index(f"radars.{radar}]")
    at = text.index("doppler_positive", begin)
    other = "approaching" if positive == "receding" else "receding"
    fleet.write_text(text[:at] + text[at:].replace(other, positive, 1))
    return fleet


def _motion(i: int) -> tuple[float, float]:
    """Speed [m/s] and yaw rate [rad/s] of the car at a moment."""
    return _SPEED_MPS + _SWING_MPS * np.sin(0.15 * i), _TURN_RADPS * np.sin(0.1 * i)


def _scan(radar: Mounted, speed: float, turn: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Detections of standing things, a tenth of them of something that moves, in radar axes."""
    azimuth, distance = rng.uniform(-_FIELD_RAD, _FIELD_RAD, _DETECTIONS), rng.uniform(4, 70, _DETECTIONS)
    rise = rng.uniform(-0.05, 0.08, _DETECTIONS)
    u = np.stack([np.cos(azimuth), np.sin(azimuth), rise], -1)
    yaw = np.radians(radar.yaw_deg)
    vx, vy = speed - turn * radar.xyz_m[1], turn * radar.xyz_m[0]
    own = np.array([np.cos(yaw) * vx + np.sin(yaw) * vy, np.cos(yaw) * vy - np.sin(yaw) * vx, 0.0])
    rate = -u @ own + rng.normal(0, radar.noise_mps, _DETECTIONS)
    rate[: _DETECTIONS // 10] += rng.uniform(2, 9)
    rate = -rate if radar.positive == "approaching" else rate
    columns = dict(zip("xyz", (distance[:, None] * u).T, strict=True))
    columns |= {"doppler": rate, "power": 0 * rate + 30}
    return {name: values.astype(np.float32) for name, values in columns.items()}
