"""What study `states` measures of an exported file: errors against tomorrow's truth, and what becomes of them."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.config import VerifyConfig
from pipeline.rig.changes import change_between
from pipeline.rig.se3 import from_quaternion, inverse, transform_points
from pipeline.rig.spherical import camera_direction_angles, to_spherical, wrap_angle
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.calibrations import DOF_NAMES
from tests.benchmarks.studies.rates import rate

__all__ = ["Entry", "apart", "between", "counts", "measure", "read_file", "readme_text", "summary"]

_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_AHEAD_OF = ("camera", "radar", "lidar", "base")  # of an edge's ends, the one before which its targets lie
# A file is farther off than prior and record if by more than this: less is the mounts' scatter of one day.
_FARTHER_DEG, _FARTHER_M = 0.1, 0.02
_FARTHER = f"farther than prior and record (by {_FARTHER_DEG} deg or {_FARTHER_M} m)"
_COARSE = "coarse labels: first night with camera-lidar certified"
_LIMITS = VerifyConfig()
_UNITS = np.r_[np.full(3, 180 / np.pi), np.ones(3)]  # rows hold degrees and metres

Row = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Entry:
    """One transform of an exported file, T_parent_child by sensors' names.

    Args:
        what: edge, or pose (of the tree that a car loads).
        sigma: of the rotation about the parent's axes [rad] and the child's origin [m]; None = not stated.
        used: per DoF, whether it is of the data; the others are written at the prior.
        frames: names of both in the file, of poses.
        certified: azimuth, elevation; None = the file says nothing of it (poses).
    """

    what: str
    parent: str
    child: str
    T: np.ndarray | None
    sigma: np.ndarray | None = None
    used: tuple[bool, ...] = (True,) * 6
    certified: tuple[str, ...] | None = None
    status: str = ""
    reason: str = ""
    frames: tuple[str, str] = ("", "")


def between(poses: Mapping[str, np.ndarray], parent: str, child: str) -> np.ndarray:
    """T_parent_child from the poses of both in one frame, by name."""
    return inverse(poses[parent]) @ poses[child]


def read_file(folder: Path) -> list[Entry]:
    """Edges and poses of an exported calibration; none where nothing was written.

    All that the study knows of the format is here.
    """
    [*paths] = folder.glob("*.json")
    if not paths:
        return []
    held = json.loads(paths[0].read_text())
    sensor_of = {frame: sensor for sensor, frame in held["frame_names"].items()}
    entries = []
    for name, pair in held["pairs"].items():
        ends = name.split("-" if "-" in name else "_")
        at_prior = {*pair["kept_at_prior"]}
        entries.append(
            Entry(
                "edge", ends[0], ends[1], np.array(next(T for key, T in pair.items() if key.startswith("T_"))),
                _sigma(pair["sigma"]), tuple(dof not in at_prior for dof in DOF_NAMES),
                tuple(pair["certified"]), pair["status"], pair["reason"],
            )
        )  # fmt: skip
    used = {(e.parent, e.child): e.used for e in entries}
    for pose in held["poses"]:
        frames = pose["parent"], pose["child"]
        a, b = (sensor_of[frame] for frame in frames)
        own = used.get((a, b)) or _turned_round(used.get((b, a), (True,) * 6))
        T, sigma = np.array(pose["T_parent_child"]), _sigma(pose["sigma"])
        entries.append(Entry("pose", a, b, T, sigma, own, status="written", frames=frames))
    return entries


def _turned_round(used: tuple[bool, ...]) -> tuple[bool, ...]:
    """Axes used along the child's axes, which mix the parent's: all three, or none."""
    return (all(used[:3]),) * 3 + (all(used[3:]),) * 3


def _sigma(sigma: Mapping[str, float] | None) -> np.ndarray | None:
    return None if sigma is None else np.array(list(sigma.values()))


def apart(folder: Path, entries: Sequence[Entry]) -> tuple[float, float]:
    """Largest difference [deg], [m] of the ROS 2 file's transforms from the poses beside it; NaN if it lacks one."""
    launch = next(folder.glob("*.launch.yaml"), None)
    text = "" if launch is None else launch.read_text()
    found = {}
    for line in re.findall(r"--x .*", " ".join(text.split()).replace(" - node", "\n")):
        given = dict(re.findall(r"--([a-z-]+) '?([^\s']+)", line))
        q, t = ([float(given[n]) for n in names] for names in (("qw", "qx", "qy", "qz"), "xyz"))
        found[given["frame-id"], given["child-frame-id"]] = from_quaternion(np.array(q), np.array(t))
    poses = [(e, found.get(e.frames)) for e in entries if e.what == "pose"]
    changes = [
        np.full(6, np.nan) if T is None else change_between(e.T, T) for e, T in poses if e.T is not None
    ]
    largest = np.abs(np.array(changes or np.zeros((1, 6)))).max(axis=0) * _UNITS
    return float(largest[:3].max()), float(largest[3:].max())


