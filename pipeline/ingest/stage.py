"""Stage ingest: the logs of one vehicle-day to one partition of `frames`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from pipeline.config import FleetConfig, IngestConfig, Rig, config_hash
from pipeline.errors import ConfigError, ContractError
from pipeline.extrinsics.prior import read_transforms
from pipeline.ingest.containers.reader import content_identity
from pipeline.ingest.frame_builder import FrameBuilder, Rejected, Trio
from pipeline.ingest.index import DayIndex, index_logs, topics_of
from pipeline.ingest.sync import Rejection, match_nearest, match_trios, number_drives
from pipeline.results import Progress, StageResult, silent
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.tables import Manifest, read_manifest, write_partition
from schemas.frames import FRAMES, Frame
from schemas.versions import CODE_VERSION

__all__ = ["ingest_day", "pick_trios", "read_file_prior"]

_CHUNK_BYTES = (
    24 << 20
)  # a row group: large enough to compress, small enough that a worker stays far below 2 GB
_CHUNK_FRAMES = 16
_PROBLEMS_SHOWN = 3
_UNUSABLE = (
    Rejection.IMAGE_DAMAGED,
    Rejection.IMAGE_SIZE,
    Rejection.CAMERA_INFO,
    Rejection.LIDAR_DAMAGED,
    Rejection.LIDAR_SPARSE,
    Rejection.RADAR_DAMAGED,
    Rejection.RADAR_SPARSE,
)


class _NothingUsableError(Exception):
    """Leaves the writer's block, so that nothing is written."""


