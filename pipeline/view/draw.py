"""Layers as open3d's geometries, and a picture of them without a window."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import open3d
from jaxtyping import Float, UInt8
from open3d.visualization import rendering

from pipeline.view.layers import Dots, Layer, Name, Picture, Strokes

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


def viewpoint(
    T_car: Mapping[str, Float[np.ndarray, "4 4"]], cameras: Iterable[str]
) -> tuple[Float[np.ndarray, 3], Float[np.ndarray, 3]]:
    """Target and eye of the view: from behind and above, along the mean direction of the cameras, else forward."""
    looks = [T_car[name][:3, 2] for name in cameras if name in T_car]
    way = np.array([1.0, 0.0, 0.0]) if not looks else np.mean(looks, axis=0) * [1, 1, 0]
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
            scene.add_geometry(f"{layer.part}-{number}", *_MAKERS[type(layer)](layer, scale))


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
        view, projection = (
            renderer.scene.camera.get_view_matrix(),
            renderer.scene.camera.get_projection_matrix(),
        )
        del renderer
    names = []
    for layer in layers:
        if isinstance(layer, Name):
            u, v, w = (projection @ view @ [*layer.xyz, 1.0])[[0, 1, 3]]
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


def _dots(layer: Dots, scale: float) -> tuple[Any, Any]:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(layer.xyz))
    cloud.colors = open3d.utility.Vector3dVector(layer.rgb)
    material = _material("defaultUnlit")
    material.point_size = layer.size_px * scale
    return cloud, material


def _strokes(layer: Strokes, scale: float) -> tuple[Any, Any]:
    lines = open3d.geometry.LineSet(
        open3d.utility.Vector3dVector(layer.ends.reshape(-1, 3)),
        open3d.utility.Vector2iVector(np.arange(2 * len(layer.ends)).reshape(-1, 2)),
    )
    lines.colors = open3d.utility.Vector3dVector(layer.rgb)
    material = _material("unlitLine")
    material.line_width = layer.width_px * scale
    return lines, material


def _picture(layer: Picture, _: float) -> tuple[Any, Any]:
    both = np.concatenate([layer.triangles, layer.triangles[:, ::-1]])  # to be seen from either side
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(layer.xyz), open3d.utility.Vector3iVector(both)
    )
    mesh.triangle_uvs = open3d.utility.Vector2dVector([0.0, 1.0] + [1.0, -1.0] * layer.uv[both.reshape(-1)])
    material = _material("defaultUnlit")
    # The shader takes pictures, not colours of points, for sRGB and makes them linear: undone beforehand.
    encoded = np.round(255 * (np.arange(256) / 255) ** (1 / 2.2)).astype(np.uint8)
    material.albedo_img = open3d.geometry.Image(np.ascontiguousarray(encoded[layer.rgb]))
    return mesh, material


def _material(shader: str) -> Any:
    material = rendering.MaterialRecord()
    material.shader = shader
    return material


_MAKERS: Mapping[type, Callable[[Any, float], tuple[Any, Any]]] = {
    Dots: _dots,
    Strokes: _strokes,
    Picture: _picture,
}
