"""Pictures of a vehicle-day: chosen frames drawn, as text inside a page, as a page of one frame, as files.

The view from above: lidar by height, radar orange at the prior and black at the result.

Source: paper, figures 1b, 3 and 4. Its points are a bitmap, axes and words are SVG around it.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from markupsafe import Markup

from pipeline.core.errors import ConfigError
from pipeline.report.overlays import (
    Extrinsics,
    Scene,
    Window,
    close_up,
    front_view,
    lidar_view,
    lidar_window,
    whole_view,
)
from pipeline.report.page import render, write_page
from pipeline.report.reading import choose_windows
from pipeline.report.svg import Plot, document
from pipeline.rig.cameras import camera_of
from pipeline.rig.estimates import Prior, Solution
from pipeline.rig.se3 import exp_se3, inverse, log_se3, rotation_angle_rad, transform_points
from schemas.calibrations import PAIRS, SENSORS
from schemas.words import AXIS_NAMES

__all__ = [
    "between",
    "jpeg_uri",
    "scene_pictures",
    "top_bitmap",
    "top_view",
    "write_frame_page",
    "write_picture",
]

_CLOSE_UPS = 3
_CLOSE_UP_WIDTH_PX = 420
_AHEAD_M, _BEHIND_M, _SIDE_M = 60.0, 3.0, 30.0
_PX_PER_M = 16
_PRIOR_BGR = (58, 129, 224)  # orange, as the prior in charts
_HIGH_M = 4.0  # end of the height colours: a lorry's roof
_WIDTH_PX = 960
_STEPS = 16
_STEP_MS, _FIRST_MS, _LAST_MS = 70, 1200, 2200  # long enough at both ends to look around
# Of 100; dots stay sharp, and a sweep of a 1.8 Mpx camera stays below 1.5 MB.
_WEBP_QUALITY = 50
_MOVING = {".webp": (cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY), ".gif": ()}
_STILL = {".jpg": (cv2.IMWRITE_JPEG_QUALITY, 85), ".png": ()}
_LABELS = ("before", "from this frame")
_JPEG_QUALITY = 82


def _close_ups(scene: Scene, before: Extrinsics, after: Extrinsics) -> dict[str, Any]:
    """Windows with most lidar edges at silhouettes, enlarged, at both states: pairs of data URIs."""
    windows = choose_windows(scene.observation, after.T_camera_lidar, _CLOSE_UPS)
    width = windows[0].size_px[0] if windows else 1
    zoom = max(2, round(_CLOSE_UP_WIDTH_PX / width))
    pairs = [[jpeg_uri(close_up(scene, s, window, zoom)) for s in (before, after)] for window in windows]
    angle = np.degrees(width / camera_of(scene.frame).focal_px[0])
    return {"pairs": pairs, "zoom": zoom, "window_deg": f"{angle:.1f}"}


def scene_pictures(
    scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str], camera_name: str
) -> dict[str, Any]:
    """All pictures of a frame as data URIs, empty if the frame lacks a sensor that they need, and words about it.

    `camera_name`: which one, if the rig has several.
    """
    camera, lidar, radar = (sensor in scene.observation.sensors for sensor in SENSORS)
    kinds = ["lidar by range"] * lidar + ["moving radar clusters as white +"] * radar
    return {
        "frame_index": scene.frame.frame_index,
        "log": scene.frame.log,
        "drive": scene.frame.drive,
        "front": jpeg_uri(front_view(scene, before, after, labels)) if camera else "",
        "shown": ", ".join([*kinds, "detected road users as boxes"]).capitalize(),
        "top": top_view(scene, before, after, labels) if lidar and radar else "",
        "close_ups": _close_ups(scene, before, after) if camera and lidar else None,
        "camera": camera_name,
    }


def top_view(scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str]) -> Markup:
    """Bird's-eye view in the lidar frame, radar at both states; at one where the labels are equal."""
    plot = Plot(44.0, 8.0, 540.0, 567.0, (-_SIDE_M, _SIDE_M), (-_BEHIND_M, _AHEAD_M))
    # PNG is lossless: single dots stay sharp.
    uri = _uri("png", top_bitmap(scene, before, after), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    plot.parts.append(
        f'<image x="44" y="8" width="540" height="567" href="{uri}" preserveAspectRatio="none"/>'
    )
    sides = [(float(x), f"{x:g}") for x in range(-30, 31, 10)]
    plot.frame(sides, [(float(y), f"{y:g}") for y in range(0, 61, 10)])
    named = dict(zip(labels, ("#{2:02x}{1:02x}{0:02x}".format(*_PRIOR_BGR), "#111"), strict=True))
    for k, (text, colour) in enumerate(named.items()):
        plot.text(52.0, 26.0 + 18.0 * k, text, colour=colour, size=14.0, bold=True)
    plot.text(314.0, 604.0, "to the right of the lidar [m]; up: ahead [m]", anchor="middle")
    for k, height in enumerate(np.linspace(0.0, _HIGH_M, 9)):
        colour = "#{2:02x}{1:02x}{0:02x}".format(*_height_colours(np.array([height]))[0])
        plot.parts.append(f'<rect x="594" y="{430 - 40 * k}" width="12" height="40" fill="{colour}"/>')
        if k % 2 == 0:
            plot.text(610.0, 454.0 - 40.0 * k, f"{height:g} m")
    plot.text(594.0, 490.0, "height")
    return document(650.0, 612.0, plot.parts, f"From above: radar over lidar, {' and '.join(named)}")


def top_bitmap(scene: Scene, before: Extrinsics, after: Extrinsics) -> UInt8[np.ndarray, "H W 3"]:
    """Points alone, BGR on white."""
    size = (round((_AHEAD_M + _BEHIND_M) * _PX_PER_M), round(2 * _SIDE_M * _PX_PER_M))
    image = np.full((*size, 3), 255, np.uint8)
    lidar = scene.frame.lidar_xyz_m
    if len(lidar):
        at, inside = _pixels(lidar, size)
        height = lidar[inside, 2] - np.percentile(lidar[:, 2], 5)
        order = np.argsort(height)  # what stands hides what lies
        column, row = at[inside][order].T
        colour = _height_colours(height[order])
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (2, 1), (0, 2), (1, 2), (2, 2)):
            image[np.clip(row + dy, 0, size[0] - 1), np.clip(column + dx, 0, size[1] - 1)] = colour
    for state, dot in ((before, _PRIOR_BGR), (after, (0, 0, 0))):
        points = transform_points(state.T_lidar_radar, scene.frame.radar_xyz_m.astype(np.float64))
        at, inside = _pixels(points, size)
        for u, v in at[inside]:
            cv2.circle(image, (int(u), int(v)), 2, dot, -1, cv2.LINE_AA)
    return image


