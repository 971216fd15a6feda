"""A vehicle-day and its calibration as a Foxglove MCAP, with the uncertainty as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from heapq import merge
from typing import Any, BinaryIO

import foxglove
import numpy as np
from foxglove import channels, layouts
from foxglove import messages as fg
from jaxtyping import Float

from pipeline.export import foxglove_messages as its
from pipeline.export.calibration import ExportedCalibration, ExportedPair, poses_of, sigmas_of
from pipeline.export.provenance import provenance_of, used_lines, warnings_of
from pipeline.export.texts import to_json
from pipeline.rig.cameras import camera_of
from pipeline.rig.graph import Sensor
from pipeline.rig.se3 import change_between
from schemas.calibrations import DOF_NAMES
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["layout_of", "write_foxglove"]

_IN_UNITS = np.array([np.degrees(1.0)] * 3 + [100.0] * 3)  # rad to deg, m to cm
_UNITS = ["deg"] * 3 + ["cm"] * 3
_ROW = {
    "pair": "string", "axis": "string", "change": "number", "sigma": "number", "unit": "string",
    "determined": "boolean", "status": "string",
}  # fmt: skip
_TEXTS = {"type": "array", "items": {"type": "string"}}
_TABLE_SCHEMA: dict[str, Any] = {
    "type": "object",
    "title": "boresight.Calibration",
    "properties": {
        **{name: {"type": "string"} for name in ("vehicle", "source", "method")},
        "warnings": _TEXTS,
        "in_words": _TEXTS,
        "rows": {
            "type": "array",
            "items": {"type": "object", "properties": {name: {"type": kind} for name, kind in _ROW.items()}},
        },
    },
}


def _table_of(calibration: ExportedCalibration, before: ExportedCalibration) -> dict[str, Any]:
    """A row per pair and axis: change from the prior along the parent's axes, with sigma [deg, cm]."""
    told = {"vehicle": calibration.vehicle, "source": calibration.source, "method": calibration.method}
    words = {"warnings": warnings_of(calibration), "in_words": used_lines(calibration)}
    rows = [row for pair in calibration.pairs.values() for row in _rows(pair, before)]
    return told | words | {"rows": rows}


def _rows(pair: ExportedPair, before: ExportedCalibration) -> list[dict[str, Any]]:
    T_prior = before.T_between(pair.edge.parent.name, pair.edge.child.name)
    sigmas = sigmas_of(pair.T, pair.covariance)
    change, sigma = (
        [None] * 6 if known is None else (known * _IN_UNITS).tolist()
        for known in (
            None if T_prior is None else change_between(T_prior, pair.T),
            None if sigmas is None else np.array(list(sigmas.values())),
        )
    )
    columns = zip(DOF_NAMES, change, sigma, _UNITS, map(bool, pair.observable), strict=True)
    rows = [dict(zip(_ROW, (pair.pair, *row, pair.status), strict=True)) for row in columns]
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


# Topics are named after the sensors. Images are copied byte for byte, each cloud is in the frame of its
# sensor, and the reference lidar's depth jumps are drawn in every image. The reference is the root (or
# base, if its pose is known). The same points are also written in frames at the prior: `NAME_prior`, child
# of the reference, and the reference's own, child of the first camera. A viewer shows both, and either can
# be hidden.


Scene = tuple[Frame, Observation | None]
_TF_TOPIC, _TABLE_TOPIC = "/tf", "/boresight/calibration"
_IN_A_ROW = 3  # pictures per row of the layout


