"""Can these logs be calibrated, and which DoF? Looks at topics, stamps, frame ids and a sample of frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from pipeline.config import FleetConfig, IngestConfig
from pipeline.errors import ConfigError
from pipeline.geometry.scan_rows import rows_of
from pipeline.geometry.spherical import to_spherical
from pipeline.ingest.captures import Rejected
from pipeline.ingest.directions_and_units import Motion, motion_of, prior_transform
from pipeline.ingest.index import ACCEPTED_TYPES, DayIndex, index_logs
from pipeline.ingest.moments import MomentBuilder
from pipeline.ingest.readiness import DofVerdict, Evidence, judge, overall
from pipeline.ingest.roles import NEEDED, topics_of
from pipeline.ingest.stage import pick_moments, read_file_prior
from pipeline.ingest.sync import WRONG_UNIT, constant_gap_ns
from pipeline.results import Progress, silent
from pipeline.rig.rig import Rig
from pipeline.rigs import OnnxSemantics
from pipeline.store.views import frame_of, logged_stars, priors_of
from schemas.calibrations import SENSORS, pairs_of
from schemas.captures import Capture
from schemas.faults import FAULTS
from schemas.frames import Frame
from schemas.moments import Moment

__all__ = ["CheckReport", "SyncQuality", "TopicFinding", "check_logs"]

_SAMPLE = 40  # frames looked into; the rest only by their stamps


@dataclass(frozen=True)
class TopicFinding:
    """One topic that the rig names. `problem` is empty where it is as it must be."""

    role: str
    topic: str
    types: list[str]
    messages: int
    rate_hz: float | None
    problem: str = ""


@dataclass(frozen=True)
class SyncQuality:
    """How sweeps meet images and scans: median distance to the nearest, and moments within the gate.

    `gate_ms` is of raw stamps, None where the gate is by motion; `camera_offset_ms` and `radar_offset_ms` are the
    constant parts of the gaps, 0 where sensors run freely.
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
    """What `boresight check` found. `answer` is "yes", "partly" or "no"."""

    answer: str
    verdicts: list[DofVerdict]
    evidence: Evidence
    topics: list[TopicFinding]
    sync: SyncQuality
    frame_ids: dict[str, list[str]]
    has_point_time: bool
    has_odometry: bool
    rejected: dict[str, int]
    problems: list[str]
    advice: list[str]


