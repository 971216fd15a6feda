"""Surface of a road, and its sides: motorway; urban kerbs, pavements, lamps, trees, house fronts, parked cars."""

from __future__ import annotations

import numpy as np

from pipeline.simulate.world.actors import HOLLOW, VARIANTS, actor_mesh
from pipeline.simulate.world.landscapes import Fence
from pipeline.simulate.world.meshes import CHUNK_M, Chunk, MeshBuilder, Span
from pipeline.simulate.world.props import (
    PANEL,
    SIGN_COLOURS,
    bollards,
    bush,
    delineator,
    farm,
    lamp,
    litter_bin,
    made_once,
    rail_post,
    sign,
    signal,
    tree,
)

__all__ = [
    "add_asphalt", "add_halls", "add_house", "add_motorway", "add_parked", "add_pavement", "add_plots",
    "add_rows", "add_street",
]  # fmt: skip


def add_street(c: Chunk) -> None:
    """Both sides of a street: kerb, pavement with its objects, houses, parked cars."""
    layout = c.drive.layout
    style = np.random.default_rng([c.drive.seed, 32])
    walk = style.uniform(2.6, 4.2)
    for side in (-1, 1):
        add_pavement(c, side, walk)
        _furniture(c, side, layout.edge, walk)
        _frontage(c, side, layout.edge + walk)
        if layout.parking_m:
            add_parked(c, side, layout.edge - layout.parking_m / 2)


def add_pavement(c: Chunk, side: int, walk: float) -> None:
    """Kerb and pavement of one side, and grass behind them."""
    kerb, far = side * c.drive.layout.edge, side * (c.drive.layout.edge + walk)
    c.band(c.whole, (kerb, kerb + side * 0.001), (0.0, 0.12), "kerb")
    c.strip((kerb, kerb + side * 0.15), (0.12, 0.12), "kerb")
    c.strip((kerb + side * 0.15, far), (0.12, 0.12), "paving")
    c.strip((far, side * 90.0), (0.10, 0.10), "grass", 10.0)


def _furniture(c: Chunk, side: int, edge: float, walk: float) -> None:
    rng = c.rng
    for s in c.every(32.0):
        c.put(lamp(-side * 1.4), s + 8.0 * side, side * (edge + 0.45), 0.12)
    for s in c.every(21.0, 6.0, 0.6):
        c.put(sign(int(rng.integers(24))), s, side * (edge + 0.5), 0.12, 0.0 if side < 0 else np.pi)
    avenue = np.random.default_rng([c.drive.seed, 33, side + 1]).random() < 0.55
    for s in c.every(9.0, 1.5, 0.75 if avenue else 0.12):
        plant = tree(int(rng.integers(40)))
        c.put(plant, s, side * (edge + min(1.3, walk - 0.8)), 0.12, rng.uniform(0, 6.28))
    for s in c.every(14.0, 4.0, 0.35):
        c.put(bollards(), s, side * (edge + 0.35), 0.12)
    for s in c.every(26.0, 8.0, 0.4):
        c.put(litter_bin(), s, side * (edge + walk - 0.5), 0.12)


def _frontage(c: Chunk, side: int, d: float) -> None:
    """Houses, gardens, walls and gaps behind the pavement, as plots of about 13 m."""
    rng, s = c.rng, c.s0
    while s < c.s0 + CHUNK_M - 4.0:
        width = min(rng.uniform(9, 18), c.s0 + CHUNK_M - s)
        kind = rng.random()
        if kind < 0.50:
            add_house(c, side, s, width, d + float(rng.choice([0.2, 3.0, 5.0, 8.0])))
        elif kind < 0.62:
            c.wall((s, s + width), side * (d + 0.1), (0.0, rng.uniform(1.2, 2.2)), "stone")
        elif kind < 0.76:
            height, blue = rng.uniform(1.0, 1.8), rng.uniform(0.6, 1.2)
            c.wall((s, s + width), side * (d + 0.1), (0.0, height), "slats", (0.8, 0.8, blue))
        if kind > 0.45:
            for _ in range(int(rng.integers(1, 4))):
                for plant, kinds, near, far in ((tree, 40, 3, 14), (bush, 20, 1.2, 3)):
                    mesh, at = plant(int(rng.integers(kinds))), s + rng.uniform(1, width)
                    c.put(mesh, at, side * (d + rng.uniform(near, far)), 0.1, rng.uniform(0, 6))
        s += width


