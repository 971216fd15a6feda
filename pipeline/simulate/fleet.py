"""A fleet's logs, truth and fleet.toml. Each vehicle-day has its seed, so their order has no effect."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress, silent
from pipeline.rig.topics import TOPICS, topics_of
from pipeline.simulate.faults import DayFaults, Fault, faults_on, misread, shaken
from pipeline.simulate.logs.frame_messages import Setup
from pipeline.simulate.logs.recording import (
    CONTAINERS,
    FIRST_FRAME_S,
    PARTIAL,
    log_name,
    open_log,
    record_drive,
)
from pipeline.simulate.sensors.data_sheets import CameraSpec, RadarSpec
from pipeline.simulate.sensors.mounting import Mounting, mounting_of
from pipeline.simulate.sensors.rig_spec import RigSpec, SensorSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.semantics import SemanticsSpec
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.landscapes import landscape_named

__all__ = [
    "FleetSpec",
    "begin_fleet",
    "day_names",
    "drive_of",
    "fleet_toml",
    "mounting_on",
    "remove_half_logs",
    "rig_of",
    "rigs_of",
    "simulate_fleet",
    "simulate_vehicle_day",
    "truth_of",
    "vehicle_names",
]

# --------------------------------------------------------------------------------------------------
# True poses, clocks and errors of a vehicle-day, by sensor, for evaluation; not in the logs.


def truth_of(rig: RigSpec, morning: Mounting, evening: Mounting, today: DayFaults) -> dict[str, Any]:
    """Poses, clocks and errors of a day's sensors; stamp_a = stamp_b + dt_a_b_s, as in records."""
    ends = _poses(evening) | (evening.pairs() if rig.is_short else {})
    return {
        "rig": rig.name,
        "reference": rig.reference.name,
        **_poses(morning),
        "cameras": {s.name: _camera(s, morning, today) for s in rig.of_kind("camera")},
        "radars": {n: asdict(m.errors) for n, m in morning.sensors.items() if m.errors is not None},
        **(_of_three(morning, rig, today) if rig.is_short else {}),
        "at_end_of_day": ends,
    }


def _poses(mounting: Mounting) -> dict[str, Any]:
    """Poses of all sensors, and delays of their stamps relative to the reference's."""
    sensors = mounting.sensors.items()
    return {
        "T_base_sensor": {n: m.T_vehicle.tolist() for n, m in sensors},
        "dt_s": {n: m.delay_s for n, m in sensors},
    }


def _camera(sensor: SensorSpec, mounting: Mounting, today: DayFaults) -> dict[str, Any]:
    assert isinstance(sensor.sheet, CameraSpec)
    true, logged = mounting.camera(sensor.name)
    stated = misread(logged, today, sensor.name)
    return {"K": true.K.tolist(), "K_logged": stated.K.tolist(), "readout_s": sensor.sheet.readout_s}


def _of_three(m: Mounting, rig: RigSpec, today: DayFaults) -> dict[str, Any]:
    """Truth of a three-sensor rig under the keys that its readers expect."""
    camera, radar, errors = m["camera"], m["radar"], m["radar"].errors
    assert errors is not None
    about = _camera(rig["camera"], m, today)
    return {
        **m.pairs(),
        **{f"T_vehicle_{n}": mounted.T_vehicle.tolist() for n, mounted in m.sensors.items()},
        "dt_camera_lidar_s": camera.delay_s,
        "dt_lidar_radar_s": -radar.delay_s,
        "dt_camera_radar_s": camera.delay_s - radar.delay_s,
        "radar_range_bias_m": errors.range_bias_m,
        "radar_elevation_bias_rad": errors.elevation_bias_rad,
        "camera_K": about["K"],
        "camera_K_logged": about["K_logged"],
        "camera_readout_s": about["readout_s"],
    }


# --------------------------------------------------------------------------------------------------
# A fleet's logs, truth and fleet.toml. Each vehicle-day has its seed, so their order has no effect.


_IN_TURN: Final = "mixed"


@dataclass(frozen=True)
class FleetSpec:
    """Specification of a simulated fleet; `frames` per vehicle-day, spread over `drives` drives."""

    vehicles: int = 3
    days: int = 4
    first_day: str = "2026-03-02"
    frames: int = 40
    drives: int = 3
    rate_hz: float = 2.0
    rig: str = "demo"
    own_rigs: tuple[tuple[str, str], ...] = ()  # (vehicle, rig) for vehicles with another rig
    own_frames: int | None = None  # frames per day of those vehicles; None = same as the others
    environments: str = "mixed"  # a landscape's name, or urban and highway in turn
    container: str = "mcap"  # mcap, ros1, db3, mixed
    faults: tuple[Fault, ...] = ()
    seed: int = 1
    remount_deg: float | None = None  # sd per axis and day; None = the rig's (fixed sensors: hundredths)
    semantics: SemanticsSpec = field(default_factory=SemanticsSpec)

    def __post_init__(self) -> None:
        for name in ("vehicles", "days", "frames", "drives", "rate_hz"):
            value = getattr(self, name)
            if value <= 0:
                raise ConfigError("simulate", name, f"{value} is not positive")
        if self.environments != _IN_TURN:
            landscape_named(self.environments)
        names = vehicle_names(self)
        for fault in self.faults:
            if fault.vehicle not in names:
                raise ConfigError("--faults", fault.vehicle, f"no such vehicle among {', '.join(names)}")
            sensors = [s.name for s in rig_of(self, names.index(fault.vehicle)).sensors]
            if fault.sensor not in sensors:
                words = f"{fault.vehicle} has no such sensor among {', '.join(sensors)}"
                raise ConfigError("--faults", fault.sensor, words)


