"""The rig from above: position, orientation and field of view of each sensor, and the edges between sensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

from pipeline.report.svg import MUTED, document
from pipeline.rig.graph import BASE, Kind
from pipeline.rig.se3 import inverse
from pipeline.store.current import transform_of
from schemas.calibrations import CalibrationRecord
from schemas.poses import PoseRow

__all__ = ["DrawnSensor", "rig_figure", "rig_of_day"]

# Of the drawing, of a column of names, of the rig between them.
_WIDTH, _MARGIN, _PICTURE = 900.0, 240.0, 420.0
_ROW = 34.0  # of two lines of text
_COLOURS: Final[Mapping[str, str]] = {
    "camera": "#2b6cb0",
    "lidar": "#b7791f",
    "radar": "#7b4bb3",
    "base": MUTED,
}
_STATUS_COLOURS: Final[Mapping[str, str]] = {"accepted": "#2f9e6b", "held": "#d19a1a", "refused": "#c8434a"}
_SMALLEST_M = 2.5  # a rig of sensors at one place is not blown up beyond that
_BEND = 0.12  # of an edge, in its length
_LOOK_PX = 74.0  # of a field of view, whatever the sensor's range


@dataclass(frozen=True, eq=False)
class DrawnSensor:
    """A sensor of the drawing.

    Args:
        T_body_sensor: its pose in axes x forward, y left, z up.
        width_rad: width of its field of view, centred on its line of sight; 2 pi = all around.
        status: accepted, held, refused or none.
        sentence: text beside its name: the accuracy of its pose.
    """

    name: str
    kind: Kind
    T_body_sensor: np.ndarray  # 4 4
    width_rad: float
    status: str
    sentence: str

    @property
    def at_m(self) -> Float[np.ndarray, " 2"]:
        """Position of the sensor in the body frame: forward and left."""
        return self.T_body_sensor[:2, 3]

    @property
    def heading_rad(self) -> float:
        """Azimuth of the line of sight, counted from forward to the left: a camera's z axis, else the x axis."""
        x, y = self.T_body_sensor[:2, 2 if self.kind == "camera" else 0]
        return float(np.arctan2(y, x))


def rig_figure(sensors: Sequence[DrawnSensor], edges: Iterable[CalibrationRecord]) -> Markup:
    """The rig from above, forward up; the names and sentences of the sensors are on the left and right."""
    height = max(_PICTURE, _ROW * (len(sensors) / 2 + 2)) + _ROW
    place = _places(sensors, height)
    parts = [_view(s, place[s.name]) for s in sorted(sensors, key=lambda s: -s.width_rad)]
    parts += [
        _edge(e, place[e.parent_frame], place[e.child_frame])
        for e in edges
        if e.parent_frame in place and e.child_frame in place
    ]
    for side in ("left", "right"):
        parts += _column(side, _on_side(sensors, side), place, height)
    parts += [_dot(s, place[s.name]) for s in sensors]
    parts += _legend(sensors, height)
    return document(_WIDTH, height, parts, f"The rig from above: {', '.join(s.name for s in sensors)}")


def rig_of_day(poses: Sequence[PoseRow], records: Iterable[CalibrationRecord]) -> Markup:
    """The rig according to a day's current poses and edges; empty without poses."""
    T = {p.sensor: pose for p in poses if (pose := transform_of(p)) is not None}
    by_name = {p.sensor: p for p in poses}
    if len(T) < 2:
        return Markup("")
    T_body_reference = inverse(T[BASE.name]) if BASE.name in T else _upright(by_name[poses[0].reference].kind)
    sensors = [
        DrawnSensor(
            name,
            cast("Kind", by_name[name].kind),
            T_body_reference @ pose,
            by_name[name].view_azimuth_rad or 0.0,
            by_name[name].status,
            _known(by_name[name]),
        )
        for name, pose in T.items()
    ]
    return rig_figure(sensors, records)


def _upright(kind: str) -> Float[np.ndarray, "4 4"]:
    """T_body_sensor of a sensor that looks ahead."""
    T = np.eye(4)
    if kind == "camera":
        T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return T


def _known(pose: PoseRow) -> str:
    """Text with the accuracy of directions in the sensor, and remarks on its pose."""
    if pose.azimuth_sigma_rad is None or pose.elevation_sigma_rad is None:
        return pose.reason
    azimuth_deg, elevation_deg = np.degrees([pose.azimuth_sigma_rad, pose.elevation_sigma_rad])
    return "; ".join([f"azimuth ± {azimuth_deg:.2f}°, elevation ± {elevation_deg:.2f}°", *pose.notes])


def _places(sensors: Sequence[DrawnSensor], height: float) -> dict[str, tuple[float, float]]:
    """Position in the drawing by name: forward is up, left is left."""
    at = np.array([s.at_m for s in sensors])
    middle = (at.min(axis=0) + at.max(axis=0)) / 2
    span = max(float(np.ptp(at, axis=0).max()), _SMALLEST_M)
    px_per_m = (_PICTURE - 2.2 * _LOOK_PX) / span
    u, v = _WIDTH / 2 - (at[:, 1] - middle[1]) * px_per_m, height / 2 - (at[:, 0] - middle[0]) * px_per_m
    return {s.name: (float(a), float(b)) for s, a, b in zip(sensors, u, v, strict=True)}


