"""Stage ingest: the logs of one vehicle-day to one partition of `frames`."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.config import FleetConfig, Rig, config_hash
from pipeline.errors import ConfigError
from pipeline.geometry.se3 import from_rotation_translation
from pipeline.ingest.index import DayIndex, index_logs, topics_of
from pipeline.ingest.messages import FrameBuilder, Rejected, Rejection, Trio
from pipeline.ingest.readers import content_identity
from pipeline.ingest.sync import Trios, match_nearest, match_trios, number_drives
from pipeline.results import Progress, StageResult, silent
from pipeline.store.partitions import Lake, Partition, work_key
from pipeline.store.tables import read_manifest, write_partition
from schemas.frames import FRAMES, Frame
from schemas.versions import CODE_VERSION

__all__ = ["ingest_day", "pick_trios", "read_file_prior"]

_CHUNK_BYTES = (
    24 << 20
)  # a row group: large enough to compress, small enough that a worker stays far below 2 GB
_CHUNK_FRAMES = 16
_PROBLEMS_SHOWN = 3


class _NothingUsable(Exception):  # noqa: N818  # leaves the writer's block so that nothing is written
    pass


def ingest_day(
    logs: Sequence[Path],
    partition: Partition,
    fleet: FleetConfig,
    lake: Lake,
    progress: Progress = silent,
    fleet_file: str = "fleet.toml",
) -> StageResult:
    """Write the partition of `frames` that the logs give; nothing is done where it was made from the same inputs before.

    A day without a single usable trio is "refused": nothing is written (an empty table would look like a day that was
    calibrated and found nothing), a partition of earlier inputs stays, and the reason names topics and what to do.
    `rejected` counts each sweep that became no frame under one Rejection, and damage, dropped points and missing parts
    under names of their own.

    Args:
        logs: files or ROS 2 bag folders, in any order; recordings split by time or by sensor belong together.
        partition: vehicle and day.
        fleet: the whole configuration.
        lake: where to write.
        progress: told of frames done and total.
        fleet_file: path of fleet.toml, for messages and as the folder of a prior file.

    Raises:
        ConfigError: unknown vehicle, a log that does not exist, an unusable prior file.
    """
    rig = fleet.rig_of(partition.vehicle, file=fleet_file)
    missing = [str(p) for p in logs if not p.exists()]
    if missing:
        raise ConfigError("command line", "LOG", f"no such file: {', '.join(missing)}")
    file_prior = read_file_prior(rig, fleet_file)
    inputs = sorted(content_identity(p) for p in logs)
    key = work_key("ingest", CODE_VERSION, _config_key(fleet, rig, fleet_file), inputs)
    manifest = read_manifest(lake, FRAMES, partition)
    output = str(lake.folder(FRAMES.name, partition))
    if manifest is not None and manifest.work_key == key:
        outcome = StageResult("ingest", partition.vehicle, partition.day, "cached", key, manifest.rows)
        return _with_counts(outcome, manifest.kept, manifest.rejected, outputs=[output])
    progress(0, 0, "reading the index")
    index = index_logs(logs, rig)
    try:
        trios = pick_trios(index, fleet)
        rejected = Counter(trios[1])
        builder = FrameBuilder(index, rig, fleet, file_prior)
        with write_partition(lake, FRAMES, partition, key, CODE_VERSION, inputs) as writer:
            for chunk in _chunks(_frames(trios[0], builder, index, rejected, progress)):
                writer.append(chunk)
            if not writer.rows:
                raise _NothingUsable
            rows, kept = writer.rows, {"frames": writer.rows}
            counted = _all_counts(rejected, index, builder)
            writer.describe(kept=kept, rejected=counted, problems=index.problems, logs=index.log_names)
    except _NothingUsable:
        reason = refusal(index, rig, rejected, fleet.ingest.sync_gate_s)
        refused = StageResult("ingest", partition.vehicle, partition.day, "refused", key, reason=reason)
        return _with_counts(refused, {"frames": 0}, _all_counts(rejected, index, builder))
    finally:
        index.close()
    done = StageResult(
        "ingest", partition.vehicle, partition.day, "done", key, rows, reason=_shorten(index.problems)
    )
    return _with_counts(done, kept, counted, outputs=[output])


def pick_trios(index: DayIndex, fleet: FleetConfig) -> tuple[list[Trio], Counter[str]]:
    """Trios in order of time, thinned evenly to `max_frames`, and why the other sweeps are left out."""
    gate_ns = round(fleet.ingest.sync_gate_s * 1e9)
    lidar = index.stream("lidar")
    camera_ns = index.stream("image").stamps_ns
    found = match_trios(lidar.stamps_ns, camera_ns, index.stream("radar").stamps_ns, gate_ns)
    rejected = Counter(found.rejected)
    drives = _drives(index)
    labels = match_nearest(camera_ns[found.camera], index.stream("labels").stamps_ns, gate_ns)
    detections = match_nearest(camera_ns[found.camera], index.stream("detections").stamps_ns, gate_ns)
    picked = _spread(len(found.lidar), fleet.ingest.max_frames)
    if len(picked) < len(found.lidar):
        rejected[Rejection.NOT_PICKED] += len(found.lidar) - len(picked)
    return [_trio(found, int(i), labels, detections, drives) for i in picked], rejected


def refusal(index: DayIndex, rig: Rig, rejected: Counter[str], gate_s: float) -> str:
    """Why a day gives no frame, in words: which topic, and what to do."""
    topics = {role: topic for topic, role in topics_of(rig).items()}
    absent = [f"{topics[r]} ({r})" for r in ("image", "lidar", "radar") if not index.stream(r).stamps]
    if absent:
        what = f"no usable message on {', '.join(absent)}: check the topic names in fleet.toml against `boresight check`"
    elif rejected.get(Rejection.CAMERA_INFO):
        what = f"no usable intrinsics on {topics['info']}: log a sensor_msgs/CameraInfo with a calibrated K"
    elif (
        sum(rejected[r] for r in (Rejection.NO_CAMERA, Rejection.NO_RADAR, Rejection.SPREAD))
        >= len(index.stream("lidar").stamps) - rejected[Rejection.DUPLICATE_STAMP]
    ):
        what = (
            f"no sweep of {topics['lidar']} has an image of {topics['image']} and a scan of {topics['radar']} within "
            f"{gate_s * 1e3:g} ms: trigger the sensors together, check their clocks, or raise ingest.sync_gate_s"
        )
    else:
        reason, count = max(
            ((r, c) for r, c in rejected.items() if r in set(Rejection)), key=lambda rc: rc[1]
        )
        what = f"every synchronised trio was unusable, most often {reason} ({count})"
    return _shorten([what, *index.problems])


def read_file_prior(rig: Rig, fleet_file: str) -> tuple[np.ndarray, np.ndarray] | None:
    """T_camera_lidar and T_lidar_radar of a prior file, None where the prior comes from /tf_static.

    Raises:
        ConfigError: no such file, or no two rigid 4x4 transforms in it.
    """
    if rig.prior.file is None:
        return None
    path = Path(fleet_file).parent / rig.prior.file
    try:
        raw = json.loads(path.read_text())
        found = [np.array(raw[name], np.float64) for name in ("T_camera_lidar", "T_lidar_radar")]
    except (OSError, ValueError, KeyError, TypeError) as err:
        raise ConfigError(str(path), "", f"is no prior file: {type(err).__name__}: {err}") from err
    for name, T in zip(("T_camera_lidar", "T_lidar_radar"), found, strict=True):
        rigid = (
            T.shape == (4, 4)
            and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4)
            and np.linalg.det(T[:3, :3]) > 0
        )
        if not rigid or not np.allclose(T[3], [0, 0, 0, 1]):
            raise ConfigError(str(path), name, "is no rigid 4x4 transform")
    return from_rotation_translation(found[0][:3, :3], found[0][:3, 3]), from_rotation_translation(
        found[1][:3, :3], found[1][:3, 3]
    )


def _config_key(fleet: FleetConfig, rig: Rig, fleet_file: str) -> str:
    prior = (
        ""
        if rig.prior.file is None
        else hashlib.sha256((Path(fleet_file).parent / rig.prior.file).read_bytes()).hexdigest()
    )
    return config_hash(fleet.ingest, rig, {"prior": prior})


def _drives(index: DayIndex) -> dict[int, int]:
    """Drive of each sweep, by its place in the stream."""
    lidar = index.stream("lidar")
    order = np.argsort(lidar.stamps_ns, kind="stable")
    numbers = number_drives([lidar.stamps[i] for i in order], [lidar.located[i].log for i in order])
    return {int(i): int(n) for i, n in zip(order, numbers, strict=True)}


def _spread(count: int, limit: int | None) -> np.ndarray:
    return (
        np.arange(count)
        if limit is None or count <= limit
        else np.unique(np.linspace(0, count - 1, limit).round().astype(int))
    )


def _trio(found: Trios, i: int, labels: np.ndarray, detections: np.ndarray, drives: dict[int, int]) -> Trio:
    partner = [None if m[i] < 0 else int(m[i]) for m in (labels, detections)]
    return Trio(
        int(found.camera[i]), int(found.lidar[i]), int(found.radar[i]), *partner, drives[int(found.lidar[i])]
    )


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


def _with_counts(
    outcome: StageResult, kept: dict[str, int], rejected: dict[str, int], outputs: list[str] | None = None
) -> StageResult:
    return StageResult(**{**outcome.__dict__, "kept": kept, "rejected": rejected, "outputs": outputs or []})


def _shorten(problems: list[str]) -> str:
    more = len(problems) - _PROBLEMS_SHOWN
    return "; ".join(problems[:_PROBLEMS_SHOWN]) + (f"; and {more} more" if more > 0 else "")
