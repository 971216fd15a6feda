"""A vehicle-day and its calibration as a Foxglove MCAP, with the uncertainty as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from pipeline.rig.changes import change_between
from pipeline.rig.graph import Sensor
from schemas.calibrations import DOF_NAMES
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["TABLE_SCHEMA", "TABLE_TOPIC", "TF_TOPIC", "layout_of", "table_of", "write_foxglove"]

# --------------------------------------------------------------------------------------------------
# Changes and sigmas of a calibration as one JSON message for a table panel.


_IN_UNITS = np.array([np.degrees(1.0)] * 3 + [100.0] * 3)  # rad to deg, m to cm
_ROW = {
    "pair": {"type": "string"},
    "axis": {"type": "string"},
    "change": {"type": "number"},
    "sigma": {"type": "number"},
    "unit": {"type": "string"},
    "determined": {"type": "boolean"},
    "status": {"type": "string"},
}
TABLE_SCHEMA: dict[str, Any] = {
    "type": "object",
    "title": "boresight.Calibration",
    "properties": {
        "vehicle": {"type": "string"},
        "source": {"type": "string"},
        "method": {"type": "string"},
        "warnings": {"type": "array", "items": {"type": "string"}},
        "in_words": {"type": "array", "items": {"type": "string"}},
        "rows": {"type": "array", "items": {"type": "object", "properties": _ROW}},
    },
}


def table_of(
    calibration: ExportedCalibration, priors: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, Any]:
    """A row per pair and axis: change from the prior along the parent's axes, with sigma [deg, cm]."""
    rows = [row for pair in calibration.pairs.values() for row in _rows(pair, priors.get(pair.pair))]
    told = {"vehicle": calibration.vehicle, "source": calibration.source, "method": calibration.method}
    words = {"warnings": warnings_of(calibration), "in_words": used_lines(calibration)}
    return told | words | {"rows": rows}


def _rows(pair: ExportedPair, prior: Float[np.ndarray, "4 4"] | None) -> list[dict[str, Any]]:
    change: list[float | None] = [None] * 6
    if prior is not None:
        change = (change_between(prior, pair.T) * _IN_UNITS).tolist()
    known = sigmas_of(pair.T, pair.covariance)
    sigma: list[float | None] = (
        [None] * 6
        if known is None
        else [float(s * u) for s, u in zip(known.values(), _IN_UNITS, strict=True)]
    )
    units = ["deg"] * 3 + ["cm"] * 3
    rows = [
        {"pair": pair.pair, "axis": axis, "change": c, "sigma": s, "unit": unit, "determined": bool(seen),
         "status": pair.status}
        for axis, c, s, unit, seen in zip(DOF_NAMES, change, sigma, units, pair.observable, strict=True)
    ]  # fmt: skip
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


# --------------------------------------------------------------------------------------------------
# A vehicle-day as a Foxglove MCAP: sensor data at the prior and at the calibration, and the uncertainty.
#
# Topics are named after the sensors. Images are copied byte for byte, each cloud is in the frame of its
# sensor, and the reference lidar's depth jumps are drawn in every image. The reference is the root (or
# base, if its pose is known). The same points are also written in frames at the prior: `NAME_prior`, child
# of the reference, and the reference's own, child of the first camera. A viewer shows both, and either can
# be hidden.


Scene = tuple[Frame, Observation | None]
TF_TOPIC, TABLE_TOPIC = "/tf", "/boresight/calibration"
_IN_A_ROW = 3  # pictures per row of the layout


@dataclass(frozen=True, eq=False)
class _Drive:
    """Calibration to draw, and the prior in the same form."""

    now: ExportedCalibration
    before: ExportedCalibration
    lidar: str | None  # its depth jumps are drawn in the images

    def frame(self, sensor: str) -> str:
        return self.now.names.of(sensor)

    def priors(self) -> dict[str, tuple[str, Float[np.ndarray, "4 4"]]]:
        """By lidar and radar with a prior: the sensor that it hangs from, and T_sensor_own."""
        reference = self.now.reference.name
        camera = next((s.name for s in self.now.sensors if s.kind == "camera"), reference)
        parents = {
            s.name: camera if s.name == reference else reference
            for s in self.now.sensors
            if s.kind != "camera"
        }
        found = {n: (p, self.before.between(p, n)) for n, p in parents.items() if p != n}
        return {name: (parent, known[0]) for name, (parent, known) in found.items() if known is not None}


class _Channels:
    """Channels by topic, each created with its first message."""

    def __init__(self, context: foxglove.Context) -> None:
        self._context, self._made = context, dict[str, Any]()

    def add(self, kind: Any, topic: str, message: Any, now: int) -> None:
        if topic not in self._made:
            self._made[topic] = kind(topic, context=self._context)
        self._made[topic].log(message, log_time=now)


