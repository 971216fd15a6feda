"""Study: how far up does a radar look, how surely does `joint` say so, and do its witnesses agree?

    python tests/benchmarks/studies/days.py generate --root DAYS --sets radar-elevation
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --workers 2
    python tests/benchmarks/studies/radar_elevation.py --root DAYS --dirty --out OUT/radar_dirty.jsonl

Twelve days of 40 frames from the prior that the logs carry, urban and highway: eight of the paper's sensors, four of a
16-ring lidar with an ambiguous radar; with `--dirty` 48 of six rigs whose radars are as dirty as real ones (set
radar-dirty; dev-dirty with `--tuning`). Errors are of lidar-radar's elevation at the paper's three targets, against
where the radar's detections point and against its mounting, which differ by the radar's own constant error (.15 deg).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.benchmarks.studies.days import SETS
from tests.benchmarks.studies.engine import Run, run_study, study_arguments
from tests.benchmarks.studies.metrics import ELEVATION_LIMITS_DEG, rms, share

__all__ = ["summary"]

_PITCH = 1  # of error and sigma
_SIGMAS, _MOST_SIGMAS = 2.0, 3.0
_WITNESSES = ("registration", "boxes", "doppler", "heights")


def main() -> None:
    """Run what is missing, then print the tables."""
    parser = study_arguments(__doc__ or "", "radar_elevation")
    parser.add_argument("--dirty", action="store_true", help="days of radars that are as dirty as real ones")
    args = parser.parse_args()
    tuning, tested = ("dev-dirty", "radar-dirty") if args.dirty else ("dev", "radar-elevation")
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


if __name__ == "__main__":
    main()
