"""A fleet's logs, truth and fleet.toml. Each vehicle-day has its seed, so their order has no effect."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress, silent
from pipeline.rig.topics import TOPICS, topics_of
from pipeline.simulate.faults import (
    DayFaults,
    Fault,
    faults_on,
    misread,
    networks_on,
    shaken,
)
from pipeline.simulate.logs.recording import FIRST_FRAME_S, PARTIAL, SUFFIXES, open_log, record_drive
from pipeline.simulate.sensors.mounting import Mounting, mounting_of
from pipeline.simulate.sensors.rig_spec import CameraSpec, RadarSpec, RigSpec, SensorSpec
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.simulated_frame import Setup
from pipeline.simulate.world.casting import World
from pipeline.simulate.world.drives import Drive
from pipeline.simulate.world.landscapes import landscape_named

__all__ = [
    "FleetSpec", "begin_fleet", "day_names", "drive_of", "fleet_toml", "mounting_on", "remove_half_logs",
    "simulate_fleet", "simulate_vehicle_day",
]  # fmt: skip

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

    def __post_init__(self) -> None:
        for name in ("vehicles", "days", "frames", "drives", "rate_hz"):
            value = getattr(self, name)
            if value <= 0:
                raise ConfigError("simulate", name, f"{value} is not positive")
        if self.environments != _IN_TURN:
            landscape_named(self.environments)
        rigs = self.rigs
        for fault in self.faults:
            if fault.vehicle not in rigs:
                raise ConfigError("--faults", fault.vehicle, f"no such vehicle among {', '.join(rigs)}")
            sensors = [s.name for s in rigs[fault.vehicle].sensors]
            if fault.sensor not in sensors:
                words = f"{fault.vehicle} has no such sensor among {', '.join(sensors)}"
                raise ConfigError("--faults", fault.sensor, words)

    @property
    def names(self) -> list[str]:
        """vehicle-1, vehicle-2, ..."""
        return [f"vehicle-{i + 1}" for i in range(self.vehicles)]

    @property
    def dates(self) -> list[str]:
        """Its days as YYYY-MM-DD."""
        return day_names(self.first_day, self.days)

    @property
    def rigs(self) -> dict[str, RigSpec]:
        """The rig of each vehicle, by name."""
        return {name: rig_named(dict(self.own_rigs).get(name, self.rig)) for name in self.names}


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
    (out / "fleet.toml").write_text(fleet_toml(name, spec.rigs))
    return [(vehicle, day) for day in range(spec.days) for vehicle in range(spec.vehicles)]


def remove_half_logs(out: Path) -> None:
    """Remove what a process left that was killed while it wrote."""
    for folder in out.glob(f"logs/*/*/{PARTIAL}*"):
        shutil.rmtree(folder, ignore_errors=True)


def simulate_vehicle_day(
    spec: FleetSpec, vehicle: int, day: int, out: Path, progress: Progress = silent
) -> int:
    """Write one vehicle-day, a log per drive; returns the number of logs."""
    name, day_name = spec.names[vehicle], spec.dates[day]
    rig, folder, drives, done = spec.rigs[name], out / "logs" / name / day_name, [], 0
    total = int(faults_on(spec.faults, name, day).amount("few"))
    total = total or (name in dict(spec.own_rigs) and spec.own_frames) or spec.frames
    per_drive = [total // spec.drives + (i < total % spec.drives) for i in range(spec.drives)]
    for i, frames in enumerate(filter(None, per_drive)):
        drive = drive_of(spec, vehicle, day, i, frames)
        container = [*SUFFIXES][(i + day) % 3] if spec.container == "mixed" else spec.container
        path = folder / f"{name}_{day_name}_{i:02d}{SUFFIXES[container]}"
        rng = np.random.default_rng([spec.seed, vehicle, day, i, 51])

        def tick(n: int, base: int = done) -> None:
            progress(base + n, spec.frames, f"{name} {day_name}")

        setups = [_setup(spec, vehicle, day, (done + k) / max(total - 1, 1)) for k in range(frames)]
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
    return len(drives)


def mounting_on(spec: FleetSpec, vehicle: int, day: int, share: float = 0.0) -> Mounting:
    """Mounting of a vehicle's sensors after a share of a day's frames, faults included."""
    name = spec.names[vehicle]
    rig = spec.rigs[name]
    if spec.remount_deg is not None:  # the paper's rig is taken off every evening: lever arms change too
        shift_m = rig.remount_translation_m * max(spec.remount_deg / rig.remount_rotation_deg, 1.0) / 4
        rig = replace(rig, remount_rotation_deg=spec.remount_deg, remount_translation_m=shift_m)
    return shaken(mounting_of(rig, spec.seed, vehicle, day), spec.faults, name, day, share)


def _setup(spec: FleetSpec, vehicle: int, day: int, share: float) -> Setup:
    """State of the vehicle after a share of a day's frames."""
    name = spec.names[vehicle]
    today = faults_on(spec.faults, name, day, share)
    return Setup(spec.rigs[name], mounting_on(spec, vehicle, day, share), networks_on(today), today)