def _pixels(points: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    at = np.stack([(_SIDE_M - points[:, 1]) * _PX_PER_M, (_AHEAD_M - points[:, 0]) * _PX_PER_M], 1)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < size[1]) & (at[:, 1] < size[0])
    return np.where(inside[:, None], at, 0).astype(int), inside


def _height_colours(height_m: np.ndarray) -> np.ndarray:
    level = np.round(235 * np.clip(height_m / _HIGH_M, 0, 1) + 10).astype(np.uint8)
    return (
        cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0]
        if len(level)
        else np.zeros((0, 3), np.uint8)
    )


def between(before: Extrinsics, after: Extrinsics, share: float) -> Extrinsics:
    """The state between the two: share 0 is `before`, 1 is `after`, with each pair interpolated along its own screw."""
    pairs = zip(vars(before).values(), vars(after).values(), strict=True)
    return Extrinsics(*(exp_se3(share * log_se3(T @ inverse(T_before))) @ T_before for T_before, T in pairs))


def write_picture(
    out: Path, scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str]
) -> Path:
    """Write the scene's camera image with lidar and moving radar at two states, with labels.

    .jpg and .png are stills, `before` left and `after` right; .webp and .gif move between the two. The
    folder is created.

    Raises:
        ConfigError: another suffix.
    """
    kind = out.suffix.lower()
    if kind not in _MOVING | _STILL:
        known = ", ".join(_STILL | _MOVING)
        raise ConfigError("command line", "picture", f"{out.name} ends in none of {known}")
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind in _STILL:
        written = cv2.imwrite(str(out), front_view(scene, before, after, labels), _STILL[kind])
    else:
        written = cv2.imwriteanimation(str(out), _animation(scene, before, after), _MOVING[kind])
    if not written:
        raise OSError(f"{out} could not be written")
    return out


