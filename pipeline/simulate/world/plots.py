"""Roadsides of a landscape: plots with fences and houses, halls, rows of trees and poles."""

from __future__ import annotations

import numpy as np

from pipeline.simulate.world.actors import HOLLOW, VARIANTS, actor_mesh
from pipeline.simulate.world.chunk import CHUNK_M, Chunk, Span
from pipeline.simulate.world.landscapes import Fence
from pipeline.simulate.world.meshes import MeshBuilder
from pipeline.simulate.world.props import bush, made_once, tree
from pipeline.simulate.world.street import add_house, add_parked, add_pavement

__all__ = ["add_halls", "add_plots", "add_rows"]


def add_plots(c: Chunk) -> None:
    """Both sides of a street or a country road: pavement or verge, parked cars, plots with their objects."""
    layout, landscape = c.drive.layout, c.drive.landscape
    style = np.random.default_rng([c.drive.seed, 35])
    walk = style.uniform(*landscape.walk_m)
    for side in (-1, 1):
        if walk:
            add_pavement(c, side, walk)
        else:
            ground = "soil" if style.random() < 0.3 else "grass"
            c.strip((side * layout.edge, side * 90.0), (0.0, 0.0), ground, 10.0)
        if layout.parking_m:
            add_parked(c, side, layout.edge - layout.parking_m / 2)
        _plots(c, side, layout.edge + max(walk, 0.0 if landscape.houses > 0.5 else 2.5))


def _plots(c: Chunk, side: int, d: float) -> None:
    """Plots of about 13 m: a fence, sometimes a house behind it, trees and bushes."""
    rng, landscape, s = c.rng, c.drive.landscape, c.s0
    kinds, weights = zip(*landscape.fences, strict=True)
    while s < c.s0 + CHUNK_M - 4.0:
        width = min(rng.uniform(9, 18), c.s0 + CHUNK_M - s)
        _fence(c, (s, s + width), side, d + 0.1, kinds[int(rng.choice(len(kinds), p=weights))])
        back = d + float(rng.choice(landscape.setback_m))
        if rng.random() < landscape.houses:
            add_house(c, side, s, width, back, landscape.storeys)
        for _ in range(int(rng.poisson(landscape.green))):
            plants = tree(int(rng.integers(40))), bush(int(rng.integers(20)))
            for plant, reach in zip(plants, ((2.0, 14.0), (0.8, 3.0)), strict=True):
                at, beside = s + rng.uniform(1, width), side * (d + rng.uniform(*reach))
                c.put(plant, at, beside, 0.1, rng.uniform(0, 6))
        s += width


def _fence(c: Chunk, s: Span, side: int, d: float, kind: Fence) -> None:
    """Boundary between a plot and the pavement."""
    rng = c.rng
    height, thick = rng.uniform(1.0, 2.0), rng.uniform(0.5, 1.0)
    tint = tuple(rng.uniform(0.7, 1.2, 3).tolist())
    if kind == "wall":
        c.wall(s, side * d, (0.0, height), "stone")
    elif kind == "slats":
        c.wall(s, side * d, (0.0, height), "slats", tint)
    elif kind == "mesh":
        c.wall(s, side * d, (0.0, height), "mesh")
        for post in np.arange(s[0] + 0.1, s[1], 2.5):
            c.put(_post(height), float(post), side * d)
    elif kind == "hedge":
        near, far = side * d, side * (d + thick)
        for at in (near, (near + far) / 2, far):
            c.wall(s, at, (0.0, height), "hedge", tint)
        c.band(s, (min(near, far), max(near, far)), (height, height), "hedge", 10.0, tint)


@made_once
def _post(b: MeshBuilder, height_m: float) -> None:
    b.tube(np.zeros(3), np.array([0, 0, height_m + 0.1]), 0.03, "metal_pole", 5)


def add_rows(c: Chunk) -> None:
    """Trees and poles at even distances along both sides, closer to the road than other objects."""
    landscape = c.drive.landscape
    beside = c.drive.layout.edge + (1.6 if landscape.fast else 0.6)
    for side in (-1, 1):
        for s in c.every(landscape.trees_m) if landscape.trees_m else ():
            c.put(tree(int(c.rng.integers(40))), s, side * (beside + 1.0), 0.0, c.rng.uniform(0, 6.28))
        for s in c.every(landscape.poles_m) if landscape.poles_m else ():
            c.put(_pole(), s, side * beside)


@made_once
def _pole(b: MeshBuilder) -> None:
    b.tube(np.zeros(3), np.array([0, 0, 6.0]), 0.09, "metal_pole", 7)


def add_halls(c: Chunk) -> None:
    """Walls and a ceiling with lamps, `inner_m` from the road's edge; cars between columns, nose in."""
    landscape, edge = c.drive.landscape, c.drive.layout.edge
    wall, top = edge + landscape.inner_m, landscape.ceiling_m
    c.strip((-wall, wall), (top, top), "ceiling")
    for lamp in c.every(8.0):
        c.band((lamp, lamp + 1.2), (-0.15, 0.15), (top - 0.02, top - 0.02), "ceiling_lamp")
    for side in (-1, 1):
        c.wall(c.whole, side * wall, (0.0, top), "concrete")
        floor = landscape.surface if landscape.columns_m else "paving"
        c.strip((side * edge, side * wall), (0.0, 0.0), floor)
        for beam in c.every(landscape.columns_m) if landscape.columns_m else ():
            c.put(_column(top), beam, side * (edge + 0.5))
            _bays(c, side, beam + 0.5, edge + 3.2)


@made_once
def _column(b: MeshBuilder, top_m: float) -> None:
    b.box((0, 0, top_m / 2), (0.5, 0.5, top_m), "concrete")


def _bays(c: Chunk, side: int, s: float, d: float) -> None:
    """Up to two cars side by side, perpendicular to the road."""
    for k in range(2):
        if c.rng.random() < 0.6:
            mesh = actor_mesh("car", int(c.rng.integers(VARIANTS["car"])) + HOLLOW * c.drive.landscape.glass)
            instance = 1_000_001 + (round(s * 4) * 4 + 2 * k + (side > 0)) % 1_000_000
            c.put(mesh, s + 1.5 + 3.0 * k, side * d, 0.0, side * np.pi / 2, instance)