def drive_of(spec: FleetSpec, vehicle: int, day: int, number: int, frames: int) -> Drive:
    """One of a vehicle's drives of a day."""
    environment = spec.environments
    if environment == _IN_TURN:
        environment = ("urban", "highway")[(vehicle + day + number) % 2]
    start = datetime.fromisoformat(spec.dates[day]).replace(tzinfo=UTC) + timedelta(
        hours=8 + 3 * number, minutes=7 * vehicle
    )
    seed = int(np.random.default_rng([spec.seed, vehicle, day, number, 52]).integers(1 << 31))
    today = faults_on(spec.faults, spec.names[vehicle], day)
    duration = FIRST_FRAME_S + frames / spec.rate_hz + 1.0
    return Drive(
        seed, environment, duration, int(start.timestamp()) * 10**9, today.has("night") or today.has("dusk")
    )


def _truth(spec: FleetSpec, vehicle: int, day: int) -> dict[str, Any]:
    """True poses, clocks and errors of a day, by sensor; not in the logs; stamp_a = stamp_b + dt_a_b_s."""
    name = spec.names[vehicle]
    rig, today = spec.rigs[name], faults_on(spec.faults, name, day)
    morning, evening = (mounting_on(spec, vehicle, day, share) for share in (0.0, 1.0))
    cameras = {s.name: _camera(s, morning, today) for s in rig.of_kind("camera")}
    return {
        "vehicle": name,
        "day": spec.dates[day],
        "seed": spec.seed,
        "rig": rig.name,
        "reference": rig.reference.name,
        **_poses(morning),
        "cameras": cameras,
        "radars": {s.name: asdict(morning[s.name].errors) for s in rig.of_kind("radar")},
        **(_of_three(morning, cameras["camera"]) if rig.is_short else {}),
        "at_end_of_day": _poses(evening) | (evening.pairs() if rig.is_short else {}),
        "faults": [asdict(f) | {"active": f.day <= day} for f in spec.faults if f.vehicle == name],
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
    K, K_logged = mounting.camera(sensor.name).K, misread(sensor, today).K
    return {"K": K.tolist(), "K_logged": K_logged.tolist(), "readout_s": sensor.sheet.readout_s}


def _of_three(m: Mounting, camera: Mapping[str, Any]) -> dict[str, Any]:
    """Truth of a three-sensor rig under the keys that its readers expect."""
    errors, dt_camera_s, dt_radar_s = m["radar"].errors, m["camera"].delay_s, m["radar"].delay_s
    return {
        **m.pairs(),
        **{f"T_vehicle_{n}": mounted.T_vehicle.tolist() for n, mounted in m.sensors.items()},
        "dt_camera_lidar_s": dt_camera_s,
        "dt_lidar_radar_s": -dt_radar_s,
        "dt_camera_radar_s": dt_camera_s - dt_radar_s,
        "radar_range_bias_m": errors.range_bias_m,
        "radar_elevation_bias_rad": errors.elevation_bias_rad,
        **{f"camera_{key}": value for key, value in camera.items()},
    }


def fleet_toml(fleet: str, rigs: Mapping[str, RigSpec]) -> str:
    """Text of fleet.toml for vehicles with a rig each; the prior's sigmas are deviations of a pair from CAD."""
    sections = [f'[fleet]\nname = "{fleet}"\n']
    for rig in {r.name: r for r in rigs.values()}.values():
        sections += _sections(rig)
    sections += [f'[vehicles."{vehicle}"]\nrig = "{rig.name}"\n' for vehicle, rig in rigs.items()]
    return "\n".join(sections)


def _sections(rig: RigSpec) -> list[str]:
    head = f"[rigs.{rig.name}"
    stamps = "" if rig.stamp_sigma_s is None else f"stamp_sigma_s = {rig.stamp_sigma_s}\n"
    sections = [
        f"{head}.{s.kind}{'' if rig.is_short else f's.{s.name}'}]\n{_sensor(s)}{stamps if s.kind == 'camera' else ''}"
        for s in rig.sensors
    ]
    if not rig.is_short:
        first = [next((s.name for s in rig.of_kind(kind)), "") for kind in ("camera", "lidar", "radar")]
        three = f"three = {json.dumps(first)}\n" if all(first) else ""  # for training and its networks
        sections.insert(0, f'{head}]\nreference = "{rig.reference.name}"\nbase = "base_link"\n{three}')
    sigmas = f"rotation_sigma_deg = 1.2\ntranslation_sigma_m = {rig.stated_translation_m}\n"
    return [
        *sections,
        f'{head}.ego]\nodometry = "{TOPICS["odometry"]}"\n',
        f'{head}.prior]\nsource = "tf_static"\n{sigmas}',
    ]


def _sensor(sensor: SensorSpec) -> str:
    topics, sheet = topics_of(sensor.name, sensor.kind), sensor.sheet
    if isinstance(sheet, CameraSpec):
        readout = f"readout_s = {sheet.readout_s}\n" if sheet.readout_s else ""
        return (
            f'image = "{topics["image"]}"\ninfo = "{topics["info"]}"\n'
            f'semantics = {{ source = "topics", labels = "{topics["labels"]}", '
            f'detections = "{topics["detections"]}", label_set = "cityscapes" }}\n{readout}'
        )
    points = f'points = "{topics["points"]}"\n'
    if not isinstance(sheet, RadarSpec):
        return points
    period_mps = sheet.doppler_period_mps
    period = "" if period_mps is None else f"doppler_period_mps = {period_mps}\n"
    return f'{points}doppler_field = "doppler"\ndoppler_positive = "{sheet.doppler_positive}"\n{period}'
