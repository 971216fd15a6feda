"""`boresight calibrate`: observations of one vehicle-day to calibration records."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from jobs.terminal.summary import exit_code, print_summary, progress_reporter
from pipeline.calibrate.methods import method_named
from pipeline.core.config import load_fleet
from pipeline.core.errors import ConfigError
from pipeline.core.stage_work import Task
from pipeline.core.stages import CALIBRATE
from pipeline.fleet.ledger import record_outcome
from pipeline.report.reading import scene_of
from pipeline.rig.day_prior import require_named_files
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import perceived
from schemas.words import day_word

__all__ = ["calibrate", "parse_pair"]


# The parameters of a command are its options: more than eight, because a user sets each of them.
def calibrate(
    *,
    fleet: Path,
    lake: str,
    vehicle: str,
    day: str,
    method: str = "joint",
    perturb: str | None = None,
    seed: int | None = None,
    frame: int | None = None,
    page: Path | None = None,
    polish: bool = False,
) -> int:
    """Estimate the poses between a vehicle's sensors on one day, with their uncertainty.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
        method: joint; tracking, pairwise-optimisation, joint-optimisation; networks: pairwise-ssl, joint-ssl.
        perturb: ROT_DEG,TRANS_M: move the prior by exactly this much, for tests.
        seed: random seed; default: the seed of the configuration.
        frame: frame_index or stamp_ns of one frame, calibrated alone by a network (joint-ssl unless --method
            names another). Writes no record; the summary contains the transforms.
        page: HTML page to write for that frame, before and after.
        polish: refine the networks' result with the optimiser, as solve.polish in fleet.toml does.
    """
    if page is not None and frame is None:
        raise ConfigError(
            "command line", "page", "shows one frame: name it by --frame (for a day: boresight report)"
        )
    method_named(method)
    config = load_fleet(fleet)
    require_named_files(config)
    if polish:
        config = config.changed(solve={"polish": True})
    shifted = None if perturb is None else parse_pair(perturb, "perturb")
    task = Task(config, Lake.at(lake), Partition(vehicle, day), method, seed, shifted)
    if frame is None:
        return _calibrate_day(task)
    return _calibrate_frame(replace(task, method="joint-ssl") if method == "joint" else task, frame, page)


def _calibrate_day(task: Task) -> int:
    """Calibrate the day, write its records to the lake and print their statuses."""
    vehicle, day = task.partition.vehicle, task.partition.day
    task.fleet.rig_of(vehicle)  # raises for an unknown vehicle
    if perceived(task.lake, task.partition) is None:
        problem = (
            f"the lake has no observations of {vehicle} on {day}: run `boresight ingest` and `perceive` first"
        )
        raise ConfigError("command line", "day", problem)
    with progress_reporter(f"calibrate {vehicle} {day}") as progress:
        outcome = CALIBRATE.run(replace(task, progress=progress))
    record_outcome(task.lake, outcome, task.method or "")
    word = day_word(status for status, pairs in outcome.kept.items() if pairs)
    word = outcome.status if word == "done" else word  # or "cached"
    print_summary(
        "calibrate",
        word,
        vehicle=outcome.vehicle,
        day=outcome.day,
        method=task.method,
        pairs=outcome.kept,
        reason=outcome.reason,
        work_key=outcome.work_key,
        outputs=outcome.outputs,
    )
    return exit_code([word])


def _calibrate_frame(task: Task, frame: int, page: Path | None) -> int:
    """Calibrate one frame, print its transforms, and write its page if a path is given."""
    from pipeline.calibrate.networks import calibrate_frame

    partition = task.partition
    with progress_reporter(f"calibrate {partition.vehicle} {partition.day}") as progress:
        progress(0, 0, f"frame {frame}")
        found = calibrate_frame(task, frame)
        if page is not None:
            from pipeline.report.pictures import write_frame_page

            progress(0, 0, "page")
            title = f"{partition.vehicle}, {partition.day}, frame {found.frame.frame_index}"
            scene = scene_of(found.frame, found.observation, task.fleet.report)
            write_frame_page(page, scene, found.prior, found.solution, title)
    estimates = {
        pair: {
            "T": estimate.T,
            "T_prior": found.prior.of(pair),
            "covariance": estimate.covariance,
            "observable": estimate.observable,
            "diagnostics": estimate.diagnostics,
        }
        for pair, estimate in found.solution.pairs.items()
    }
    print_summary(
        "calibrate",
        "done",
        vehicle=partition.vehicle,
        day=partition.day,
        method=task.method,
        frame_index=found.frame.frame_index,
        stamp_ns=found.frame.stamp_ns,
        page=page,
        estimates=estimates,
        reason="one frame: no verdict and no record",
    )
    return 0


def parse_pair(text: str, option: str) -> tuple[float, float]:
    """Parse "ROT_DEG,TRANS_M" to (degrees, metres); a ConfigError names `option`."""
    try:
        rotation_deg, translation_m = (float(part) for part in text.split(","))
    except ValueError as err:
        raise ConfigError("command line", option, f"{text!r} is not ROT_DEG,TRANS_M, as in 2,0.1") from err
    if not (0 <= rotation_deg < 180 and 0 <= translation_m < 1e3):
        raise ConfigError("command line", option, f"{text!r}: degrees must be in 0..180, metres must be >= 0")
    return rotation_deg, translation_m
