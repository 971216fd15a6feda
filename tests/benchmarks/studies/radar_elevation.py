"""Study: how far up does a radar look, how surely does `joint` say so, and do its witnesses agree?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets radar-elevation
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --workers 2
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --dirty --out OUT/radar_dirty.jsonl
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --convoys --out OUT/radar_convoys.jsonl
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --parts --out OUT/radar_parts.md

Twelve days of 40 frames from the prior that the logs carry, urban and highway: eight of the paper's sensors, four of a
16-ring lidar with an ambiguous radar; with `--dirty` 48 of six rigs whose radars are as dirty as real ones (set
radar-dirty; dev-dirty with `--tuning`), with `--convoys` six of them on highways alone. Errors are of lidar-radar's
elevation at the paper's three targets, against where the radar's detections point and against its mounting, which
differ by the radar's own constant error (.15 deg).

`--parts` asks the real car's day, which has no truth, whether its sigmas hold: pitch against the given calibration by
halves and quarters, without the term `doppler`, and without detections below the road; with `--tuning` the last of
dirty days, whose truth is known, as they are and with elevations as noisy as the real ones. A difference counts in two
sigmas: of both as if they shared nothing, and of what they do not share. Parts share a radar, so what all days err by
alike is in neither (`own` is without it); of what is left of a whole it is the difference of the variances (Hausman
1978). A part is not compared with the whole: that is half of what the halves differ by.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from pipeline.calibrate.joint.lidar_radar.estimate import estimate_lidar_radar
from pipeline.config import TERMS
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.geometry.se3 import transform_points
from pipeline.geometry.spherical import from_spherical, to_spherical
from schemas.observations import Observation
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.days import REAL, SETS, Day, DaySpec, load_day
from tests.benchmarks.studies.engine import Run, prior_of, run_study, study_arguments
from tests.benchmarks.studies.metrics import ELEVATION_LIMITS_DEG, rms, share
from tests.benchmarks.studies.radar_dirt import BELOW_M

__all__ = ["summary"]

_PITCH = 1  # of error and sigma
_SIGMAS, _MOST_SIGMAS = 2.0, 3.0
_WITNESSES = ("registration", "boxes", "doppler", "heights")
_NOISE_RAD = np.radians(3.4)  # beside that of a dirty radar: 3.7 as on the real day (radar_dirt.py)
_OF_DETECTIONS = ("xyz_m", "power_db", "residual_mps", "motion", "cluster")


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = study_arguments(__doc__ or "", "radar_elevation")
    parser.add_argument("--dirty", action="store_true", help="days of radars that are as dirty as real ones")
    parser.add_argument("--convoys", action="store_true", help="such days on highways alone")
    parser.add_argument("--parts", action="store_true", help="the real car's day in parts (days.py adopt)")
    args = parser.parse_args()
    if args.parts:
        dirty = [day for day in SETS["dev-dirty"] if (args.root / day.name).exists()]
        _write_parts(dirty if args.tuning else [REAL], args)
        return
    tuning, tested = ("dev-dirty", "radar-dirty") if args.dirty else ("dev", "radar-elevation")
    tested = "radar-convoys" if args.convoys else tested
    days = SETS[tuning if args.tuning else tested]
    run_study([Run(day, seed=day.seed) for day in days], args, summary)


def summary(results: list[dict[str, Any]]) -> str:
    """Every day, then each rig, then all."""
    said = " | ".join(f"{name} [deg]" for name in _WITNESSES)
    about = "frames with a way | status | error [deg] | against the mounting [deg] | pitch error / sigma"
    lines = [
        f"| day | {about} | {said} | certified |",
        "|---|---|---|---|---|---|" + "---|" * (len(_WITNESSES) + 1),
    ]
    known = sorted(
        (r for r in results if "error" in _pair(r)), key=lambda r: (r["day"]["rig"], r["day"]["seed"])
    )
    lines += [_row(r) for r in known]
    rigs = dict.fromkeys(r["day"]["rig"] for r in known)
    parts = [_line(rig, [_pair(r) for r in known if r["day"]["rig"] == rig]) for rig in rigs]
    return "\n".join([*lines, "", *parts, _line("all", [_pair(r) for r in known])])


def _pair(result: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = result["pairs"].get("lidar_radar", {})
    return found


def _row(result: dict[str, Any]) -> str:
    p, day = _pair(result), result["day"]
    said = " | ".join(_said(p["diagnostics"], name) for name in _WITNESSES)
    return (
        f"| {day['rig']} {day['environment']} {day['seed']} | {p['diagnostics'].get('doppler_frames', 0):.0f} "
        f"| {p['status']} | {p['el_deg']:.3f} | {p['mounting_el_deg']:.3f} | {_z(p):+.1f} | {said} "
        f"| {'yes' if _is_certified(p) else 'no'} |"
    )


def _said(diagnostics: dict[str, float], name: str) -> str:
    """Where a witness alone would turn pitch, and its sigma."""
    if f"{name}_pitch_offset_rad" not in diagnostics:
        return "-"
    offset, sigma = (np.degrees(diagnostics[f"{name}_pitch_{what}_rad"]) for what in ("offset", "sigma"))
    return f"{offset:+.2f} +- {sigma:.2f}"


def _line(name: str, pairs: Sequence[dict[str, Any]]) -> str:
    certified = [p for p in pairs if _is_certified(p)]
    limit_deg = ELEVATION_LIMITS_DEG["lidar_radar"]
    errors, mounted = (np.array([p[key] for p in pairs]) for key in ("el_deg", "mounting_el_deg"))
    return (
        f"- {name}: mean error {errors.mean():.3f} deg (mounting {mounted.mean():.3f}), largest {errors.max():.3f}; "
        f"mean pitch error {np.degrees(np.mean([p['error'][_PITCH] for p in pairs])):+.3f}; "
        f"RMS pitch error/sigma {rms([_z(p) for p in pairs]):.2f}, within three "
        f"{share(abs(_z(p)) <= _MOST_SIGMAS for p in pairs)}; certified within {limit_deg} deg "
        f"{share(_is_certified(p) for p in pairs)}, right {share(p['el_deg'] <= limit_deg for p in certified)}; "
        f"witnesses agree within two sigmas {share(_agree(p['diagnostics']) for p in pairs)}"
    )


def _z(p: dict[str, Any]) -> float:
    return float(p["error"][_PITCH] / p["sigma"][_PITCH])


def _is_certified(p: dict[str, Any]) -> bool:
    return p["status"] == "accepted" and bool(p["diagnostics"].get("vouched_el", 0.0))


def _agree(diagnostics: dict[str, float]) -> bool:
    """Every two witnesses lie within two sigmas of their difference."""
    said = [
        (diagnostics[f"{n}_pitch_offset_rad"], diagnostics[f"{n}_pitch_sigma_rad"])
        for n in _WITNESSES
        if f"{n}_pitch_offset_rad" in diagnostics
    ]
    return all(abs(a - b) <= _SIGMAS * np.hypot(s, t) for k, (a, s) in enumerate(said) for b, t in said[:k])


@dataclass(frozen=True)
class _Part:
    """Pitch by part of a day, its sigma, and what of that other days do not share [deg]."""

    name: str
    frames: range
    pitch: float
    sigma: float
    own: float


def _write_parts(days: Sequence[DaySpec], args: argparse.Namespace) -> None:
    """Pitch and sigma of each part of some days, and how far apart those are that can be compared."""
    lines = [
        f"Calibrated by commit {commit_now()}",
        "",
        "| day | part | frames | pitch [deg] | sigma | own |",
    ]
    compared = [
        "| day | of | apart [deg] | sigmas of both | sigmas of what is not shared |",
        "|---|---|---|---|---|",
    ]
    lines.append("|---|---|---|---|---|---|")
    known = [(f"{day.spec.rig} {day.spec.seed}", day) for day in (load_day(spec, args.root) for spec in days)]
    noisy = [(f"{name}, noisy", replace(day, rows=[_noisy(o) for o in day.rows])) for name, day in known]
    for name, day in known + noisy * args.tuning:
        every, parts = range(len(day.rows)), list[_Part]()
        for n in (1, 2, 4) if day.spec == REAL else (1,):
            cuts = np.linspace(0, len(every), n + 1).astype(int)
            parts += [_part(f"{k + 1} of {n}", every[a:b], day) for k, (a, b) in enumerate(pairwise(cuts))]
        if day.spec == REAL:
            parts.append(_part("without doppler", every, day, [t for t in TERMS if t != "doppler"]))
        above = [_above_road(o, day.pointing_of("lidar_radar")) for o in day.rows]
        parts.append(_part("without detections below the road", every, replace(day, rows=above)))
        cells = [f"{p.name} | {len(p.frames)} | {p.pitch:+.2f} | {p.sigma:.2f} | {p.own:.2f}" for p in parts]
        lines += [f"| {name} | {cell} |" for cell in cells]
        compared += [f"| {name} {cell}" for a, b in combinations(parts, 2) if (cell := _apart(a, b))]
    args.out.write_text("\n".join([*lines, "", *compared, ""]))
    print(args.out.read_text())


def _part(name: str, frames: range, day: Day, terms: Sequence[str] = TERMS) -> _Part:
    """What some frames say, started at the given calibration with the sigmas of a prior."""
    prior, config = (
        prior_of(day, ("logged", 2.0, 0.05), 0),
        day.fleet.changed(solve={"terms": list(terms)}).solve,
    )
    rows = [day.rows[k] for k in frames]
    found = estimate_lidar_radar(rows, prior, config, np.random.default_rng(0))
    assert found.common_covariance is not None
    every, common = (
        change_covariance(found.T, C)[_PITCH, _PITCH] for C in (found.covariance, found.common_covariance)
    )
    sigmas = np.degrees(np.sqrt([every, max(every - common, 0.0)]))
    pitch = np.degrees(change_between(day.pointing_of("lidar_radar"), found.T)[_PITCH])
    print(f"{name}: {pitch:+.2f} deg", flush=True)
    return _Part(name, frames, float(pitch), *map(float, sigmas))


def _noisy(o: Observation) -> Observation:
    """With elevations as noisy as the real radar's."""
    aer = to_spherical(o.radar_xyz_m.astype(np.float64))
    aer[:, 1] += _NOISE_RAD * np.random.default_rng(o.stamp_ns).standard_normal(len(aer))
    return replace(o, radar_xyz_m=from_spherical(aer).astype(np.float32))


