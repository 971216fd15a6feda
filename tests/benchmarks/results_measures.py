"""How a row of the result tables computes its number from result lines, each by a name that rows.toml uses.

A measure takes the chosen lines and the row, and returns the text of the cell. Rates come with a 95 % interval over
what is independent: days, never records, for the three records of a day share their frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from schemas.calibrations import PAIRS
from tests.benchmarks.studies.basin import in_basin
from tests.benchmarks.studies.faults import is_right, outcome_of
from tests.benchmarks.studies.in_use import answer_of_log
from tests.benchmarks.studies.metrics import within
from tests.benchmarks.studies.rates import interval, rate
from tests.benchmarks.studies.rig_faults import is_on_base
from tests.benchmarks.studies.states_measures import counts

__all__ = ["MEASURES", "interval", "rate"]

LIMIT_DEG = {"camera_lidar": 0.2, "lidar_radar": 0.5, "camera_radar": 0.5}  # of priors.jsonl: found

Lines = Sequence[Mapping[str, Any]]
Row = Mapping[str, Any]


def errors(lines: Lines, row: Row) -> str:
    """Mean errors of `pairs`: azimuth / elevation [deg], and with `range = true` / range [m]."""
    names = ["az_deg", "el_deg", *(["range_m"] if row.get("range") else [])]
    cells = []
    for pair in row.get("pairs", PAIRS):
        found = [r["pairs"][pair] for r in lines if "az_deg" in r["pairs"].get(pair, {})]
        cells.append("/".join(f"{np.mean([p[name] for p in found]):.3f}" for name in names))
    return ", ".join(cells)


def wrong_days(lines: Lines, _row: Row) -> str:
    """Days on which a record was accepted with an angle that it certifies beyond its limit."""
    days: dict[tuple[str, ...], bool] = {}
    for r in lines:
        key = tuple(str(r["day"][name]) for name in ("rig", "environment", "seed"))
        accepted = [(pair, p) for pair, p in r["pairs"].items() if p["status"] == "accepted"]
        days[key] = days.get(key, False) or any(not within(pair, p, claimed=True) for pair, p in accepted)
    return rate(sum(days.values()), len(days))


def mounting(lines: Lines, row: Row) -> str:
    """Accepted records of the camera on days of a wrong principal point: how far the mounting is off by it."""
    records = [p for r in lines for pair, p in r["pairs"].items() if pair.startswith("camera")]
    accepted = sum(p["status"] == "accepted" for p in records)
    return f"{accepted} of {len(records)} records, {row['off']} off"


def accepted_days(lines: Lines, row: Row) -> str:
    """Days on which every pair of `pairs` was accepted."""
    pairs = row.get("pairs", PAIRS)
    good = [all(r["pairs"].get(pair, {}).get("status") == "accepted" for pair in pairs) for r in lines]
    return f"{rate(sum(good), len(good))}{row.get('unit', '')}"


def inside(lines: Lines, _row: Row) -> str:
    """Share of determined degrees of freedom within 1 and 3 sigma; the interval is of days' own shares."""
    days = []
    for r in lines:
        known = [p for p in r["pairs"].values() if "error" in p]
        seen = np.concatenate([np.array(p["observable"], bool) for p in known])
        error, sigma = (np.concatenate([np.array(p[key]) for p in known]) for key in ("error", "sigma"))
        days.append((np.abs(error) / sigma)[seen])
    shares = np.array([np.mean(z <= 1) for z in days])
    half = 196 * shares.std(ddof=1) / np.sqrt(len(days))
    all_within = sum(bool((z <= 3).all()) for z in days)
    one = 100 * np.mean(np.concatenate(days) <= 1)
    return f"{one:.0f} % (+- {half:.0f}); in three: {rate(all_within, len(days))}"


def found(lines: Lines, row: Row) -> str:
    """Days that end in the right basin by the size of the start's error; the bound is of the worst size.

    Of camera-lidar and lidar-radar, or of `pairs`; with `everything = true` of all pairs, azimuth and elevation, to the
    limits of the study `priors`.
    """
    sizes: dict[float, list[bool]] = {}
    for r in lines:
        sizes.setdefault(r["prior"][1], []).append(_is_home(r["pairs"], row))
    counts = [(sum(home), len(home)) for _, home in sorted(sizes.items())]
    words, trials = [str(hits) for hits, _ in counts], {n for _, n in counts}
    if len(trials) > 1:
        words = [f"{hits} of {n}" for hits, n in counts]
    of_all = f" of {counts[0][1]}" if len(trials) == 1 else ""
    return f"{', '.join(words)}{of_all} (> {100 * min(interval(*c)[0] for c in counts):.0f} %)"


