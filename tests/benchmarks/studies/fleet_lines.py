"""What a vehicle gains from its model line, and whether its answer hangs on it.

    python -m tests.benchmarks.studies.fleet_lines made [--seeds 9400-9409] [--vehicles 100]
    python -m tests.benchmarks.studies.fleet_lines speed [--vehicles 10000] [--nights 30]
    python -m tests.benchmarks.studies.fleet_lines driven --few LAKE --many LAKE --truth DIR

`made` draws records (`tests/makers/line_records.py`) and runs the stages audit and lines on them. `driven` compares a
fleet's days of ten frames, with its line, with days of fifty frames alone: lakes of `boresight simulate --alike-deg
.05 --frames 10` (50) and `nightly`. Prints a line of JSON for each question.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config import FleetConfig
from pipeline.geometry.changes import change_between, change_covariance
from pipeline.stage_work import Task, Window
from pipeline.stages import AUDIT, LINES
from pipeline.store.commits import commit_records
from pipeline.store.current import current_records, transform_of
from pipeline.store.partitions import Lake
from pipeline.store.records import read_last, read_records
from schemas.calibrations import CALIBRATIONS, CalibrationRecord
from schemas.fleet_model import FLEET_MODEL, LINE_ANSWERS, FleetModelRow, LineAnswer
from schemas.service_events import SERVICE_EVENTS, ServiceEvent
from tests.benchmarks.studies.commits import commit_now
from tests.makers.fleet_lakes import one_rig_fleet
from tests.makers.line_records import DEG, MadeLine, change_of, line_records

_AXES = {"camera_lidar": [0, 1, 2], "lidar_radar": [1, 2]}  # that a made day shows
_LIKE = np.array([0.03 * DEG] * 3 + [0.003] * 3)  # equal mounts


def _fleet(**sections: Any) -> FleetConfig:
    values = one_rig_fleet().model_dump(exclude_defaults=True)
    return FleetConfig.model_validate(values | {"vehicles": {"*": {"rig": "default"}}} | sections)


def _night(
    line: MadeLine, fleet: FleetConfig | None = None, events: list[ServiceEvent] | None = None
) -> tuple[dict[str, FleetModelRow], dict[tuple[str, str], LineAnswer]]:
    """The last night of a made line: rows by pair, answers by vehicle and pair."""
    with tempfile.TemporaryDirectory() as folder:
        lake = Lake.at(folder)
        commit_records(lake, CALIBRATIONS, line_records(line))
        if events:
            commit_records(lake, SERVICE_EVENTS, events)
        task = Task(fleet or _fleet(), lake, Window())
        AUDIT.run(task)
        LINES.run(task)
        answers = {(a.vehicle, a.pair): a for a in read_last(lake, LINE_ANSWERS, LineAnswer, "joint")}
        day = next(iter(answers.values())).day
        return {r.pair: r for r in read_records(lake, FLEET_MODEL, FleetModelRow, day=day)}, answers


def _off(line: MadeLine, answer: LineAnswer, v: int, of: str) -> tuple[np.ndarray, np.ndarray]:
    """Error of a vehicle's last record, with its line or alone, and its sigmas, by axis."""
    T = transform_of(answer)
    change = change_of(T, answer.pair)
    mount = line.mounts()[answer.pair][v] + line.motion(v, line.days - 1).get(answer.pair, np.zeros(6))
    covariance = {
        "answer": answer.covariance, "alone": answer.alone_covariance, "record": answer.record_covariance,
    }[of]  # fmt: skip
    if of == "alone":
        change = change - answer.moved_by
    if of == "record":
        change = change + answer.record_change
    return change - mount, np.sqrt(np.diag(change_covariance(T, np.asarray(covariance))))


