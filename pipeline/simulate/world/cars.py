"""Cars as meshes, closed or with seats behind transparent windows; seats of a bus, loads of lorries."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pipeline.simulate.world.materials import MATERIALS, material
from pipeline.simulate.world.meshes import Colour, Mesh, MeshBuilder

__all__ = ["add_car", "add_load", "add_seats", "add_wheels", "glazed"]

_SIDES: Final = dict.fromkeys(("front", "rear", "left", "right"), "car_paint")
_PANES: Final = {material(f"{name}_glass"): material(f"{name}_window") for name in ("car", "truck", "bus")}
_HOLLOW: Final = np.arange(len(MATERIALS), dtype=np.uint8)
_HOLLOW[list(_PANES)] = list(_PANES.values())
_HOLLOW[material("car_paint")] = material("car_lacquer")


def add_wheels(
    b: MeshBuilder, xs: tuple[float, ...], half_width_m: float, radius_m: float, tyre: str, rim: str
) -> None:
    """Add a wheel on each side at every x."""
    for x in xs:
        for side in (-1, 1):
            outer, inner = side * half_width_m, side * (half_width_m - 0.22)
            b.tube(np.array([x, inner, radius_m]), np.array([x, outer, radius_m]), radius_m, tyre, sides=12)
            b.tube(
                np.array([x, outer, radius_m]),
                np.array([x, outer + side * 0.01, radius_m]),
                0.6 * radius_m,
                rim,
                sides=8,
            )


@dataclass(frozen=True)
class _CarShape:
    """Sizes of a car [m]: half length and width, heights of roof and belt line, x of the cabin's rear end."""

    half: float
    w: float
    height: float
    belt: float
    bonnet: float
    tail: float
    estate: bool


def _car_shape(rng: np.random.Generator) -> _CarShape:
    length, width, height = rng.uniform(3.8, 4.9), rng.uniform(1.70, 1.90), rng.uniform(1.40, 1.66)
    half, estate = length / 2, rng.random() < 0.5
    bonnet = rng.uniform(0.85, 1.15)
    tail = -half + (0.10 if estate else rng.uniform(0.45, 0.65))
    return _CarShape(half, width / 2, height, 0.60 * height, bonnet, tail, estate)


def add_car(b: MeshBuilder, rng: np.random.Generator, colour: Colour, *, hollow: bool = False) -> None:
    """Add a car, a saloon or an estate; `hollow` has no lid below its windows, and seats."""
    shape = _car_shape(rng)
    half, w = shape.half, shape.w
    low = (-half, half, -w, w, 0.20)
    shoulder = (-half + 0.06, half - 0.12, -w + 0.02, w - 0.02, 0.44 * shape.height)
    deck = (-half + 0.10, half - 0.35, -w + 0.06, w - 0.06, shape.belt)
    b.frustum(low, shoulder, "car_paint", colour)
    b.frustum(shoulder, deck, _SIDES if hollow else "car_paint", colour)
    if hollow:
        _open_deck(b, shape, colour)
    _car_cabin(b, shape, colour)
    add_wheels(b, (-half + 0.80, half - 0.82), w + 0.01, 0.32, "car_tyre", "car_rim")
    _car_lamps(b, shape)


def _open_deck(b: MeshBuilder, shape: _CarShape, colour: Colour) -> None:
    """Bonnet, boot lid and shelf around the open cabin; dashboard, and two rows of seats with headrests."""
    half, w, belt = shape.half, shape.w - 0.06, shape.belt
    front, floor = half - shape.bonnet, 0.44 * shape.height
    for x0, x1 in ((front, half - 0.35), (-half + 0.10, shape.tail)):
        b.quads(
            np.array([[[x0, -w, belt], [x1, -w, belt], [x1, w, belt], [x0, w, belt]]]), "car_paint", colour
        )
    shelf = 0.9 if shape.estate else 0.35
    b.box((shape.tail + shelf / 2, 0, belt - 0.1), (shelf, 1.9 * w, 0.03), "seat")
    b.box((front - 0.30, 0, belt - 0.08), (0.5, 1.9 * w, 0.16), "seat")
    back = shape.tail + shelf + 0.1
    for x, gap in ((back, 0.0), (back + 0.45 * (front - back), 0.3)):
        add_seats(b, x, 0.92 * w, (floor, 0.74 * shape.height), gap)


