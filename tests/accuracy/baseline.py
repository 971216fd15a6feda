"""The baseline of the accuracy gate: the numbers of the fixed days, what they may differ by, and how they are accepted.

    python -m tests.accuracy.accept                    prints what is measured
    python -m tests.accuracy.accept --accept           writes it into baseline.json (make accuracy-accept)
    python -m tests.accuracy.accept --accept --noise   and measures anew what numbers may differ by

Each day is calibrated from one start; `--noise` does so several times more, each time with another tenth of the frames
left out and other random draws. The scatter of these is what the gate allows a number to differ by: code that does the
same work in another order moves it less.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.accuracy.days import FIXED, WHOLE, FixedDay, make_day, measure_day
from tests.benchmarks.studies.commits import commit_now
from tests.benchmarks.studies.metrics import within
from tests.budgets import slowness

__all__ = [
    "BASELINE", "baseline_of", "keep_noise", "main", "together", "worse", "wrong_and_accepted", "z_scores",
]  # fmt: skip
BASELINE = Path(__file__).parent / "baseline.json"
_DRAWS = range(4)  # calibrations of a day behind a baseline
_NOISE_SD = 3.0
_NOISE_CPU = 1.0  # share: machines and their load differ by more than code that nobody slowed down
_LOST_DEG = 1.0
_RANK = ("accepted", "held", "refused", "missing")  # from the best


def numbers(result: Mapping[str, Any]) -> dict[str, float]:
    """What the gate holds small: azimuth, elevation [deg] and range [m] of each pair that has a pose."""
    return {
        f"{pair} {what}": measured[what]
        for pair, measured in result["pairs"].items()
        for what in ("az_deg", "el_deg", "range_m")
        if what in measured
    }


def verdicts(result: Mapping[str, Any]) -> dict[str, str]:
    """Status of each pair; `missing` where the day has no record of it."""
    return {pair: result["pairs"].get(pair, {"status": "missing"})["status"] for pair in PAIRS}


def wrong_and_accepted(result: Mapping[str, Any]) -> list[str]:
    """Pairs that were accepted though an angle that they certify is beyond its limit."""
    return [
        pair
        for pair, measured in result["pairs"].items()
        if measured["status"] == "accepted" and not within(pair, measured, claimed=True)
    ]


def z_scores(result: Mapping[str, Any]) -> np.ndarray:
    """Error over sigma of every degree of freedom that the day determined."""
    found = [
        np.array(p["error"])[np.array(p["observable"], bool)]
        / np.array(p["sigma"])[np.array(p["observable"], bool)]
        for p in result["pairs"].values()
        if "error" in p
    ]
    return np.concatenate(found) if found else np.zeros(0)


def baseline_of(draws: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """The baseline from several calibrations of each day, the first of all frames: its numbers, their noise, verdicts.

    Noise is three times the scatter of a number over the calibrations, its own or that of all days together, whichever
    is more: of a handful the scatter is itself unsure.
    """
    scatter: dict[str, list[float]] = {}
    for results in draws.values():
        for name, values in _by_name(results).items():
            if len(values) > 1 and _is_found(name, results[0]):
                scatter.setdefault(name, []).append(float(np.var(values, ddof=1)))
    pooled = {name: float(np.sqrt(np.mean(variances))) for name, variances in scatter.items()}
    return {day: _entry(results, pooled) for day, results in draws.items()}


def _entry(results: Sequence[Mapping[str, Any]], pooled: Mapping[str, float]) -> dict[str, Any]:
    seen = [verdicts(result) for result in results]
    return {
        "numbers": {
            name: _value_and_noise(values, pooled.get(name, 0.0))
            for name, values in _by_name(results).items()
        },
        "verdicts": {pair: sorted({v[pair] for v in seen}) for pair in PAIRS},
    }


def _by_name(results: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for result in results:
        for name, value in numbers(result).items():
            found.setdefault(name, []).append(value)
    return found


def _is_found(name: str, result: Mapping[str, Any]) -> bool:
    """Whether the pair of a number lies in the right basin: where it does not, its scatter tells nothing of others."""
    pair = result["pairs"][name.split(maxsplit=1)[0]]
    return bool(max(pair["az_deg"], pair["el_deg"]) < _LOST_DEG)


def _value_and_noise(values: Sequence[float], pooled: float) -> dict[str, float]:
    own = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return {"value": round(values[0], 4), "noise": round(_NOISE_SD * max(own, pooled) + 5e-5, 4)}


def worse(known: Mapping[str, Any], result: Mapping[str, Any]) -> list[str]:
    """What is worse than the baseline by more than its noise, a sentence each."""
    found = numbers(result)
    lines = [
        f"{name} is {found.get(name, float('nan')):.4f}, baseline {b['value']:.4f} with noise {b['noise']:.4f}"
        for name, b in known["numbers"].items()
        if not found.get(name, float("inf")) <= b["value"] + b["noise"]
    ]
    lines += [
        f"{pair} is {status}, baseline {' or '.join(known['verdicts'][pair])}"
        for pair, status in verdicts(result).items()
        if _RANK.index(status) > max(_RANK.index(seen) for seen in known["verdicts"][pair])
    ]
    return lines


def together(results: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Over days, those of `FIXED` that every pair is found on: root mean square of each angle, and coverage.

    Coverage is the share of determined degrees of freedom that lie beyond one sigma, and beyond three.
    """
    squares: dict[str, list[float]] = {}
    z = []
    for result in results:
        z.append(np.abs(z_scores(result)))
        for name, value in numbers(result).items():
            squares.setdefault(name, []).append(value**2)
    found = {name: float(np.sqrt(np.mean(v))) for name, v in squares.items() if name.endswith("deg")}
    return found | {f"share beyond {n} sigma": float(np.mean(np.concatenate(z) > n)) for n in (1, 3)}