def _animation(scene: Scene, before: Extrinsics, after: Extrinsics) -> cv2.Animation:
    # Starts and ends slowly, so that the eye can follow a silhouette.
    shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _STEPS))
    window = lidar_window(scene, after)
    animation = cv2.Animation()
    animation.frames = [_drawn(scene, between(before, after, float(s)), after, window) for s in shares]
    animation.durations = [_FIRST_MS, *[_STEP_MS] * (_STEPS - 2), _LAST_MS]
    return animation


def _drawn(scene: Scene, state: Extrinsics, after: Extrinsics, window: Window) -> UInt8[np.ndarray, "H W 3"]:
    label = f"camera-lidar: {_distance(state.T_camera_lidar, after.T_camera_lidar)} from the result"
    image = lidar_view(scene, state, window, label)
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
    return cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)


def _distance(T: Float[np.ndarray, "4 4"], T_other: Float[np.ndarray, "4 4"]) -> str:
    """Angle and shift between two poses in words."""
    angle_deg = float(np.degrees(rotation_angle_rad(T_other @ inverse(T))))
    return f"{angle_deg:.2f} deg, {100 * np.linalg.norm(T_other[:3, 3] - T[:3, 3]):.0f} cm"


def write_frame_page(path: Path, scene: Scene, prior: Prior, solution: Solution, title: str) -> Path:
    """Write pictures at the prior and at the solution, and the sigmas of each pair from one frame."""
    before = Extrinsics(*(prior.of(pair) for pair in PAIRS))
    after = Extrinsics(*(solution.pairs[pair].T for pair in PAIRS))
    views = [
        {
            "label": label,
            "front": jpeg_uri(whole_view(scene, state, label)),
            "top": top_view(scene, state, state, (label, label)),
        }
        for label, state in zip(_LABELS, (before, after), strict=True)
    ]
    html = render(
        "frame.html",
        title=title,
        method=solution.method,
        labels=_LABELS,
        views=views,
        close_ups=_close_ups(scene, before, after),
        pairs=[_told(pair, prior, solution) for pair in PAIRS],
    )
    return write_page(path, html)


def _told(pair: str, prior: Prior, solution: Solution) -> dict[str, str]:
    """Text of the page about a pair."""
    estimate, T = solution.pairs[pair], prior.of(pair)
    turned_deg = np.degrees(rotation_angle_rad(estimate.T @ inverse(T)))
    shifted_m = float(np.linalg.norm(estimate.T[:3, 3] - T[:3, 3]))
    sigma = np.sqrt(np.diag(estimate.covariance))
    names = AXIS_NAMES[pair.partition("_")[0]]
    seen = zip(names[:3], sigma[:3], estimate.observable[:3], strict=True)
    known = [f"{name} {np.degrees(s):.2f} deg" for name, s, observable in seen if observable]
    return {
        "title": pair.replace("_", "-"),
        "moved": f"{turned_deg:.2f} deg and {shifted_m:.3f} m from before",
        "known": ", ".join(known) if known else "nothing: the prior stays",
        "matrix": "\n".join("  ".join(f"{v: .6f}" for v in row) for row in estimate.T),
    }


def jpeg_uri(image_bgr: UInt8[np.ndarray, "H W 3"], width_px: int | None = None) -> str:
    """A photograph, scaled down to `width_px` where it is wider."""
    if width_px is not None and image_bgr.shape[1] > width_px:
        height = round(image_bgr.shape[0] * width_px / image_bgr.shape[1])
        image_bgr = cv2.resize(image_bgr, (width_px, height), interpolation=cv2.INTER_AREA)
    return _uri("jpeg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def _uri(kind: str, image_bgr: UInt8[np.ndarray, "H W 3"], options: list[int]) -> str:
    done, data = cv2.imencode(f".{kind}", image_bgr, options)
    assert done, "OpenCV encodes every uint8 image"
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"