def _is_home(pairs: Mapping[str, Any], row: Row) -> bool:
    if row.get("everything"):
        angles = ("az_deg", "el_deg")
        return all(pairs.get(pair, {}).get(a, np.inf) < LIMIT_DEG[pair] for pair in PAIRS for a in angles)
    asked = row.get("pairs", ("camera_lidar", "lidar_radar"))
    return all(in_basin(pair, pairs.get(pair, {})) for pair in asked)


def clocks(lines: Lines, row: Row) -> str:
    """Time offsets of a pair within 5 ms, and their RMS error."""
    known = [r["pairs"][row["pairs"][0]] for r in lines if "dt_s" in r["pairs"].get(row["pairs"][0], {})]
    off = np.array([p["dt_s"] - p["dt_true_s"] for p in known])
    hits = int(np.sum(np.abs(off) <= 0.005))
    return f"{rate(hits, len(off))}, RMS {1e3 * np.sqrt(np.mean(off**2)):.1f} ms"


def clock_sigmas(lines: Lines, row: Row) -> str:
    """Time offsets of `pairs` within three of their sigmas, and their error in sigmas (RMS)."""
    records = [r["pairs"].get(pair, {}) for r in lines for pair in row["pairs"]]
    known = [p for p in records if p.get("dt_s") is not None]
    z = np.array([(p["dt_s"] - p["dt_true_s"]) / p["dt_sigma_s"] for p in known])
    return f"{rate(int(np.sum(np.abs(z) <= 3)), len(z))}, {np.sqrt(np.mean(z**2)):.2f} sigma"


def verified(lines: Lines, row: Row) -> str:
    """Answers of `boresight verify` that are `answer`."""
    hits = [answer_of_log(dict(r)) == row["answer"] for r in lines]
    return rate(sum(hits), len(hits))


def total(lines: Lines, row: Row) -> str:
    """Sum of a field over all lines."""
    return row.get("text", "{}").format(sum(r[row["field"]] for r in lines))


def value(lines: Lines, row: Row) -> str:
    """Fields of one line ("a.b"), put into `text`."""
    [line] = lines
    values = []
    for name in row["fields"]:
        at: Any = line
        for part in name.split("."):
            at = at[int(part)] if isinstance(at, list) else at[part]
        values.append(at)
    return str(row["text"]).format(*values)


def by_noise(lines: Lines, row: Row) -> str:
    """A field of the drift study's lines, one value per kind of errors of `noises`, times `scale`."""
    known = {r["noise"]: r[row["field"]] for r in lines}
    return row.get("text", "{}").format(
        ", ".join(f"{row.get('scale', 1) * known[noise]:.{row.get('digits', 0)}f}" for noise in row["noises"])
    )


def efficiency(lines: Lines, _row: Row) -> str:
    """Two workers by the clock, pool and Ray: half of the inline night over the shared one, waits included."""
    by = {r["executor"]: r["wall_s"] for r in lines}
    return ", ".join(f"{by['inline'] / 2 / by[way]:.2f}" for way in ("process", "ray"))


def starts(lines: Lines, row: Row) -> str:
    """Real car: by start, camera-lidar within .15/.20 deg of the given calibration, and accepted."""
    mine = [[r["pairs"].get("camera_lidar", {}) for r in lines if r["start"] == s] for s in row["starts"]]
    near = [sum(p.get("az_deg", 9) <= 0.15 and p.get("el_deg", 9) <= 0.20 for p in pairs) for pairs in mine]
    accepted = [sum(p.get("status") == "accepted" for p in pairs) for pairs in mine]
    [runs] = {len(pairs) for pairs in mine}
    return f"{', '.join(map(str, near))} of {runs}; accepted {', '.join(map(str, accepted))}"


def given_inside(lines: Lines, row: Row) -> str:
    """Real car: by pair, determined degrees of freedom of all runs within 1 and 3 sigma of the given calibration."""
    cells = []
    for pair in row["pairs"]:
        known = [r["pairs"][pair] for r in lines if pair in r["pairs"]]
        seen = np.concatenate([np.array(p["observable"], bool) for p in known])
        error, sigma = (np.concatenate([np.array(p[k]) for p in known]) for k in ("error", "error_sigma"))
        z = np.abs(error / sigma)[seen]
        cells.append(f"{100 * np.mean(z <= 1):.0f}, {100 * np.mean(z <= 3):.0f} %")
    return "; ".join(cells)


