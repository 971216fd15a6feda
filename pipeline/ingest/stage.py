"""Stage ingest: the logs of one vehicle-day to one partition of `frames`."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from pipeline.config import FleetConfig, IngestConfig
from pipeline.errors import ConfigError
from pipeline.extrinsics.prior_file import read_transforms
from pipeline.ingest.containers.reader import content_identity
from pipeline.ingest.frame_builder import FrameBuilder, Rejected, Trio
from pipeline.ingest.index import DayIndex, index_logs, topics_of
from pipeline.ingest.repetition import REPEATED
from pipeline.ingest.sync import (
    WRONG_UNIT,
    Rejection,
    Trios,
    match_by_motion,
    match_nearest,
    match_trios,
    motion_gates_ns,
    number_drives,
)
from pipeline.results import Progress
from pipeline.rig.rig import Rig
from pipeline.work import NothingUsable, Run, Task, Work
from schemas.faults import FAULTS
from schemas.frames import SENSORS_ABSENT, SWEEPS_LOGGED, SWEEPS_PLANNED, SWEEPS_READ, Frame

__all__ = ["find_trios", "pick_trios", "read_file_prior", "work"]

_PROBLEMS_SHOWN = 3
# Reasons that state a fault.
_STATED = dict.fromkeys(REPEATED.values(), "stuck_sensor") | dict.fromkeys(WRONG_UNIT.values(), "unit")
_NO_STAMP_NS = -(10**18)  # long before any log
_SAME_IMAGE_NS = 5_000_000  # labels and detections carry the stamp of the image that they were computed on
_FAR_FROM_DAY = dt.timedelta(hours=12 + 14 + 12)  # half a day, the earliest time zone, and a night's drive
_UNUSABLE = (
    Rejection.IMAGE_DAMAGED,
    Rejection.IMAGE_SIZE,
    Rejection.CAMERA_INFO,
    Rejection.LIDAR_DAMAGED,
    Rejection.LIDAR_SPARSE,
    Rejection.RADAR_DAMAGED,
    Rejection.RADAR_SPARSE,
    *_STATED,
)


def work(task: Task) -> Work:
    """The partition of `frames` that the task's logs give.

    A day without a single moment that two sensors saw is refused: nothing is written (an empty table would look like a
    day that was looked at and gave nothing), a partition of earlier inputs stays, and the reason names topics and what
    to do. `rejected` counts each sweep that became no frame under one Rejection, and damage, dropped points and missing
    parts under names of their own.

    Raises:
        ConfigError: unknown vehicle, a log that does not exist, an unusable prior file.
    """
    rig = task.fleet.rig_of(task.partition.vehicle)
    missing = [str(p) for p in task.logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    file_prior = read_file_prior(rig, task.fleet)
    prior_key = {} if file_prior is None else {"prior": [T.tolist() for T in file_prior.values()]}
    config = task.fleet.ingest
    wider = (config.wider, config.wider.wider)  # as a night reads a long day that asked for more
    return Work(
        (config, rig, prior_key),
        lambda run: _rows(task, rig, file_prior, run),
        inputs=tuple(sorted(content_identity(p) for p in task.logs)),
        wider=() if config.read_budget is None else tuple((c, rig, prior_key) for c in wider),
    )


def _rows(
    task: Task, rig: Rig, file_prior: dict[str, np.ndarray] | None, run: Run
) -> Generator[Frame, None, None]:
    """The day's frames in order of time, one at a time."""
    config = task.fleet.ingest
    run.progress(0, 0, "reading the index")
    index = index_logs(task.logs, rig, budget=config.read_budget)
    try:
        builder = FrameBuilder(index, rig, config, file_prior)
        trios, rejected = pick_trios(index, config)
        made = 0
        for frame in _frames(trios, builder, index, rejected, run.progress):
            made += 1
            yield frame
        run.rejected.update(_all_counts(rejected, index, builder))
        run.kept.update(_reading_counts(index))
        if not made:
            raise NothingUsable(*refusal(index, rig, rejected, config))
        _complain_of_date(index, task.partition.day)
        run.extra |= {"problems": index.problems, "logs": index.log_names, "frame_ids": builder.frame_ids}
        run.extra[SENSORS_ABSENT] = absences(index, rig, builder.counts, config)
        run.remarks = _shorten(index.problems)
    finally:
        index.close()


