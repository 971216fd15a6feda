"""Layers as open3d's geometries, and a picture of them without a window."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import open3d
from jaxtyping import Float, UInt8
from open3d.visualization import rendering

from pipeline.view.layers import Dots, Layer, Name, Picture, Rig, Strokes

__all__ = ["BACKGROUND", "VERTICAL_DEG", "add_layers", "quiet_stdout", "render", "viewpoint"]

BACKGROUND = (0.055, 0.067, 0.09, 1.0)
VERTICAL_DEG = 50.0
_ROW_PX = 18
_BEHIND_M, _ABOVE_M, _AHEAD_M = 11.0, 6.5, 12.0


@contextmanager
def quiet_stdout() -> Iterator[None]:
    """Send the renderer's output to stderr: stdout ends with the summary."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def viewpoint(rig: Rig) -> tuple[Float[np.ndarray, 3], Float[np.ndarray, 3]]:
    """Target and eye of the view: from behind and above, along the mean direction of the cameras, else forward."""
    T_car = rig.placed("calibrated")
    looks = [T[:3, 2] for name, T in T_car.items() if rig.kinds[name] == "camera"]
    way = np.mean(looks or [np.array([1.0, 0.0, 0.0])], axis=0) * [1, 1, 0]
    # Cameras all around look nowhere on the whole.
    way = way / np.linalg.norm(way) if np.linalg.norm(way) > 0.3 else np.array([1.0, 0.0, 0.0])
    middle = np.mean([T[:3, 3] for T in T_car.values()], axis=0)
    aside = np.array([-way[1], way[0], 0.0])
    eye = middle - _BEHIND_M * way + 0.35 * _BEHIND_M * aside + [0, 0, _ABOVE_M]
    return middle + _AHEAD_M * way + [0, 0, -1.0], eye


def add_layers(scene: Any, layers: Iterable[Layer], parts: Iterable[str], scale: float = 1.0) -> None:
    """Draw these parts in an empty scene of open3d, except names, which are not geometry."""
    wanted = set(parts)
    for number, layer in enumerate(layers):
        if layer.part in wanted and not isinstance(layer, Name):
            scene.add_geometry(f"{layer.part}-{number}", *_geometry(layer, scale))


def render(
    layers: list[Layer],
    target: Float[np.ndarray, 3],
    eye: Float[np.ndarray, 3],
    size_px: tuple[int, int],
    title: str,
) -> UInt8[np.ndarray, "H W 3"]:
    """Picture (RGB) with names of sensors and a title."""
    width, height = size_px
    with quiet_stdout():
        renderer = rendering.OffscreenRenderer(width, height)
        renderer.scene.set_background(BACKGROUND)
        renderer.scene.view.set_post_processing(False)  # colours as the camera has them
        add_layers(renderer.scene, layers, {layer.part for layer in layers})
        renderer.setup_camera(VERTICAL_DEG, target, eye, [0, 0, 1])
        image = np.asarray(renderer.render_to_image()).copy()
        camera = renderer.scene.camera
        projection = camera.get_projection_matrix() @ camera.get_view_matrix()
        del renderer
    names = []
    for layer in (layer for layer in layers if isinstance(layer, Name)):
        u, v, w = (projection @ [*layer.xyz, 1.0])[[0, 1, 3]]
        if w > 0:
            names.append((int((1 - v / w) / 2 * height), int((u / w + 1) / 2 * width), layer))
    row = 0
    for v, u, layer in sorted(names, key=lambda name: name[:2]):
        row = max(row + _ROW_PX, v - 6)  # below each other, where sensors sit together
        _write(image, layer.text, (u + 12, row), tuple(round(255 * c) for c in layer.rgb), 0.5)
    _write(image, title, (14, 26), (255, 255, 255), 0.6)
    return image


def _write(image: np.ndarray, text: str, at: tuple[int, int], rgb: tuple[int, ...], size: float) -> None:
    for colour, thickness in (((0, 0, 0), 4), (rgb, 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thickness, cv2.LINE_AA)


def _geometry(layer: Dots | Strokes | Picture, scale: float) -> tuple[Any, Any]:
    """A layer's geometry and its material."""
    points, material = open3d.utility.Vector3dVector, rendering.MaterialRecord()
    if isinstance(layer, Dots):
        shape: Any = open3d.geometry.PointCloud(points(layer.xyz))
        shape.colors = points(layer.rgb)
        material.shader, material.point_size = "defaultUnlit", layer.size_px * scale
    elif isinstance(layer, Strokes):
        ends = open3d.utility.Vector2iVector(np.arange(2 * len(layer.ends)).reshape(-1, 2))
        shape = open3d.geometry.LineSet(points(layer.ends.reshape(-1, 3)), ends)
        shape.colors = points(layer.rgb)
        material.shader, material.line_width = "unlitLine", layer.width_px * scale
    else:
        both = np.concatenate([layer.triangles, layer.triangles[:, ::-1]])  # to be seen from either side
        shape = open3d.geometry.TriangleMesh(points(layer.xyz), open3d.utility.Vector3iVector(both))
        corners_uv = [0.0, 1.0] + [1.0, -1.0] * layer.uv[both.reshape(-1)]
        shape.triangle_uvs = open3d.utility.Vector2dVector(corners_uv)
        # The shader takes pictures, not colours of points, for sRGB and makes them linear: undone beforehand.
        encoded = np.round(255 * (np.arange(256) / 255) ** (1 / 2.2)).astype(np.uint8)
        material.shader = "defaultUnlit"
        material.albedo_img = open3d.geometry.Image(np.ascontiguousarray(encoded[layer.rgb]))
    return shape, material
