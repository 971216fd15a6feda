"""`boresight simulate`: logs of a synthetic fleet, with its true extrinsics."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from jobs.extras import require
from jobs.terminal.night_view import night_view
from jobs.terminal.summary import print_summary, progress_reporter
from pipeline.core.errors import ConfigError, LogError
from pipeline.core.results import Progress
from pipeline.fleet.executor import EXECUTORS

if TYPE_CHECKING:
    from pipeline.simulate.fleet import FleetSpec

__all__ = ["simulate", "simulate_days"]


def simulate(
    *,
    out: Path,
    vehicles: int = 3,
    days: int = 4,
    first_day: str = "2026-03-02",
    frames: int = 40,
    rate_hz: float = 2.0,
    rig: str = "demo",
    environments: str = "mixed",
    container: Literal["mcap", "ros1", "db3", "mixed"] = "mcap",
    faults: str = "",
    remount_deg: float | None = None,
    reflectors: bool = False,
    seed: int = 1,
    workers: int = 1,
) -> int:
    """Write OUT/logs/VEHICLE/DAY/*, OUT/truth/VEHICLE/DAY.json and OUT/fleet.toml.

    Args:
        out: folder to write into; logs with the same name are replaced.
        vehicles: number of vehicles, named vehicle-1 and so on.
        days: number of consecutive days.
        first_day: first day, YYYY-MM-DD.
        frames: moments per vehicle-day, each logged by every sensor, in three drives.
        rate_hz: moments per second within a drive.
        rig: sensors: demo, paper, paper-one-clock, paper-free, ring16, corner-left, corner-right, spin128,
            rosette, hdl64, keyhole, telephoto, fisheye, pinhole, rolling, truck, bumper, tilted, van (6
            cameras, 2 lidars, 5 radars), duo (2, 1, 2) or no_lidar (3, 0, 3). Append `-flat` for radars
            without elevation, or `-pairs` for a second image before each moment. Append `-dirty` for radars with
            strong road reflections and twice the noise. pipeline/simulate/README.md describes each rig.
        environments: surroundings of the drives: urban and highway in turn (mixed), one of them, suburb, jam,
            alley, country, deck, tunnel, or world-SEED, drawn from SEED.
        container: ROS 2 MCAP, ROS 1 bag, ROS 2 bag folder, or each in turn.
        faults: vehicle:day:sensor:kind:amount, separated by commas; kinds: yaw pitch roll [deg], x y z [m],
            drift-... per day, warm-... over the day, time and stamp [s] (0.5@0.6: after .6 of the day's
            frames), missing, stuck, swap, intrinsics, centre, centre-v [px], labels, night, dusk, few.
        remount_deg: standard deviation per axis of the mounting's change from day to day, for a rig that is
            taken off every evening; default: the change of a fixed sensor, some hundredths of a degree.
        reflectors: record three corner reflectors on every vehicle's last day too, under OUT/reflectors.
        seed: random seed; the same seed gives the same logs.
        workers: number of processes.
    """
    require("simulate")
    from pipeline.simulate.faults import parse_faults
    from pipeline.simulate.fleet import FleetSpec, day_names
    from pipeline.simulate.reflectors import simulate_reflectors
    from pipeline.simulate.sensors.rigs import rig_named

    spec_of_rig = rig_named(rig)
    if reflectors and not spec_of_rig.is_short:
        problem = "three reflectors are recorded by rigs of camera, lidar and radar"
        raise ConfigError("--reflectors", rig, problem)
    named = parse_faults(faults, day_names(first_day, days), spec_of_rig)
    spec = FleetSpec(
        vehicles=vehicles, days=days, first_day=first_day, frames=frames, rate_hz=rate_hz, rig=rig, seed=seed,
        environments=environments, container=container, faults=named, remount_deg=remount_deg,
    )  # fmt: skip
    result = {
        "vehicles": spec.names,
        "days": spec.dates,
        "frames": vehicles * days * frames,
        "logs": simulate_days(spec, out, "synthetic", workers),
        "fleet": str(out / "fleet.toml"),
        "truth": str(out / "truth"),
    }
    if reflectors:
        with progress_reporter("reflectors") as progress:
            result["reflectors"] = [
                str(simulate_reflectors(spec, v, days - 1, out, progress=progress)) for v in range(vehicles)
            ]
    print_summary("simulate", "done", **result)
    return 0


def simulate_days(spec: FleetSpec, out: Path, fleet: str, workers: int | None) -> int:
    """Write fleet.toml and all vehicle-days, with progress; returns the number of logs."""
    from pipeline.simulate.fleet import begin_fleet, remove_half_logs

    work, logs = begin_fleet(spec, out, fleet), 0
    names = [f"{spec.names[v]} {spec.dates[d]}" for v, d in work]
    run = EXECUTORS["process" if workers is None or workers > 1 else "inline"]
    try:
        with (
            night_view(names, len(work), title="simulate") as view,
            closing(run(partial(_simulate_one, spec, out), work, workers, view.watch)) as results,
        ):
            for finished in results:
                if finished.error:
                    raise LogError(str(out), f"simulating failed: {finished.error}\n{finished.trace}")
                view.ended(names[work.index(finished.item)])
                logs += finished.value or 0
    finally:
        remove_half_logs(out)
    return logs


def _simulate_one(spec: FleetSpec, out: Path, at: tuple[int, int], progress: Progress) -> int:
    from pipeline.simulate.fleet import simulate_vehicle_day

    return simulate_vehicle_day(spec, *at, out, progress)