def check_logs(
    logs: Sequence[Path],
    rig: Rig,
    fleet: FleetConfig,
    progress: Progress = silent,
) -> CheckReport:
    """Look at logs without writing anything.

    Raises:
        ConfigError: a log does not exist, or the prior file is unusable.
    """
    missing = [str(p) for p in logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    progress(0, 0, "reading the index")
    index = index_logs(logs, rig, survey=True)
    try:
        anchored, rejected = pick_moments(index, fleet.ingest)
        builder = MomentBuilder(index, rig, fleet.ingest, read_file_prior(rig, fleet))
        built = []
        picked = np.unique(np.linspace(0, max(len(anchored) - 1, 0), _SAMPLE).round().astype(int))
        for done, i in enumerate(picked if anchored else [], 1):
            try:
                built.append(builder.build(anchored[i], int(i)))
            except Rejected as outcome:
                rejected[outcome.reason] += 1
                index.complain(str(outcome))
            progress(done, len(picked), "frames looked at")
        without = Counter({k: n for k, n in builder.counts.items() if k.startswith("without_")})
    finally:
        index.close()
    frames = _frames(built, index, builder)
    usable = round(len(anchored) * len(frames) / len(picked)) if anchored else 0
    topics = _topics(index, rig)
    needed = {str(role) for role in topics_of(rig).values() if role.what in NEEDED}
    missing = [f"{t.topic} ({t.role}): {t.problem}" for t in topics if t.problem and t.role in needed]
    missing += _of_another_unit(rejected + builder.counts, rig, index.problems)
    motion = motion_of(frames, rig)
    has_prior = 2 * builder.counts["frames_without_prior"] < len(frames)
    evidence = replace(_evidence(frames, usable, rig, motion, has_prior=has_prior), missing=tuple(missing))
    verdicts = judge(evidence)
    return CheckReport(
        answer=overall(verdicts),
        verdicts=verdicts,
        evidence=evidence,
        topics=topics,
        sync=_sync(index, len(anchored), fleet.ingest),
        frame_ids=builder.prior.frame_ids,
        has_point_time=any(f.lidar_time_s is not None for f in frames),
        has_odometry=any(f.ego_speed_mps is not None for f in frames),
        rejected={str(k): int(v) for k, v in (rejected + index.damage + without).items() if v},
        problems=index.problems,
        advice=[*motion.advice, *_advice(frames, rig, topics, usable)],
    )


def _frames(
    built: Sequence[tuple[Moment, Mapping[str, Capture]]], index: DayIndex, builder: MomentBuilder
) -> list[Frame]:
    """Moments as the first camera, lidar and radar saw them."""
    chosen = {kind: sensor for sensor, kind in reversed(index.kinds.items())}
    stars = logged_stars(builder.prior.rows())
    priors = {log: priors_of(star, chosen) for log, star in stars.items()}
    return [
        frame_of(
            moment, {k: captures[s] for k, s in chosen.items() if s in captures}, priors.get(moment.log, {})
        )
        for moment, captures in built
    ]


def _of_another_unit(counts: Counter[str], rig: Rig, problems: Sequence[str]) -> list[str]:
    """Sensors whose points are no metres, as topics that are as good as missing, and which unit fits."""
    named = {"lidar": rig.lidar, "radar": rig.radar}
    found = []
    for sensor, reason in WRONG_UNIT.items():
        topics = named[sensor]
        if topics is not None and counts[reason] + counts[f"without_{sensor}_{reason}"]:
            why = next((p for p in problems if p.startswith(reason)), FAULTS["unit"])
            found.append(f"{topics.points} ({sensor}): {why}")
    return found


def _evidence(frames: list[Frame], usable: int, rig: Rig, motion: Motion, *, has_prior: bool) -> Evidence:
    def share(flags: list[bool]) -> float:
        return float(np.mean(flags)) if flags else 0.0

    # A rig without a camera lacks no labels, but has no boxes either.
    has_labels = rig.camera is None or isinstance(rig.semantics, OnnxSemantics)
    rings = max((_rings(f) for f in frames), default=0)
    seen, swept, scanned = ([f for f in frames if sensor in f.sensors] for sensor in SENSORS)
    return Evidence(
        frames=usable,
        has_prior=has_prior,
        labels_share=1.0 if has_labels else share([f.labels_png is not None for f in seen]),
        detections_share=1.0
        if isinstance(rig.semantics, OnnxSemantics)
        else share([f.detection_boxes_px is not None for f in seen]),
        has_intensity=share([f.lidar_intensity is not None for f in swept]) > 0.5,
        rings=rings,
        elevation_share=share([f.radar_has_elevation for f in scanned]),
        moving_share=motion.moving_share,
        doppler_problem=motion.doppler_problem,
        doppler_is_wrong=motion.doppler_is_wrong,
        wrong=motion.wrong,
        frames_of={
            pair: round(usable * share([pair in pairs_of(f.sensors) for f in frames]))
            for pair in pairs_of(rig.sensors)
        },
    )


def _rings(frame: Frame) -> int:
    """Rows that the log names; none where what it calls rings are lasers of a pattern without rows."""
    if frame.lidar_ring is None:
        return 0
    xyz = frame.lidar_xyz_m.astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    row = rows_of(to_spherical(xyz[finite]), frame.lidar_ring[finite])
    return 0 if row is None else int(row.max()) + 1


def _topics(index: DayIndex, rig: Rig) -> list[TopicFinding]:
    findings = []
    for topic, role in topics_of(rig).items():
        types = Counter({kind: n for (name, kind), n in index.surveyed.items() if name == topic})
        wanted = ACCEPTED_TYPES[role.what]
        problem = ""
        if not types:
            others = sorted(
                {name for (name, kind) in index.surveyed if kind in wanted and name not in topics_of(rig)}
            )
            problem = "no message" + (f"; the same type comes on {', '.join(others[:4])}" if others else "")
        elif not set(types) & set(wanted):
            problem = f"type {', '.join(types)}, not {' or '.join(wanted)}"
        stamps = np.unique(index.stream(role).stamps_ns)
        rate = float(1e9 / np.median(np.diff(stamps))) if len(stamps) > 2 else None
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
    right = np.clip(np.searchsorted(b_ns, a_ns), 1, max(len(b_ns) - 1, 1))
    nearest = np.minimum(
        np.abs(a_ns - b_ns[np.minimum(right, len(b_ns) - 1)]), np.abs(a_ns - b_ns[right - 1])
    )
    return float(np.median(nearest) * 1e-6)


def _advice(frames: list[Frame], rig: Rig, topics: list[TopicFinding], usable: int) -> list[str]:
    advice = [
        f"{t.topic}: {t.problem}" for t in topics if t.problem and t.role not in {"tf_static", "odometry"}
    ]
    if frames and "camera_lidar" in frames[0].priors:
        R = prior_transform(frames[0], "camera_lidar")[:3, :3]
        # Up of the lidar is -y of an optical frame; more than 45 deg off, the frame is no optical one.
        if -R[1, 2] < np.cos(np.pi / 4):
            advice.append(
                "the image's frame id is no optical frame (x right, y down, z forward): check /tf_static"
            )
    if rig.ego is None and rig.radar is None:
        advice.append(
            "no odometry configured, and no radar: the car's speed and the time offset stay unknown"
        )
    elif rig.ego is None:
        advice.append(
            "no odometry configured: ego speed comes from Doppler, by which the lidar is de-skewed but for turns"
        )
    elif frames and all(f.ego_speed_mps is None for f in frames):
        advice.append(
            f"{rig.ego.odometry} never brackets a sweep: the lidar is de-skewed by Doppler, but for turns"
        )
    if any("lidar" in f.sensors for f in frames) and all(f.lidar_time_s is None for f in frames):
        advice.append("the lidar logs no time per point: sweeps cannot be de-skewed")
    if 0 < usable < 100:
        advice.append(f"{usable} frames: a calibration takes 100 where it can, so log a longer drive")
    return advice
