"""A fleet's logs, truth and fleet.toml. Every vehicle-day has its own seed, so days come out the same in any order."""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.errors import ConfigError
from pipeline.geometry.se3 import from_rotation_translation
from pipeline.results import Progress, silent
from pipeline.simulate.casting import World
from pipeline.simulate.drives import Drive
from pipeline.simulate.faults import DayFaults, Fault, faults_on, misread, shaken
from pipeline.simulate.frames import SimulatedFrame, frame_at
from pipeline.simulate.logs import CONTAINERS, TOPICS, Put, log_name, open_log
from pipeline.simulate.messages import Messages
from pipeline.simulate.rigs import Mounting, RigSpec, mounting_of, rig_named
from pipeline.simulate.semantics import SemanticsSpec
from pipeline.simulate.toml import fleet_toml

__all__ = ["FleetSpec", "day_names", "simulate_fleet", "simulate_vehicle_day", "vehicle_names"]

_ODOMETRY_HZ: Final = 20.0
_SETTLE_S: Final = 1.0  # a drive's log begins this long before its first frame


@dataclass(frozen=True)
class FleetSpec:
    """What to simulate; `frames` per vehicle-day, spread over `drives` drives."""

    vehicles: int = 3
    days: int = 4
    first_day: str = "2026-03-02"
    frames: int = 40
    drives: int = 3
    rate_hz: float = 2.0
    rig: str = "demo"
    environments: str = "mixed"  # urban, highway, mixed
    container: str = "mcap"  # mcap, ros1, db3, mixed
    faults: tuple[Fault, ...] = ()
    seed: int = 1
    semantics: SemanticsSpec = field(default_factory=SemanticsSpec)


def vehicle_names(spec: FleetSpec) -> list[str]:
    """vehicle-1, vehicle-2, ..."""
    return [f"vehicle-{i + 1}" for i in range(spec.vehicles)]


def day_names(first_day: str, days: int) -> list[str]:
    """Consecutive days as YYYY-MM-DD."""
    try:
        first = date.fromisoformat(first_day)
    except ValueError as err:
        raise ConfigError("--first-day", "", f"{first_day!r} is no day as YYYY-MM-DD") from err
    return [(first + timedelta(days=i)).isoformat() for i in range(days)]


def simulate_fleet(
    spec: FleetSpec, out: Path, progress: Progress = silent, workers: int = 1
) -> dict[str, Any]:
    """Write `logs/<vehicle>/<day>/`, `truth/<vehicle>/<day>.json` and `fleet.toml` under `out`.

    Returns:
        Counts and paths, for a summary.
    """
    vehicles, days = vehicle_names(spec), day_names(spec.first_day, spec.days)
    for fault in spec.faults:
        if fault.vehicle not in vehicles:
            raise ConfigError(
                "--faults", fault.vehicle, f"unknown vehicle; the fleet has {', '.join(vehicles)}"
            )
    out.mkdir(parents=True, exist_ok=True)
    (out / "fleet.toml").write_text(fleet_toml("synthetic", spec.rig, rig_named(spec.rig), vehicles))
    work = [(v, d) for d in range(len(days)) for v in range(len(vehicles))]
    total, done, logs = len(work) * spec.frames, 0, 0
    if workers <= 1:
        for v, d in work:
            base = done
            logs += simulate_vehicle_day(
                spec, v, d, out, lambda n, _t, what, base=base: progress(base + n, total, what)
            )
            done += spec.frames
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            jobs = {pool.submit(simulate_vehicle_day, spec, v, d, out): (v, d) for v, d in work}
            for job in as_completed(jobs):
                v, d = jobs[job]
                logs, done = logs + job.result(), done + spec.frames
                progress(done, total, f"{vehicles[v]} {days[d]}")
    return {
        "vehicles": vehicles,
        "days": days,
        "frames": total,
        "logs": logs,
        "fleet": str(out / "fleet.toml"),
    }