def rig_of(spec: FleetSpec, vehicle: int) -> RigSpec:
    """The rig of a vehicle."""
    return rig_named(dict(spec.own_rigs).get(vehicle_names(spec)[vehicle], spec.rig))


def rigs_of(spec: FleetSpec) -> dict[str, RigSpec]:
    """The rig of each vehicle, by name."""
    return {name: rig_of(spec, i) for i, name in enumerate(vehicle_names(spec))}


def vehicle_names(spec: FleetSpec) -> list[str]:
    """vehicle-1, vehicle-2, ..."""
    return [f"vehicle-{i + 1}" for i in range(spec.vehicles)]


def day_names(first_day: str, days: int) -> list[str]:
    """Consecutive days as YYYY-MM-DD; raises ConfigError if `first_day` is not a valid day."""
    try:
        first = date.fromisoformat(first_day)
    except ValueError as err:
        raise ConfigError("--first-day", "", f"{first_day!r} is not a day as YYYY-MM-DD") from err
    return [(first + timedelta(days=i)).isoformat() for i in range(days)]


def simulate_fleet(spec: FleetSpec, out: Path) -> None:
    """Write `logs/VEHICLE/DAY/`, `truth/VEHICLE/DAY.json` and `fleet.toml` to `out`, day by day."""
    for vehicle, day in begin_fleet(spec, out, "synthetic"):
        simulate_vehicle_day(spec, vehicle, day, out)


def begin_fleet(spec: FleetSpec, out: Path, name: str) -> list[tuple[int, int]]:
    """Write fleet.toml; returns vehicle and day of all that is to be simulated."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "fleet.toml").write_text(fleet_toml(name, rigs_of(spec)))
    return [(vehicle, day) for day in range(spec.days) for vehicle in range(spec.vehicles)]


def remove_half_logs(out: Path) -> None:
    """Remove what a process left that was killed while it wrote."""
    for folder in out.glob(f"logs/*/*/{PARTIAL}*"):
        shutil.rmtree(folder, ignore_errors=True)


def simulate_vehicle_day(
    spec: FleetSpec, vehicle: int, day: int, out: Path, progress: Progress = silent
) -> int:
    """Write one vehicle-day, a log per drive; returns the number of logs."""
    name, day_name = vehicle_names(spec)[vehicle], day_names(spec.first_day, spec.days)[day]
    rig, folder, drives, done = rig_of(spec, vehicle), out / "logs" / name / day_name, [], 0
    shares = _shares(_frames(spec, name, day), spec.drives)
    for i, frames in enumerate(shares):
        drive = drive_of(spec, vehicle, day, i, frames)
        container = CONTAINERS[(i + day) % 3] if spec.container == "mixed" else spec.container
        path = folder / log_name(f"{name}_{day_name}_{i:02d}", container)
        rng = np.random.default_rng([spec.seed, vehicle, day, i, 51])

        def tick(n: int, base: int = done) -> None:
            progress(base + n, spec.frames, f"{name} {day_name}")

        last = max(sum(shares) - 1, 1)
        setups = [_setup(spec, vehicle, day, (done + k) / last) for k in range(frames)]
        with open_log(path, container) as log:
            record_drive(log, World(drive, rig.behind_m), setups, spec.rate_hz, rng, tick)
        done += frames
        drives.append(
            {"log": path.name, "frames": frames}
            | {k: getattr(drive, k) for k in ("environment", "start_ns", "seed", "night")}
        )
    truth = out / "truth" / name / f"{day_name}.json"
    truth.parent.mkdir(parents=True, exist_ok=True)
    truth.write_text(json.dumps(_truth(spec, vehicle, day) | {"drives": drives}, indent=1))
    return len(shares)


def mounting_on(spec: FleetSpec, vehicle: int, day: int, share: float = 0.0) -> Mounting:
    """Mounting of a vehicle's sensors after a share of a day's frames, faults included."""
    rig = rig_of(spec, vehicle)
    if spec.remount_deg is not None:  # the paper's rig is taken off every evening: lever arms change too
        shift_m = rig.remount_translation_m * max(spec.remount_deg / rig.remount_rotation_deg, 1.0) / 4
        rig = replace(rig, remount_rotation_deg=spec.remount_deg, remount_translation_m=shift_m)
    mounting = mounting_of(rig, spec.seed, vehicle, day)
    return shaken(mounting, spec.faults, vehicle_names(spec)[vehicle], day, share)


def _setup(spec: FleetSpec, vehicle: int, day: int, share: float) -> Setup:
    """State of the vehicle after a share of a day's frames."""
    today = faults_on(spec.faults, vehicle_names(spec)[vehicle], day, share)
    return Setup(
        rig_of(spec, vehicle),
        mounting_on(spec, vehicle, day, share),
        spec.semantics,
        today,
    )


