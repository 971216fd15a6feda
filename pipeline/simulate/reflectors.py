"""The paper's controlled recording: a standing car and three trihedral corner reflectors on a level lot.

The JSON next to the recording is the input of `boresight evaluate --reflectors`; pipeline/evaluate/recording.py
describes its format. The truth is under `truth`, which evaluate does not read.

Source: paper, section 2.1 (150 frames, positions picked by hand in each sensor's data) and figure 2.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from pipeline.core.results import Progress, silent
from pipeline.rig.se3 import inverse, transform_points
from pipeline.rig.topics import TOPICS
from pipeline.simulate.faults import misread
from pipeline.simulate.fleet import FleetSpec, mounting_on
from pipeline.simulate.logs.recording import messages_of, open_log
from pipeline.simulate.sensors.radar import Scan
from pipeline.simulate.sensors.simulated_frame import Scene, Setup, frame_of, triggered_stamps
from pipeline.simulate.world.casting import Moment, standing_of
from pipeline.simulate.world.drives import Parked
from pipeline.simulate.world.meshes import Mesh, MeshBuilder, Number

__all__ = ["REFLECTORS_VEHICLE", "simulate_reflectors"]

# Apexes in the vehicle frame [m]: three ranges, three bearings, at about sensor height.
REFLECTORS_VEHICLE: Final = np.array([[16.3, -2.6, 1.45], [26.0, 3.5, 1.30], [41.2, 0.6, 1.60]])
_EDGE_M: Final = 0.35
_LIDAR_PICK_SIGMA_M: Final = 0.015
_RATE_HZ: Final = 10.0
_SUN: Final = np.array([0.35, 0.55, 0.76]) / np.linalg.norm([0.35, 0.55, 0.76])


def simulate_reflectors(
    spec: FleetSpec, vehicle: int, day: int, out: Path, frames: int = 150, progress: Progress = silent
) -> Path:
    """Write `reflectors/<vehicle>/<day>.mcap` and `<day>.json` (picks and truth); returns the latter."""
    name, day_name = spec.names[vehicle], spec.dates[day]
    rig, mounting = spec.rigs[name], mounting_on(spec, vehicle, day)
    rng = np.random.default_rng([spec.seed, vehicle, day, 71])
    scene = Scene(Parked(), _SUN, beacons_map=REFLECTORS_VEHICLE)
    moment = Moment(standing_of(_lot(), np.zeros(3), _SUN, lambda p: p, 8.0), [], 0.0)
    start_ns = (
        int((datetime.fromisoformat(day_name).replace(tzinfo=UTC) + timedelta(hours=18)).timestamp()) * 10**9
    )
    folder, scans = out / "reflectors" / name, list[Scan]()

    def at(t_s: float) -> int:
        return start_ns + round(t_s * 1e9)

    setup = Setup(rig, mounting)
    with open_log(folder / f"{day_name}.mcap", "mcap") as log:
        log.put(TOPICS["tf"], at(0.0), log.messages.sensor_poses(at(0.0), mounting.nominal()))
        for k in range(frames):
            stamps = triggered_stamps(rig, mounting, 1.0 + k / _RATE_HZ, rng)
            frame = frame_of(moment, scene, setup, stamps, rng)
            stamps_ns = {n: at(t) for n, t in stamps.items()}
            items = messages_of(log.messages, frame, stamps_ns, setup, rng)
            for time_ns, topic, message in sorted(items, key=lambda p: p[0]):
                log.put(topic, time_ns, message)
            scans += [m for m in frame.values() if isinstance(m, Scan)]
            progress(k + 1, frames, f"{name} {day_name} reflectors")
    path = folder / f"{day_name}.json"
    about = {"vehicle": name, "day": day_name, "frames": frames, "reflector": {"edge_m": _EDGE_M}}
    path.write_text(json.dumps(about | _picks(setup, scans, rng), indent=1))
    return path


def _lot() -> Mesh:
    """Level asphalt with bays, a fence at its far end, and the reflectors on tripods."""
    b = MeshBuilder()
    lot = _level(-40, 90, -60, 60, 0.0)
    b.quads(lot, "asphalt", uv=lot[..., :2])
    for side in (-1, 1):
        for x in np.arange(6.0, 60.0, 2.6):
            y0, y1 = sorted((side * 8.0, side * 13.0))
            line = _level(x - 0.06, x + 0.06, y0, y1, 0.004)
            b.quads(line, "paint", uv=line[..., :2])
    b.box((75.0, 0.0, 0.9), (0.1, 110.0, 1.8), "slats")
    rng = np.random.default_rng(72)
    for y in np.arange(-50.0, 51.0, 8.0):
        b.blob(np.array([82.0, y + rng.uniform(-2, 2), 3.2]), rng.uniform(1.6, 3.0, 3), "foliage", rng)
    for apex in REFLECTORS_VEHICLE:
        _trihedral(b, apex)
    return b.mesh()


def _level(x0: Number, x1: Number, y0: Number, y1: Number, z: Number) -> np.ndarray:
    return np.array([[[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]])


def _trihedral(b: MeshBuilder, apex: np.ndarray) -> None:
    """Three right-angled plates that open towards the vehicle, symmetric about the line of sight."""
    u = -apex * [1, 1, 0] / np.linalg.norm(apex[:2])
    side = np.array([-u[1], u[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    # Orthonormal triad with its sum along u: columns of a rotation that takes (1, 1, 1)/sqrt(3) to u.
    edges = [
        u / np.sqrt(3) + (np.cos(a) * side + np.sin(a) * up) * np.sqrt(2 / 3)
        for a in np.radians([90, 210, 330])
    ]
    tips = [apex + _EDGE_M * e for e in edges]
    for i in range(3):
        b.quads(np.array([[apex, tips[i], tips[(i + 1) % 3], apex]]), "corner_reflector")
    foot = apex - u * 0.05
    for a in np.radians([20, 140, 260]):
        ground = np.array([foot[0] + 0.45 * np.cos(a), foot[1] + 0.45 * np.sin(a), 0.0])
        b.tube(ground, foot - [0, 0, 0.22], 0.02, "tripod", 5)


def _picks(setup: Setup, scans: list[Scan], rng: np.random.Generator) -> dict[str, Any]:
    """Careful manual picks in each sensor's data, and the truth."""
    m = setup.mounting
    seen, lidar, radar = (
        transform_points(inverse(m[n].T_vehicle), REFLECTORS_VEHICLE) for n in ("camera", "lidar", "radar")
    )
    camera, logged = m.camera("camera"), misread(setup.rig["camera"], setup.faults)
    pixels, _ = camera.project(seen)
    positions = zip(pixels, lidar, radar, strict=True)
    targets = [_target(scans, *position, camera.width_px, rng) for position in positions]
    return {
        "targets": targets,
        "camera": {
            "model": logged.model,
            "K": logged.K.tolist(),
            "D": logged.D.tolist(),
            "width_px": logged.width_px,
            "height_px": logged.height_px,
        },
        "truth": {
            "pixels": pixels.tolist(),
            "lidar_m": lidar.tolist(),
            "radar_m": radar.tolist(),
            "camera_K": camera.K.tolist(),
            **m.pairs(),
        },
    }


