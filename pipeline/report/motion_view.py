"""A camera's own motion in its picture: tracks, the point that the image expands from, and where straight ahead is.

Straight ahead is the vehicle's x axis at the prior and at the result. In a turn the camera does not move straight
ahead, so the picture is of a moment that hardly turns.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import DamagedError
from pipeline.core.sections import ReportConfig
from pipeline.report.overlays import decode_image
from pipeline.report.pictures import jpeg_uri
from pipeline.report.reading import has_frames, scene_of, spread_observations
from pipeline.rig.cameras import Camera, camera_of
from pipeline.rig.se3 import exp_so3
from pipeline.store.current import prior_of, transform_of
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import frames_of
from schemas.calibrations import CalibrationRecord
from schemas.frames import Frame
from schemas.observations import Observation

__all__ = ["draw_motion", "motion_pictures"]

_WIDTH_PX = 1000
_TRACK, _BEFORE, _AFTER, _SEEN = (90, 220, 90), (200, 200, 200), (255, 170, 60), (60, 60, 255)
_STRAIGHT_RAD = np.radians(0.3)  # of the turn between both images


def motion_pictures(
    lake: Lake, partition: Partition, records: Iterable[CalibrationRecord], config: ReportConfig
) -> list[dict[str, str]]:
    """Picture (data URI) and caption of each camera with an edge to the vehicle frame, if the day still has frames."""
    found = []
    for record in records:
        before, after = prior_of(record), transform_of(record)
        if record.pair != "camera_base" or before is None or after is None or not has_frames(lake, partition):
            continue
        chosen = {"camera": record.parent_frame}
        try:
            seen = [o for o in spread_observations(lake, partition, chosen) if o.motion_turn_rad is not None]
            if not seen:
                continue
            shown = min(seen, key=_how_plain)
            frame = next(iter(frames_of(lake, partition, [shown.frame_index], chosen)))
        except DamagedError as err:
            lake.damage.append(str(err))
            continue
        picture = draw_motion(scene_of(frame, shown, config).frame, shown, before, after)
        found.append(
            {"camera": record.parent_frame, "picture": jpeg_uri(picture), "caption": _caption(shown)}
        )
    return found


def draw_motion(
    frame: Frame,
    seen: Observation,
    T_before: Float[np.ndarray, "4 4"],
    T_after: Float[np.ndarray, "4 4"],
) -> UInt8[np.ndarray, "H W 3"]:
    """The image with its tracks, the direction of travel by them, and straight ahead at two T_camera_base."""
    assert seen.motion_turn_rad is not None
    assert seen.motion_direction is not None
    assert seen.motion_tracks_px is not None
    scale = _WIDTH_PX / frame.image_width_px
    camera = camera_of(frame).scaled(scale)
    grey = cv2.cvtColor(decode_image(frame), cv2.COLOR_BGR2GRAY)
    image = cv2.cvtColor(cv2.resize(grey, (camera.width_px, camera.height_px)), cv2.COLOR_GRAY2BGR)
    image = np.asarray(image * 0.7, np.uint8)
    for u0, v0, u1, v1 in np.round(seen.motion_tracks_px * scale).astype(int).tolist():
        cv2.line(image, (u0, v0), (u1, v1), _TRACK, 1, cv2.LINE_AA)
        cv2.circle(image, (u1, v1), 2, _TRACK, -1, cv2.LINE_AA)
    travel = seen.motion_direction @ exp_so3(seen.motion_turn_rad / 2)  # in axes of this image
    _mark(image, camera, travel, _SEEN, cv2.MARKER_CROSS)
    _mark(image, camera, T_before[:3, 0], _BEFORE, cv2.MARKER_SQUARE)
    _mark(image, camera, T_after[:3, 0], _AFTER, cv2.MARKER_DIAMOND)
    return image


def _mark(
    image: np.ndarray, camera: Camera, direction: np.ndarray, colour: tuple[int, ...], marker: int
) -> None:
    """Mark a direction, or the opposite one where that is in the image: what a camera that looks back sees."""
    for sign in (1.0, -1.0):
        uv, valid = camera.project(sign * direction[None])
        if valid[0] and camera.contains(uv)[0]:
            at = (round(float(uv[0, 0])), round(float(uv[0, 1])))
            cv2.drawMarker(image, at, (0, 0, 0), marker, 34, 6, cv2.LINE_AA)
            cv2.drawMarker(image, at, colour, marker, 30, 2, cv2.LINE_AA)


def _how_plain(seen: Observation) -> float:
    """Small for a moment that hardly turns, with tracks all over the image."""
    assert seen.motion_turn_rad is not None
    turn = float(np.linalg.norm(seen.motion_turn_rad))
    return turn / _STRAIGHT_RAD - 3.0 * (seen.motion_spread or 0.0)


def _caption(seen: Observation) -> str:
    count = 0 if seen.motion_tracks_px is None else len(seen.motion_tracks_px)
    way = "" if seen.ego_driven_m is None else f" and {abs(seen.ego_driven_m):.1f} m of driving"
    return (
        f"Frame {seen.frame_index}: {count} tracks from the image {seen.motion_span_s or 0.0:.2f} s{way} earlier. "
        "Red cross: the point of expansion, the direction of travel. Grey square and blue diamond: straight ahead of "
        "the vehicle, by the prior and by the result. For a side camera, both are outside the image."
    )
