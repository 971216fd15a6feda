"""Study: what the car's way (Doppler against the road) is worth beside a network, for the radar's elevation.

    python -m tests.benchmarks.studies.ssl_way --model FILE.onnx [--days ROOT/DAY ...] [--real FOLDER] [--frames 4]

Days of `days.generate_day` whose images were kept, and a folder with a real vehicle-day as `ssl_photographs` takes it.
Each day, from Table 1's start, is answered once by the network and then with the way; so are single frames, knocked by
5 deg / 5 cm. Errors of lidar_radar and camera_radar elevation at the paper's targets, against the mounting. What was
measured already is kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import SolveError
from pipeline.extrinsics.estimates import Prior, Solution
from pipeline.geometry.targets import errors_at_targets
from pipeline.learn.infer.frame_network import FrameNetwork
from pipeline.learn.infer.onnx_networks import open_networks
from pipeline.learn.infer.pitch_by_travel import informed_by_way
from pipeline.learn.infer.vehicle_day import single_frame_solution, solve_by_networks
from pipeline.store.views import frames_of
from schemas.calibrations import PAIRS
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.days import DATE, VEHICLE
from tests.benchmarks.studies.ssl_days import ModelSet, SslDay, Where, open_day
from tests.benchmarks.studies.ssl_measures import STARTS
from tests.benchmarks.studies.ssl_photographs import real_day

_RADAR_PAIRS = ("camera_radar", "lidar_radar")


def day_told(networks: list[FrameNetwork], day: SslDay) -> dict[str, Any]:
    """Elevation errors [deg] of the day without and with the way, and what the way says of the network's pitch."""
    prior = day.prior(*STARTS["prior"], seed=day.where.seed)
    solution = solve_by_networks(
        dict.fromkeys(PAIRS, day.rows),
        prior,
        networks=networks,
        frames=lambda wanted: frames_of(day.lake, day.partition, wanted),
        method="joint-ssl",
        seed=day.where.seed,
    )
    return _told(day, solution, informed_by_way(solution, day.rows, prior))


def frames_told(networks: list[FrameNetwork], day: SslDay, count: int) -> list[dict[str, Any]]:
    """The same of single frames."""
    told = []
    for k, (row, frame) in enumerate(zip(*day.spread(count), strict=True)):
        prior: Prior = day.prior(*STARTS["abrupt 5"], seed=1000 * day.where.seed + k)
        wide = replace(prior, rotation_sigma_rad=float(np.radians(5.0)))
        try:
            solution = single_frame_solution(frame, row, wide, networks=networks, method="joint-ssl", seed=k)
        except SolveError:
            continue
        told.append(_told(day, solution, informed_by_way(solution, [row], wide)))
    return told


def _told(day: SslDay, without: Solution, with_way: Solution) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for pair in _RADAR_PAIRS:
        errors = [errors_at_targets(pair, s.pairs[pair].T, day.true_of(pair))[1] for s in (without, with_way)]
        said = with_way.pairs[pair].diagnostics
        offsets = [said.get(f"doppler_pitch_{name}_rad", np.nan) for name in ("offset", "sigma")]
        out[pair] = {
            "without_deg": round(float(np.degrees(errors[0])), 3),
            "with_deg": round(float(np.degrees(errors[1])), 3),
            "way_deg": [None if np.isnan(v) else round(float(np.degrees(v)), 3) for v in offsets],
        }
    return out


def summary(results: Mapping[str, Any]) -> str:
    """A table of Markdown: elevation without / with the way, the day and the mean of its single frames."""
    lines = ["Elevation [deg] without / with the car's way: the day; (mean of single frames):", ""]
    lines += [f"| day | {' | '.join(_RADAR_PAIRS)} |", "|---|---|---|"]
    for name, told in results.items():
        cells = []
        for pair in _RADAR_PAIRS:
            kinds = ("without_deg", "with_deg")
            day = " / ".join(f"{told['day'][pair][k]:.2f}" for k in kinds)
            frames = [np.mean([f[pair][k] for f in told["frames"]]) for k in kinds] if told["frames"] else []
            cells.append(f"{day} ({' / '.join(f'{v:.2f}' for v in frames)})")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure what is missing, write, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--days", type=Path, nargs="*", default=[], help="folders of days with images")
    parser.add_argument("--real", type=Path, help="folder with fleet.toml and lake")
    parser.add_argument("--frames", type=int, default=4, help="single frames of each day")
    parser.add_argument("--out", type=Path, default=Path("tests/benchmarks/results/ssl_way.json"))
    args = parser.parse_args()
    models = ModelSet("network", (args.model.resolve(),))
    results: dict[str, Any] = json.loads(args.out.read_text()) if args.out.exists() else {}
    days = [open_day(Where(f, VEHICLE, DATE, int(f.name.split("_")[3]))) for f in args.days]
    for day in [*days, *([real_day(args.real)] if args.real else [])]:
        name = day.where.name if day.where.folder in args.days else "real"
        if name in results:
            continue
        learn = models.configured(day.fleet).learn
        networks: list[FrameNetwork] = [*open_networks(models.by_name, learn, day.fleet.prepare)]
        told = {"day": day_told(networks, day), "frames": frames_told(networks, day, args.frames)}
        about = {"network": models.key, "commit": commit_now(), "date": time.strftime("%Y-%m-%d")}
        results[name] = told | about
        args.out.write_text(json.dumps(results, indent=1) + "\n")
        args.out.with_suffix(".md").write_text(summary(results) + "\n")
    print(summary(results))


if __name__ == "__main__":
    main()