def simulate_vehicle_day(
    spec: FleetSpec, vehicle: int, day: int, out: Path, progress: Progress = silent
) -> int:
    """Write one vehicle-day, a log per drive; returns the number of logs."""
    name, day_name = vehicle_names(spec)[vehicle], day_names(spec.first_day, spec.days)[day]
    rig, today = rig_named(spec.rig), faults_on(spec.faults, name, day)
    mounting = shaken(mounting_of(rig, spec.seed, vehicle, day), spec.faults, name, day)
    folder, drives, done = out / "logs" / name / day_name, [], 0
    counts = _shares(today.frames or spec.frames, spec.drives)
    for i, count in enumerate(counts):
        drive = _drive(spec, vehicle, day, i, count, day_name, today)
        container = CONTAINERS[(i + day) % 3] if spec.container == "mixed" else spec.container
        path = folder / log_name(f"{name}_{day_name}_{i:02d}", container)
        rng = np.random.default_rng([spec.seed, vehicle, day, i, 51])
        with open_log(path, container) as (messages, put):
            _write_drive(
                messages,
                put,
                World(drive),
                rig,
                mounting,
                spec,
                today,
                count,
                rng,
                lambda n, base=done: progress(base + n, spec.frames, f"{name} {day_name}"),
            )
        done += count
        drives.append(
            {
                "log": path.name,
                "environment": drive.environment,
                "start_ns": drive.start_ns,
                "frames": count,
                "seed": drive.seed,
            }
        )
    truth = out / "truth" / name / f"{day_name}.json"
    truth.parent.mkdir(parents=True, exist_ok=True)
    truth.write_text(json.dumps(_truth(spec, name, day_name, rig, mounting, day, drives), indent=1))
    return len(counts)