def _complain_of_date(index: DayIndex, day: str) -> None:
    """Name a day whose sweeps were stamped on another one, whatever the time zone and also of a drive over midnight."""
    stamps_ns = index.stream(index.anchor).stamps_ns
    stamped = dt.datetime.fromtimestamp(float(np.median(stamps_ns)) * 1e-9, dt.UTC)
    if abs(stamped - dt.datetime.fromisoformat(f"{day}T12:00+00:00")) > _FAR_FROM_DAY:
        index.complain(
            f"sweeps are stamped {stamped:%Y-%m-%d %H:%M} UTC, far from the day {day} that they are filed under"
        )


def pick_trios(index: DayIndex, config: IngestConfig) -> tuple[list[Trio], Counter[str]]:
    """Trios in order of time, thinned evenly to `max_frames`, and why the other sweeps are left out."""
    found, drives = find_trios(index, config), _drives(index)
    # Both are as long as there are moments; of one without an image they match nothing.
    images_ns = np.append(index.stream("image").stamps_ns, _NO_STAMP_NS)[found.camera]
    labels = match_nearest(images_ns, index.stream("labels").stamps_ns, _SAME_IMAGE_NS)
    detections = match_nearest(images_ns, index.stream("detections").stamps_ns, _SAME_IMAGE_NS)
    picked = _spread(len(found.lidar), config.max_frames)
    anchors = found.lidar if index.anchor == "lidar" else found.radar
    trios = [
        Trio(
            camera=_place(found.camera[i]),
            lidar=_place(found.lidar[i]),
            radar=_place(found.radar[i]),
            labels=_place(labels[i]),
            detections=_place(detections[i]),
            drive=int(drives[anchors[i]]),
        )
        for i in picked
    ]
    return trios, +(found.rejected + Counter({Rejection.NOT_PICKED: len(found.lidar) - len(picked)}))


def _place(at: np.int64) -> int | None:
    return int(at) if at >= 0 else None


def find_trios(index: DayIndex, config: IngestConfig) -> Trios:
    """All trios of the day, or of its bursts, within the gate that the configuration asks for.

    Without a sweep all day, the radar's scans with an image.
    """
    lidar, camera, radar = (index.stream(role).stamps_ns for role in (index.anchor, "image", "radar"))
    is_swept = index.anchor == "lidar"
    radar = radar if is_swept else radar[:0]
    wanted = index.sweeps_in_bursts()
    lidar = lidar[wanted]
    if config.sync_gate_s is not None:
        found = match_trios(lidar, camera, radar, round(config.sync_gate_s * 1e9))
    else:
        speed, yaw_rate = index.ego.motion_at(lidar)
        gates = motion_gates_ns(speed, yaw_rate, config.sync_gate_m, float(np.radians(config.sync_gate_deg)))
        found = match_by_motion(lidar, camera, radar, gates)
    taken = wanted[found.lidar]
    return replace(found, lidar=taken) if is_swept else replace(found, lidar=found.radar, radar=taken)


def refusal(index: DayIndex, rig: Rig, rejected: Counter[str], config: IngestConfig) -> tuple[str, ...]:
    """Why a day gives no frame, in words: which topic, and what to do; then the faults that this states."""
    topics = {role: topic for topic, role in topics_of(rig).items()}
    streams = [r for r in ("image", "lidar", "radar") if r in topics]
    absent = [f"{topics[r]} ({r})" for r in streams if not index.stream(r).stamps]
    faults: tuple[str, ...] = ()
    if len(streams) - len(absent) < 2:
        what, faults = _nothing_on(", ".join(absent)), ("configuration",)
    elif rejected.get(Rejection.CAMERA_INFO):
        what = _no_intrinsics(topics["info"])
    elif not set(rejected) & set(_UNUSABLE):
        of = {"image": "an image", "lidar": "a sweep", "radar": "a scan"}
        met = " and ".join(f"{of[r]} of {topics[r]}" for r in streams if f"{topics[r]} ({r})" not in absent)
        what = f"{met} never come {_near_enough(config)}"
    else:
        reason = max(_UNUSABLE, key=lambda r: rejected[r])
        what = f"of no moment two sensors were usable, most often {reason} ({rejected[reason]})"
        if reason in _STATED:
            what, faults = f"{FAULTS[_STATED[reason]]}: {what}", (_STATED[reason],)
    return _shorten([what, *index.problems]), *faults


