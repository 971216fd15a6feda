"""`boresight export frames`: frames of many vehicle-days with a calibration, as training data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from jobs.calibration_sources import pairs_to, read_calibration
from jobs.prepare import days_with_observations, over_days
from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.core.config import FleetConfig, load_fleet
from pipeline.core.errors import ConfigError, SolveError
from pipeline.export.calibration import sigmas_of
from pipeline.learn.frames.card import write_card
from pipeline.learn.frames.days import DayTask, export_day, plan_frames
from pipeline.learn.frames.frame import Mounting, Perturbation
from pipeline.learn.frames.output import Output
from pipeline.rig.day_prior import rig_prior
from pipeline.rig.graph import BASE
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import ingested
from schemas.moments import PRIOR

__all__ = ["export_frames"]


def export_frames(
    *,
    fleet: Path,
    lake: str,
    out: str,
    format: Literal["parquet", "nuscenes"],  # noqa: A002 - as it is typed
    calibration: Literal["state", "day", "prior"] = "state",
    perturb: tuple[float, float] | None = None,
    perturb_per: Literal["frame", "day"] = "frame",
    seed: int = 0,
    sensor: Annotated[tuple[str, ...], Parameter(negative=())] = (),
    method: str = "joint",
    force: bool = False,
    from_day: Annotated[str | None, Parameter(name="--from")] = None,
    to_day: Annotated[str | None, Parameter(name="--to")] = None,
    vehicles: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    unsplit: Annotated[bool, Parameter(negative=())] = False,
    executor: Literal["process", "inline"] = "process",
    workers: int | None = None,
) -> int:
    """Write synchronised frames of many days with calibration, in splits without leaks, and a data card.

    A vehicle-day is exported whole or not at all: run the command again after a stop, or after the lake has
    grown. Exit code 3 if vehicle-days are left out; the card gives the reasons.

    Args:
        fleet: fleet.toml; section [prepare] sets the spacing of frames and the split.
        lake: folder of the tables, or s3://BUCKET/PREFIX.
        out: folder of the export, or s3://BUCKET/PREFIX.
        format: parquet (with a torch Dataset) or nuscenes (images undistorted).
        calibration: state (the one that each vehicle loads tonight; days before a sensor moved are left out),
            day (the records of each day), or prior (the prior of each day).
        perturb: DEG M: move the pose of each sensor by exactly this much; the unperturbed pose is written
            too.
        perturb_per: draw a perturbation per frame or per day.
        seed: random seed of the perturbations.
        sensor: only this sensor; repeat for several; default: all.
        method: calibration method.
        force: use held poses too, marked as held.
        from_day: first day, YYYY-MM-DD.
        to_day: last day.
        vehicles: only these vehicles; default: all vehicles of fleet.toml in the lake.
        unsplit: put every frame in the split train. A single vehicle-day cannot be split without a leak.
        executor: process (a pool) or inline (one after the other in this process).
        workers: processes at a time; default: one per CPU that this process may use.
    """
    config, tables, output = load_fleet(fleet), Lake.existing(lake).absolute(), Output.at(out)
    days = days_with_observations(config, tables, from_day, to_day, vehicles)
    known, left_out = _mountings(tables, config, days, calibration, method, sensor, force=force)
    if not known:
        raise ConfigError("command line", "calibration", f"no vehicle-day has one: {left_out[0]['reason']}")
    settings: dict[str, Any] = {
        "format": format,
        "calibration": calibration,
        "method": method,
        "sensors": list(sensor),
    }
    settings |= {"seed": seed, "perturb": None if perturb is None else list(perturb)}
    settings |= {"perturb_per": perturb_per}
    whole = {"val_fraction": 0.0, "test_fraction": 0.0} if unsplit else {}
    prepare = config.prepare.split_with(**whole)
    with progress_reporter("plan") as progress:
        planned, settings = plan_frames(tables, list(known), prepare, output, settings, progress)
    moved = None if perturb is None else Perturbation(*perturb, seed, perturb_per)
    tasks = [
        DayTask(tables, day, output, format, places, dict(lost), known[day], moved)
        for day, (places, lost) in planned.items()
    ]
    counts, failed, done = Counter[str](), list[dict[str, str]](), list[Partition]()
    for end in over_days("frames", export_day, tasks, executor, workers):
        counts[end.value or "failed"] += 1
        if end.value is None:
            failed.append(_left_out(end.item.partition, end.error))
        else:
            done.append(end.item.partition)
    left_out += sorted(failed, key=lambda f: (f["vehicle"], f["day"]))
    card = write_card(output, settings, [day for day in planned if day in done], left_out)
    status = "failed" if failed and not done else "held" if left_out else "done"
    print_summary(
        "export frames",
        status,
        format=format,
        vehicle_days=dict(counts),
        **{n: card[n] for n in ("frames", "frames_left_out")},
        left_out=left_out,
        out=out,
    )
    return exit_code([status])


def _mountings(
    lake: Lake,
    fleet: FleetConfig,
    days: Sequence[Partition],
    kind: str,
    method: str,
    sensors: Sequence[str],
    *,
    force: bool,
) -> tuple[dict[Partition, Mounting], list[dict[str, str]]]:
    """The calibration of each vehicle-day, and the vehicle-days without one, with the reason."""
    known, without = {}, []
    for day in days:
        try:
            known[day] = _mounting(lake, fleet, day, kind, method, sensors, force=force)
        except (ConfigError, SolveError) as err:
            if isinstance(err, ConfigError) and err.key == "sensor":
                raise
            without.append(_left_out(day, str(err)))
    return known, without


def _left_out(day: Partition, reason: str) -> dict[str, str]:
    return {"vehicle": day.vehicle, "day": day.day, "reason": reason}


# The calibration of a day: a vehicle's state, the day's records, or the prior.


def _mounting(
    lake: Lake,
    fleet: FleetConfig,
    day: Partition,
    kind: str,
    method: str,
    sensors: Sequence[str],
    *,
    force: bool,
) -> Mounting:
    """Poses of the named sensors (no name: all) on one vehicle-day, from the chosen kind of calibration.

    Raises:
        ConfigError: there is no such calibration, or the rig has no sensor of that name.
        SolveError: fewer than two sensors have a pose, or the state starts after that day.
    """
    rig = fleet.rig_of(day.vehicle)
    unknown = [name for name in sensors if name not in rig.sensors]
    if unknown:
        problem = f"no {', '.join(unknown)}: the rig of {day.vehicle} has {', '.join(rig.sensors)}"
        raise ConfigError("command line", "sensor", problem)
    of_prior = kind == "prior"
    found = _of_prior(lake, fleet, day) if of_prior else _of_calibration(lake, day, kind, method, force=force)
    T = {n: T for n, T in found.T.items() if not sensors or n in sensors}
    if len(T) < 2:
        problem = f"{found.source} has poses of {', '.join(T) or 'no sensor'}, and a frame needs two"
        raise SolveError(problem)
    return replace(found, T=T)


def _of_prior(lake: Lake, fleet: FleetConfig, day: Partition) -> Mounting:
    manifest, rig = ingested(lake, day), fleet.rig_of(day.vehicle)
    prior = rig_prior((manifest.extra if manifest else {}).get(PRIOR, ()), fleet, rig)
    reference = prior.reference.name
    T = {n: T for n in rig.sensors if (T := prior.between(reference, n)) is not None}
    about = {}
    for name in T:
        turn, shift = prior.sigmas_between(reference, name) if name != reference else (0.0, 0.0)
        about[name] = _about("prior", [float(np.degrees(turn))] * 3, [shift] * 3)
    without = {name: "no transform joins it to the others" for name in rig.sensors if name not in T}
    return Mounting(f"prior of {day.day}", reference, T, about, prior.between(BASE.name, reference), without)


def _of_calibration(lake: Lake, day: Partition, kind: str, method: str, *, force: bool) -> Mounting:
    of_day = day.day if kind == "day" else None
    found = read_calibration(str(lake), day.vehicle, of_day, method, force=force)
    reference = found.reference.name
    T, about = {reference: np.eye(4)}, {reference: _about("reference", [0.0] * 3, [0.0] * 3)}
    for sensor in (s.name for s in found.sensors if s.name != reference):
        pose = found.between(reference, sensor)
        if pose is None:
            continue
        pairs, status = pairs_to(found, sensor)
        for since in (pair.details.get("since") for pair in pairs):
            if since and str(since) > day.day:
                counts = f"{found.source} counts since {since} (--calibration day takes each day's own)"
                raise SolveError(f"{sensor} moved: {counts}")
        sigma = list((sigmas_of(*pose) or {}).values())
        T[sensor] = pose[0]
        about[sensor] = _about(status, [float(np.degrees(s)) for s in sigma[:3]] or None, sigma[3:] or None)
        if at_prior := sorted({dof for pair in pairs for dof in pair.at_prior}):
            about[sensor] |= {"kept_at_prior": at_prior}  # or no check covers them
    return Mounting(found.source, reference, T, about, found.T_base, dict(found.left_out))


def _about(
    status: str, rotation_deg: list[float] | None, translation_m: list[float] | None
) -> dict[str, Any]:
    return {"status": status, "sigma_rotation_deg": rotation_deg, "sigma_translation_m": translation_m}