def _target(
    scans: list[Scan], pixel: Float[np.ndarray, " 2"], lidar_m: Float[np.ndarray, " 3"],
    radar_m: Float[np.ndarray, " 3"], width_px: int, rng: np.random.Generator,
) -> dict[str, Any]:  # fmt: skip
    """One reflector as picked, from its true position in each sensor."""
    step = width_px / 1824  # half a pixel of the full camera
    pixel_sd, lidar_sd = 0.5 * max(step, 0.5), _LIDAR_PICK_SIGMA_M
    picked_pixel, picked_lidar = pixel + rng.normal(0, pixel_sd, 2), lidar_m + rng.normal(0, lidar_sd, 3)
    detections = _radar_picks(scans, radar_m)
    return {
        "pixel": picked_pixel.tolist(),
        "lidar_m": picked_lidar.tolist(),
        "radar_m": detections.mean(axis=0).tolist(),
        # In image and cloud, a person picks a standing target once; the radar's detections scatter.
        "spread": {
            "pixel": [pixel_sd] * 2,
            "lidar_m": [lidar_sd] * 3,
            "radar_m": detections.std(axis=0).tolist(),
        },
        "frames": {"pixel": 1, "lidar_m": 1, "radar_m": len(detections)},
    }


def _radar_picks(scans: list[Scan], near_m: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "N 3"]:
    """The strongest detection near a reflector in every scan that has one."""
    found = []
    for scan in scans:
        offset = np.linalg.norm(scan.xyz_m[:, :2] - near_m[:2], axis=1)
        close = np.flatnonzero(offset < 1.5)
        if close.size:
            found.append(scan.xyz_m[close[np.argmax(scan.power_db[close])]])
    return np.array(found, np.float64) if found else np.full((1, 3), np.nan)
