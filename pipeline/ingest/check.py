"""Check whether logs can be calibrated, and which DoF: by topics, stamps, frame ids and some frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from pipeline.core.config import FleetConfig, IngestConfig
from pipeline.core.errors import ConfigError, SolveError
from pipeline.core.results import Progress, silent
from pipeline.ingest.directions_and_units import prior_transform
from pipeline.ingest.index import DayIndex, index_logs
from pipeline.ingest.messages.radar import CORRECT_FIELD
from pipeline.ingest.moments import MomentBuilder, spread
from pipeline.ingest.readiness import DofVerdict, Evidence, Unheard, overall, unheard_topics
from pipeline.ingest.reasons import because
from pipeline.ingest.rig_sample import RigFinding, RigSample
from pipeline.ingest.roles import NEEDED, topics_of
from pipeline.ingest.stage import pick_moments, read_file_prior
from pipeline.ingest.sync import WRONG_UNIT, constant_gap_ns, nearest_gaps_ns
from pipeline.rig.day_prior import no_prior, rig_prior
from pipeline.rig.prior import RigPrior
from pipeline.rig.rig import Rig
from pipeline.store.views import logged_stars
from schemas.calibrations import SENSORS
from schemas.faults import FAULTS
from schemas.frames import Frame

__all__ = ["CheckReport", "SyncQuality", "TopicFinding", "check_logs"]

_SAMPLE = 40  # frames that are decoded; of the others only the stamps are read


@dataclass(frozen=True)
class TopicFinding:
    """One topic of the rig; `problem` is empty if there is none."""

    role: str
    topic: str
    types: list[str]
    messages: int
    rate_hz: float | None
    problem: str = ""


@dataclass(frozen=True)
class SyncQuality:
    """Synchronisation: median time from sweeps to the nearest image and scan, and moments within the gate.

    `gate_ms` applies to raw stamps, None if the gate is by motion; `camera_offset_ms` and `radar_offset_ms`
    are the constant parts of the gaps, 0 if a sensor is not triggered.
    """

    sweeps: int
    moments: int
    camera_median_ms: float | None
    radar_median_ms: float | None
    gate_ms: float | None
    camera_offset_ms: float
    radar_offset_ms: float


@dataclass(frozen=True)
class CheckReport:
    """Result of `boresight check`; `answer` is "yes", "weak", "partly" or "no".

    `corrections` has what is wrong in fleet.toml or in the recording, and how to correct it: before a night.
    """

    answer: str
    verdicts: list[DofVerdict]
    rig: RigFinding
    evidence: Evidence
    topics: list[TopicFinding]
    sync: SyncQuality
    frame_ids: dict[str, list[str]]
    has_point_time: bool
    has_odometry: bool
    rejected: dict[str, int]
    problems: list[str]
    advice: list[str]
    corrections: list[str]


def check_logs(
    logs: Sequence[Path], rig: Rig, fleet: FleetConfig, progress: Progress = silent
) -> CheckReport:
    """Check logs without writing; raises ConfigError for a missing log or an unusable prior file."""
    missing = [str(p) for p in logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    progress(0, 0, "reading the index")
    index = index_logs(logs, rig)
    try:
        anchored, rejected = pick_moments(index, rig, fleet.ingest)
        builder = MomentBuilder(index, rig, fleet.ingest, read_file_prior(rig, fleet))
        picked, damaged = [anchored[i] for i in spread(len(anchored), _SAMPLE)], Counter[str]()
        built = list(builder.built(picked, damaged, progress))
        for reason in damaged:
            if not any(problem.startswith(reason) for problem in index.problems):
                index.complain(reason)
        rejected += damaged
        without = Counter({k: n for k, n in builder.counts.items() if k.startswith("without_")})
        unheard = unheard_topics(index, rig)
    finally:
        index.close()
    topics = _topics(index, rig, unheard)
    silent = dict[str, tuple[str, ...]]()
    for found in (u for u in unheard if u.role.what in NEEDED):
        silent[found.role.sensor] = (*silent.get(found.role.sensor, ()), str(found))
    shown = {sensor for _, captures in built for sensor in captures}
    silent |= _of_another_unit(rejected + builder.counts, rig, index.problems, shown)
    rows = builder.prior.rows()
    present = [frozenset(a.places) for a in anchored]
    prior = _prior(rows, fleet, rig, index.problems) if built else None
    of_tracks = {t.topic for t in topics if any(kind.endswith("RadarTracks") for kind in t.types)}
    tracked = [name for name, radar in rig.radars.items() if radar.points in of_tracks]
    sample = RigSample(rig, built, len(picked), present, logged_stars(rows), prior, silent, tracked)
    verdicts = [v for own in sample.verdicts.values() for v in own]
    first = sample.frames({str(kind): sensor for sensor, kind in reversed(index.kinds.items())})
    return CheckReport(
        answer=overall(verdicts) if verdicts else "no", verdicts=verdicts, rig=sample.finding,
        evidence=sample.whole, topics=topics, sync=_sync(index, len(anchored), fleet.ingest),
        frame_ids=builder.prior.frame_ids, has_point_time=any(f.lidar_time_s is not None for f in first),
        has_odometry=any(f.ego_speed_mps is not None for f in first),
        rejected={str(k): int(v) for k, v in (rejected + index.damage + without).items() if v},
        problems=index.problems, advice=[*sample.advice, *_advice(first, rig, topics, sample.whole.frames)],
        corrections=_corrections(unheard, sample, index.problems, {p.name for p in logs}),
    )  # fmt: skip


def _corrections(
    unheard: Sequence[Unheard], sample: RigSample, problems: Sequence[str], names: Collection[str]
) -> list[str]:
    """Mistakes that no further drive mends: topics, fields, signs and units, a missing prior, unusable logs."""
    found = [str(u) for u in unheard if u.is_misconfigured]
    found += [p for p in problems if p.endswith(CORRECT_FIELD)]
    if not sample.built:
        of_logs = [p for p in problems if Path(p.split(":")[0]).name in names]
        return found or [because("again", problem=p) for p in of_logs]
    for of in sample.evidence.values():
        found += [of.doppler_problem] if of.doppler_is_wrong else []
        found += of.wrong
    untied = [sample.name(edge) for edge, of in sample.evidence.items() if of.frames and not of.has_prior]
    if untied or sample.prior is None:
        found.append(because("write prior", reason=no_prior(", ".join(untied) or "any pair")))
    return list(dict.fromkeys(found))


def _prior(
    rows: Sequence[Mapping[str, Any]], fleet: FleetConfig, rig: Rig, problems: list[str]
) -> RigPrior | None:
    """Prior of all sensors; None if there is none, with the reason added to `problems`."""
    try:
        return rig_prior(rows, fleet, rig)
    except SolveError as err:
        problems.append(err.reason)
        return None


def _of_another_unit(
    counts: Counter[str], rig: Rig, problems: Sequence[str], shown: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """Topics by sensor whose points are not in metres; their problem names the unit that fits."""
    found = dict[str, tuple[str, ...]]()
    for node in (n for n in rig.nodes if n.kind in WRONG_UNIT):
        reason = WRONG_UNIT[node.kind]
        rejected = 0 if node.name in shown else counts[reason]
        if counts[f"without_{node.name}_{reason}"] + rejected:
            why = next((p for p in problems if p.startswith(reason)), FAULTS["unit"])
            topics = rig.lidars if node.kind == "lidar" else rig.radars
            found[node.name] = (f"{topics[node.name].points} ({node.name}): {why}",)
    return found


def _topics(index: DayIndex, rig: Rig, unheard: Sequence[Unheard]) -> list[TopicFinding]:
    problems = {found.topic: found.problem for found in unheard}
    findings = []
    for topic, role in topics_of(rig).items():
        types = index.types_of(topic)
        stamps = np.unique(index.stream(role).stamps_ns)
        rate = float(1e9 / np.median(np.diff(stamps))) if len(stamps) > 2 else None
        problem = problems.get(topic, "" if types else because("no message"))
        findings.append(TopicFinding(str(role), topic, sorted(types), sum(types.values()), rate, problem))
    return findings


def _sync(index: DayIndex, moments: int, config: IngestConfig) -> SyncQuality:
    others = [
        next((s for s, k in index.kinds.items() if k == kind and s != index.anchor), "") for kind in SENSORS
    ]
    lidar, image, radar = (
        np.unique(index.captures(s).stamps_ns) for s in (index.anchor, others[0], others[2])
    )
    return SyncQuality(
        sweeps=len(index.captures(index.anchor).stamps),
        moments=moments,
        camera_median_ms=_median_distance_ms(lidar, image),
        radar_median_ms=_median_distance_ms(lidar, radar),
        gate_ms=None if config.sync_gate_s is None else config.sync_gate_s * 1e3,
        camera_offset_ms=constant_gap_ns(lidar, image) * 1e-6,
        radar_offset_ms=constant_gap_ns(lidar, radar) * 1e-6,
    )


def _median_distance_ms(a_ns: Int64[np.ndarray, " N"], b_ns: Int64[np.ndarray, " M"]) -> float | None:
    if not len(a_ns) or not len(b_ns):
        return None
    return float(np.median(np.abs(nearest_gaps_ns(a_ns, b_ns))) * 1e-6)


def _advice(frames: list[Frame], rig: Rig, topics: list[TopicFinding], usable: int) -> list[str]:
    advice = [
        f"{t.topic}: {t.problem}" for t in topics if t.problem and t.role not in {"tf_static", "odometry"}
    ]
    if frames and "camera_lidar" in frames[0].priors:
        R = prior_transform(frames[0], "camera_lidar")[:3, :3]
        # The lidar's up axis is -y in an optical frame; if it is off by more than 45 deg, the frame is not
        # optical.
        if -R[1, 2] < np.cos(np.pi / 4):
            advice.append(because("not optical"))
    if rig.ego is None and not rig.radars:
        advice.append(because("no speed"))
    elif rig.ego is None:
        advice.append(because("no odometry"))
    elif frames and all(f.ego_speed_mps is None for f in frames):
        advice.append(because("odometry silent", topic=rig.ego.odometry))
    untimed = any("lidar" in f.sensors for f in frames) and all(f.lidar_time_s is None for f in frames)
    if untimed and all(lidar.turn is None for lidar in rig.lidars.values()):
        advice.append(because("no times"))
    if 0 < usable < 100:
        advice.append(because("longer", frames=usable))
    return advice