def ingest_day(
    logs: Sequence[Path],
    partition: Partition,
    fleet: FleetConfig,
    lake: Lake,
    progress: Progress = silent,
) -> StageResult:
    """Write the partition of `frames` that the logs give; "cached" where the same inputs gave it before.

    A day without a single usable trio is "refused": nothing is written (an empty table would look like a day
    that was looked at and gave nothing), a partition of earlier inputs stays, and the reason names topics and
    what to do. `rejected` counts each sweep that became no frame under one Rejection, and damage, dropped
    points and missing parts under names of their own.

    Args:
        logs: files or ROS 2 bag folders, in any order; recordings split by time or by sensor belong together.
        partition: vehicle and day.
        fleet: the whole configuration.
        lake: where to write.
        progress: told of frames done and total.

    Raises:
        ConfigError: unknown vehicle, a log that does not exist, an unusable prior file.
    """
    rig = fleet.rig_of(partition.vehicle)
    missing = [str(p) for p in logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    file_prior = read_file_prior(rig, fleet)
    inputs = sorted(content_identity(p) for p in logs)
    prior_key = {} if file_prior is None else {"prior": [T.tolist() for T in file_prior]}
    key = work_key("ingest", CODE_VERSION, config_hash(fleet.ingest, rig, prior_key), inputs)
    manifest = _manifest(lake, partition)
    if manifest is not None and manifest.work_key == key:
        return _result("cached", lake, partition, key, manifest.rows, manifest.rejected)
    progress(0, 0, "reading the index")
    index = index_logs(logs, rig)
    builder = FrameBuilder(index, rig, fleet.ingest, file_prior)
    trios, rejected = pick_trios(index, fleet.ingest)
    try:
        with write_partition(lake, FRAMES, partition, key, CODE_VERSION, inputs) as writer:
            for chunk in _chunks(_frames(trios, builder, index, rejected, progress)):
                writer.append(chunk)
            _require_rows(writer.rows)
            counts = _all_counts(rejected, index, builder)
            writer.describe(
                kept={"frames": writer.rows}, rejected=counts, problems=index.problems, logs=index.log_names
            )
    except _NothingUsableError:
        reason = refusal(index, rig, rejected, fleet.ingest.sync_gate_s)
        return _result("refused", lake, partition, key, 0, _all_counts(rejected, index, builder), reason)
    finally:
        index.close()
    return _result("done", lake, partition, key, writer.rows, counts, _shorten(index.problems))


def pick_trios(index: DayIndex, config: IngestConfig) -> tuple[list[Trio], Counter[str]]:
    """Trios in order of time, thinned evenly to `max_frames`, and why the other sweeps are left out."""
    gate_ns = round(config.sync_gate_s * 1e9)
    camera_ns = index.stream("image").stamps_ns
    found = match_trios(index.stream("lidar").stamps_ns, camera_ns, index.stream("radar").stamps_ns, gate_ns)
    drives = _drives(index)
    # Labels and detections carry the stamp of the image that they were computed on.
    labels = match_nearest(camera_ns[found.camera], index.stream("labels").stamps_ns, gate_ns)
    detections = match_nearest(camera_ns[found.camera], index.stream("detections").stamps_ns, gate_ns)
    picked = _spread(len(found.lidar), config.max_frames)
    trios = [
        Trio(
            camera=int(found.camera[i]),
            lidar=int(found.lidar[i]),
            radar=int(found.radar[i]),
            labels=int(labels[i]) if labels[i] >= 0 else None,
            detections=int(detections[i]) if detections[i] >= 0 else None,
            drive=int(drives[found.lidar[i]]),
        )
        for i in picked
    ]
    return trios, +(found.rejected + Counter({Rejection.NOT_PICKED: len(found.lidar) - len(picked)}))


def refusal(index: DayIndex, rig: Rig, rejected: Counter[str], gate_s: float) -> str:
    """Why a day gives no frame, in words: which topic, and what to do."""
    topics = {role: topic for topic, role in topics_of(rig).items()}
    absent = [f"{topics[r]} ({r})" for r in ("image", "lidar", "radar") if not index.stream(r).stamps]
    if absent:
        what = (
            f"no usable message on {', '.join(absent)}: mend the topics in fleet.toml (see `boresight check`)"
        )
    elif rejected.get(Rejection.CAMERA_INFO):
        what = f"no usable intrinsics on {topics['info']}: log a sensor_msgs/CameraInfo with a calibrated K"
    elif not set(rejected) & set(_UNUSABLE):
        what = (
            f"no sweep of {topics['lidar']} has an image of {topics['image']} and a scan of "
            f"{topics['radar']} within {gate_s * 1e3:g} ms: trigger the sensors together, check their "
            "clocks, or raise ingest.sync_gate_s"
        )
    else:
        reason = max(_UNUSABLE, key=lambda r: rejected[r])
        what = f"every synchronised trio was unusable, most often {reason} ({rejected[reason]})"
    return _shorten([what, *index.problems])


def read_file_prior(rig: Rig, fleet: FleetConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """T_camera_lidar and T_lidar_radar of a prior file, None where the prior comes from /tf_static.

    Raises:
        ConfigError: no such file, or no two rigid 4x4 transforms in it.
    """
    if rig.prior.file is None:
        return None
    transforms = read_transforms(fleet.path_of(rig.prior.file))
    return transforms["camera_lidar"], transforms["lidar_radar"]


def _manifest(lake: Lake, partition: Partition) -> Manifest | None:
    try:
        return read_manifest(lake, FRAMES, partition)
    except (ContractError, ValueError, OSError):
        return None  # another version or a damaged file: made anew


def _drives(index: DayIndex) -> Int64[np.ndarray, " N"]:
    """Drive of each sweep, by its place in the stream."""
    lidar = index.stream("lidar")
    order = np.argsort(lidar.stamps_ns, kind="stable")
    drives = np.zeros(len(order), np.int64)
    drives[order] = number_drives([lidar.stamps[i] for i in order], [lidar.located[i].log for i in order])
    return drives


def _require_rows(rows: int) -> None:
    if not rows:
        raise _NothingUsableError


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


def _chunks(frames: Iterator[Frame]) -> Iterator[list[Frame]]:
    chunk: list[Frame] = []
    size = 0
    for frame in frames:
        chunk.append(frame)
        size += len(frame.image) + 24 * len(frame.lidar_x_m)
        if size >= _CHUNK_BYTES or len(chunk) >= _CHUNK_FRAMES:
            yield chunk
            chunk, size = [], 0
    yield chunk


def _all_counts(rejected: Counter[str], index: DayIndex, builder: FrameBuilder) -> dict[str, int]:
    return {str(k): int(v) for k, v in (rejected + index.damage + builder.counts).items() if v}


def _result(
    status: str,
    lake: Lake,
    partition: Partition,
    key: str,
    rows: int,
    rejected: dict[str, int],
    reason: str = "",
) -> StageResult:
    outputs = [str(lake.folder(FRAMES.name, partition))] if rows else []
    return StageResult(
        "ingest",
        partition.vehicle,
        partition.day,
        status,
        key,
        rows,
        {"frames": rows},
        rejected,
        reason,
        outputs,
    )


def _shorten(problems: list[str]) -> str:
    more = len(problems) - _PROBLEMS_SHOWN
    return "; ".join(problems[:_PROBLEMS_SHOWN]) + (f"; and {more} more" if more > 0 else "")
