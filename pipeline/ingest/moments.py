"""One moment of a day as a table row, with a row of each of its sensors.

A sensor whose payload is damaged, incomplete or a repetition is left out of its moment. For a rig with one
sensor of each kind, such a moment is kept if no complete moment within the second before shows the same
scene; for other rigs, if an edge can still be estimated between two of its sensors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from pipeline.core.config import IngestConfig
from pipeline.ingest.captures import Read, Rejected, readers_of
from pipeline.ingest.index import DayIndex
from pipeline.ingest.logged_prior import LoggedPrior
from pipeline.ingest.repetition import REPEATED, Repetitions
from pipeline.ingest.sync import Rejection, none_near
from pipeline.rig.graph import possible_edges
from pipeline.rig.pose_columns import pose_columns
from pipeline.rig.prior import Star
from pipeline.rig.rig import Rig
from schemas.captures import Capture
from schemas.moments import SAME_SCENE_NS, Moment

__all__ = ["Anchored", "MomentBuilder"]


@dataclass(frozen=True, slots=True)
class Anchored:
    """Captures of one moment (indices by sensor), the sensor that stamps it, and its stretch of driving."""

    places: Mapping[str, int]
    anchor: str
    drive: int


class MomentBuilder:
    """Builds rows from an index; `counts` collects dropped points and missing parts by name."""

    def __init__(
        self, index: DayIndex, rig: Rig, ingest: IngestConfig, file_prior: Star | None = None
    ) -> None:
        self._index, self._rig = index, rig
        self.counts: Counter[str] = Counter()
        self.prior = LoggedPrior(index, rig, file_prior)
        self._readers = readers_of(index, rig, ingest, self.counts)
        self._kinds = {node.name: node.kind for node in rig.nodes if node.name in self._readers}
        self._repetitions = {sensor: Repetitions() for sensor in self._readers}
        self._whole_ns = -SAME_SCENE_NS  # stamp of the last moment with all sensors

    def build(self, at: Anchored, moment: int) -> tuple[Moment, dict[str, Capture]]:
        """Rows of a moment and its sensors, called in order of time; raises Rejected if it is not kept."""
        missing: dict[str, Rejected] = {}
        parts = {s: part for s in self._readers if (part := self._part(s, at, moment, missing)) is not None}
        stream = self._index.captures(at.anchor)
        stamp_ns, log = stream.stamps[at.places[at.anchor]], stream.located[at.places[at.anchor]].log
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
                part = self._readers[sensor].read(at.places[sensor], moment)
                if self._repetitions[sensor].is_new(part.measured):
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