class _Drive:
    """Messages of a calibration, and of the prior in the same form, on channels by topic."""

    def __init__(
        self, context: foxglove.Context, now: ExportedCalibration, before: ExportedCalibration
    ) -> None:
        self._context, self._channels = context, dict[str, Any]()
        self._now, self._before, reference = now, before, now.reference
        self._lidar = reference.name if reference.kind == "lidar" else None  # its edges are in the images
        camera = next((s.name for s in now.sensors if s.kind == "camera"), reference.name)
        # By lidar and radar with a prior: the sensor that it hangs from, and T_sensor_own.
        self._priors: dict[str, tuple[str, Float[np.ndarray, "4 4"]]] = {}
        for own in (s.name for s in now.sensors if s.kind != "camera"):
            parent = camera if own == reference.name else reference.name
            T = None if parent == own else before.T_between(parent, own)
            if T is not None:
                self._priors[own] = parent, T

    def log_tree(self, stamp_ns: int) -> None:
        """Poses of the calibration and of the prior."""
        edges = [(pose.parent, pose.child, pose.T) for pose in poses_of(self._now)]
        edges += [(self._frame(p), f"{self._frame(n)}_prior", T) for n, (p, T) in self._priors.items()]
        tree = fg.FrameTransforms(transforms=[its.transform_message(*edge, stamp_ns) for edge in edges])
        self._log(channels.FrameTransformsChannel, _TF_TOPIC, tree, stamp_ns)

    def log_camera(self, sensor: Sensor, frame: Frame, seen: Observation | None) -> None:
        """Image, intrinsics, and what is drawn in the image."""
        name, now, frame_id = sensor.name, frame.stamp_ns, self._frame(sensor.name)
        if "camera" not in frame.sensors:
            return
        at = its.time_message(frame.camera_stamp_ns)
        picture = fg.CompressedImage(
            timestamp=at, frame_id=frame_id, data=frame.image, format=frame.image_format
        )
        self._log(channels.CompressedImageChannel, f"/{name}/image", picture, now)
        intrinsics = its.intrinsics_message(camera_of(frame), frame_id, at)
        self._log(channels.CameraCalibrationChannel, f"/{name}/calibration", intrinsics, now)
        if seen is None or "camera" not in seen.sensors:
            return
        drawn = channels.ImageAnnotationsChannel
        self._log(drawn, f"/{name}/boxes", its.boxes_message(seen, at), now)
        if self._lidar is None or "lidar" not in seen.sensors:
            return
        for topic, of, colour in (
            ("overlay", self._now, its.CALIBRATED), ("overlay_prior", self._before, its.PRIOR),
        ):  # fmt: skip
            T = of.T_between(name, self._lidar)
            if T is not None:
                self._log(drawn, f"/{name}/{topic}", its.edges_message(seen, T, colour, at), now)

    def log_cloud(self, sensor: Sensor, frame: Frame, seen: Observation | None) -> None:
        """Points in the sensor's frame and in that of its prior, and a lidar's objects."""
        name, now, frame_id, kind = sensor.name, frame.stamp_ns, self._frame(sensor.name), sensor.kind
        if kind not in frame.sensors:
            return
        columns, stamp_ns = its.cloud_columns(frame, kind)
        for topic, where in (("points", frame_id), ("points_prior", f"{frame_id}_prior")):
            if topic == "points" or name in self._priors:
                cloud = its.cloud_message(columns, where, stamp_ns)
                self._log(channels.PointCloudChannel, f"/{name}/{topic}", cloud, now)
        if kind == "lidar" and seen is not None and kind in seen.sensors:
            objects = its.clusters_message(seen, frame_id, now)
            self._log(channels.SceneUpdateChannel, f"/{name}/boxes", objects, now)

    def _frame(self, sensor: str) -> str:
        return self._now.names.of(sensor)

    def _log(self, kind: Any, topic: str, message: Any, now: int) -> None:
        if topic not in self._channels:
            self._channels[topic] = kind(topic, context=self._context)
        self._channels[topic].log(message, log_time=now)