def _above_road(o: Observation, T_lidar_radar: np.ndarray) -> Observation:
    """Without the detections that the given calibration puts below the lidar's road."""
    if o.ground_plane is None:
        return o
    over = transform_points(T_lidar_radar, o.radar_xyz_m.astype(np.float64)) @ o.ground_plane[:3]
    keep = over + o.ground_plane[3] > BELOW_M
    columns = {f"radar_{n}": getattr(o, f"radar_{n}") for n in _OF_DETECTIONS}
    return replace(o, **{n: v[keep] for n, v in columns.items() if v is not None})


def _apart(a: _Part, b: _Part) -> str:
    """A line on two parts without a frame in common, or on a whole and what is left of it; else nothing."""
    shared = set(a.frames) & set(b.frames)
    if shared and (a.name != "1 of 1" or a.frames != b.frames):
        return ""
    apart, both = b.pitch - a.pitch, np.hypot(a.sigma, b.sigma)
    unshared = np.sqrt(abs(a.sigma**2 - b.sigma**2)) if shared else np.hypot(a.own, b.own)
    sigmas = f"{abs(apart) / both:.1f} | {abs(apart) / max(unshared, 1e-3):.1f}"
    return f"| {a.name}, {b.name} | {apart:+.2f} | {sigmas} |"


if __name__ == "__main__":
    main()