def add_house(
    c: Chunk, side: int, s: float, width: float, d: float, storeys: tuple[int, ...] = (1, 2, 2, 3, 4)
) -> None:
    """A house with its front `d` from the centre line, with a number of storeys drawn from the given ones."""
    rng = c.rng
    top, depth = 3.0 * int(rng.choice(storeys)) + 0.6, rng.uniform(8, 12)
    gap, tone = float(rng.choice([0.0, 0.0, 1.5])), rng.uniform(0.55, 1.35)
    tint = (tone * rng.uniform(0.9, 1.15), tone * rng.uniform(0.9, 1.1), tone * rng.uniform(0.75, 1.1))
    s1, near, far = s + width - gap, side * d, side * (d + depth)
    c.wall((s, s1), near, (0.0, top), "facade", tint)
    for end in (s, s1):
        face = np.array([[[end, near, 0.0], [end, far, 0.0], [end, far, top], [end, near, top]]])
        c.along.quads(face, "facade", tint, np.abs(face[..., 1:]))
    ridge = [(near + far) / 2, top + rng.uniform(0.3, 3.0)]
    for edge in (near, far):
        c.along.quads(np.array([[s, edge, top], [s1, edge, top], [s1, *ridge], [s, *ridge]]), "roof", tint)
    for end in (s, s1):
        gable = np.array([[end, near, top], [end, far, top], [end, *ridge], [end, *ridge]])
        c.along.quads(gable, "facade", tint)


def add_parked(c: Chunk, side: int, d: float) -> None:
    """Cars and vans parked along one side, in line."""
    for k, s in enumerate(c.every(6.5)):
        if c.rng.random() > 0.68 or (c.index % 4 == 1 and abs(s + 3.2 - c.s0 - 20.0) < 9.0):
            continue
        kind = "car" if c.rng.random() < 0.88 else "van"
        instance = 1_000_001 + ((c.index * 64 + k) * 2 + (side > 0)) % 1_000_000
        yaw = (0.0 if side < 0 else np.pi) + c.rng.normal(0, 0.02)
        mesh = actor_mesh(kind, int(c.rng.integers(VARIANTS[kind])) + HOLLOW * c.drive.landscape.glass)
        c.put(mesh, s + 3.25 + c.rng.uniform(-0.3, 0.3), side * d + c.rng.normal(0, 0.08), 0.0, yaw, instance)


def add_motorway(c: Chunk) -> None:
    """Both sides of a motorway, the rail between the carriageways, sometimes a gantry or a farm."""
    rng = c.rng
    style = np.random.default_rng([c.drive.seed, 34])
    _guard_rail(c, 0.0, both=True)
    for side in (-1, 1):
        slope = _verge(c, side, style)
        _plants(c, side, slope)
        for s in c.every(55.0, 15.0, 0.7):
            d = side * (c.drive.layout.edge + 1.7)
            c.put(sign(int(rng.integers(24))), s, d, 0.0, 0.0 if side < 0 else np.pi)
    if c.index % 7 == 3:
        _gantry(c, c.s0 + 20.0)
    if c.index % 5 == 2:
        house, d = farm(rng), float(rng.choice([-1, 1])) * rng.uniform(45, 80)
        c.put(house, c.s0 + 20.0, d, 1.0, rng.uniform(0, 6.28))


