"""`boresight verify`: check the calibration that a car uses now against one log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numpy import degrees
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jobs.calibration_sources import FrameOptions, poses_in_use
from jobs.terminal.summary import print_json, print_summary, progress_reporter
from pipeline.core.config import FleetConfig, load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE, INGEST, PERCEIVE
from pipeline.export.files import reference_of_rig, star_text
from pipeline.report.comparison import in_use_view
from pipeline.report.stage import write_day_page
from pipeline.rig.day_prior import require_named_files
from pipeline.rig.graph import Sensor
from pipeline.store.partitions import Lake, Partition
from pipeline.store.records import read_records
from pipeline.verify.axes import (
    answer_of,
    answers_by_sensor,
    check_axes,
    errors_in_words,
    limits_of,
    probes,
    wrong_sensors,
)
from pipeline.verify.one_axis import AxisCheck
from pipeline.verify.one_log import check_poses, for_one_look, prior_in_use, with_prior
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.poses import POSES, PoseRow

__all__ = ["verify", "with_calibration"]

# Exit codes of its own: schedulers take 3 for success.
_EXIT_CODES = {"right": 0, "wrong": 4, "inconclusive": 5}
_NEXT_STEPS = {
    "wrong": "recalibrate with `boresight nightly`, then load what `boresight state` shows",
    "inconclusive": "repeat with a longer log of varied driving; the reasons are with each axis",
}
_ANY_CAR = "car"  # name of the log's vehicle where fleet.toml has all vehicles in one entry
_COLOUR = {"pass": "green", "warn": "yellow", "fail": "red", "inconclusive": "dim"}
_DAY = "2000-01-01"  # of the single vehicle-day of a temporary lake
# As many as `select.frames` selects for a calibration. On the one real drive tried, 60 left the radar
# undecided.
_FRAMES = 100


# The parameters of a command are its options: more than eight, because a user sets each of them.
def verify(
    *logs: Path,
    fleet: Path,
    calibration: str | None = None,
    lake: str | None = None,
    vehicle: str | None = None,
    camera_lidar_deg: float = 0.5,
    radar_deg: float = 1.0,
    frames: int = _FRAMES,
    page: Path | None = None,
    json: bool = False,
    named: FrameOptions | None = None,
) -> int:
    """Check the calibration in use against one log: pass, warn, fail or inconclusive per pair and axis.

    For a rig of many sensors: per sensor and axis, and right, wrong or undecided per sensor. Exit code 0: right, all
    axes that the pairs must determine pass or warn; 4: wrong, an axis fails; 5: inconclusive, the log cannot decide.

    Args:
        logs: MCAP files, ROS 1 bags, ROS 2 bag folders or .db3 files of one drive.
        fleet: fleet.toml: topics, and sizes of errors that matter ([verify]).
        calibration: calibration in use: JSON {"T_camera_lidar": 4x4, "T_lidar_radar": 4x4},
            FORMAT:FILE[,FILE] of `boresight export`, or [VEHICLE@]DAY or state of a lake. For a rig with more
            sensors: JSON {"reference": "top", "T": {"front": 4x4, ...}}, or one of the others. Default: the
            prior of fleet.toml (tf_static of the log, or its file).
        lake: folder of the tables, if the calibration is a day or a state in a lake.
        vehicle: vehicle of the log; default: the only one of fleet.toml, or any, where it has one entry for all.
        camera_lidar_deg: an axis passes only if an error of this size would have made it fail.
        radar_deg: the same limit for pairs with the radar.
        frames: number of frames of the log to use.
        page: HTML page to write, with pictures of both calibrations.
        json: print only one JSON object with every axis on stdout.
        named: frame names in the calibration's files.
    """
    if not logs:
        raise ConfigError("command line", "LOG", "name at least one log of the car")
    config, asked_deg = load_fleet(fleet), (camera_lidar_deg, radar_deg)
    name = _vehicle(config, vehicle)
    of_sensors = not config.rig_of(name).is_one_of_each
    config, lacking = for_one_look(config, frames), list[Sensor]()
    with TemporaryDirectory(prefix="boresight-verify-") as folder:
        if calibration is not None:
            in_use = Path(folder) / "in_use.json"
            config, lacking = with_calibration(
                in_use, config, name, calibration, lake, named or FrameOptions()
            )
        require_named_files(config)
        with progress_reporter(f"verify {name}") as progress:
            task = Task(
                config, Lake.at(Path(folder) / "lake"), Partition(name, _DAY), "joint",
                probe_deg=probes(asked_deg), logs=logs, progress=progress,
            )  # fmt: skip
            records = _calibrate(task)
            checks = _checks(task, records, lacking if of_sensors else None, asked_deg)
            if page is not None:
                view = in_use_view(answer_of(checks), [asdict(c) for c in checks], errors_in_words(checks))
                write_day_page(task.lake, task.partition, config, page, "joint", in_use=view)
    answer, sensors = answer_of(checks), answers_by_sensor(checks) if of_sensors else {}
    refused = sorted({r.reason for r in records if r.status == "refused"})
    undecided = [f"{c.pair} {c.axis}: {c.reason}" for c in checks if c.status == "inconclusive"]
    reason = {"right": [], "wrong": errors_in_words(checks), "inconclusive": undecided}[answer]
    told: dict[str, Any] = {"vehicle": name, "reason": "; ".join([*refused, *reason]), "page": page}
    told |= {"wrong_sensors": wrong_sensors(checks), "errors": errors_in_words(checks)}
    told |= {"next_steps": [_NEXT_STEPS[answer]] if answer in _NEXT_STEPS else []}
    told |= {"sensors": sensors} if of_sensors else {}
    told |= {"axes": [asdict(c) for c in checks]}
    if json:
        print_json({"answer": answer, **told})
    else:
        _print_table(checks, answer, sensors)
        print_summary("verify", answer, **told)
    return _EXIT_CODES[answer]


def _vehicle(config: FleetConfig, vehicle: str | None) -> str:
    if vehicle is not None:
        config.rig_of(vehicle)  # raises for an unknown vehicle
        return vehicle
    if len(config.vehicles) != 1:
        raise ConfigError("command line", "vehicle", f"name one of {sorted(config.vehicles)} with --vehicle")
    return next(iter(config.named_vehicles), _ANY_CAR)


def with_calibration(
    file: Path, config: FleetConfig, vehicle: str, calibration: str, lake: str | None, named: FrameOptions
) -> tuple[FleetConfig, list[Sensor]]:
    """Configuration with the calibration in use as prior, and the sensors that it lacks, in a rig of many.

    Args:
        file: written, unless the calibration is a prior file itself.

    Raises:
        ConfigError: neither a file nor a lake, or too few sensors; raised before a log is opened.
    """
    if calibration.endswith(".json") and ":" not in calibration:
        return config.with_prior_file(vehicle, Path(calibration)), []
    rig = config.rig_of(vehicle)
    poses, names = poses_in_use(calibration, lake, vehicle, rig, named)
    kept = {*poses, reference_of_rig(rig).name}
    if len(kept) < 2:
        raise ConfigError(calibration, "sensors", f"has none of {', '.join(n.name for n in rig.nodes)}")
    part = rig if rig.is_one_of_each else rig.of_sensors(kept)
    file.write_bytes(star_text(poses, names, part, "verify", [calibration]))
    lacking = [n for n in rig.nodes if n not in part.nodes]
    return config.with_rig(vehicle, part).with_prior_file(vehicle, file), lacking


def _calibrate(task: Task) -> list[CalibrationRecord]:
    """Records of the log, with the calibration in use as prior."""
    for stage in (INGEST, PERCEIVE):
        stage.run(task)
    vehicle = task.partition.vehicle
    prior = prior_in_use(task.fleet, task.lake, task.partition)
    if prior is not None and not prior.untied:  # else a sensor is silent: its prior stays as logged
        CALIBRATE.run(replace(task, fleet=with_prior(task.fleet, task.lake, vehicle, prior)))
    else:
        CALIBRATE.run(task)
    return read_records(task.lake, CALIBRATIONS, CalibrationRecord, vehicle=vehicle)


def _checks(
    task: Task,
    records: Sequence[CalibrationRecord],
    lacking: Sequence[Sensor] | None,
    asked_deg: tuple[float, float],
) -> list[AxisCheck]:
    """Checks per pair and axis; per sensor and axis with `lacking`, the sensors without a pose in use."""
    verify = task.fleet.verify
    if lacking is None:
        return [c for r in records for c in check_axes(r, limits_of(r.pair, verify, asked_deg), verify)]
    poses = read_records(task.lake, POSES, PoseRow, vehicle=task.partition.vehicle)
    prior = prior_in_use(task.fleet, task.lake, task.partition)
    return check_poses(poses, prior, lacking, verify, asked_deg, records)


def _print_table(checks: list[AxisCheck], answer: str, sensors: Mapping[str, str]) -> None:
    table = Table(title="The calibration in use", title_justify="left")
    headings = ("sensor" if sensors else "pair", "axis", "", "off [deg]", "sigma [deg]", "detects [deg]")
    for heading in headings:
        # Text: rich reads square brackets as styles.
        table.add_column(Text(heading), justify="right" if "deg" in heading else "left")
    for c in checks:
        found = [degrees(v) for v in (abs(c.off_rad), c.sigma_rad, c.shown_rad)]
        numbers = ["-" if isnan(value) else f"{value:.2f}" for value in found]
        table.add_row(c.pair, c.axis, f"[{_COLOUR[c.status]}]{c.status}[/]", *numbers)
    console = Console(stderr=True)
    console.print(table)
    for c in checks:
        if c.status == "inconclusive":
            console.print(f"{c.pair} {c.axis}: {c.reason}.", markup=False, highlight=False)
    for sentence in errors_in_words(checks):
        console.print(f"Wrong: {sentence}.", style="red", markup=False, highlight=False)
    for word in ("right", "wrong", "undecided"):
        if own := [sensor for sensor, found in sensors.items() if found == word]:
            console.print(f"{word}: {', '.join(own)}", markup=False, highlight=False)
    console.print(f"Is the calibration in use right: [bold]{answer}[/]")
