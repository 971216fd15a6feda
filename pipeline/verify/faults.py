"""Known faults added to a log's captures, to find those that its answer does not detect.

The calibration stays the same, but the data that check it are wrong. A camera's fault, if it has a size, is
as large as the error that must be detected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np

from pipeline.rig.graph import Sensor
from pipeline.store.moments import joined, write_moments
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_manifest
from schemas.captures import Image, Sweep
from schemas.moments import FILES, MOMENTS
from schemas.versions import CODE_VERSION

__all__ = ["FAULTS_OF", "Fault", "copy_with_fault", "faults_of_log"]

_FOCAL = 1.02
_HEIGHT_M = 0.3
_EVERY = 3  # frames, of which one shows another place


def _labels(image: Image, _: Image, asked_rad: float) -> Image | None:
    """Labels and boxes moved to the right, like those of a rotated camera."""
    if image.labels_png is None:
        return None
    labels = cv2.imdecode(np.frombuffer(image.labels_png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert labels is not None, "ingest has read it"
    shift_px = float(image.camera_K[0, 0]) * np.tan(asked_rad)
    M = np.array([[1, 0, shift_px * labels.shape[1] / image.image_width_px], [0, 1, 0]], np.float64)
    size = labels.shape[1::-1]
    moved = cv2.warpAffine(labels, M, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    boxes = image.detection_boxes_px
    if boxes is not None:
        boxes = (boxes + np.array([shift_px, 0, shift_px, 0])).astype(np.float32)
    return replace(image, labels_png=cv2.imencode(".png", moved)[1].tobytes(), detection_boxes_px=boxes)


def _focal(image: Image, _: Image, __: float) -> Image:
    K = image.camera_K.copy()
    K[[0, 1], [0, 1]] *= _FOCAL
    return replace(image, camera_K=K)


def _centre(image: Image, _: Image, asked_rad: float) -> Image:
    K = image.camera_K.copy()
    K[0, 2] += K[0, 0] * np.tan(asked_rad)
    return replace(image, camera_K=K)


def _elsewhere(image: Image, other: Image, _: float) -> Image:
    if image.moment % _EVERY:
        return image
    return replace(other, moment=image.moment, stamp_ns=image.stamp_ns, camera_K=image.camera_K)


def _mirrored(sweep: Sweep, _: Sweep, __: float) -> Sweep:
    return replace(sweep, lidar_y_m=-sweep.lidar_y_m)


def _raised(sweep: Sweep, _: Sweep, __: float) -> Sweep:
    return replace(sweep, lidar_z_m=(sweep.lidar_z_m + np.float32(_HEIGHT_M)).astype(np.float32))


# By kind of sensor and words: (capture, capture of another moment, asked error) -> capture; None = cannot be had.
FAULTS_OF: Final[Mapping[str, Mapping[str, Callable[[Any, Any, float], Any]]]] = {
    "camera": {
        "labels shifted": _labels,
        "CameraInfo: focal length +2 %": _focal,
        "CameraInfo: principal point shifted": _centre,
        "every third image of another place": _elsewhere,
    },
    "lidar": {"mirrored": _mirrored, "points 0.3 m too high": _raised},
}


@dataclass(frozen=True)
class Fault:
    """One fault of one sensor."""

    sensor: str
    kind: str
    words: str

    @property
    def name(self) -> str:
        """Sensor and fault."""
        return f"{self.sensor}: {self.words}"


def faults_of_log(
    sensors: Sequence[Sensor], count: int, identity: str, *, labelled: bool = True
) -> list[Fault]:
    """Faults for a log: sensors and faults alternate over the logs of a set.

    Args:
        sensors: sensors of the rig.
        count: number of faults.
        identity: hexadecimal identity of the log, which determines the first of its faults in the list of
            all.
        labelled: whether the log has labels; labels computed by a model are not in the log and cannot be
            shifted.
    """
    every = [
        Fault(s.name, s.kind, words)
        for kind, own in FAULTS_OF.items()
        for words in own
        for s in sorted(sensors, key=lambda s: s.name)
        if s.kind == kind and (labelled or words != "labels shifted")
    ]
    first = int(identity, 16) % max(len(every), 1)
    return [every[(first + k) % len(every)] for k in range(min(count, len(every)))]


def copy_with_fault(lake: Lake, partition: Partition, fault: Fault, asked_rad: float, target: Lake) -> None:
    """Copy a vehicle-day's captures with a fault into another lake, for stage perceive.

    Args:
        lake: lake with the captures.
        partition: vehicle-day.
        fault: fault to add.
        asked_rad: error that must be detected, for faults that have a size.
        target: lake without that vehicle-day.
    """
    manifest = read_manifest(lake, MOMENTS, partition)
    assert manifest is not None, "the caller has ingested it"
    change = FAULTS_OF[fault.kind][fault.words]
    far = max(manifest.rows // 2, 1)  # moments away
    ahead = joined(lake, MOMENTS, partition, [fault.sensor], range(far, manifest.rows))
    last: Any = None
    key = f"{manifest.work_key} {fault.name} {asked_rad:.6f}"
    with write_moments(target, MOMENTS, partition, key, CODE_VERSION, manifest.inputs) as out:
        for moment, captures in joined(lake, MOMENTS, partition):
            _, other = next(ahead, (None, {}))
            last = other.get(fault.sensor, last)
            own = captures.get(fault.sensor)
            changed = None if own is None else change(own, last or own, asked_rad)
            out.append(moment, captures if changed is None else captures | {fault.sensor: changed})
        extra = {k: v for k, v in manifest.extra.items() if k != FILES}
        out.describe(kept=manifest.kept, rejected=manifest.rejected, remarks=manifest.remarks, **extra)
