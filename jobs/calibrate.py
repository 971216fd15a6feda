"""`boresight calibrate`: observations of one vehicle-day to calibration records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.config import FleetConfig
    from pipeline.store.partitions import Lake, Partition

__all__ = ["calibrate", "parse_pair", "parse_perturb"]


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
    """Find out how the vehicle's sensors sat relative to each other on that day, and how sure that is.

    Args:
        fleet: fleet.toml.
        lake: folder of the tables.
        vehicle: vehicle id, as in fleet.toml.
        day: YYYY-MM-DD.
        method: joint; tracking, pairwise-optimisation, joint-optimisation; or by networks: pairwise-ssl, joint-ssl.
        perturb: ROT_DEG,TRANS_M: move the prior on purpose by exactly this much, for tests.
        seed: of everything random; the configuration's where left out.
        frame: frame_index or stamp_ns: calibrate from this frame alone, by a network (joint-ssl where no SSL method
            is named). Nothing is recorded; the summary holds the transforms.
        page: HTML page of that frame, before and after.
        polish: let the optimiser finish from the networks' answer, as solve.polish in fleet.toml.
    """
    from pipeline.config import load_fleet
    from pipeline.errors import ConfigError
    from pipeline.store.partitions import Lake, Partition

    if page is not None and frame is None:
        raise ConfigError(
            "command line", "page", "is of one frame: name it by --frame (days: boresight report)"
        )
    config = load_fleet(fleet)
    if polish:
        config = config.changed(solve={"polish": True})
    partition, tables, moved = Partition(vehicle, day), Lake.at(lake), parse_perturb(perturb)
    if frame is not None:
        ssl = "joint-ssl" if method == "joint" else method
        return _calibrate_frame(config, tables, partition, frame, ssl, moved, seed, page)
    return _calibrate_day(config, tables, partition, method, moved, seed)


def _calibrate_day(
    config: FleetConfig,
    lake: Lake,
    partition: Partition,
    method: str,
    perturb: tuple[float, float] | None,
    seed: int | None,
) -> int:
    """The day's records in the lake, their statuses in the summary."""
    from jobs.terminal.summary import exit_code, print_summary, progress_reporter
    from pipeline.calibrate.stage import calibrate_day

    with progress_reporter(f"calibrate {partition.vehicle} {partition.day}") as progress:
        result = calibrate_day(
            partition,
            config,
            lake,
            method=method,
            perturb=perturb,
            seed=seed,
            progress=progress,
        )
    print_summary(
        "calibrate",
        result.status,
        vehicle=partition.vehicle,
        day=partition.day,
        method=method,
        pairs=result.kept,
        reason=result.reason,
        work_key=result.work_key,
        outputs=result.outputs,
    )
    return exit_code([result.status, *(status for status, pairs in result.kept.items() if pairs)])


def _calibrate_frame(
    config: FleetConfig,
    lake: Lake,
    partition: Partition,
    frame: int,
    method: str,
    perturb: tuple[float, float] | None,
    seed: int | None,
    page: Path | None,
) -> int:
    """One frame's transforms in the summary, and its page where one is wanted."""
    from jobs.terminal.summary import print_summary
    from pipeline.calibrate.networks import calibrate_frame

    found = calibrate_frame(partition, config, lake, frame, method=method, perturb=perturb, seed=seed)
    if page is not None:
        from pipeline.report.frame import write_frame_page

        title = f"{partition.vehicle}, {partition.day}, frame {found.frame.frame_index}"
        write_frame_page(page, found.frame, found.observation, found.prior, found.solution, title)
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
        method=method,
        frame_index=found.frame.frame_index,
        stamp_ns=found.frame.stamp_ns,
        page=page,
        estimates=estimates,
        reason="one frame: nothing judges it and nothing is recorded",
    )
    return 0


def parse_perturb(text: str | None) -> tuple[float, float] | None:
    """(degrees, metres) of "ROT_DEG,TRANS_M"; None stays None.

    Raises:
        ConfigError: not two numbers >= 0.
    """
    return None if text is None else parse_pair(text, "perturb")


def parse_pair(text: str, option: str) -> tuple[float, float]:
    """(degrees, metres) of "ROT_DEG,TRANS_M"; `option` names the culprit.

    Raises:
        ConfigError: not two numbers >= 0.
    """
    from pipeline.errors import ConfigError

    try:
        rotation_deg, translation_m = (float(part) for part in text.split(","))
    except ValueError as err:
        raise ConfigError("command line", option, f"{text!r} is not ROT_DEG,TRANS_M, as in 2,0.1") from err
    if not (0 <= rotation_deg < 180 and 0 <= translation_m < 1e3):
        raise ConfigError("command line", option, f"{text!r}: degrees must be in 0..180, metres must be >= 0")
    return rotation_deg, translation_m
