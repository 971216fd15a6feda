"""Study: what a day tells of focal length, principal point and readout time, and when CameraInfo is contradicted.

    python tests/benchmarks/studies/intrinsics.py --root DAYS

Ten days of seven rigs, two of them at dusk (tuning seeds: the floors of `intrinsics` were chosen on them as they are,
on none of them with a fault), each as it is and with CameraInfo's focal length 3 % and 1 % off, its principal point 20
and 4 px off to the right and down. Camera-lidar is aligned from a prior 2 deg and 5 cm off (drawn); measured are the
day's own focal length and principal point against the true ones, and whether the record would be held for them.

The readout time is profiled on the days as they are, and on two of rig `rolling` (30 ms) with the shutter taken for a
global one: points exposed at each value, the pose solved again, a parabola through the scores.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.calibrate.joint.camera_lidar.estimate import Aligned, align_camera_lidar
from pipeline.calibrate.joint.camera_lidar.intrinsics import DayIntrinsics, contradictions
from pipeline.calibrate.joint.camera_lidar.observability import IS_TZ
from pipeline.calibrate.joint.camera_lidar.refine import Scored, refine
from pipeline.calibrate.joint.camera_lidar.time_offset import FOCAL
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.days import Day, DaySpec, load_day
from tests.benchmarks.studies.engine import RESULTS, prior_of, search_range, spoiled

PRIOR = ("drawn", 2.0, 0.05)
FAULTS = ("", "focal:0.03", "focal:-0.03", "focal:0.01", "focal:-0.01", "centre:20", "centre:-20", "centre:4")
DUSK = "camera:dusk:1"
DAYS = (
    DaySpec(190, "highway", rig="truck"),
    DaySpec(191, "urban"),
    DaySpec(192, "mixed", rig="ring16"),
    DaySpec(193, "highway", rig="spin128", fault=DUSK),
    DaySpec(194, "urban", rig="demo"),
    DaySpec(195, "mixed", rig="fisheye"),
    DaySpec(196, "highway", rig="pinhole"),
    DaySpec(197, "urban", rig="rosette", fault=DUSK),
    DaySpec(198, "mixed", rig="truck"),
    DaySpec(199, "highway"),
)
ROLLING = (DaySpec(181, "mixed", rig="rolling"), DaySpec(183, "mixed", rig="rolling"))
READOUTS_S = (-0.04, -0.02, 0.0, 0.02, 0.04, 0.06)
_STEPS = 2  # of the pose at each readout time


@dataclass(frozen=True, eq=False)
class Measured:
    """One day with one fault: what it told, and what is true of CameraInfo."""

    day: DaySpec
    fault: str
    found: DayIntrinsics
    true_focal: float
    true_centre_px: np.ndarray
    told: tuple[str, ...]


def main() -> None:
    """Measure every day with every fault, then write and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="days that days.py generated")
    parser.add_argument("--out", type=Path, default=RESULTS / "intrinsics.md")
    args = parser.parse_args()
    results, readouts, commit = [], [], commit_now()
    for spec in (*DAYS, *ROLLING):
        day = load_day(spec, args.root)
        for fault in FAULTS if spec in DAYS else ("",):
            result, aligned = measure(day, fault)
            results.append(result)
            print(*_line(result), sep=" | ", flush=True)
            if not fault:
                readouts.append((spec, readout_s(aligned)))
    text = "\n".join([f"Calibrated by commit {commit}.", "", *_tables(results), "", *_readouts(readouts)])
    args.out.write_text(text + "\n")
    print(text)


def measure(day: Day, fault: str) -> tuple[Measured, Aligned]:
    """Align a day whose CameraInfo has a fault, and compare its intrinsics with the true ones."""
    prior = prior_of(day, PRIOR, day.spec.seed)
    config = day.fleet.solve.model_copy(update=search_range(PRIOR))
    rows = spoiled(day.rows, fault)
    aligned = align_camera_lidar(rows, prior, config, np.random.default_rng([day.spec.seed, 0]))
    true, logged = np.array(day.truth["camera_K"], np.float64).reshape(3, 3), rows[0].camera_K
    told = contradictions(aligned.intrinsics, prior.camera)
    off = true[:2, 2] - logged[:2, 2]
    result = Measured(day.spec, fault, aligned.intrinsics, true[0, 0] / logged[0, 0], off, tuple(told))
    return result, aligned


def readout_s(aligned: Aligned) -> float:
    """Where a parabola through the scores at READOUTS_S is highest [s]; nan where it has no top."""
    problem = aligned.problem
    fixed, scores = IS_TZ | (np.arange(8) == FOCAL), []
    for value in READOUTS_S:
        # 1 ns stands for none: `exposed_at` leaves points alone at 0, where an earlier readout may have moved them.
        terms = replace(problem.terms, readout_s=value or 1e-9).exposed_at(aligned.state.alone)
        scored = Scored(terms, aligned.kernel, problem.prior, problem.config)
        state = refine(scored, aligned.state, steps=_STEPS, fixed=fixed)
        scores.append(float(terms.score(state.alone, aligned.kernel).sum()))
    bend, slope, _ = np.polyfit(READOUTS_S, scores, 2)
    return float(-slope / (2 * bend)) if bend < 0 else float("nan")


def _line(r: Measured) -> Iterator[str]:
    found, off = r.found, r.found.centre_px - r.true_centre_px
    yield f"{r.day.name} {r.fault or 'as it is'}"
    yield f"focal {found.focal - 1:+.2%} +- {found.focal_sigma:.2%}, true {r.true_focal - 1:+.2%}"
    (right, down), (right_sigma, down_sigma) = off, found.centre_sigma_px
    yield f"right {right:+.1f} +- {right_sigma:.1f}, down {down:+.1f} +- {down_sigma:.1f} px off"
    yield "held" if r.told else ""


def _tables(results: list[Measured]) -> Iterator[str]:
    yield "| CameraInfo | days | held for focal length | for principal point | focal length off, RMS [%] | its z, RMS |"
    yield "|---|---|---|---|---|---|"
    for fault in FAULTS:
        of = [r for r in results if r.fault == fault]
        off = np.array([r.found.focal - r.true_focal for r in of])
        z = off / [r.found.focal_sigma for r in of]
        counts = [sum(any(what in t for t in r.told) for r in of) for what in ("focal length", "principal")]
        row = (len(of), *counts, f"{100 * _rms(off):.2f}", f"{_rms(z):.2f}")
        yield f"| {fault or 'as it is'} | {' | '.join(map(str, row))} |"
    yield ""
    yield "| rig | principal point off, right and down [px], RMS | its sigma | z, RMS |"
    yield "|---|---|---|---|"
    for rig in dict.fromkeys(r.day.rig for r in results):
        of = [r for r in results if r.day.rig == rig]
        off = np.array([r.found.centre_px - r.true_centre_px for r in of])
        sigma = np.array([r.found.centre_sigma_px for r in of])
        columns = (off, sigma, off / sigma)
        cells = ["{:.1f}, {:.1f}".format(*np.sqrt((c**2).mean(0))) for c in columns]
        yield f"| {rig} | {' | '.join(cells)} |"


def _readouts(readouts: list[tuple[DaySpec, float]]) -> Iterator[str]:
    yield "| day | readout time by its profile [ms] |"
    yield "|---|---|"
    for spec, value in readouts:
        yield f"| {spec.name} | {1e3 * value:+.0f} |"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