def write_foxglove(
    stream: BinaryIO,
    calibration: ExportedCalibration,
    before: ExportedCalibration,
    scenes: Mapping[Sensor, Iterable[Scene]],
) -> int:
    """Write the scenes of all sensors as an MCAP to a seekable stream; returns their number.

    Of a sensor without calibration only the prior (`before`) is drawn. Scenes of a camera include the
    reference lidar.
    """
    context = foxglove.Context()
    logged, count, moment = _Channels(context), 0, -1
    table = foxglove.Channel(TABLE_TOPIC, schema=TABLE_SCHEMA, context=context)
    reference = calibration.reference
    drive = _Drive(calibration, before, reference.name if reference.kind == "lidar" else None)
    streams = [_in_order(place, *of_sensor) for place, of_sensor in enumerate(scenes.items())]
    stamp_ns, provenance = 0, provenance_of(calibration)
    with foxglove.open_mcap(stream, context=context) as writer:
        for index, _, sensor, frame, seen in merge(*streams, key=lambda row: row[:2]):
            stamp_ns = frame.stamp_ns
            if not count:
                table.log(table_of(calibration, _priors(drive)), log_time=stamp_ns)
            if index != moment:
                moment = index
                tree = fg.FrameTransforms(transforms=_transforms(drive, stamp_ns))
                logged.add(channels.FrameTransformsChannel, TF_TOPIC, tree, stamp_ns)
            (_log_camera if sensor.kind == "camera" else _log_cloud)(logged, drive, sensor, (frame, seen))
            count += 1
        told = {name: str(provenance[name]) for name in ("written_by", "vehicle", "source", "method")}
        writer.write_metadata("boresight", told)
        times = {"log_time": stamp_ns, "create_time": stamp_ns}
        writer.attach(
            **times, name="calibration.json", media_type="application/json", data=to_json(provenance)
        )
    return count


def _in_order(
    place: int, sensor: Sensor, scenes: Iterable[Scene]
) -> Iterator[tuple[int, int, Sensor, Frame, Observation | None]]:
    """Scenes with their sort key: moment, then index of the sensor."""
    for frame, seen in scenes:
        yield frame.frame_index, place, sensor, frame, seen


def _priors(drive: _Drive) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Prior of each calibrated pair, by pair name."""
    ends = {words: (pair.edge.parent.name, pair.edge.child.name) for words, pair in drive.now.pairs.items()}
    found = {words: drive.before.between(*two) for words, two in ends.items()}
    return {words: known[0] for words, known in found.items() if known is not None}


def _transforms(drive: _Drive, stamp_ns: int) -> list[fg.FrameTransform]:
    edges = [(pose.parent, pose.child, pose.T) for pose in poses_of(drive.now)]
    edges += [(drive.frame(p), f"{drive.frame(n)}_prior", T) for n, (p, T) in drive.priors().items()]
    return [its.transform_message(*edge, stamp_ns) for edge in edges]


def _log_camera(logged: _Channels, drive: _Drive, sensor: Sensor, scene: Scene) -> None:
    frame, seen = scene
    name, now, frame_id = sensor.name, frame.stamp_ns, drive.frame(sensor.name)
    if "camera" not in frame.sensors:
        return
    at = its.time_message(frame.camera_stamp_ns)
    picture = fg.CompressedImage(timestamp=at, frame_id=frame_id, data=frame.image, format=frame.image_format)
    logged.add(channels.CompressedImageChannel, f"/{name}/image", picture, now)
    intrinsics = its.intrinsics_message(camera_of(frame), frame_id, at)
    logged.add(channels.CameraCalibrationChannel, f"/{name}/calibration", intrinsics, now)
    if seen is None or "camera" not in seen.sensors:
        return
    drawn = channels.ImageAnnotationsChannel
    logged.add(drawn, f"/{name}/boxes", its.boxes_message(seen, at), now)
    if drive.lidar is None or "lidar" not in seen.sensors:
        return
    for topic, of, colour in (
        ("overlay", drive.now, its.CALIBRATED), ("overlay_prior", drive.before, its.PRIOR),
    ):  # fmt: skip
        known = of.between(name, drive.lidar)
        if known is not None:
            edges = its.edges_message(seen, known[0], colour, at)
            logged.add(drawn, f"/{name}/{topic}", edges, now)


def _log_cloud(logged: _Channels, drive: _Drive, sensor: Sensor, scene: Scene) -> None:
    frame, seen = scene
    name, now, frame_id, kind = sensor.name, frame.stamp_ns, drive.frame(sensor.name), sensor.kind
    if kind not in frame.sensors:
        return
    columns, stamp_ns = its.cloud_columns(frame, kind)
    for topic, where in (("points", frame_id), ("points_prior", f"{frame_id}_prior")):
        if topic == "points" or name in drive.priors():
            cloud = its.cloud_message(columns, where, stamp_ns)
            logged.add(channels.PointCloudChannel, f"/{name}/{topic}", cloud, now)
    if kind == "lidar" and seen is not None and kind in seen.sensors:
        objects = its.clusters_message(seen, frame_id, now)
        logged.add(channels.SceneUpdateChannel, f"/{name}/boxes", objects, now)


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
    table = layouts.TablePanel(config=layouts.TableConfig(topic_path=f"{TABLE_TOPIC}.rows"))
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