def shown(lines: Lines, row: Row) -> str:
    """Days of a network on the real car, mean over draws: azimuth/elevation of camera-lidar, and how many held."""
    days = lines[0][row["key"]]["days"]
    mean = [np.mean([d["camera_lidar"][name] for d in days]) for name in ("az_deg", "el_deg")]
    accepted = sum(d["camera_lidar"]["status"] == "accepted" for d in days)
    return f"{mean[0]:.2f}/{mean[1]:.2f}, {accepted} of {len(days)} accepted"


def knocked(lines: Lines, _row: Row) -> str:
    """Vehicles that were knocked and are RED with sensor and day; and others that are RED."""
    vehicles = [v for r in lines for v in r["vehicles"]]
    bad = [v for v in vehicles if v["knocked"]]
    red = sum(v["told"]["status"] == "RED" for v in vehicles if not v["knocked"])
    return f"{rate(sum(v['right'] for v in bad), len(bad))}; others RED: {red} of {len(vehicles) - len(bad)}"


def faulty(lines: Lines, _row: Row) -> str:
    """Of records of the study `faults` that were accepted, those that are wrong; all records in brackets."""
    records = [(r["rig"], pair, p) for r in lines for pair, p in r["pairs"].items()]
    wrong = [not is_right(pair, p, rig) for rig, pair, p in records if p["status"] == "accepted"]
    return f"{sum(wrong)} of {len(wrong)} accepted ({len(records)} records)"


def named(lines: Lines, _row: Row) -> str:
    """Of records that a fault stopped, those whose fault is named rightly."""
    good = {(r["rig"], r["seed"]): r for r in lines if r["case"] == "good"}
    told = [outcome_of(pair, r, good.get((r["rig"], r["seed"]))) for r in lines for pair in r["pairs"]]
    stopped = [what for what in told if what.startswith("stopped")]
    return f"{stopped.count('stopped, named rightly')} of {len(stopped)}"


def stopped_good(lines: Lines, _row: Row) -> str:
    """Of the days of study `faults` that have no fault, those of which a record is stopped and names one."""
    days = [[p["status"] != "accepted" and bool(p["faults"]) for p in r["pairs"].values()] for r in lines]
    return rate(sum(map(any, days)), len(days))


def rig_wrong(lines: Lines, _row: Row) -> str:
    """Of poses of the study `rig_faults` that were accepted, those that are wrong; sensor-days in brackets."""
    poses = [pose for r in lines for pose in r.get("poses", {}).values()]
    wrong = [pose["wrong"] for pose in poses if pose["status"] == "accepted"]
    return f"{sum(wrong)} of {len(wrong)} accepted ({len(poses)} sensor-days)"


def rig_base(lines: Lines, _row: Row) -> str:
    """Of accepted poses of the reference lidar on the vehicle frame, those right in roll, pitch, yaw and height."""
    off = [r["poses"]["base"]["off"] for r in lines if r["poses"]["base"]["status"] == "accepted"]
    return rate(sum(is_on_base(v) for v in off), len(off))


def rig_knocks(lines: Lines, row: Row) -> str:
    """Of knocked vehicles of the study `rig_drift` those with a share of theirs, and where another sensor is named."""
    vehicles = sum(r["vehicles"] for r in lines)
    hits, wrong = (round(sum(r[name] * r["vehicles"] for r in lines)) for name in (row["field"], "wrong"))
    return f"{rate(hits, vehicles)}; another named: {wrong}"


def power(lines: Lines, row: Row) -> str:
    """Study drift_power: RED with the right sensor within `nights`, by whose days; the interval is of the rarer."""
    found = {r["records"]: (r[f"right_within_{row['nights']}"], r["movers"]) for r in lines}
    shares = ", ".join(f"{name} {100 * hits / movers:.0f} %" for name, (hits, movers) in found.items())
    low, high = interval(*min(found.values(), key=lambda pair: pair[0] / pair[1]))
    return f"{shares} ({100 * low:.0f} to {100 * high:.0f})"


def states(lines: Lines, row: Row) -> str:
    """What study `states` counts under the words of `count`."""
    return counts(lines)[row["count"]]


def last(lines: Lines, row: Row) -> str:
    """As `value`, of the last line that was chosen."""
    return value(lines[-1:], row)


MEASURES: dict[str, Callable[[Lines, Row], str]] = {
    f.__name__: f
    for f in (
        accepted_days, by_noise, clock_sigmas, clocks, efficiency, errors, faulty, found, given_inside, inside,
        knocked, last, mounting, named, power, rig_base, rig_knocks, rig_wrong, shown, starts, states, stopped_good,
        total, value, verified, wrong_days,
    )
}  # fmt: skip