def _verge(c: Chunk, side: int, style: np.random.Generator) -> float:
    """Banks, rail and noise wall of one side; returns the height of the bank [m]."""
    edge = side * c.drive.layout.edge
    walled, railed = style.random() < 0.35, style.random() < 0.75
    foot, slope = edge + side * 3.0, style.uniform(-1.0, 2.5)
    c.strip((edge, foot), (0.0, -0.1), "grass", 10.0)
    c.strip((foot, edge + side * 14.0), (-0.1, slope), "grass", 10.0)
    field = "soil" if style.random() < 0.3 else "grass"
    c.strip((edge + side * 14.0, side * 150.0), (slope, slope + 2.0), field, 10.0)
    if railed:
        _guard_rail(c, edge + side * 0.8, both=False)
    if walled and (c.index // 6) % 2 == 0:
        c.wall(c.whole, edge + side * 4.5, (-0.2, 3.5 + 0.5 * (c.index % 2)), "noise_wall")
    return slope


def _plants(c: Chunk, side: int, slope: float) -> None:
    """Delineators, trees and bushes on the bank of one side."""
    rng, edge = c.rng, side * c.drive.layout.edge
    for s in c.every(25.0):
        c.put(delineator(), s, edge + side * 1.4)
    for s in c.every(6.0, 3.0, 0.55):
        d = edge + side * rng.uniform(8, 26)
        c.put(tree(int(rng.integers(40))), s, d, slope * 0.7 - 0.2, rng.uniform(0, 6.28))
    for s in c.every(5.0, 2.0, 0.5):
        plant = bush(int(rng.integers(20)))
        c.put(plant, s, edge + side * rng.uniform(5, 10), 0.2 * slope, rng.uniform(0, 6.28))


def _guard_rail(c: Chunk, d: float, *, both: bool) -> None:
    for offset in (-0.18, 0.18) if both else (0.0,):
        for low, high, out in ((0.48, 0.58, 0.0), (0.58, 0.68, 0.05), (0.68, 0.78, 0.0)):
            d0 = d + offset + out
            c.strip((d0, d0 + 1e-3), (low, high), "rail", 4.0)
    for s in c.every(4.0):
        c.put(rail_post(), s, d)


def _gantry(c: Chunk, s: float) -> None:
    layout = c.drive.layout
    left, right = 0.0, -layout.edge - 1.6
    b = MeshBuilder()
    for d in (left, right):
        b.tube(np.array([0, d, 0.0]), np.array([0, d, 7.6]), 0.16, "metal_pole", 8)
    for z in (6.6, 7.5):
        b.tube(np.array([0, left, z]), np.array([0, right, z]), 0.10, "metal_pole", 6)
    for d in layout.lanes_own:
        panel = (-0.25, -0.20, d - 1.6, d + 1.6)
        b.frustum((*panel, 5.6), (*panel, 8.0), PANEL, SIGN_COLOURS[2])
    c.put(b.mesh(), s, 0.0)


def add_asphalt(c: Chunk) -> None:
    """Asphalt with repairs and manholes, lane markings, crossings with their signals."""
    layout, lift = c.drive.layout, 0.004
    c.strip((-layout.edge, layout.edge), (0.0, 0.0), c.drive.landscape.surface)
    for _ in range(int(c.rng.integers(0, 4))):  # repairs: dark in the image, less so for the lidar
        s = c.s0 + c.rng.uniform(2, 30)
        d = c.rng.uniform(-layout.edge + 1, max(layout.edge, 3.0) - 3)
        length, width = c.rng.uniform(1.5, 9), c.rng.uniform(0.6, 2.4)
        c.band((s, s + length), (d, d + width), (lift / 2, lift / 2), "asphalt_patch")
    for _ in range(int(c.rng.integers(0, 3))):
        s, d = c.s0 + c.rng.uniform(0, 39), c.rng.uniform(-layout.edge + 1, layout.edge - 1)
        c.band((s, s + 0.62), (d, d + 0.62), (lift, lift), "manhole")
    if c.drive.landscape.markings:
        _lanes(c)


def _lanes(c: Chunk) -> None:
    layout, lift = c.drive.layout, 0.004
    own, other = sorted(layout.lanes_own), sorted(layout.lanes_oncoming)
    half = layout.lane_m / 2
    inner = [d + half for d in own[:-1]] + [d + half for d in other[:-1]]
    for d in inner:
        _dashes(c, d, 6.0, 12.0) if layout.landscape.fast else _dashes(c, d, 3.0, 9.0)
    w = 0.10 if layout.landscape.fast else 0.075
    if layout.landscape.fast:
        for d in (own[-1] + half, own[0] - half, other[0] - half, other[-1] + half):
            c.strip((d - 1.5 * w, d + 1.5 * w), (lift, lift), "paint")
        return
    if c.index % 5 in (1, 2):
        c.strip((-w, w), (lift, lift), "paint")
    else:
        _dashes(c, 0.0, 3.0, 9.0)
    for side in (-1, 1):
        edge = side * (layout.edge - layout.parking_m)
        if layout.parking_m:
            c.strip((edge - w, edge + w), (lift, lift), "paint")
            for s in c.every(6.5):
                d0, d1 = sorted((edge, side * layout.edge))
                c.band((s - w, s + w), (d0, d1), (lift, lift), "paint")
    if c.index % 4 == 1 and layout.lanes_oncoming and not c.drive.landscape.ceiling_m:
        _crossing(c, c.s0 + 20.0)


def _dashes(c: Chunk, d: float, dash_m: float, period_m: float) -> None:
    for s in c.every(period_m):
        c.band((s, s + dash_m), (d - 0.075, d + 0.075), (0.004, 0.004), "paint", step=3.0)


def _crossing(c: Chunk, s: float) -> None:
    layout = c.drive.layout
    edge = layout.edge
    for d in np.arange(-edge + 0.5, edge - 0.5, 1.0):
        c.band((s, s + 3.5), (float(d), float(d) + 0.5), (0.005, 0.005), "paint")
    c.band((s - 1.6, s - 1.2), (-edge + layout.parking_m, 0.0), (0.005, 0.005), "paint")
    c.band((s + 4.8, s + 5.2), (0.0, edge - layout.parking_m), (0.005, 0.005), "paint")
    for d in layout.lanes_own:
        _arrow(c, s - 12.0, d)
    for side, yaw in ((-1, np.pi), (1, 0.0)):
        c.put(signal(), s - 1.0 if side < 0 else s + 4.5, side * (edge + 0.5), 0.12, yaw)


def _arrow(c: Chunk, s: float, d: float) -> None:
    c.band((s, s + 2.4), (d - 0.08, d + 0.08), (0.005, 0.005), "paint")
    tip = [s + 4.0, d, 0.005]
    head = np.array([[s + 2.4, d - 0.35, 0.005], tip, tip, [s + 2.4, d + 0.35, 0.005]])
    c.along.quads(head, "paint", uv=head[..., :2])


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
    for at in c.every(8.0):
        c.band((at, at + 1.2), (-0.15, 0.15), (top - 0.02, top - 0.02), "ceiling_lamp")
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
