"""Roadsides of a motorway: banks, guard rails, noise walls, delineators, trees, gantries, farms."""

from __future__ import annotations

import numpy as np

from pipeline.simulate.world.chunk import CHUNK_M, Chunk
from pipeline.simulate.world.meshes import MeshBuilder
from pipeline.simulate.world.props import PANEL, SIGN_COLOURS, bush, delineator, farm, rail_post, sign, tree

__all__ = ["add_motorway"]


def add_motorway(c: Chunk) -> None:
    """Both sides of a motorway, the rail between the carriageways, sometimes a gantry or a farm."""
    rng = c.rng
    style = np.random.default_rng([c.drive.seed, 34])
    _guard_rail(c, 0.0, both=True)
    for side in (-1, 1):
        slope = _verge(c, side, style)
        _plants(c, side, slope)
        for s in c.every(55.0, 15.0, 0.7):
            d = side * (c.drive.layout.left_edge + 1.7)
            c.put(sign(int(rng.integers(24))), s, d, 0.0, 0.0 if side < 0 else np.pi)
    if c.index % 7 == 3:
        _gantry(c, c.s0 + 20.0)
    if c.index % 5 == 2:
        house, d = farm(rng), float(rng.choice([-1, 1])) * rng.uniform(45, 80)
        c.put(house, c.s0 + 20.0, d, 1.0, rng.uniform(0, 6.28))


def _verge(c: Chunk, side: int, style: np.random.Generator) -> float:
    """Banks, rail and noise wall of one side; returns the height of the bank [m]."""
    edge = side * c.drive.layout.left_edge
    walled, railed = style.random() < 0.35, style.random() < 0.75
    foot, slope = edge + side * 3.0, float(style.uniform(-1.0, 2.5))
    _sloped(c, edge, foot, 0.0, -0.1, "grass")
    _sloped(c, foot, edge + side * 14.0, -0.1, slope, "grass")
    field = "soil" if style.random() < 0.3 else "grass"
    _sloped(c, edge + side * 14.0, side * 150.0, slope, slope + 2.0, field)
    if railed:
        _guard_rail(c, edge + side * 0.8, both=False)
    if walled and (c.index // 6) % 2 == 0:
        top = float(3.5 + 0.5 * (c.index % 2))
        c.wall((c.s0, c.s0 + CHUNK_M), edge + side * 4.5, (-0.2, top), "noise_wall")
    return slope


def _plants(c: Chunk, side: int, slope: float) -> None:
    """Delineators, trees and bushes on the bank of one side."""
    rng, edge = c.rng, side * c.drive.layout.left_edge
    for s in c.every(25.0):
        c.put(delineator(), s, edge + side * 1.4)
    for s in c.every(6.0, 3.0, 0.55):
        d = edge + side * rng.uniform(8, 26)
        c.put(tree(int(rng.integers(40))), s, d, slope * 0.7 - 0.2, rng.uniform(0, 6.28))
    for s in c.every(5.0, 2.0, 0.5):
        plant = bush(int(rng.integers(20)))
        c.put(plant, s, edge + side * rng.uniform(5, 10), 0.2 * slope, rng.uniform(0, 6.28))


def _sloped(c: Chunk, d0: float, d1: float, h0: float, h1: float, name: str) -> None:
    if d0 > d1:
        d0, d1, h0, h1 = d1, d0, h1, h0
    c.strip((d0, d1), (h0, h1), name, 10.0)


def _guard_rail(c: Chunk, d: float, *, both: bool) -> None:
    for offset in (-0.18, 0.18) if both else (0.0,):
        for low, high, out in ((0.48, 0.58, 0.0), (0.58, 0.68, 0.05), (0.68, 0.78, 0.0)):
            c.band(
                (c.s0, c.s0 + CHUNK_M), (d + offset + out, d + offset + out + 1e-3), (low, high), "rail", 4.0
            )
    for s in c.every(4.0):
        c.put(rail_post(), s, d)


def _gantry(c: Chunk, s: float) -> None:
    layout = c.drive.layout
    left, right = 0.0, layout.right_edge - 1.6
    b = MeshBuilder()
    for d in (left, right):
        b.tube(np.array([0, d, 0.0]), np.array([0, d, 7.6]), 0.16, "metal_pole", 8)
    for z in (6.6, 7.5):
        b.tube(np.array([0, left, z]), np.array([0, right, z]), 0.10, "metal_pole", 6)
    for d in layout.lanes_own:
        b.frustum(
            (-0.25, -0.20, d - 1.6, d + 1.6, 5.6),
            (-0.25, -0.20, d - 1.6, d + 1.6, 8.0),
            PANEL,
            SIGN_COLOURS[2],
        )
    c.put(b.mesh(), s, 0.0)