def target_errors_deg(kinds: tuple[str, str], T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Mean azimuth and elevation error in the parent at targets ahead of the sensor with the narrower view."""
    parent, child = kinds
    owner = min(kinds, key=_AHEAD_OF.index)
    ahead = DEFAULT_TARGETS @ _OPTICAL if owner == "camera" else DEFAULT_TARGETS
    points = ahead if owner == child else transform_points(inverse(T_true), ahead)
    angles: Callable[[np.ndarray], np.ndarray] = (
        camera_direction_angles if parent == "camera" else to_spherical
    )
    off = angles(transform_points(T, points)) - angles(transform_points(T_true, points))
    azimuth, elevation = np.degrees(np.abs(wrap_angle(off[:, :2])).mean(axis=0))
    return float(azimuth), float(elevation)


def measure(
    entry: Entry,
    kinds: tuple[str, str],
    truth: Mapping[str, np.ndarray],
    others: Mapping[str, np.ndarray | None],
) -> dict[str, Any]:
    """An entry against the truth: errors and sigmas by axis [deg], [m], angles at targets, and those of `others`.

    Args:
        kinds: of its two sensors.
        truth: T_base_sensor by name.
        others: T_parent_child of the prior and of the last record; None = there is none.
    """
    row: dict[str, Any] = {
        "what": entry.what, "edge": f"{entry.parent}-{entry.child}", "kind": "_".join(kinds),
        "status": entry.status, "reason": entry.reason,
        "certified": None if entry.certified is None else list(entry.certified),
    }  # fmt: skip
    T_true = between(truth, entry.parent, entry.child)
    for name, T in {**others, "file": entry.T}.items():
        row[name] = None if T is None else _errors(kinds, T, T_true)
    if entry.T is not None:
        row["used"] = [int(u) for u in entry.used]
        row["sigma"] = None if entry.sigma is None else _rounded(entry.sigma * _UNITS)
    return row


def _errors(kinds: tuple[str, str], T: np.ndarray, T_true: np.ndarray) -> dict[str, Any]:
    change = change_between(T_true, T)
    azimuth, elevation = target_errors_deg(kinds, T, T_true)
    turn, shift = np.degrees(np.linalg.norm(change[:3])), np.linalg.norm(change[3:])
    return {
        "error": _rounded(change * _UNITS), "az_deg": _number(azimuth), "el_deg": _number(elevation),
        "turn_deg": _number(turn), "shift_m": _number(shift),
    }  # fmt: skip


def _rounded(values: np.ndarray) -> list[float]:
    return [_number(v) for v in values]


def _number(value: float) -> float:
    return float(f"{float(value):.4g}")


def limits_deg(kind: str) -> tuple[float, float]:
    """Largest azimuth and elevation error of a certified edge or pose."""
    if "radar" in kind:
        return _LIMITS.radar_limit_deg, _LIMITS.radar_elevation_limit_deg
    return (_LIMITS.camera_lidar_limit_deg,) * 2


def is_wrong(row: Row) -> bool:
    """A direction is certified, and its error at targets beyond the limit."""
    errors = row["file"]["az_deg"], row["file"]["el_deg"]
    return any(
        name in (row["certified"] or ()) and error > limit
        for name, error, limit in zip(("azimuth", "elevation"), errors, limits_deg(row["kind"]), strict=True)
    )


def is_right(row: Row) -> bool:
    """The file has it, and both directions are within their limits."""
    if row["file"] is None:
        return False
    azimuth, elevation = limits_deg(row["kind"])
    return bool(row["file"]["az_deg"] <= azimuth and row["file"]["el_deg"] <= elevation)


def is_farther(row: Row, by_deg: float = _FARTHER_DEG, by_m: float = _FARTHER_M) -> bool:
    """The file is farther from the truth than both the prior and the last record, in rotation or in position."""
    if row["record"] is None:
        return False
    return any(
        row["file"][name] > max(row["prior"][name], row["record"][name]) + by
        for name, by in (("turn_deg", by_deg), ("shift_m", by_m))
    )


def sigmas_off(row: Row) -> np.ndarray:
    """Errors in the file's sigmas, of the axes that are written as used; none where the file states none."""
    if not row["file"] or row["sigma"] is None:
        return np.zeros(0)
    used = np.array(row["used"], bool)
    return np.abs(np.array(row["file"]["error"])[used] / np.array(row["sigma"])[used])


def nights_until_right(rows: Sequence[Row]) -> int | None:
    """Nights from a knock until all edges of the sensor that a file of the vehicle ever had are right; None = never.

    0 = the file of the night after the drive that it happened on.
    """
    own = [r for r in rows if r["what"] == "edge" and r["moved"] in r["edge"].split("-")]
    had = {r["edge"] for r in own if r["file"] is not None}
    for night in sorted({r["night"] for r in own if r["night"] >= r["moved_on"]}):
        tonight = [r for r in own if r["night"] == night and r["edge"] in had]
        if tonight and all(is_right(r) for r in tonight):
            return int(night - rows[0]["moved_on"])
    return None


def summary(rows: Sequence[Row]) -> str:
    """Markdown: a column per rig and one of all, by what the study asks; then the faults, one a line."""
    rigs = sorted({r["rig"] for r in rows})
    columns = {rig: [r for r in rows if r["rig"] == rig] for rig in rigs} | {"all": list(rows)}
    if len(rigs) == 1:
        del columns["all"]
    cells = {name: counts(own) for name, own in columns.items()}
    heads = ["of the exported file, against tomorrow's truth", *cells]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    questions = next(iter(cells.values()))
    lines += ["| " + " | ".join([q, *(own[q] for own in cells.values())]) + " |" for q in questions]
    return "\n".join([*lines, "", *_by_edge(rows), "", *_faults(rows)])


def counts(rows: Sequence[Row]) -> dict[str, str]:
    """What the study asks, in words, and its answer from these lines."""
    written = [r for r in rows if r["file"] is not None]
    edges = [r for r in written if r["what"] == "edge"]
    z = [sigmas_off(r) for r in written]
    inside = np.concatenate([np.zeros(0), *z]) <= 3
    days = Counter(r["status"] for r in rows if r["what"] == "edge")
    moved = {(r["rig"], r["vehicle"]): r for r in rows if r["moved"] and r["knock"]}
    waits = {key: nights_until_right([r for r in rows if (r["rig"], r["vehicle"]) == key]) for key in moved}
    apart_deg = [r["ros2_apart"] for r in rows if r["ros2_apart"] is not None]
    return {
        "vehicles, nights": f"{len({(r['rig'], r['vehicle']) for r in rows})}, {len({r['night'] for r in rows})}",
        "edges and poses in files": f"{len(edges)} and {len(written) - len(edges)}",
        "edges by status": ", ".join(f"{word} {n}" for word, n in sorted(days.items())),
        "wrong and certified": rate(sum(map(is_wrong, edges)), len(edges)),
        "edges with a certified direction": rate(sum(bool(r["certified"]) for r in edges), len(edges)),
        "within 3 sigmas, of all axes used": rate(int(inside.sum()), len(inside)),
        "edges and poses with all axes used within 3": rate(sum(bool((v <= 3).all()) for v in z), len(z)),
        _FARTHER: rate(sum(map(is_farther, written)), len(written)),
        "farther by anything": rate(sum(is_farther(r, 0, 0) for r in written), len(written)),
        "nights from a knock until right": ", ".join(
            f"{rows_of['vehicle'].removeprefix('vehicle-')} ({rows_of['story']}): {'never' if n is None else n}"
            for (rows_of, n) in zip(moved.values(), waits.values(), strict=True)
        ),
        _COARSE: _coarse(rows),
        "ROS 2 file apart from the other [deg, m]": f"{max((a[0] for a in apart_deg), default=0):.2g}, "
        f"{max((a[1] for a in apart_deg), default=0):.2g}",
    }


# Of `counts`, those with a goal: what the table of all results asks, the goal, the key.
_GOALS = (
    ("files of states, against the next drive: certified and wrong", "0 of 600", "wrong and certified"),
    ("the same: axes that are used within 3 sigmas", "99 %", "within 3 sigmas, of all axes used"),
    ("the same: farther from the truth than prior and record", "0", _FARTHER),
    ("coarse labels: night of the first state that certifies camera-lidar", "4", _COARSE),
)


def readme_text(rows: Sequence[Row]) -> str:
    """Rows for results/rows.toml, and the paragraph of results/README.md, of these lines."""
    same = 'file = "states.jsonl"\nmeasure = "states"'
    made = [
        f'[[row]]\nquestion = "{q}"\ngoal = "{goal}"\n{same}\ncount = "{key}"\n' for q, goal, key in _GOALS
    ]
    seeds = ", ".join(sorted({f"{r['rig']} {r['seed']}" for r in rows}))
    told = "; ".join(f"{name}: {text}" for name, text in counts(rows).items())
    commits = ", ".join(sorted({r["commit"] for r in rows}))
    command = "`python -m tests.benchmarks.studies.states --keep DIR` -> [states.jsonl](states.jsonl)"
    return "\n".join([*made, f"{command}. Seeds {seeds}, code of {commits}. {told}."])


def _coarse(rows: Sequence[Row]) -> str:
    own = [r for r in rows if r["story"] == "coarse" and r["kind"] == "camera_lidar" and r["what"] == "edge"]
    words = []
    for edge in sorted({(r["rig"], r["edge"]) for r in own}):
        nights = [
            r["night"] + 1 for r in own if (r["rig"], r["edge"]) == edge and len(r["certified"] or ()) == 2
        ]
        words.append(f"{edge[1]}: {min(nights, default='never')}")
    return ", ".join(words)


def _by_edge(rows: Sequence[Row]) -> list[str]:
    """Errors at targets (RMS, of those in files) and their certification, by rig and edge."""
    heads = [
        "edge",
        "in files",
        "az/el RMS [deg]",
        "prior's",
        "last record's",
        "certified az, el",
        "beyond 3 sigmas",
    ]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for key in sorted({(r["rig"], r["what"], r["edge"]) for r in rows}):
        own = [r for r in rows if (r["rig"], r["what"], r["edge"]) == key]
        held = [r for r in own if r["file"] is not None]
        z = np.concatenate([np.zeros(0), *map(sigmas_off, held)])
        cells = [
            " ".join(key), f"{len(held)} of {len(own)}", *(_rms(held, name) for name in ("file", "prior", "record")),
            ", ".join(str(sum(d in (r["certified"] or ()) for r in held)) for d in ("azimuth", "elevation")),
            f"{int((z > 3).sum())} of {len(z)}",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _rms(rows: Sequence[Row], name: str) -> str:
    found = [r[name] for r in rows if r[name] is not None]
    if not found:
        return "-"
    return "/".join(f"{np.sqrt(np.mean([f[k] ** 2 for f in found])):.3f}" for k in ("az_deg", "el_deg"))


def _faults(rows: Sequence[Row]) -> list[str]:
    """What is wrong and certified, farther off than prior and record, or beyond 5 sigmas: a line each."""
    lines = []
    for r in (r for r in rows if r["file"] is not None):
        z = sigmas_off(r)
        what = [
            *(["WRONG and certified"] if r["what"] == "edge" and is_wrong(r) else []),
            *(["farther than prior and record"] if is_farther(r) else []),
            *([f"{z.max():.1f} sigmas"] if len(z) and z.max() > 5 else []),
        ]
        if what:
            lines.append(
                f"- {r['rig']} {r['vehicle']} ({r['story']}, moved on {r['moved_on'] + 1}) night {r['night'] + 1} "
                f"{r['what']} {r['edge']}: {', '.join(what)}; az/el/turn [deg], shift [m] of file {_told(r['file'])}, "
                f"prior {_told(r['prior'])}, record {_told(r['record'])}"
            )
    return lines


def _told(errors: Mapping[str, Any] | None) -> str:
    if errors is None:
        return "-"
    return "/".join(f"{errors[k]:.3g}" for k in ("az_deg", "el_deg", "turn_deg", "shift_m"))