def absences(index: DayIndex, rig: Rig, counts: Counter[str], config: IngestConfig) -> dict[str, str]:
    """Why moments lack a sensor of the rig, in words, by sensor: which topic, and what to do."""
    topics = {role: topic for topic, role in topics_of(rig).items()}
    found = {}
    for sensor in rig.sensors:
        role = "image" if sensor == "camera" else sensor
        own = Counter({r: counts[f"without_{sensor}_{r}"] for r in Rejection})
        reason, count = own.most_common(1)[0]
        if not count:
            continue
        if not index.stream(role).stamps:
            found[sensor] = _nothing_on(f"{topics[role]} ({role})")
        elif reason == Rejection.CAMERA_INFO:
            found[sensor] = _no_intrinsics(topics["info"])
        elif reason in (Rejection.NO_CAMERA, Rejection.NO_RADAR):
            found[sensor] = f"nothing of {topics[role]} is near enough: not {_near_enough(config)}"
        else:
            stated = f"{FAULTS[_STATED[reason]]}: " if reason in _STATED else ""
            why = next((p for p in index.problems if p.startswith(f"{reason}: ")), reason)
            found[sensor] = f"{stated}{topics[role]} was unusable, most often {why} ({count})"
    return found


def _nothing_on(topics: str) -> str:
    return f"no usable message on {topics}: mend the topics in fleet.toml (see `boresight check`)"


def _no_intrinsics(topic: str) -> str:
    return f"no usable intrinsics on {topic}: log a sensor_msgs/CameraInfo with a calibrated K"


def _near_enough(config: IngestConfig) -> str:
    """The gate in words, and what to do where nothing passes it."""
    if config.sync_gate_s is not None:
        gate = f"within {config.sync_gate_s * 1e3:g} ms"
        return f"{gate}: check their clocks, raise ingest.sync_gate_s, or leave it out to gate by motion"
    gate = f"before the car drives {config.sync_gate_m:g} m or turns {config.sync_gate_deg:g} deg"
    return (
        f"{gate}, constant offsets aside: check the sensors' clocks and rates, or raise "
        "ingest.sync_gate_m and sync_gate_deg"
    )


def read_file_prior(rig: Rig, fleet: FleetConfig) -> dict[str, np.ndarray] | None:
    """Transforms of a prior file by pair, None where the prior comes from /tf_static.

    Raises:
        ConfigError: no such file, or not the rigid 4x4 transforms in it that the rig needs.
    """
    if rig.prior.file is None:
        return None
    found = read_transforms(fleet.path_of(rig.prior.file), [n.kind for n in rig.nodes])
    return {pair: T for pair, T in found.items() if len(found) == 1 or pair != "camera_radar"}


def _drives(index: DayIndex) -> Int64[np.ndarray, " N"]:
    """Drive of each sweep, by its place in the stream."""
    sweeps = index.stream(index.anchor)
    order = np.argsort(sweeps.stamps_ns, kind="stable")
    drives = np.zeros(len(order), np.int64)
    drives[order] = number_drives([sweeps.stamps[i] for i in order], [sweeps.located[i].log for i in order])
    return drives


def _spread(count: int, limit: int | None) -> Int64[np.ndarray, " N"]:
    if limit is None or count <= limit:
        return np.arange(count, dtype=np.int64)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))


def _frames(
    trios: list[Trio], builder: FrameBuilder, index: DayIndex, rejected: Counter[str], progress: Progress
) -> Iterator[Frame]:
    frame_index = 0
    for done, trio in enumerate(trios, 1):
        try:
            yield builder.build(trio, frame_index)
            frame_index += 1
        except Rejected as outcome:
            rejected[outcome.reason] += 1
            if rejected[outcome.reason] == 1 and outcome.detail:
                index.complain(f"{outcome.reason}: {outcome.detail}")
        progress(done, len(trios), "frames")


def _all_counts(rejected: Counter[str], index: DayIndex, builder: FrameBuilder) -> dict[str, int]:
    return {str(k): int(v) for k, v in (rejected + index.damage + builder.counts).items() if v}


def _reading_counts(index: DayIndex) -> dict[str, int]:
    """Of a day that was read in bursts: sweeps that its logs hold, that the plan is about, and that were read."""
    if index.reading is None:
        return {}
    read = len(index.sweeps_in_bursts())
    return {SWEEPS_LOGGED: index.reading.sweeps, SWEEPS_PLANNED: index.reading.planned, SWEEPS_READ: read}


def _shorten(problems: list[str]) -> str:
    more = len(problems) - _PROBLEMS_SHOWN
    return "; ".join(problems[:_PROBLEMS_SHOWN]) + (f"; and {more} more" if more > 0 else "")
