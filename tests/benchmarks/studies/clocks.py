"""Study: does `joint` calibrate sensors without a common trigger, and late ones, as well as triggered ones?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets clocks
    python tests/benchmarks/studies/clocks.py --root DAYS --workers 2

Six drives of 40 frames, urban and highway in turn, each driven with several kinds of clocks: triggered by the lidar
within a few milliseconds; running freely at 30, 10 and 13 Hz; triggered with stamps that lie (camera 60 ms late, radar
60 ms early, the measurements themselves together); four of them triggered, with a camera that measures 60 ms before its
stamp. Ratios are to the same drives triggered.
Every vehicle has delays of its own besides (12 and -18 ms, scattering by 4 ms).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import rms, share

CLOCKS = ("triggered", "free-running", "stamps 60 ms off", "camera 60 ms late")
_COLUMNS = (
    ("camera_lidar", "az_deg"),
    ("camera_lidar", "el_deg"),
    ("lidar_radar", "az_deg"),
    ("lidar_radar", "range_m"),
)


def main() -> None:
    """Run what is missing, then print the table."""
    args = study_arguments(__doc__ or "", "clocks").parse_args()
    days = SETS["dev-clocks" if args.tuning else "clocks"]
    runs = [Run(day, seed=day.seed) for day in days]
    triggered = [day for day in days if clock_of(day.rig, day.fault, "") == CLOCKS[0]]
    runs += [Run(day, seed=day.seed, spoil="stamps:0.06") for day in triggered]
    run_study(runs, args, summary)


def clock_of(rig: str, fault: str, spoil: str) -> str:
    """Which of CLOCKS a run's day has."""
    if spoil:
        return CLOCKS[2]
    return CLOCKS[3] if fault else CLOCKS[1] if rig == "paper-free" else CLOCKS[0]


def summary(results: list[dict[str, Any]]) -> str:
    """Per kind of clocks: RMS errors, their ratios to triggered sensors, accepted pairs, offsets, sigmas."""
    by_clock = {
        clock: [r for r in results if clock_of(r["day"]["rig"], r["day"]["fault"], r["spoil"]) == clock]
        for clock in CLOCKS
    }
    lines = [
        "| clocks | days | CL az / el [deg] | LR az [deg] / range [m] | ratios | accepted | dt in 5 ms | 1, 3 sigma |",
        "|---|---|---|---|---|---|---|---|",
    ]
    base = by_clock[CLOCKS[0]]
    for clock, rows in by_clock.items():
        if rows:
            seeds = {r["day"]["seed"] for r in rows}
            lines.append(_row(clock, rows, [r for r in base if r["day"]["seed"] in seeds]))
    lines += [
        "",
        "RMS errors of camera-lidar (CL), then lidar-radar (LR), and their ratios to those of triggered sensors.",
        "Sigmas: share of the pose's six unknowns within 1 and 3 of them.",
        "",
        "Per drive: azimuth [deg], elevation [deg], range [m], error of the time offset [ms].",
        "",
        "| drive | clocks | camera-lidar | lidar-radar |",
        "|---|---|---|---|",
    ]
    for r in sorted(results, key=lambda r: r["day"]["seed"]):
        clock = clock_of(r["day"]["rig"], r["day"]["fault"], r["spoil"])
        cells = [_cell(r["pairs"].get(pair, {})) for pair in ("camera_lidar", "lidar_radar")]
        lines.append(f"| {r['day']['seed']} {r['day']['environment']} | {clock} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _row(clock: str, rows: list[dict[str, Any]], base: list[dict[str, Any]]) -> str:
    own, triggered = ([rms(_values(r, *c)) for c in _COLUMNS] for r in (rows, base))
    ratios = " / ".join(f"{a / b:.2f}" for a, b in zip(own, triggered, strict=True)) if base else "-"
    accepted, offsets, sigmas = [], [], []
    for pair in ("camera_lidar", "lidar_radar"):
        pairs = [r["pairs"].get(pair, {}) for r in rows]
        accepted.append(f"{sum(p.get('status') == 'accepted' for p in pairs)}")
        error = np.array([p["dt_s"] - p["dt_true_s"] for p in pairs if "dt_s" in p])
        offsets.append(share(np.abs(error) <= 0.005))
        known = [p for p in pairs if "error" in p]
        z = np.abs(np.array([p["error"] for p in known]) / np.array([p["sigma"] for p in known]))
        sigmas.append(f"{100 * np.mean(z < 1):.0f} %, {100 * np.mean(z < 3):.0f} %")
    return (
        f"| {clock} | {len(rows)} | {own[0]:.3f} / {own[1]:.3f} | {own[2]:.3f} / {own[3]:.3f} | {ratios} "
        f"| {' / '.join(accepted)} | {' / '.join(offsets)} | {'; '.join(sigmas)} |"
    )


def _values(results: list[dict[str, Any]], pair: str, name: str) -> np.ndarray:
    return np.array([r["pairs"][pair][name] for r in results if name in r["pairs"].get(pair, {})])


def _cell(p: dict[str, Any]) -> str:
    if "az_deg" not in p:
        return p.get("reason", "refused")
    error_ms = f"{1e3 * (p['dt_s'] - p['dt_true_s']):+.1f}" if "dt_s" in p else "-"
    return f"{p['az_deg']:.3f} / {p['el_deg']:.3f} / {p['range_m']:.3f}, {error_ms}, {p['status']}"


if __name__ == "__main__":
    main()
