"""Road users as meshes, cars closed or with seats behind windows: x forward, y left, z up, origin on the ground."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np

from pipeline.simulate.world.materials import MATERIALS, material
from pipeline.simulate.world.meshes import Colour, Mesh, MeshBuilder

__all__ = ["HOLLOW", "VARIANTS", "actor_mesh", "add_car", "add_load", "add_seats", "add_wheels", "glazed"]

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


VARIANTS: Final = {"car": 24, "van": 6, "truck": 8, "bus": 3, "cyclist": 6, "pedestrian": 12}
# Added to a variant: the same road user with windows transparent to beams, and open loads.
HOLLOW: Final = 1000
_COLOURS: Final = (
    (0.70, 0.70, 0.70),
    (0.45, 0.46, 0.48),
    (0.03, 0.03, 0.035),
    (0.10, 0.11, 0.12),
    (0.22, 0.23, 0.25),
    (0.35, 0.03, 0.03),
    (0.05, 0.09, 0.26),
    (0.10, 0.20, 0.34),
    (0.06, 0.14, 0.08),
    (0.50, 0.42, 0.30),
    (0.75, 0.75, 0.73),
    (0.55, 0.28, 0.05),
)


@lru_cache(maxsize=256)
def actor_mesh(kind: str, variant: int) -> Mesh:
    """Mesh of one of the kinds in VARIANTS, which differ in size, shape and colour and repeat."""
    hollow, variant = variant >= HOLLOW, variant % HOLLOW % VARIANTS[kind]
    rng = np.random.default_rng([list(VARIANTS).index(kind), variant])
    colour = _COLOURS[int(rng.integers(len(_COLOURS)))]
    b = MeshBuilder()
    if kind == "car":
        add_car(b, rng, colour, hollow=hollow)
    elif kind == "van":
        _van(b, rng, colour)
    elif kind == "truck":
        _truck(b, rng, colour, open_load=hollow and variant % 2 == 0)
    elif kind == "bus":
        _bus(b, colour)
        for x in np.arange(-4.5, 4.5, 1.5) if hollow else ():
            add_seats(b, float(x), 1.1, (1.3, 2.0), 0.7)
    elif kind == "cyclist":
        _cyclist(b, rng)
    else:
        _person(b, rng, "cloth", (0.32, 0.12, -0.24, 0.0)[variant % 4], seated=False)
    return glazed(b.mesh(1), rng.uniform(0.5, 1.0)) if hollow else b.mesh(1)


def _van(b: MeshBuilder, rng: np.random.Generator, colour: Colour) -> None:
    length, w, height = rng.uniform(5.0, 6.0), 0.98, rng.uniform(2.0, 2.6)
    half = length / 2
    b.frustum((-half, half, -w, w, 0.25), (-half + 0.05, half - 0.15, -w, w, 1.05), "car_paint", colour)
    cargo_end = half - 1.75
    b.frustum(
        (-half + 0.05, cargo_end, -w, w, 1.05),
        (-half + 0.10, cargo_end, -w + 0.10, w - 0.10, height),
        "car_paint",
        colour,
    )
    cab = {"front": "car_glass", "left": "car_glass", "right": "car_glass", "top": "car_paint"}
    b.frustum(
        (cargo_end, half - 0.55, -w, w, 1.05),
        (cargo_end, half - 1.2, -w + 0.12, w - 0.12, height - 0.1),
        cab,
        colour,
    )
    b.box((-half + 0.05, 0, 1.55), (0.05, 1.2, 0.55), "car_glass")
    add_wheels(b, (-half + 1.0, half - 0.95), w + 0.01, 0.35, "car_tyre", "car_rim")
    for side in (-1, 1):
        b.box((half - 0.10, side * (w - 0.22), 0.75), (0.14, 0.30, 0.22), "car_lamp")
        b.box((-half + 0.03, side * (w - 0.10), 1.10), (0.08, 0.18, 0.45), "car_tail")
    b.box((-half, 0, 0.65), (0.05, 0.5, 0.11), "car_plate")


def _truck(b: MeshBuilder, rng: np.random.Generator, colour: Colour, *, open_load: bool) -> None:
    cargo, w, height = rng.uniform(5.5, 12.0), 1.25, rng.uniform(3.2, 3.9)
    half = (cargo + 2.4) / 2
    cab_start = half - 2.1
    tarpaulin = _COLOURS[int(rng.integers(len(_COLOURS)))]
    if open_load:
        add_load(b, rng, (-half, cab_start - 0.3), w, tarpaulin)
    else:
        floor = (-half, cab_start - 0.3, -w, w)
        b.frustum((*floor, 1.0), (*floor, height), "truck_paint", tarpaulin)
    b.box((0, 0, 0.85), (2 * half - 1.0, 1.0, 0.3), "truck_tyre")
    b.frustum((cab_start, half, -w, w, 0.5), (cab_start, half - 0.05, -w, w, 1.6), "truck_paint", colour)
    faces = {"front": "truck_glass", "left": "truck_glass", "right": "truck_glass", "rear": "truck_paint"}
    b.frustum(
        (cab_start, half - 0.05, -w, w, 1.6), (cab_start, half - 0.2, -w + 0.05, w - 0.05, 2.4), faces, colour
    )
    b.frustum(
        (cab_start, half - 0.2, -w + 0.05, w - 0.05, 2.4),
        (cab_start, half - 0.7, -w + 0.1, w - 0.1, 2.9),
        "truck_paint",
        colour,
    )
    axles = (-half + 1.0, -half + 2.2, half - 1.3) if cargo > 7.5 else (-half + 1.5, half - 1.3)
    add_wheels(b, axles, w + 0.03, 0.5, "truck_tyre", "truck_tyre")
    for side in (-1, 1):
        b.box((-half, side * (w - 0.25), 0.95), (0.08, 0.4, 0.18), "truck_tail")
    b.box((-half - 0.02, 0, 0.62), (0.10, 2.3, 0.14), "truck_paint", (0.3, 0.3, 0.3))


def _bus(b: MeshBuilder, colour: Colour) -> None:
    half, w = 5.9, 1.27
    b.frustum((-half, half, -w, w, 0.35), (-half, half, -w, w, 1.25), "bus_paint", colour)
    faces = dict.fromkeys(("front", "rear", "left", "right"), "bus_glass")
    b.frustum((-half, half, -w, w, 1.25), (-half, half - 0.1, -w + 0.03, w - 0.03, 2.45), faces, colour)
    b.frustum(
        (-half, half - 0.1, -w + 0.03, w - 0.03, 2.45),
        (-half + 0.1, half - 0.2, -w + 0.1, w - 0.1, 3.05),
        "bus_paint",
        colour,
    )
    for x in np.linspace(-half + 1.4, half - 1.4, 7):
        for side in (-1, 1):
            b.box((float(x), side * (w - 0.01), 1.85), (0.12, 0.06, 1.2), "bus_paint", colour)
    add_wheels(b, (-half + 2.6, half - 2.6), w + 0.03, 0.48, "bus_tyre", "bus_tyre")


def _person(b: MeshBuilder, rng: np.random.Generator, cloth: str, stride_m: float, seated: bool) -> None:
    height = rng.uniform(1.58, 1.90)
    top = tuple(rng.uniform(0.04, 0.55, 3))
    trousers = tuple(rng.uniform(0.03, 0.20, 3))
    hip, neck = (0.52 * height, 0.83 * height)
    lift, lean = (0.38, 0.22) if seated else (0.0, 0.0)
    for side, step in ((-1, stride_m), (1, -stride_m)):
        foot = np.array([step + lean, side * 0.10, 0.05 + (0.35 + side * 0.12 if seated else 0.0)])
        knee = np.array([0.5 * step + (0.33 if seated else 0.04), side * 0.10, hip * 0.52 + lift])
        hip_point = np.array([0.0, side * 0.09, hip + lift])
        b.tube(foot, knee, 0.065, cloth, 6, trousers)
        b.tube(knee, hip_point, 0.085, cloth, 6, trousers)
        hand = np.array(
            [-0.8 * step + (0.48 if seated else 0.0), side * 0.24, hip + lift + (0.25 if seated else 0.0)]
        )
        b.tube(np.array([lean, side * 0.20, neck + lift - 0.05]), hand, 0.05, cloth, 5, top)
    b.frustum(
        (-0.11, 0.11, -0.17, 0.17, hip + lift - 0.05),
        (-0.12 + lean, 0.12 + lean, -0.22, 0.22, neck + lift),
        cloth,
        top,
    )
    head = np.array([lean + 0.02, 0.0, neck + lift + 0.60 * (height - neck)])
    skin, throat, face = cloth, (0.4, 0.27, 0.2), top
    if cloth == "cloth":
        skin, throat, face = "skin", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)
    b.tube(head - [0, 0, 0.14], head - [0, 0, 0.03], 0.055, skin, 5, throat)
    b.blob(head, np.array([0.10, 0.085, 0.125]), skin, rng, face)


def _cyclist(b: MeshBuilder, rng: np.random.Generator) -> None:
    _person(b, rng, "rider_cloth", 0.08, seated=True)
    for x in (-0.53, 0.53):
        phi = np.linspace(0, 2 * np.pi, 13)
        ring = np.stack([x + 0.34 * np.cos(phi), np.zeros(13), 0.35 + 0.34 * np.sin(phi)], 1)
        for a, c in itertools.pairwise(ring):
            b.tube(a, c, 0.025, "bike_tyre", 4)
    places = {"rear": (-0.53, 0.35), "front": (0.53, 0.35), "seat": (-0.18, 0.95), "low": (-0.02, 0.33)}
    at = {name: np.array([x, 0, z]) for name, (x, z) in (places | {"bar": (0.42, 0.95)}).items()}
    for tube in ("rear seat", "rear low", "seat low", "seat bar", "low bar", "bar front"):
        one, other = tube.split()
        b.tube(at[one], at[other], 0.022, "bike_metal", 4)
    b.tube(np.array([0.42, -0.28, 1.02]), np.array([0.42, 0.28, 1.02]), 0.018, "bike_metal", 4)
