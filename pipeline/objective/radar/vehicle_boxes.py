"""Radar detections inside the camera's vehicle boxes: the term that determines a radar's roll and pitch.

Detections between the sides of a box, at the range given by its height, belong to that vehicle. Their
elevation in the camera frame is the box's elevation up to a constant per class (returns come from below the
box's centre). Roll is a slope of the difference over azimuth, for any constant; pitch cannot be separated
from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from pipeline.objective.radar.registration import robust_equations
from pipeline.objective.stamp_gaps import scan_to_image_s
from pipeline.rig.cameras import camera_of
from pipeline.rig.se3 import camera_direction_angles, from_spherical, hat, to_spherical, transform_points
from schemas.observations import Observation

__all__ = [
    "BOX_CLASSES", "BoxPairs", "VehicleBoxes", "box_equations", "box_pairs", "elevation_residuals",
    "median_of_rows", "vehicle_boxes",
]  # fmt: skip

BOX_CLASSES = (("car",), ("truck", "bus"))
_KIND_OF = {name: kind for kind, names in enumerate(BOX_CLASSES) for name in names}
BIAS_SIGMA_RAD = np.radians(1.0)  # returns lie up to half a box below its centre; real logs showed 0.5-1 deg
_HEIGHT_M = (1.5, 2.9)
_RANGE_FACTOR = 1.8  # box height to range: vans to low cars, poor boxes
_RANGE_M = (3.0, 60.0)
_DEPTH_M = 3.5  # detections of one vehicle lie within this range interval
_LEAST_HEIGHT_PX = 12.0
_LEAST_DETECTIONS = 2  # fewer are not used


@dataclass(frozen=True, eq=False)
class VehicleBoxes:
    """Boxes as directions from the camera, left and up positive."""

    kind: Int64[np.ndarray, " B"]  # index into BOX_CLASSES
    azimuth_rad: Float[np.ndarray, " B"]  # of the centre
    elevation_rad: Float[np.ndarray, " B"]
    left_rad: Float[np.ndarray, " B"]  # azimuths of the sides
    right_rad: Float[np.ndarray, " B"]
    expected_m: Float[np.ndarray, " B"]  # range that the height suggests
    frame: Int64[np.ndarray, " B"]  # index into the observations given
    # By frame, detections in radar axes where they were when the image was taken: as points [m], and as azimuth,
    # elevation [rad], range. What they moved along the line of sight changes no direction.
    scans: Mapping[int, tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]]


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """Vehicles seen by camera and radar: one radar point per box."""

    point_radar_m: Float[np.ndarray, "B 3"]  # median azimuth, elevation and range of the detections
    azimuth_rad: Float[np.ndarray, " B"]  # box centre as the camera sees it, left positive
    elevation_rad: Float[np.ndarray, " B"]  # up positive
    kind: Int64[np.ndarray, " B"]  # index into BOX_CLASSES
    frame: Int64[np.ndarray, " B"]  # index into the observations given

    @property
    def count(self) -> int:
        """Number of boxes."""
        return len(self.kind)


def vehicle_boxes(observations: Sequence[Observation]) -> VehicleBoxes:
    """Whole, unoccluded vehicle boxes of frames whose radar measures elevation."""
    rows = [
        _boxes_of_frame(o, index)
        for index, o in enumerate(observations)
        if o.radar_has_elevation and len(o.road_user_boxes_px) and len(o.radar_xyz_m)
    ]
    kind, azimuth, elevation, left, right, expected_m, frame = np.concatenate([np.zeros((0, 7)), *rows]).T
    turns = scan_to_image_s(observations) * [o.ego_yaw_rate_radps or 0.0 for o in observations]
    scans = {}
    for index in np.unique(frame).astype(int).tolist():
        c, s = np.cos(turns[index]), np.sin(turns[index])
        to_image = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        radar = observations[index].radar_xyz_m.astype(np.float64) @ to_image
        scans[index] = radar, to_spherical(radar)
    numbers = kind.astype(np.int64), frame.astype(np.int64)
    return VehicleBoxes(numbers[0], azimuth, elevation, left, right, expected_m, numbers[1], scans)


def box_pairs(
    boxes: VehicleBoxes, T_camera_radar: Float[np.ndarray, "4 4"], elevation_gate_rad: float
) -> BoxPairs:
    """Find the detections of each box.

    The azimuth of `T_camera_radar` is right to about a box's width; detections farther than
    `elevation_gate_rad` from the box's centre are left out.
    """
    paired, middle = list[int](), list[np.ndarray]()
    for index, (radar, directions) in boxes.scans.items():
        in_camera = transform_points(T_camera_radar, radar)
        angles = camera_direction_angles(in_camera)
        distance = np.linalg.norm(in_camera, axis=1)
        for b in np.flatnonzero(boxes.frame == index).tolist():
            chosen = _detections_of(angles, distance, boxes, b, elevation_gate_rad)
            if len(chosen) >= _LEAST_DETECTIONS:
                paired.append(b)
                middle.append(median_of_rows(directions[chosen]))
    points = from_spherical(np.array(middle, np.float64).reshape(-1, 3))
    of = np.array(paired, np.int64)
    return BoxPairs(points, boxes.azimuth_rad[of], boxes.elevation_rad[of], boxes.kind[of], boxes.frame[of])


def elevation_residuals(
    pairs: BoxPairs, T_camera_radar: Float[np.ndarray, "4 4"], bias_rad: Float[np.ndarray, " C"]
) -> tuple[Float[np.ndarray, " B"], Float[np.ndarray, "B P"]]:
    """Radar elevation minus box elevation minus the class's bias, and its Jacobian.

    Unknowns: left twist of T_camera_radar (6), then the biases, one per entry of BOX_CLASSES.
    """
    camera = transform_points(T_camera_radar, pairs.point_radar_m)
    elevation = camera_direction_angles(camera)[:, 1]
    x, y, z = camera.T
    h = np.hypot(x, z)
    r2 = h * h + y * y
    # elevation = atan2(-y, hypot(x, z))
    gradient = np.stack([x * y / (h * r2), -h / r2, z * y / (h * r2)], -1)
    J = np.zeros((pairs.count, 6 + len(bias_rad)))
    J[:, :3] = -(gradient[:, None, :] @ hat(camera))[:, 0]
    J[:, 3:6] = gradient
    J[np.arange(pairs.count), 6 + pairs.kind] = -1.0
    return elevation - pairs.elevation_rad - bias_rad[pairs.kind], J


def box_equations(
    pairs: BoxPairs, T_camera_radar: Float[np.ndarray, "4 4"], bias_rad: Float[np.ndarray, " C"], frames: int
) -> tuple[Float[np.ndarray, "F P P"], Float[np.ndarray, "F P"], float]:
    """Per frame, information and gradient of the robust (Cauchy) elevation cost, and the residual's own sigma [rad].

    The spread of the residuals themselves is taken as the precision of this radar's elevations.
    """
    found = elevation_residuals(pairs, T_camera_radar, bias_rad)
    return robust_equations(*found, pairs.frame, frames)


def _boxes_of_frame(o: Observation, frame: int) -> np.ndarray:
    """Rows of one frame's boxes: columns of VehicleBoxes."""
    camera = camera_of(o)
    boxes = o.road_user_boxes_px.astype(np.float64)
    x0, y0, x1, y1 = boxes.T
    inside = (x0 > 3) & (y0 > 3) & (x1 < o.image_width_px - 4) & (y1 < o.image_height_px - 4)
    kinds = np.array([_KIND_OF.get(name, -1) for name in o.road_user_classes], int)
    whole = inside & (kinds >= 0) & (y1 - y0 >= _LEAST_HEIGHT_PX)
    chosen = [b for b in np.flatnonzero(whole) if not _is_occluded(boxes, int(b))]
    xm, ym = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    pixels = np.stack([np.stack(uv, -1)[chosen] for uv in ((xm, ym), (x0, ym), (x1, ym), (xm, y0), (xm, y1))])
    angle = camera_direction_angles(camera.unproject(pixels))
    height_rad = np.maximum(angle[3, :, 1] - angle[4, :, 1], 1e-3)
    kind = kinds[chosen]
    expected_m = np.array(_HEIGHT_M)[kind] / height_rad
    middle, left, right = angle[0], angle[1, :, 0], angle[2, :, 0]
    rows = np.column_stack([kind, middle, left, right, expected_m, np.full(len(kind), frame)])
    return rows[np.isfinite(rows).all(1)]