def few_frames(seeds: list[int], vehicles: int) -> Iterator[dict[str, Any]]:
    """One day of ten frames with the line, against fifty frames alone: five times the information of a day."""
    for scatter, name in ((_LIKE, "equal mounts (.03 deg, 3 mm)"), (4 * _LIKE, "scatter .12 deg, 12 mm")):
        for pair, axes in _AXES.items():
            found: dict[str, list[np.ndarray]] = {"with": [], "sigma": [], "alone": [], "many": []}
            for seed in seeds:
                line = MadeLine(vehicles, 1, seed, scatter=scatter)
                _, answers = _night(line)
                many = replace(line, sigma={p: s / np.sqrt(5) for p, s in line.sigma.items()})
                _, sure = _night(many)
                for v in range(vehicles):
                    off, sigma = _off(line, answers[line.vehicle(v), pair], v, "answer")
                    found["with"].append(off[axes])
                    found["sigma"].append(sigma[axes])
                    found["alone"].append(_off(line, answers[line.vehicle(v), pair], v, "alone")[1][axes])
                    found["many"].append(_off(line, sure[line.vehicle(v), pair], v, "alone")[1][axes])
            off, sigma, alone, many_sigma = (np.array(found[k]) for k in ("with", "sigma", "alone", "many"))
            yield {
                "question": "a day of ten frames with its line", "mounts": name, "pair": pair, "vehicles": len(off),
                "sigma_deg": _deg(np.median(sigma, axis=0)), "alone_deg": _deg(np.median(alone, axis=0)),
                "fifty_frames_alone_deg": _deg(np.median(many_sigma, axis=0)),
                "rms_deg": _deg(np.sqrt(np.mean(off**2, axis=0))),
                "rms_sigma": round(float(np.sqrt(np.mean((off / sigma) ** 2))), 3),
                "within_three": round(float(np.mean(np.abs(off / sigma) < 3)), 4),
            }  # fmt: skip


_BIAS = {
    "lidar_radar": np.array([0, 0.8 * DEG, 0, -0.10, 0, 0]),
    "camera_lidar": np.array([-0.2 * DEG, 0, 0, 0, 0, 0]),
}
_OF_BIAS = {
    "radar elevation": ("lidar_radar", 0.8 * DEG),
    "radar range": ("lidar_radar", 0.10),
    "camera labels or principal point, vertical": ("camera_lidar", 0.2 * DEG),
}


def shared(seeds: list[int], vehicles: int) -> Iterator[dict[str, Any]]:
    """Errors that all sensors share, five nights: records alone, and re-mounts and a known drawing."""
    drawing = _fleet(fleet_model={"common_mount_sigma_deg": 0.3, "common_mount_sigma_m": 0.02})
    for name, fleet, share in (("records alone", _fleet(), 0.0), ("a third re-mounted", drawing, 1 / 3)):
        off: dict[str, list[float]] = {key: [] for key in _OF_BIAS}
        told: dict[str, int] = dict.fromkeys(_OF_BIAS, 0)
        moved: dict[str, list[float]] = {pair: [] for pair in _BIAS}
        for seed in seeds:
            again = int(share * vehicles)
            remount = np.random.default_rng([seed, 3]).normal(size=(vehicles, 2, 6))
            drawn = np.array([0.3 * DEG] * 3 + [0.02] * 3)

            def motion(
                v: int, _day: int, a: int = again, r: np.ndarray = remount, s: np.ndarray = drawn
            ) -> Any:
                return {"camera_lidar": s * r[v, 0], "lidar_radar": s * r[v, 1]} if v < a else {}

            line = MadeLine(vehicles, 5, seed, scatter=_LIKE, bias=_BIAS, motion=motion)
            events = [
                ServiceEvent(
                    vehicle=line.vehicle(v), day="2026-02-27", sensor="all", kind="re-mount", work_key=f"e{v}"
                )
                for v in range(again)
            ]
            rows, answers = _night(line, fleet, events)
            for key, (pair, size) in _OF_BIAS.items():
                row = rows[pair]
                is_told = key in row.told_apart
                told[key] += is_told
                value = row.shared_errors[key] if is_told else row.totals[key]
                off[key].append(value / size - 1)
            for v in range(again, vehicles):
                for pair, bias in _BIAS.items():
                    change, sigma = _off(line, answers[line.vehicle(v), pair], v, "answer")
                    axis = int(np.argmax(np.abs(bias[:3])))
                    moved[pair].append(float(abs(change[axis]) / sigma[axis]))
        yield {
            "question": "errors that all sensors share", "how": name, "lines": len(seeds), "vehicles": vehicles,
            "relative_error": {k: [round(float(v), 3) for v in sorted(o)] for k, o in off.items()},
            "told_apart": told,
            "answers_off_by_sigmas_median": {p: round(float(np.median(z)), 2) for p, z in moved.items()},
        }  # fmt: skip