def write_foxglove(
    stream: BinaryIO,
    calibration: ExportedCalibration,
    before: ExportedCalibration,
    scenes: Mapping[Sensor, Iterable[Scene]],
) -> None:
    """Write the scenes of all sensors as an MCAP to a seekable stream.

    Of a sensor without calibration only the prior (`before`) is drawn. Scenes of a camera include the
    reference lidar.
    """
    context = foxglove.Context()
    drive, moment, stamp_ns, provenance = (
        _Drive(context, calibration, before), -1, 0, provenance_of(calibration),
    )  # fmt: skip
    table = foxglove.Channel(_TABLE_TOPIC, schema=_TABLE_SCHEMA, context=context)
    streams = [_in_order(place, *of_sensor) for place, of_sensor in enumerate(scenes.items())]
    with foxglove.open_mcap(stream, context=context) as writer:
        for index, _, sensor, frame, seen in merge(*streams, key=lambda row: row[:2]):
            stamp_ns = frame.stamp_ns
            if moment < 0:
                table.log(_table_of(calibration, before), log_time=stamp_ns)
            if index != moment:
                moment = index
                drive.log_tree(stamp_ns)
            (drive.log_camera if sensor.kind == "camera" else drive.log_cloud)(sensor, frame, seen)
        told = {name: str(provenance[name]) for name in ("written_by", "vehicle", "source", "method")}
        writer.write_metadata("boresight", told)
        times = {"log_time": stamp_ns, "create_time": stamp_ns}
        writer.attach(
            **times, name="calibration.json", media_type="application/json", data=to_json(provenance)
        )


def _in_order(
    place: int, sensor: Sensor, scenes: Iterable[Scene]
) -> Iterator[tuple[int, int, Sensor, Frame, Observation | None]]:
    """Scenes with their sort key: moment, then index of the sensor."""
    for frame, seen in scenes:
        yield frame.frame_index, place, sensor, frame, seen


def layout_of(sensors: Sequence[Sensor], reference: str, follow: str) -> bytes:
    """Foxglove layout: an image per camera with the lidar's edges, the scene from above, the sigmas."""
    pictures = [_picture(sensor.name, reference) for sensor in sensors if sensor.kind == "camera"]
    clouds = {
        f"/{s.name}/{topic}": layouts.BaseRendererPointCloudTopicSettings(
            visible=topic == "points", color_mode="colormap", color_map="turbo", point_size=2.0,
            color_field="z" if s.kind == "lidar" else "range_rate_mps",
        )
        for s in sensors
        if s.kind != "camera"
        for topic in ("points", "points_prior")
    }  # fmt: skip
    scene = layouts.ThreeDeePanel(
        title="From above", config=layouts.ThreeDeeConfig(follow_tf=follow, topics=clouds)
    )
    table = layouts.TablePanel(config=layouts.TableConfig(topic_path=f"{_TABLE_TOPIC}.rows"))
    rows = [_split("row", pictures[k : k + _IN_A_ROW]) for k in range(0, len(pictures), _IN_A_ROW)]
    return layouts.Layout(content=_split("column", [*rows, _split("row", [scene, table])])).to_json().encode()


def _split(direction: Any, contents: Sequence[Any]) -> Any:
    items = [layouts.SplitItem(content=content) for content in contents]
    return contents[0] if len(items) == 1 else layouts.SplitContainer(direction=direction, items=items)


def _picture(name: str, lidar: str) -> Any:
    annotations = {
        f"/{name}/{topic}": layouts.ImageAnnotationSettings(visible=topic != "overlay_prior")
        for topic in ("boxes", "overlay", "overlay_prior")
    }
    mode = layouts.ImageModeConfig(
        image_topic=f"/{name}/image", calibration_topic=f"/{name}/calibration", annotations=annotations
    )
    points = layouts.BaseRendererPointCloudTopicSettings(
        visible=False, color_mode="colormap", color_field="x", color_map="turbo", point_size=2.0
    )
    config = layouts.ImageConfig(image_mode=mode, topics={f"/{lidar}/points": points})
    return layouts.ImagePanel(title=f"{name}: the lidar's edges as calibrated", config=config)