def _frames(spec: FleetSpec, vehicle: str, day: int) -> int:
    own = spec.own_frames if vehicle in dict(spec.own_rigs) else None
    return int(faults_on(spec.faults, vehicle, day).amount("few")) or own or spec.frames


def _shares(frames: int, drives: int) -> list[int]:
    return [n for n in (frames // drives + (i < frames % drives) for i in range(drives)) if n]


def drive_of(spec: FleetSpec, vehicle: int, day: int, number: int, frames: int) -> Drive:
    """One of a vehicle's drives of a day."""
    environment = spec.environments
    if environment == _IN_TURN:
        environment = ("urban", "highway")[(vehicle + day + number) % 2]
    day_name = day_names(spec.first_day, spec.days)[day]
    start = datetime.fromisoformat(day_name).replace(tzinfo=UTC) + timedelta(
        hours=8 + 3 * number, minutes=7 * vehicle
    )
    seed = int(np.random.default_rng([spec.seed, vehicle, day, number, 52]).integers(1 << 31))
    today = faults_on(spec.faults, vehicle_names(spec)[vehicle], day)
    duration = FIRST_FRAME_S + frames / spec.rate_hz + 1.0
    return Drive(
        seed, environment, duration, int(start.timestamp()) * 10**9, today.has("night") or today.has("dusk")
    )


def _truth(spec: FleetSpec, vehicle: int, day: int) -> dict[str, Any]:
    name = vehicle_names(spec)[vehicle]
    morning, evening = (mounting_on(spec, vehicle, day, share) for share in (0.0, 1.0))
    return {
        "vehicle": name,
        "day": day_names(spec.first_day, spec.days)[day],
        "seed": spec.seed,
        **truth_of(rig_of(spec, vehicle), morning, evening, faults_on(spec.faults, name, day)),
        "faults": [asdict(f) | {"active": f.day <= day} for f in spec.faults if f.vehicle == name],
    }


def fleet_toml(fleet: str, rigs: Mapping[str, RigSpec]) -> str:
    """Text of fleet.toml for vehicles with a rig each; the prior's sigmas are deviations of a pair from CAD."""
    lines = ["[fleet]", f'name = "{fleet}"', ""]
    for name, rig in {r.name: r for r in rigs.values()}.items():
        lines += [*_sections(name, rig), ""]
    for vehicle, rig in rigs.items():
        lines += [f'[vehicles."{vehicle}"]', f'rig = "{rig.name}"', ""]
    return "\n".join(lines[:-1]) + "\n"


def _sections(rig_name: str, rig: RigSpec) -> list[str]:
    lines = (
        []
        if rig.is_short
        else [f"[rigs.{rig_name}]", f'reference = "{rig.reference.name}"', 'base = "base_link"', ""]
    )
    for sensor in rig.sensors:
        lines += [f"[rigs.{rig_name}.{sensor.kind}{'' if rig.is_short else f's.{sensor.name}'}]"]
        lines += _sensor(sensor)
        lines.append("")
    return [
        *lines,
        f"[rigs.{rig_name}.ego]",
        f'odometry = "{TOPICS["odometry"]}"',
        "",
        f"[rigs.{rig_name}.prior]",
        'source = "tf_static"',
        "rotation_sigma_deg = 1.2",
        "translation_sigma_m = 0.03",
    ]


def _sensor(sensor: SensorSpec) -> list[str]:
    topics, sheet = topics_of(sensor.name, sensor.kind), sensor.sheet
    if isinstance(sheet, CameraSpec):
        return [
            f'image = "{topics["image"]}"',
            f'info = "{topics["info"]}"',
            (
                f'semantics = {{ source = "topics", labels = "{topics["labels"]}", '
                f'detections = "{topics["detections"]}", label_set = "cityscapes" }}'
            ),
            *([f"readout_s = {sheet.readout_s}"] if sheet.readout_s else []),
        ]
    points = [f'points = "{topics["points"]}"']
    if not isinstance(sheet, RadarSpec):
        return points
    period = sheet.doppler_period_mps
    return [
        *points,
        'doppler_field = "doppler"',
        f'doppler_positive = "{sheet.doppler_positive}"',
        *([f"doppler_period_mps = {period}"] if period is not None else []),
    ]