def _view(sensor: DrawnSensor, place: tuple[float, float]) -> str:
    """Its field of view as a sector, or a disc."""
    if sensor.kind == "base":
        return ""
    (u, v), colour = place, _COLOURS[sensor.kind]
    radius = _LOOK_PX * (0.8 if sensor.kind == "radar" else 1.0)
    style = f'fill="{colour}" fill-opacity="0.11" stroke="{colour}" stroke-opacity="0.35"'
    if sensor.width_rad > np.radians(350):
        return f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:g}" {style}/>'
    start, end = (sensor.heading_rad + side * sensor.width_rad / 2 for side in (-1, 1))
    (x0, y0), (x1, y1) = ((u - radius * np.sin(a), v - radius * np.cos(a)) for a in (start, end))
    large = int(sensor.width_rad > np.pi)
    arc = f"A{radius:g} {radius:g} 0 {large} 0 {x1:.1f} {y1:.1f}"
    return f'<path d="M{u:.1f} {v:.1f}L{x0:.1f} {y0:.1f}{arc}Z" {style}/>'


def _edge(edge: CalibrationRecord, a: tuple[float, float], b: tuple[float, float]) -> str:
    colour = _STATUS_COLOURS.get(edge.status, MUTED)
    dash = "" if edge.status == "accepted" else ' stroke-dasharray="5 4"'
    sentence = f"{edge.parent_frame}-{edge.child_frame}: {edge.status}. {edge.reason}"
    title = f"<title>{escape(sentence)}</title>"
    # Bent a little, so that edges along one line do not hide each other.
    bend = ((a[0] + b[0] + _BEND * (b[1] - a[1])) / 2, (a[1] + b[1] - _BEND * (b[0] - a[0])) / 2)
    return (
        f'<path d="M{a[0]:.1f} {a[1]:.1f}Q{bend[0]:.1f} {bend[1]:.1f} {b[0]:.1f} {b[1]:.1f}" fill="none" '
        f'stroke="{colour}" stroke-width="2"{dash}>{title}</path>'
    )


def _dot(sensor: DrawnSensor, place: tuple[float, float]) -> str:
    ring = _STATUS_COLOURS.get(sensor.status, MUTED)
    return (
        f'<circle cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="5" fill="{_COLOURS[sensor.kind]}" stroke="{ring}" '
        f'stroke-width="2.5"><title>{escape(f"{sensor.name}: {sensor.sentence}")}</title></circle>'
    )


def _on_side(sensors: Sequence[DrawnSensor], side: str) -> list[DrawnSensor]:
    """Half of the sensors for each column, by their lateral position and line of sight; front ones first."""
    by_left = sorted(sensors, key=lambda s: (-s.at_m[1] - 0.5 * np.sin(s.heading_rad), s.name))
    half = (len(sensors) + 1) // 2
    taken = by_left[:half] if side == "left" else by_left[half:]
    return sorted(taken, key=lambda s: (-s.at_m[0] - 0.5 * np.cos(s.heading_rad), s.name))


def _column(
    side: str, sensors: Sequence[DrawnSensor], place: Mapping[str, tuple[float, float]], height: float
) -> list[str]:
    """Names and sentences in a column, each with a thin line to its sensor."""
    left = side == "left"
    anchor, u = ("end", _MARGIN - 8) if left else ("start", _WIDTH - _MARGIN + 8)
    top = (height - _ROW * len(sensors)) / 2
    parts = []
    for k, sensor in enumerate(sensors):
        v = top + _ROW * (k + 0.5)
        at, colour = place[sensor.name], _STATUS_COLOURS.get(sensor.status, MUTED)
        parts.append(
            f'<path d="M{u + (4 if left else -4):.1f} {v - 4:.1f}L{at[0]:.1f} {at[1]:.1f}" stroke="{MUTED}" '
            f'stroke-width="0.7" fill="none" stroke-opacity="0.7"/>'
            f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="{anchor}" font-weight="600">{escape(sensor.name)}'
            f'<tspan fill="{colour}" dx="6">{escape(sensor.status)}</tspan></text>'
            f'<text x="{u:.1f}" y="{v + 13:.1f}" text-anchor="{anchor}" font-size="10" fill="{MUTED}">'
            f"{escape(sensor.sentence)}</text>"
        )
    return parts


def _legend(sensors: Sequence[DrawnSensor], height: float) -> list[str]:
    """Legend: the forward direction, and the colour of each kind of sensor."""
    kinds = [k for k in _COLOURS if any(s.kind == k for s in sensors)]
    u, parts = _WIDTH / 2 - 34.0 * len(kinds), []
    for kind in kinds:
        parts.append(f'<circle cx="{u:.1f}" cy="{height - 10:.1f}" r="5" fill="{_COLOURS[kind]}"/>')
        parts.append(f'<text x="{u + 9:.1f}" y="{height - 6:.1f}" fill="{MUTED}">{kind}</text>')
        u += 68.0
    arrow = (
        f'<path d="M{_MARGIN + 14:g} 40V14m-5 8l5 -8 5 8" fill="none" stroke="{MUTED}" stroke-width="1.5"/>'
    )
    return [*parts, arrow, f'<text x="{_MARGIN + 24:g}" y="24" fill="{MUTED}">forward</text>']