def _is_occluded(boxes: np.ndarray, b: int) -> bool:
    """True if a nearer object (with a lower foot) covers part of the box."""
    x0, _, x1, y1 = boxes.T
    overlap = np.minimum(x1, x1[b]) - np.maximum(x0, x0[b])
    return bool(np.any((y1 > y1[b] + 1) & (overlap > 0.3 * (x1[b] - x0[b]))))


def _detections_of(
    angles: np.ndarray, distance: np.ndarray, boxes: VehicleBoxes, b: int, elevation_gate: float
) -> np.ndarray:
    """Detections between the box's sides in the most populated range interval near the expected range."""
    expected_m = boxes.expected_m[b]
    near = np.flatnonzero(
        (angles[:, 0] < boxes.left_rad[b])
        & (angles[:, 0] > boxes.right_rad[b])
        & (np.abs(angles[:, 1] - boxes.elevation_rad[b]) < elevation_gate)
        & (distance > max(_RANGE_M[0], expected_m / _RANGE_FACTOR))
        & (distance < min(_RANGE_M[1], expected_m * _RANGE_FACTOR))
    )
    if not len(near):
        return near
    r = np.sort(distance[near])
    count = np.searchsorted(r, r + _DEPTH_M, side="right") - np.arange(len(r))
    start = r[int(np.argmax(count))]
    return near[(distance[near] >= start) & (distance[near] <= start + _DEPTH_M)]


def median_of_rows(x: Float[np.ndarray, "N ..."]) -> np.ndarray:
    """Median over the first axis, as `np.median(x, axis=0)` has it; of one row or more, none with a NaN."""
    ordered = np.sort(x, axis=0)
    return np.asarray(0.5 * (ordered[(len(x) - 1) // 2] + ordered[len(x) // 2]))