def outside(seeds: list[int], vehicles: int) -> Iterator[dict[str, Any]]:
    """One vehicle unlike its line: named on its first day, and its answer as alone."""
    cases: dict[str, tuple[str, Callable[[int], np.ndarray]]] = {
        "camera knocked by .6 deg of pitch": ("camera_lidar", lambda _: np.array([0.6 * DEG, 0, 0, 0, 0, 0])),
        "camera knocked by 1 deg of pitch": ("camera_lidar", lambda _: np.array([1.0 * DEG, 0, 0, 0, 0, 0])),
        "another lens: 8 px of 450": ("camera_lidar", lambda _: np.array([0, 1.02 * DEG, 0, 0, 0, 0])),
        "radar knocked by 1 deg of yaw": ("lidar_radar", lambda _: np.array([0, 0, 1.0 * DEG, 0, 0, 0])),
        "camera sags by .1 deg a day": ("camera_lidar", lambda d: np.array([0.1 * d * DEG, 0, 0, 0, 0, 0])),
    }
    for name, (pair, change) in cases.items():
        days = 8 if "sags" in name else 1
        named, others, z, alone = 0, 0, [], []
        for seed in seeds:
            line = MadeLine(
                vehicles, days, seed, scatter=_LIKE,
                motion=lambda v, d, p=pair, c=change: {p: c(d)} if v == 7 else {},
            )  # fmt: skip
            rows, answers = _night(line)
            named += line.vehicle(7) in rows[pair].outside
            others += len([o for o in rows[pair].outside if o != line.vehicle(7)])
            off, sigma = _off(line, answers[line.vehicle(7), pair], 7, "answer")
            z.append(float(np.abs(off / sigma)[_AXES[pair]].max()))
            alone.append(float(np.abs(np.array(answers[line.vehicle(7), pair].moved_by)[:3]).max() / DEG))
        yield {
            "question": "one vehicle unlike its line", "case": name, "days": days, "lines": len(seeds), "named": named,
            "others_named": others, "of_others": (vehicles - 1) * len(seeds),
            "moved_by_line_deg": round(float(np.max(alone)), 3), "worst_axis_sigmas": [round(v, 2) for v in sorted(z)],
        }  # fmt: skip


def half_drifts(seeds: list[int], vehicles: int) -> Iterator[dict[str, Any]]:
    """Half of the vehicles drift together: status of the line by night."""
    for part in (0.3, 0.5, 0.7, 1.0):
        statuses: dict[str, list[str]] = {}
        for seed in seeds[:1]:
            line = MadeLine(
                vehicles, 24, seed, scatter=_LIKE,
                motion=lambda v, d, p=part: {"camera_lidar": np.array([0.05 * DEG * max(d - 7, 0), 0, 0, 0, 0, 0])}
                if (v * 7) % 10 < 10 * p
                else {},
            )  # fmt: skip
            records = line_records(line)
            with tempfile.TemporaryDirectory() as folder:
                lake = Lake.at(folder)
                for k, day in enumerate(sorted({r.day for r in records})):
                    commit_records(lake, CALIBRATIONS, [r for r in records if r.day == day])
                    if k < 7:
                        continue
                    task = Task(_fleet(), lake, Window(None, day))
                    AUDIT.run(task)
                    LINES.run(task)
                    rows = read_records(lake, FLEET_MODEL, FleetModelRow, day=day)
                    status = next(r.status for r in rows if r.pair == "camera_lidar")
                    statuses.setdefault(day, []).append(status)
        drifted = {day: round(0.05 * k, 2) for k, day in enumerate(statuses)}
        yield {
            "question": "a part of the line drifts together by .05 deg a day", "part": part, "vehicles": vehicles,
            "lines": 1,
            "status_by_drift_deg": {str(drifted[d]): "".join(s[0] for s in found) for d, found in statuses.items()},
        }  # fmt: skip


def without_one(seeds: list[int], vehicles: int) -> Iterator[dict[str, Any]]:
    """Largest change of any answer, in its sigmas, if any one other vehicle is left out, as the table states it."""
    stated = []
    for seed in seeds:
        rows, _ = _night(MadeLine(vehicles, 3, seed, scatter=_LIKE))
        stated += [float(r.most_without_one or 0.0) for r in rows.values()]
    yield {
        "question": "leave one vehicle out", "vehicles": vehicles, "lines": len(stated),
        "largest_change_sigmas": [round(v, 3) for v in sorted(stated)],
    }  # fmt: skip


def speed(vehicles: int, nights: int) -> dict[str, Any]:
    """CPU and memory of stage lines, in a process of its own: all nights at once, and one more night."""
    line = MadeLine(vehicles, nights + 1, 1, scatter=_LIKE)
    with tempfile.TemporaryDirectory() as folder:
        lake = Lake.at(folder)
        records = line_records(line)
        days = sorted({r.day for r in records})
        spent = []
        for day in days:
            stamp = f"{day}T23:00:00.000000Z"  # as nights record: one after another
            of_day = [replace(r, recorded_at=stamp, asserted_at=stamp) for r in records if r.day == day]
            commit_records(lake, CALIBRATIONS, of_day)
            if day in days[-2:]:
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                    spent.append(pool.submit(_night_cost, folder, day).result())
    (all_s, all_gb), (more_s, more_gb) = spent
    return {
        "question": "speed", "vehicles": vehicles, "nights": nights, "edges": 2, "all_nights_cpu_s": all_s,
        "one_more_night_cpu_s": more_s, "all_nights_gb": all_gb, "one_more_night_gb": more_gb,
    }  # fmt: skip


