"""The view from above, split into prior and calibrated: lidar by height, radar black.

Source: paper, figures 1b, 3 and 4. The points are a bitmap, axes and words are SVG around it.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from pipeline.report.encode import png_uri
from pipeline.report.overlays import Extrinsics, Scene
from pipeline.report.svg import Plot, document
from pipeline.rig.se3 import transform_points

__all__ = ["top_bitmap", "top_view"]

_AHEAD_M, _BEHIND_M, _SIDE_M = 60.0, 3.0, 30.0
_PX_PER_M = 16
_HIGH_M = 4.0  # end of the height colours: a lorry's roof


def top_view(scene: Scene, before: Extrinsics, after: Extrinsics, labels: tuple[str, str]) -> Markup:
    """Bird's-eye view in the lidar frame: radar left of the car at `before`, right of it at `after`."""
    plot = Plot(44.0, 8.0, 540.0, 567.0, (-_SIDE_M, _SIDE_M), (-_BEHIND_M, _AHEAD_M))
    uri = png_uri(top_bitmap(scene, before, after))
    plot.parts.append(
        f'<image x="44" y="8" width="540" height="567" href="{uri}" preserveAspectRatio="none"/>'
    )
    sides = [(float(x), f"{x:g}") for x in range(-30, 31, 10)]
    plot.frame(sides, [(float(y), f"{y:g}") for y in range(0, 61, 10)])
    said = ((labels[0], 52.0, "start"), (labels[1], 576.0, "end"))
    for text, u, anchor in said[: len(set(labels))]:
        plot.text(u, 26.0, text, anchor=anchor, colour="#111", size=14.0, bold=True)
    plot.text(314.0, 604.0, "to the right of the lidar [m]; up: ahead [m]", anchor="middle")
    for k, height in enumerate(np.linspace(0.0, _HIGH_M, 9)):
        colour = "#{2:02x}{1:02x}{0:02x}".format(*_height_colours(np.array([height]))[0])
        plot.parts.append(f'<rect x="594" y="{430 - 40 * k}" width="12" height="40" fill="{colour}"/>')
        if k % 2 == 0:
            plot.text(610.0, 454.0 - 40.0 * k, f"{height:g} m")
    plot.text(594.0, 490.0, "height")
    sides_said = f"left {labels[0]}, right {labels[1]}" if len(set(labels)) > 1 else labels[0]
    return document(650.0, 612.0, plot.parts, f"From above: radar over lidar, {sides_said}")


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
    for state, side in ((before, 1), (after, -1)):
        points = transform_points(state.T_lidar_radar, scene.frame.radar_xyz_m.astype(np.float64))
        points = points[points[:, 1] * side > 0]
        at, inside = _pixels(points, size)
        for u, v in at[inside]:
            cv2.circle(image, (int(u), int(v)), 2, (0, 0, 0), -1, cv2.LINE_AA)
    cv2.line(image, (size[1] // 2, 0), (size[1] // 2, size[0]), (0, 0, 0), 2)
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
