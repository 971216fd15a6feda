"""Markdown of what networks were measured at."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pipeline.learn.infer.aggregate import BIAS_SIGMA
from schemas.calibrations import DOF_NAMES, PAIRS
from tests.benchmarks.studies.metrics import inside_share, rms

__all__ = ["abrupt_table", "frame_values", "frames_table", "rows_of", "sigma_table"]

_ANGLES = 3  # the first of the six degrees of freedom


def rows_of(results: Iterable[dict[str, Any]]) -> list[str]:
    """Rows of the tables in the order in which they first appear."""
    return list(dict.fromkeys(r["method"] for r in results))


def frames_table(results: list[dict[str, Any]], start: str = "prior") -> str:
    """Errors of single frames after each pass: means, and the last pass's medians and signed errors."""
    lines = [
        "Single frames, az / el [deg] / range [m]; mean over frames after 1, 2, 3 passes, median after 3:",
        "",
        "| method | pair | frames | start | 1 pass | 2 passes | 3 passes | median | mean turn rx ry rz [deg] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for method in rows_of(results):
        for pair in PAIRS:
            errors, prior, change = (frame_values(results, method, start, pair, k) for k in _KEYS)
            if not len(errors):
                continue
            means = " | ".join(_three(errors[:, k].mean(axis=0)) for k in range(errors.shape[1]))
            turn = " ".join(f"{v:+.2f}" for v in np.degrees(change[:, :_ANGLES].mean(axis=0)))
            lines.append(
                f"| {method} | {pair} | {len(errors)} | {_three(prior.mean(axis=0))} | {means} "
                f"| {_three(np.median(errors[:, -1], axis=0))} | {turn} |"
            )
    return "\n".join(lines)


def abrupt_table(results: list[dict[str, Any]], starts: Sequence[str]) -> str:
    """Medians of single frames after sensors were knocked."""
    lines = [
        "Abrupt changes, one frame, 3 passes: median az / el [deg] / range [m] (start in brackets):",
        "",
        f"| method | pair | {' | '.join(f'{s} deg' for s in starts)} |",
        f"|---|---|{'---|' * len(starts)}",
    ]
    for method in rows_of(results):
        for pair in PAIRS:
            cells = []
            for start in starts:
                errors, prior, _ = (frame_values(results, method, start, pair, k) for k in _KEYS)
                cells.append(
                    f"{_three(np.median(errors[:, -1], axis=0))} ({_three(np.median(prior, axis=0))})"
                    if len(errors)
                    else "-"
                )
            if any(c != "-" for c in cells):
                lines.append(f"| {method} | {pair} | {' | '.join(cells)} |")
    return "\n".join(lines)


_KEYS = ("errors", "prior", "change")


def frame_values(results: list[dict[str, Any]], method: str, start: str, pair: str, what: str) -> np.ndarray:
    """`errors`, `prior` or `change` of `measure_frames`, of all frames of all days; empty where there are none."""
    found = [
        r["starts"][start][pair][what]
        for r in results
        if r["method"] == method and start in r.get("starts", {}) and r["starts"][start][pair][what]
    ]
    return np.concatenate([np.asarray(f, np.float64) for f in found]) if found else np.empty((0,))


def sigma_table(results: list[dict[str, Any]]) -> str:
    """Whether records are as good as they say: by degree of freedom, where the day determines it.

    `needed` is what BIAS_SIGMA would have to be: the error that is left of the root mean square where a record's sigma,
    less the BIAS_SIGMA in it, is taken away.
    """
    lines = [
        "Error over sigma, degree of freedom by degree of freedom (parent axes; deg, m), where the day determines it:",
        "",
        "| method | pair | DoF | days | mean | rms | median sigma | in 1 sigma | in 3 sigma | BIAS_SIGMA | needed |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method in rows_of(results):
        for pair in PAIRS:
            lines += [f"| {method} | {pair} | {row} |" for row in _sigma_rows(results, method, pair)]
    return "\n".join(lines)


def _sigma_rows(results: list[dict[str, Any]], method: str, pair: str) -> list[str]:
    days = [
        p for r in results if r["method"] == method and "error" in (p := r.get("pairs", {}).get(pair, {}))
    ]
    if not days:
        return []
    error, sigma = (np.array([p[k] for p in days]) for k in ("error", "sigma"))
    known = np.array([p["observable"] for p in days], bool)
    rows = []
    for k, name in enumerate(DOF_NAMES):
        unit = np.degrees(1.0) if k < _ANGLES else 1.0
        e, s = error[known[:, k], k] * unit, sigma[known[:, k], k] * unit
        bias = BIAS_SIGMA[pair][k] * unit
        cells = "- | - | - | - | -"
        needed = "-"
        if len(e):
            cells = (
                f"{e.mean():+.3f} | {rms(e):.3f} | {np.median(s):.3f} "
                f"| {100 * inside_share(e, s, 1):.0f} % | {100 * inside_share(e, s, 3):.0f} %"
            )
            rest = np.mean(e**2 - np.maximum(s**2 - bias**2, 0.0))
            needed = f"{np.sqrt(max(rest, 0.0)):.3f}"
        rows.append(f"{name} | {len(e)} | {cells} | {bias:.3f} | {needed}")
    every = error[known] / sigma[known]
    if len(every):
        inside = [100 * float(np.mean(np.abs(every) <= n)) for n in (1, 3)]
        rows.append(
            f"all | {len(every)} | - | {rms(every):.2f} sigma | - | {inside[0]:.0f} % | {inside[1]:.0f} % | - | -"
        )
    return rows


def _three(values: np.ndarray) -> str:
    return f"{values[0]:.2f} / {values[1]:.2f} / {values[2]:.3f}"
