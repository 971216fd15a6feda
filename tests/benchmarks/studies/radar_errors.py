"""Study: what a radar's own errors do to its roll and pitch, and what static elevations by themselves say of roll.

    python tests/benchmarks/studies/days.py generate --root DAYS --sets dev dev-basin
    python tests/benchmarks/studies/radar_errors.py --root DAYS
    python tests/benchmarks/studies/radar_errors.py --root DAYS --real

On tuning days, with the camera where it is: as perceived, with a constant elevation error of 1 deg, and with one
detection in six seen by way of the road. Then a witness of roll that matches no detection with a lidar point: the
detections' elevations over azimuth against the mean elevation of what the lidar sees there, whose constant (the radar's
own error) and scale (radars see the lower parts of trees and houses) are states. On the real day, which has no truth,
this is against the logged calibration.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.config import SolveConfig
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.spherical import to_spherical
from pipeline.objective.radar import travel
from schemas.observations import Observation
from tests.benchmarks.studies.days import REAL, SETS, Day, DaySpec, load_day
from tests.benchmarks.studies.engine import Run, prior_of
from tests.benchmarks.studies.metrics import rms
from tests.makers.radar_errors import bounced, elevated

ERROR_DEG, BOUNCED_SHARE = 1.0, 1 / 6
_REAL_DT_S = 0.02  # what three real days agree on
_PASSES, _BLOCK, _DRAWS = 8, 3, 40
Array = NDArray[np.float64]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument(
        "--seeds", type=int, nargs="*", help="of the tuning days that there are; all by default"
    )
    parser.add_argument("--real", action="store_true", help="only roll by elevations on the adopted real day")
    args = parser.parse_args()
    if args.real:
        _print_roll([REAL], args.root)
        return
    tuning = [s for s in (*SETS["dev"], *SETS["dev-basin"]) if (args.root / s.name).exists()]
    specs = [s for s in tuning if args.seeds is None or s.seed in args.seeds]
    _print_errors(specs, args.root)
    _print_roll(specs, args.root)


def _print_errors(specs: Sequence[DaySpec], root: Path) -> None:
    print("| day | roll, pitch error / sigma [deg] | moved by 1 deg of elevation error | moved by bounce |")
    print("|---|---|---|---|")
    moves = []
    for spec in specs:
        day = load_day(spec, root)
        rows = (
            day.rows,
            elevated(day.rows, float(np.radians(ERROR_DEG))),
            bounced(day.rows, day.true_of("lidar_radar"), BOUNCED_SHARE, np.random.default_rng(1)),
        )
        (error, sigma), *others = (_tilt_deg(day, each) for each in rows)
        moved = [other - error for other, _ in others]
        moves.append(moved)
        cells = [f"{error} / {sigma}", *(str(m) for m in moved)]
        print(f"| {spec.name} | {' | '.join(cells)} |", flush=True)
    by_error, by_bounce = np.swapaxes(np.array(moves), 0, 1)
    print(
        f"\nMean by elevation error {by_error.mean(0)}, largest of roll {np.abs(by_error[:, 0]).max():.2f};"
    )
    print(f"mean by bounce {by_bounce.mean(0)}, RMS of pitch {rms(by_bounce[:, 1]):.2f}\n")


def _tilt_deg(day: Day, rows: list[Observation]) -> tuple[Array, Array]:
    """Error of roll and pitch against where detections point, and sigma."""
    prior = prior_of(day, Run(day.spec).prior, day.spec.seed)
    found = estimate_lidar_radar(rows, prior, SolveConfig(), np.random.default_rng(0))
    error = change_between(day.pointing_of("lidar_radar"), found.T)
    sigma = np.sqrt(np.diag(change_covariance(found.T, found.covariance)))
    return np.degrees(error[:2]).round(2), np.degrees(sigma[:2]).round(2)


def _print_roll(specs: Sequence[DaySpec], root: Path) -> None:
    print("| day | roll by static elevations over azimuth [deg] | scale |\n|---|---|---|")
    found = []
    for spec in specs:
        day = load_day(spec, root)
        T, dt_s = day.pointing_of("lidar_radar"), day.truth.get("dt_lidar_radar_s", _REAL_DT_S)
        assert isinstance(dt_s, float)
        table = np.concatenate([_elevations(o, k, T, dt_s) for k, o in enumerate(day.rows)])
        roll, scale = _fit(table, np.ones(len(table)))
        rng, blocks = np.random.default_rng(0), (table[:, 0] // _BLOCK).astype(int)
        count = blocks.max() + 1
        drawn = [
            _fit(table, np.bincount(rng.integers(0, count, count), minlength=count)[blocks].astype(float))[0]
            for _ in range(_DRAWS)
        ]
        found.append(roll)
        print(f"| {spec.name} | {roll:+.2f} +- {np.std(drawn):.2f} | {scale:.2f} |", flush=True)
    print(f"\nRMS {rms(found):.2f}")


def _elevations(o: Observation, k: int, T_lidar_radar: Array, dt_s: float) -> Array:
    """Rows of (frame, azimuth, elevation, mean elevation of the lidar there) of static detections."""
    if o.radar_velocity_mps is None or not o.radar_has_elevation:
        return np.zeros((0, 4))
    xyz = o.radar_xyz_m[o.radar_motion == 0].astype(np.float64)
    aer = to_spherical(xyz)
    lidar = travel._lidar_elevation(o, T_lidar_radar, dt_s, xyz)  # the instrument of the car's way
    return np.column_stack([np.full(len(xyz), k), aer[:, :2], lidar])[np.isfinite(lidar)]


def _fit(table: Array, weight: Array) -> tuple[float, float]:
    """Roll [deg] by which the radar has to be turned, and scale, robustly (Cauchy); a constant is the third state."""
    _, azimuth, elevation, lidar = table.T
    # Turned by r about its x axis, the radar sees what stands at azimuth a lower by r sin(a).
    A = np.stack([-np.sin(azimuth), lidar, np.ones_like(lidar)], 1)
    w, x = weight, np.zeros(3)
    for _ in range(_PASSES):
        x = np.linalg.lstsq((A.T * w) @ A, (A.T * w) @ elevation, rcond=None)[0]
        r = elevation - A @ x
        w = weight / (1 + (r / (2 * 1.4826 * np.median(np.abs(r)))) ** 2)
    return float(np.degrees(x[0])), float(x[1])


if __name__ == "__main__":
    main()
