"""One moment of a day as a table row, with a row of each of its sensors.

A sensor whose payload is damaged, incomplete or a repetition is left out of its moment. For a rig with one
sensor of each kind, such a moment is kept if no complete moment within the second before shows the same
scene; for other rigs, if an edge can still be estimated between two of its sensors.

Repeated data under a new stamp are a stuck driver or a frozen image. Noise makes measurements differ between
moments, even when the car stands. So no two images, sweeps or scans of a day are equal to the byte. A list
of a few objects may be; it is not checked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64

from pipeline.core.config import IngestConfig
from pipeline.core.results import Progress
from pipeline.ingest.captures import Read, Rejected, readers_of
from pipeline.ingest.index import DayIndex
from pipeline.ingest.sync import Rejection, none_near
from pipeline.rig.graph import BASE, pose_columns, possible_edges
from pipeline.rig.prior import Star, between, middle_of, star_of, to_rows
from pipeline.rig.rig import Rig
from schemas.captures import Capture
from schemas.moments import SAME_SCENE_NS, Moment

__all__ = ["REPEATED", "Anchored", "MomentBuilder", "spread"]

REPEATED = {
    "camera": Rejection.IMAGE_REPEATED,
    "lidar": Rejection.LIDAR_REPEATED,
    "radar": Rejection.RADAR_REPEATED,
}


class LoggedPrior:
    """Collects the transforms between sensors, log by log; from a prior file if the rig names one."""

    def __init__(self, index: DayIndex, rig: Rig, given: Star | None) -> None:
        self._index, self._rig, self._given = index, rig, given
        self._stars: dict[tuple[int, tuple[tuple[str, str], ...]], tuple[Star, bool]] = {}
        self._untied: set[tuple[str, str]] = set()
        self.frame_ids: dict[str, list[str]] = {}

    def take(self, log: int, ids: Mapping[str, str]) -> bool:
        """Look up the poses of a moment's sensors by frame id; returns whether all of them are connected."""
        key = (log, tuple(ids.items()))
        if key not in self._stars:
            for sensor, frame_id in ids.items():
                if frame_id not in self.frame_ids.setdefault(sensor, []):
                    self.frame_ids[sensor].append(frame_id)
            frames = dict(ids) if self._rig.base is None else {**ids, BASE.name: self._rig.base}
            nodes = [node for node in self._rig.nodes if node.name in frames]
            star = self._given
            if star is None:
                star = star_of(nodes, lambda a, b: self._lookup(log, (a, frames[a]), (b, frames[b])))
            sensors = [node for node in nodes if node != BASE]
            middle = middle_of(sensors)
            self._stars[key] = star, all(between(star, middle.name, n.name) is not None for n in sensors)
        return self._stars[key][1]

    def rows(self) -> list[dict[str, Any]]:
        """Rows for the manifest: each transform of each log once, in the layout of `schemas.moments.PRIOR`."""
        rows = {}
        for (log, _), (star, _) in self._stars.items():
            for row in to_rows([star]):
                name = self._index.log_names[log]
                rows[name, row["parent"], row["child"], *row["q"], *row["t_m"]] = {"log": name, **row}
        return list(rows.values())

    def frames_above(self) -> list[dict[str, Any]]:
        """The frames between each sensor's frame and the root of the car's tree, as rows of T_parent_child."""
        chains: dict[tuple[str, str], np.ndarray] = {}
        for log in {key[0] for key in self._stars}:
            tree = self._index.trees[log]
            parent_of = tree.edges
            for frame in {name.lstrip("/") for ids in self.frame_ids.values() for name in ids}:
                child = frame
                while (parent := parent_of.get(child)) is not None and (parent, child) not in chains:
                    T = tree.lookup(parent, child)
                    assert T is not None, "an edge of the tree"
                    chains[parent, child] = T
                    child = parent
        return to_rows([chains])

    def _lookup(self, log: int, a: tuple[str, str], b: tuple[str, str]) -> np.ndarray | None:
        """T_a_b of two sensors with their frames."""
        T = self._index.trees[log].lookup(a[1], b[1])
        # Report each sensor once: if several have no chain, no two of them are connected.
        if T is None and not {a, b} <= self._untied:
            self._untied |= {a, b}
            names = f"{a[1] or '(no frame id)'} to {b[1] or '(no frame id)'}"
            self._index.complain(f"{self._rig.prior.topic} has no chain from {names}: no prior")
        return T


@dataclass(frozen=True, slots=True)
class Anchored:
    """Captures of one moment (indices by sensor), and its stretch of driving; the anchor of the day stamps it."""

    places: Mapping[str, int]
    drive: int