def add_seats(
    b: MeshBuilder, x_m: float, half_width_m: float, height_m: tuple[float, float], gap_m: float
) -> None:
    """Add two seats side by side: cushions, backs up to a height, headrests above it."""
    low, high = height_m
    for side in (-1, 1):
        middle, width = side * (half_width_m + gap_m / 2) / 2, half_width_m - gap_m / 2
        b.box((x_m + 0.3, middle, low + 0.05), (0.5, width, 0.14), "seat")
        b.box((x_m, middle, (low + high) / 2), (0.14, width, high - low), "seat")
        b.box((x_m, middle, high + 0.09), (0.10, 0.26, 0.16), "seat")


def add_load(
    b: MeshBuilder, rng: np.random.Generator, x_m: tuple[float, float], half_width_m: float, colour: Colour
) -> None:
    """Add an open bed: a floor, low boards or stakes, and crates, pipes, or nothing on it."""
    (x0, x1), w, floor = x_m, half_width_m, 1.15
    b.box(((x0 + x1) / 2, 0, floor - 0.08), (x1 - x0, 2 * w, 0.16), "truck_paint", colour)
    b.box((x1 - 0.05, 0, floor + 0.6), (0.10, 2 * w, 1.2), "truck_paint", colour)
    for x in np.arange(x0 + 0.05, x1, 1.5):
        for side in (-1, 1):
            b.box((x, side * (w - 0.04), floor + 0.5), (0.08, 0.08, 1.0), "truck_paint", (0.3, 0.3, 0.3))
    kind = rng.random()
    if kind < 0.4:
        for x in np.arange(x0 + 1.0, x1 - 0.9, 1.9):
            size = rng.uniform([0.8, 0.7, 0.4], [1.7, 2.2 * w / 1.25, 1.6])
            b.box(
                (x, rng.uniform(-0.2, 0.2), floor + size[2] / 2),
                tuple(size),
                "load",
                tuple(rng.uniform(0.5, 1.3, 3)),
            )
    elif kind < 0.75:
        for y, z in ((-0.6, 0.2), (-0.1, 0.2), (0.45, 0.2), (-0.3, 0.62), (0.2, 0.62)):
            b.tube(np.array([x0 + 0.2, y, floor + z]), np.array([x1 - 0.4, y, floor + z]), 0.2, "load", 8)


def glazed(mesh: Mesh, share: float) -> Mesh:
    """The mesh with lacquer, and with windows that transmit a share of the beams."""
    pane = np.isin(mesh.material, list(_PANES))
    tint = np.where(pane[:, None], np.float32(share), mesh.tint)
    return replace(mesh, material=_HOLLOW[mesh.material], tint=tint)


def _car_cabin(b: MeshBuilder, shape: _CarShape, colour: Colour) -> None:
    half, w, height, belt = shape.half, shape.w, shape.height, shape.belt
    foot = (shape.tail, half - shape.bonnet, -w + 0.07, w - 0.07, belt)
    rear, front = shape.tail + (0.25 if shape.estate else 0.45), half - shape.bonnet - 0.75
    roof = (rear, front, -w + 0.24, w - 0.24, height)
    faces = dict.fromkeys(("front", "rear", "left", "right"), "car_glass") | {"top": "car_paint"}
    b.frustum(foot, roof, faces, colour)
    for side in (-1, 1):  # pillars are a little outside the glass
        for x in (0.30, 0.62):
            low = np.array([foot[0] + x * (foot[1] - foot[0]), side * (w - 0.07), belt])
            high = np.array([roof[0] + x * (roof[1] - roof[0]), side * (w - 0.24), height])
            b.tube(low, high, 0.045, "car_paint", 4, colour)
        mirror = (half - shape.bonnet + 0.15, side * (w + 0.07), belt + 0.06)
        b.box(mirror, (0.12, 0.16, 0.13), "car_paint", colour)


def _car_lamps(b: MeshBuilder, shape: _CarShape) -> None:
    """Lamps, number plates and the grille."""
    half, w, height = shape.half, shape.w, shape.height
    for side in (-1, 1):
        b.box((half - 0.06, side * (w - 0.24), 0.40 * height), (0.14, 0.36, 0.14), "car_lamp")
        b.box((-half + 0.05, side * (w - 0.20), 0.47 * height), (0.10, 0.34, 0.16), "car_tail")
    b.box((-half + 0.02, 0, 0.36 * height), (0.06, 0.50, 0.11), "car_plate")
    b.box((half - 0.01, 0, 0.24 * height), (0.06, 0.50, 0.11), "car_plate")
    b.box((half - 0.03, 0, 0.31 * height), (0.08, 0.9, 0.14), "car_tyre")