def _shares(frames: int, drives: int) -> list[int]:
    return [n for n in (frames // drives + (i < frames % drives) for i in range(drives)) if n]


def _drive(
    spec: FleetSpec, vehicle: int, day: int, number: int, frames: int, day_name: str, today: DayFaults
) -> Drive:
    environment = (
        spec.environments
        if spec.environments != "mixed"
        else ("urban", "highway")[(vehicle + day + number) % 2]
    )
    start = datetime.fromisoformat(day_name).replace(tzinfo=UTC) + timedelta(
        hours=8 + 3 * number, minutes=7 * vehicle
    )
    seed = int(np.random.default_rng([spec.seed, vehicle, day, number, 52]).integers(1 << 31))
    return Drive(
        seed,
        environment,
        _SETTLE_S + frames / spec.rate_hz + 1.0,
        int(start.timestamp()) * 10**9,
        today.night,
    )


def _write_drive(
    messages: Messages, put: Put, world: World, rig: RigSpec, mounting: Mounting, spec: FleetSpec, today: DayFaults, frames: int,
    rng: np.random.Generator, tick: Any,
) -> None:  # fmt: skip
    drive = world.drive

    def at(t_s: float) -> int:
        return drive.start_ns + round(t_s * 1e9)

    odometry = _odometry(drive, rng)
    put(TOPICS["tf"], at(0.0), messages.transforms(at(0.0), _nominal(mounting)))
    semantics = _night(spec.semantics) if today.night else spec.semantics
    written = 0
    for k in range(frames):
        stamp = _SETTLE_S + k / spec.rate_hz + rng.uniform(0, 0.02)
        frame = frame_at(world, rig, mounting, stamp, rng, semantics)
        pending = _trio(messages, frame, rig, mounting, today, at, rng)
        while written < len(odometry) and odometry[written][0] <= stamp + 0.1:
            t, T, speed, yaw_rate = odometry[written]
            pending.append((at(t), TOPICS["odometry"], messages.odometry(at(t), T, speed, yaw_rate)))
            written += 1
        for time_ns, topic, message in sorted(pending, key=lambda p: p[0]):
            put(topic, time_ns, message)
        tick(k + 1)


def _trio(
    messages: Messages,
    frame: SimulatedFrame,
    rig: RigSpec,
    mounting: Mounting,
    today: DayFaults,
    at: Any,
    rng: np.random.Generator,
) -> list[tuple[int, str, Any]]:
    """The messages of one frame: (log time, topic, message)."""
    camera, lidar, radar = at(frame.camera_stamp_s), at(frame.lidar_stamp_s), at(frame.radar_stamp_s)
    sweep, scan = frame.sweep, frame.scan
    sign = -1.0 if rig.radar.doppler_positive == "approaching" else 1.0
    points = dict(zip("xyz", sweep.xyz_m.T, strict=True)) | {
        "intensity": sweep.intensity,
        "ring": sweep.ring,
        "time": sweep.time_s,
    }
    detections = dict(zip("xyz", scan.xyz_m.T, strict=True)) | {
        "doppler": np.float32(sign) * scan.range_rate_mps,
        "power": scan.power_db,
    }
    lidar_topic, radar_topic = (
        (TOPICS["radar"], TOPICS["lidar"]) if today.swapped else (TOPICS["lidar"], TOPICS["radar"])
    )
    info = misread(mounting.nominal_camera, today.focal_factor)
    labels = _permuted(frame.labels_png, rng) if today.labels_permuted else frame.labels_png
    sent = {
        "camera": [
            (camera, TOPICS["info"], messages.camera_info(camera, info)),
            (camera, TOPICS["image"], messages.image(camera, frame.jpeg, "jpeg")),
            (camera, TOPICS["labels"], messages.image(camera, labels, "mono8; png compressed")),
            (camera, TOPICS["detections"], messages.detections(camera, frame.boxes)),
        ],
        "lidar": [(lidar, lidar_topic, messages.cloud(lidar, "lidar", points))],
        "radar": [(radar, radar_topic, messages.cloud(radar, "radar", detections))],
    }
    return [item for sensor, items in sent.items() if sensor not in today.missing for item in items]


def _permuted(png: bytes, rng: np.random.Generator) -> bytes:
    """Labels with their classes exchanged (a model with another label set)."""
    import cv2  # noqa: PLC0415

    from pipeline.simulate.semantics import encode_png  # noqa: PLC0415

    labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return encode_png(np.concatenate([rng.permutation(19), np.full(237, 255)]).astype(np.uint8)[labels])


def _night(spec: SemanticsSpec) -> SemanticsSpec:
    """Networks trained by day, at night."""
    return SemanticsSpec(
        3 * spec.boundary_px, spec.swell, 0.35, 0.5, 3 * spec.box_jitter, 3 * spec.false_boxes
    )


def _nominal(m: Mounting) -> dict[str, np.ndarray]:
    return {
        "camera": m.nominal_T_vehicle_camera,
        "lidar": m.nominal_T_vehicle_lidar,
        "radar": m.nominal_T_vehicle_radar,
    }


def _odometry(drive: Drive, rng: np.random.Generator) -> list[tuple[float, np.ndarray, float, float]]:
    """Dead reckoning from wheels and a gyro: (time, T_odom_vehicle, speed, yaw rate)."""
    t = np.arange(0.0, drive.duration_s, 1 / _ODOMETRY_HZ)
    T = drive.ego.poses(t)
    velocity, omega = drive.ego.velocities(t)
    speed = np.einsum("ij,ij->i", velocity, T[:, :3, 0]) * (1 + rng.normal(0, 0.004)) + rng.normal(
        0, 0.03, len(t)
    )
    yaw_rate = np.einsum("ij,ij->i", omega, T[:, :3, 2]) + rng.normal(0, 5e-4) + rng.normal(0, 0.002, len(t))
    yaw = np.cumsum(yaw_rate) / _ODOMETRY_HZ
    x, y = np.cumsum(speed * np.cos(yaw)) / _ODOMETRY_HZ, np.cumsum(speed * np.sin(yaw)) / _ODOMETRY_HZ
    R = np.zeros((len(t), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1], R[:, 2, 2] = (
        np.cos(yaw),
        -np.sin(yaw),
        np.sin(yaw),
        np.cos(yaw),
        1.0,
    )
    poses = from_rotation_translation(R, np.stack([x, y, np.zeros_like(x)], 1))
    return [(float(a), b, float(c), float(d)) for a, b, c, d in zip(t, poses, speed, yaw_rate, strict=True)]


def _truth(
    spec: FleetSpec,
    vehicle: str,
    day: str,
    rig: RigSpec,
    m: Mounting,
    number: int,
    drives: list[dict[str, Any]],
) -> dict[str, Any]:
    """What a judge needs to know; stamp_a = stamp_b + dt_a_b_s, as in the calibration records."""
    return {
        "vehicle": vehicle,
        "day": day,
        "rig": rig.name,
        "seed": spec.seed,
        **{name: T.tolist() for name, T in m.truth().items()},
        "T_vehicle_camera": m.T_vehicle_camera.tolist(),
        "T_vehicle_lidar": m.T_vehicle_lidar.tolist(),
        "T_vehicle_radar": m.T_vehicle_radar.tolist(),
        "dt_camera_lidar_s": m.camera_delay_s,
        "dt_lidar_radar_s": -m.radar_delay_s,
        "dt_camera_radar_s": m.camera_delay_s - m.radar_delay_s,
        "radar_range_bias_m": m.radar_range_bias_m,
        "radar_elevation_bias_rad": m.radar_elevation_bias_rad,
        "camera_K": m.camera.K.tolist(),
        "camera_K_logged": m.nominal_camera.K.tolist(),
        "faults": [asdict(f) | {"active": f.day <= number} for f in spec.faults if f.vehicle == vehicle],
        "drives": drives,
    }