def _drawn(fixed: FixedDay, draws: Sequence[int]) -> tuple[list[dict[str, Any]], float] | None:
    """A day's calibrations, and the cheapest in CPU seconds of the budgets' machine; None without its recordings."""
    with tempfile.TemporaryDirectory() as folder:
        made = make_day(fixed, Path(folder))
    if made is None:
        print(f"{fixed.name}: its recordings are not on this machine")
        return None
    results = [measure_day(made, draw) for draw in draws]
    cpu_s = min(result["cpu_s"] for result in results) / slowness()
    print(
        f"{fixed.name}: {len(made.day.rows)} frames, made in {made.cpu_s:.1f} CPU s, calibrated in {cpu_s:.0f}"
    )
    for result in results:
        print("   ", verdicts(result), result["cpu_s"], numbers(result), flush=True)
    return results, cpu_s


def main() -> None:
    """Measure all days; write the baseline where that is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--accept", action="store_true")
    parser.add_argument("--noise", action="store_true")
    args = parser.parse_args()
    drawn = {fixed.name: _drawn(fixed, _DRAWS if args.noise else [0]) for fixed in FIXED}
    here = {name: found for name, found in drawn.items() if found is not None}
    if not args.accept:
        return
    if set(here) != set(drawn):
        raise SystemExit("a baseline is of all days: put the recordings beside this repository first")
    content = _content(here)
    if not args.noise:
        keep_noise(json.loads(BASELINE.read_text()), content)
    about = {"date": time.strftime("%Y-%m-%d"), "commit": commit_now()}
    BASELINE.write_text(json.dumps(about | content, indent=1) + "\n")
    print(f"accepted into {BASELINE}")


def _content(here: Mapping[str, tuple[Sequence[dict[str, Any]], float]]) -> dict[str, Any]:
    """The baseline of days' calibrations and cost."""
    days = baseline_of({name: results for name, (results, _) in here.items()})
    for name, (_, cpu_s) in here.items():
        days[name]["cpu_s"] = {"value": round(cpu_s, 1), "noise": round(_NOISE_CPU * cpu_s, 1)}
    draws = range(len(next(iter(here.values()))[0]))
    rms = [together(here[name][0][draw] for name in WHOLE) for draw in draws]
    return {
        "together": {name: _value_and_noise([r[name] for r in rms], 0.0) for name in rms[0]},
        "days": days,
    }


def keep_noise(known: Mapping[str, Any], content: dict[str, Any]) -> None:
    """Give a baseline of single calibrations the noise that an older one measured, and verdicts where they agree."""
    for numbers_known, numbers_now in (
        (known["together"], content["together"]),
        *((known["days"][name]["numbers"], day["numbers"]) for name, day in content["days"].items()),
    ):
        for name, number in numbers_now.items():
            number["noise"] = numbers_known.get(name, number)["noise"]
    for name, day in content["days"].items():
        for pair, verdict in day["verdicts"].items():
            seen = known["days"][name]["verdicts"][pair]
            day["verdicts"][pair] = seen if verdict[0] in seen else verdict