def _night_cost(folder: str, day: str) -> tuple[float, float]:
    """CPU [s] of the stage, and the largest memory of the process [GB], imports included."""
    task = Task(_fleet(), Lake.at(folder), Window(None, day))
    begin = time.process_time()
    LINES.run(task)
    spent = time.process_time() - begin
    # `ru_maxrss` would be no less than what the process that started this one took.
    most_kb = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert most_kb is not None
    return round(spent, 1), round(int(most_kb[1]) * 1024 / 1e9, 2)


def driven(few: str, many: str, truth: Path) -> Iterator[dict[str, Any]]:
    """Days of few frames with their line, and of many alone, against the truth of a simulated fleet."""
    lake = Lake.existing(few)
    answers = read_last(lake, LINE_ANSWERS, LineAnswer, "joint")
    found: dict[str, dict[str, list[np.ndarray]]] = {}
    for a in answers:
        T = transform_of(a)
        true = _true(truth, a.vehicle, a.day, a.pair)
        off = change_between(true, T)
        parts = found.setdefault(a.pair, {k: [] for k in ("off", "sigma", "alone", "alone_sigma")})
        parts["off"].append(off)
        parts["sigma"].append(np.sqrt(np.diag(change_covariance(T, np.asarray(a.covariance)))))
        parts["alone"].append(off - a.moved_by)
        parts["alone_sigma"].append(np.sqrt(np.diag(change_covariance(T, np.asarray(a.alone_covariance)))))
    records = current_records(read_records(Lake.existing(many), CALIBRATIONS, CalibrationRecord))
    for pair, parts in found.items():
        own = [r for r in records if r.pair == pair and r.covariance is not None]
        more = np.array([change_between(_true(truth, r.vehicle, r.day, pair), transform_of(r)) for r in own])
        sure = np.array(
            [np.sqrt(np.diag(change_covariance(transform_of(r), np.asarray(r.covariance)))) for r in own]
        )
        values = {k: np.array(v) for k, v in parts.items()}
        yield {
            "question": "driven days of few frames with their line", "pair": pair, "vehicles": len(values["off"]),
            "many": len(more),
            **{
                name: {"rms_deg": _deg(np.sqrt(np.mean(off[:, :3] ** 2, axis=0))),
                       "median_deg": _deg(np.median(np.abs(off[:, :3]), axis=0)),
                       "sigma_deg": _deg(np.median(sigma[:, :3], axis=0)),
                       "within_three": round(float(np.mean(np.abs(off / sigma)[:, :3] < 3)), 3)}
                for name, off, sigma in (
                    ("with_line", values["off"], values["sigma"]), ("alone", values["alone"], values["alone_sigma"]),
                    ("many_frames_alone", more, sure),
                )
            },
        }  # fmt: skip


def _true(truth: Path, vehicle: str, day: str, pair: str) -> np.ndarray:
    return np.array(json.loads((truth / vehicle / f"{day}.json").read_text())[f"T_{pair}"])


def _deg(angles: np.ndarray) -> list[float]:
    return [round(float(a), 3) for a in np.degrees(angles)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("made", "speed", "driven"))
    parser.add_argument("--seeds", default="9400-9409")
    parser.add_argument("--vehicles", type=int)
    parser.add_argument("--nights", type=int, default=30)
    parser.add_argument("--only", default="")
    parser.add_argument("--few")
    parser.add_argument("--many")
    parser.add_argument("--truth", type=Path)
    asked = parser.parse_args()
    first, _, last = asked.seeds.partition("-")
    seeds = list(range(int(first), int(last or first) + 1))
    about = {"seeds": asked.seeds, "commit": commit_now()}
    if asked.what == "speed":
        print(json.dumps(speed(asked.vehicles or 10_000, asked.nights) | about))
        return
    if asked.what == "driven":
        for row in driven(asked.few, asked.many, asked.truth):
            print(json.dumps(row | about))
        return
    for question in (few_frames, shared, outside, half_drifts, without_one):
        if asked.only in question.__name__:
            for row in question(seeds, asked.vehicles or 100):
                print(json.dumps(row | about), flush=True)


if __name__ == "__main__":
    main()
