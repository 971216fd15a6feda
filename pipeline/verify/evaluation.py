"""The paper's Table 1 from records: target errors by method and environment, and whether the sigmas tell the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.se3 import from_quaternion, inverse, log_se3
from pipeline.verify.targets import Picks, errors_at_targets, errors_of_picks, loop_errors
from schemas.calibrations import METHODS, PAIRS, CalibrationRecord

__all__ = ["Comparison", "compare", "current_runs", "table_1"]

# The rows that the paper prints (Table 1; highway and urban: extended data table 1): azimuth, elevation [deg]
# of camera-lidar and camera-radar, azimuth, elevation, range [m] of lidar-radar and of the loop.
PAPER_ROWS: tuple[tuple[str, str, tuple[float, ...]], ...] = (
    ("object tracking [60]", "all", (0.55, 2.01, 1.92, 3.13, 1.46, 1.87, 0.22, np.nan, np.nan, np.nan)),
    ("pairwise optimization", "all", (0.21, 0.28, 0.20, 0.44, 0.97, 0.21, 0.14, 1.43, 0.83, 0.01)),
    ("pairwise SSL", "all", (0.07, 0.09, 1.36, 0.29, 1.17, 1.09, 0.30, 0.14, 0.61, 0.01)),
    ("joint optimization", "all", (0.22, 0.27, 0.20, 0.45, 0.36, 0.72, 0.14, 0.09, 0.01, 0.01)),
    ("joint SSL", "all", (0.08, 0.20, 0.02, 0.14, 0.51, 0.61, 0.13, 0.02, 0.02, 0.01)),
    ("joint optimization", "highway", (0.42, 0.65, 0.08, 0.60, 0.31, 1.17, 0.13, 0.17, 0.02, 0.01)),
    ("joint SSL", "highway", (0.01, 0.22, 0.09, 0.08, 0.49, 0.66, 0.14, 0.06, 0.03, 0.07)),
    ("joint optimization", "urban", (0.13, 0.21, 0.13, 0.49, 0.02, 0.69, 0.13, 0.06, 0.01, 0.01)),
    ("joint SSL", "urban", (0.10, 0.18, 0.03, 0.37, 0.51, 0.61, 0.13, 0.03, 0.04, 0.04)),
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """One run (all pairs of one work key) against the truth."""

    method: str
    environment: str
    errors: dict[str, np.ndarray]  # pair or "loop" -> azimuth, elevation [rad], range [m]
    prior_errors: dict[str, np.ndarray]
    statuses: dict[str, str]
    normalised: np.ndarray  # error / sigma of every observable DoF of every pair


def current_runs(records: Sequence[CalibrationRecord]) -> list[dict[str, CalibrationRecord]]:
    """Records by run; of runs that differ only in code or configuration the last one counts."""
    runs: dict[tuple[object, ...], dict[str, CalibrationRecord]] = {}
    by_key: dict[tuple[str, str, str, str], dict[str, CalibrationRecord]] = {}
    for r in records:
        by_key.setdefault((r.vehicle, r.day, r.method, r.work_key), {})[r.pair] = r
    for (vehicle, day, method, _), run in by_key.items():
        first = run.get("camera_lidar")
        start = (
            None
            if first is None or first.prior_qw is None
            else (first.prior_qw, first.prior_qx, first.prior_tx_m)
        )
        seed = next(iter(run.values())).seed
        runs[(vehicle, day, method, seed, start)] = run
    return list(runs.values())


def compare(
    run: Mapping[str, CalibrationRecord],
    truth: Mapping[str, Float[np.ndarray, "4 4"]] | None,
    picks: Picks | None = None,
    truth_sigma: tuple[float, float] = (0.0, 0.0),
) -> Comparison | None:
    """Errors of one run, from truth or from picked reflectors; None where a pair was refused.

    Args:
        run: the records of one work key, by pair.
        truth: T of each pair.
        picks: reflector positions, instead of a truth.
        truth_sigma: how well the truth itself is known, per axis: rotation [rad], translation [m].
    """
    if set(run) != set(PAIRS) or any(r.qw is None for r in run.values()):
        return None
    T = {pair: _transform(run[pair], "") for pair in PAIRS}
    priors = {pair: _transform(run[pair], "prior_") for pair in PAIRS}

    def errors(of: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        if picks is not None:
            found = {pair: errors_of_picks(pair, of[pair], picks) for pair in PAIRS}
        else:
            assert truth is not None, "either truth or picks"
            found = {pair: errors_at_targets(pair, of[pair], truth[pair]) for pair in PAIRS}
        return found | {"loop": loop_errors(of)}

    first = run["camera_lidar"]
    return Comparison(
        first.method,
        first.environment,
        errors(T),
        errors(priors),
        {pair: run[pair].status for pair in PAIRS},
        np.concatenate([_normalised(run[pair], T[pair], truth[pair], truth_sigma) for pair in PAIRS])
        if truth
        else np.zeros(0),
    )


def table_1(comparisons: Sequence[Comparison]) -> str:
    """Markdown: our rows by method and environment, the paper's rows beside them, and the sigmas' honesty."""
    lines = [
        (
            "| method | environment | runs | camera-lidar az/el [deg] | camera-radar az/el [deg] "
            "| lidar-radar az/el [deg] / range [m] | loop az/el [deg] / range [m] | accepted |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    order = {method: k for k, method in enumerate(METHODS)}
    groups: dict[tuple[str, str], list[Comparison]] = {}
    for c in comparisons:
        groups.setdefault((c.method, "all"), []).append(c)
        if c.environment in ("highway", "urban"):
            groups.setdefault((c.method, c.environment), []).append(c)
    if comparisons:
        means = _mean([c.prior_errors for c in comparisons])
        lines.append(_row("(prior)", "all", len(comparisons), means, ""))
    for (method, environment), members in sorted(
        groups.items(), key=lambda g: (order.get(g[0][0], 99), g[0][0], g[0][1] != "all", g[0][1])
    ):
        accepted = sum(s == "accepted" for c in members for s in c.statuses.values())
        share = f"{accepted} of {3 * len(members)} pairs"
        lines.append(_row(method, environment, len(members), _mean([c.errors for c in members]), share))
    for name, environment, v in PAPER_ROWS:
        values = np.array(v)
        lines.append(
            f"| paper: {name} | {environment} | other data | {_join(values[:2])} | {_join(values[2:4])} "
            f"| {_join(values[4:7])} | {_join(values[7:])} | |"
        )
    return "\n".join([*lines, "", *_honesty(groups)]) + "\n"


def _honesty(groups: Mapping[tuple[str, str], Sequence[Comparison]]) -> list[str]:
    lines: list[str] = []
    for (method, environment), members in groups.items():
        z = np.abs(np.concatenate([c.normalised for c in members]))
        if environment != "all" or not len(z):
            continue
        if not lines:
            lines = [
                "| method | observable DoF | within 1 sigma | within 3 sigma | RMS of error/sigma |",
                "|---|---|---|---|---|",
            ]
        lines.append(
            f"| {method} | {len(z)} | {np.mean(z < 1):.0%} | {np.mean(z < 3):.0%} | {np.sqrt(np.mean(z**2)):.2f} |"
        )
    return lines


def _mean(errors: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.mean([e[name] for e in errors], axis=0) for name in (*PAIRS, "loop")}


def _row(method: str, environment: str, runs: int, means: Mapping[str, np.ndarray], share: str) -> str:
    degrees = {name: np.array([*np.degrees(e[:2]), e[2]]) for name, e in means.items()}
    cells = [_join(degrees["camera_lidar"][:2]), _join(degrees["camera_radar"][:2])]
    cells += [_join(degrees["lidar_radar"]), _join(degrees["loop"])]
    return f"| {method} | {environment} | {runs} | {' | '.join(cells)} | {share} |"


def _join(values: np.ndarray) -> str:
    return " / ".join("-" if np.isnan(v) else f"{v:.3f}".rstrip("0").ljust(4, "0") for v in values)


def _transform(record: CalibrationRecord, prefix: str) -> np.ndarray:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    values = np.array([getattr(record, prefix + name) for name in names], np.float64)
    return from_quaternion(values[:4], values[4:])


def _normalised(
    record: CalibrationRecord, T: np.ndarray, T_true: np.ndarray, truth_sigma: tuple[float, float]
) -> np.ndarray:
    if record.covariance is None or record.observable is None:
        return np.zeros(0)
    of_truth = np.repeat(np.square(truth_sigma), 3)
    z = log_se3(T @ inverse(T_true)) / np.sqrt(np.diag(record.covariance) + of_truth)
    return z[np.array(record.observable, bool)]
