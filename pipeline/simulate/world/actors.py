"""Road users as meshes: x forward, y left, z up, origin on the ground under the middle."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Final

import numpy as np

from pipeline.simulate.world.cars import add_car, add_load, add_seats, add_wheels, glazed
from pipeline.simulate.world.meshes import Colour, Mesh, MeshBuilder

__all__ = ["HOLLOW", "VARIANTS", "actor_mesh"]

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