class MomentBuilder:
    """Builds rows from an index; `counts` collects dropped points and missing parts by name."""

    def __init__(
        self, index: DayIndex, rig: Rig, ingest: IngestConfig, file_prior: Star | None = None
    ) -> None:
        self._index, self._rig, self._anchor = index, rig, index.anchor
        self._stream = index.captures(index.anchor)
        self.counts: Counter[str] = Counter()
        self.prior = LoggedPrior(index, rig, file_prior)
        self._readers = readers_of(index, rig, ingest, self.counts)
        self._kinds = {node.name: node.kind for node in rig.nodes if node.name in self._readers}
        self._contents: dict[str, set[int]] = {sensor: set() for sensor in self._readers}
        self._whole_ns = -SAME_SCENE_NS  # stamp of the last moment with all sensors

    def built(
        self, anchored: Sequence[Anchored], rejected: Counter[str], progress: Progress
    ) -> Iterator[tuple[Moment, dict[str, Capture]]]:
        """Rows of the moments that are kept, numbered from 0; the others are counted in `rejected` by reason."""
        moment = 0
        for done, at in enumerate(anchored, 1):
            try:
                row = self._build(at, moment)
            except Rejected as outcome:
                rejected[outcome.reason] += 1
                if rejected[outcome.reason] == 1 and outcome.detail:
                    self._index.complain(str(outcome))
            else:
                moment += 1
                yield row
            progress(done, len(anchored), "frames")

    def _build(self, at: Anchored, moment: int) -> tuple[Moment, dict[str, Capture]]:
        """Rows of a moment and its sensors, called in order of time; raises Rejected if it is not kept."""
        missing: dict[str, Rejected] = {}
        parts = {s: part for s in self._readers if (part := self._part(s, at, moment, missing)) is not None}
        place = at.places[self._anchor]
        stamp_ns, log = self._stream.stamps[place], self._stream.located[place].log
        damaged = [why for sensor, why in missing.items() if sensor in at.places]
        if damaged and not self._is_worth_having(parts, stamp_ns):
            raise damaged[0]
        self._whole_ns = self._whole_ns if missing else stamp_ns
        self._count(missing)
        for part in parts.values():
            self.counts.update(part.dropped)
        is_tied = self.prior.take(log, {sensor: part.frame_id for sensor, part in parts.items()})
        self.counts["frames_without_prior"] += not is_tied
        ego = self._index.ego.at(stamp_ns)
        captures = {sensor: part.capture for sensor, part in parts.items()}
        row = Moment(
            moment=moment, log=self._index.log_names[log], drive=at.drive, stamp_ns=stamp_ns, rows={},
            gap_ns={sensor: capture.stamp_ns - stamp_ns for sensor, capture in captures.items()},
            ego_speed_mps=None if ego is None else ego.speed_mps,
            ego_yaw_rate_radps=None if ego is None else ego.yaw_rate_radps,
            **pose_columns(None if ego is None else ego.T_odom_vehicle, "ego_"),
        )  # fmt: skip
        return row, captures

    def _is_worth_having(self, parts: Collection[str], stamp_ns: int) -> bool:
        """Whether an incomplete moment shows a scene that no complete one shows."""
        if len(set(self._kinds.values())) == len(self._kinds):
            is_seen = stamp_ns - self._whole_ns <= SAME_SCENE_NS
            return len(parts) >= min(2, len(self._readers)) and not is_seen
        left = [n for n in self._rig.nodes if n.name in parts or n.kind == "base"]
        return len(parts) > 1 and bool(possible_edges(left))

    def _part(self, sensor: str, at: Anchored, moment: int, missing: dict[str, Rejected]) -> Read | None:
        """Row of one sensor in the moment; None if unusable, with the reason added to `missing`."""
        kind = self._kinds[sensor]
        try:
            if sensor in at.places:
                part = self._readers[sensor](at.places[sensor], moment)
                # Random collisions among a day's thousands of captures are negligible with 2**64 values, at a
                # third of a digest's time.
                content, seen = hash(part.content), self._contents[sensor]
                if not part.content or content not in seen:
                    seen.add(content)
                    return part
                missing[sensor] = Rejected(REPEATED[kind])
            else:
                silent = kind == "lidar" and not self._index.captures(sensor).stamps
                missing[sensor] = Rejected(Rejection.NO_LIDAR if silent else none_near(kind))
        except Rejected as why:
            missing[sensor] = why
        return None

    def _count(self, missing: Mapping[str, Rejected]) -> None:
        """Count the missing sensors of the moment by reason; each payload problem is reported once."""
        for sensor, why in missing.items():
            name = f"without_{sensor}_{why.reason}"
            self.counts[name] += 1
            if self.counts[name] == 1 and why.detail:
                self._index.complain(str(why))


def spread(count: int, limit: int | None) -> Int64[np.ndarray, " N"]:
    """At most `limit` of so many places, evenly spread."""
    if limit is None or count <= limit:
        return np.arange(count, dtype=np.int64)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))
