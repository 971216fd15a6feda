"""Roadsides of an urban road: kerbs, pavements, lamps, trees, house fronts, parked cars."""

from __future__ import annotations

import numpy as np

from pipeline.simulate.world.actors import HOLLOW, VARIANTS, actor_mesh
from pipeline.simulate.world.chunk import CHUNK_M, Chunk
from pipeline.simulate.world.props import bollards, bush, lamp, litter_bin, sign, tree

__all__ = ["add_house", "add_parked", "add_pavement", "add_street"]


def add_street(c: Chunk) -> None:
    """Both sides of a street: kerb, pavement with its objects, houses, parked cars."""
    layout = c.drive.layout
    style = np.random.default_rng([c.drive.seed, 32])
    walk = style.uniform(2.6, 4.2)
    for side in (-1, 1):
        add_pavement(c, side, walk)
        _furniture(c, side, layout.left_edge, walk)
        _frontage(c, side, layout.left_edge + walk)
        if layout.parking_m:
            add_parked(c, side, layout.left_edge - layout.parking_m / 2)


def add_pavement(c: Chunk, side: int, walk: float) -> None:
    """Kerb and pavement of one side, and grass behind them."""
    kerb = side * c.drive.layout.left_edge
    far = side * (c.drive.layout.left_edge + walk)
    c.band((c.s0, c.s0 + CHUNK_M), (kerb, kerb + side * 0.001), (0.0, 0.12), "kerb", 5.0)
    c.strip((min(kerb, kerb + side * 0.15), max(kerb, kerb + side * 0.15)), (0.12, 0.12), "kerb")
    c.strip((min(kerb + side * 0.15, far), max(kerb + side * 0.15, far)), (0.12, 0.12), "paving")
    c.strip((min(far, side * 90.0), max(far, side * 90.0)), (0.10, 0.10), "grass", 10.0)


def _furniture(c: Chunk, side: int, edge: float, walk: float) -> None:
    rng = c.rng
    for s in c.every(32.0):
        c.put(lamp(-side * 1.4), s + 8.0 * side, side * (edge + 0.45), 0.12)
    for s in c.every(21.0, 6.0, 0.6):
        c.put(sign(int(rng.integers(24))), s, side * (edge + 0.5), 0.12, 0.0 if side < 0 else np.pi)
    avenue = np.random.default_rng([c.drive.seed, 33, side + 1]).random() < 0.55
    for s in c.every(9.0, 1.5, 0.75 if avenue else 0.12):
        c.put(
            tree(int(rng.integers(40))),
            s,
            side * (edge + min(1.3, walk - 0.8)),
            0.12,
            rng.uniform(0, 6.28),
        )
    for s in c.every(14.0, 4.0, 0.35):
        c.put(bollards(), s, side * (edge + 0.35), 0.12)
    for s in c.every(26.0, 8.0, 0.4):
        c.put(litter_bin(), s, side * (edge + walk - 0.5), 0.12)


def _frontage(c: Chunk, side: int, d: float) -> None:
    """Houses, gardens, walls and gaps behind the pavement, as plots of about 13 m."""
    rng, s = c.rng, c.s0
    while s < c.s0 + CHUNK_M - 4.0:
        width = min(float(rng.uniform(9, 18)), c.s0 + CHUNK_M - s)
        kind = rng.random()
        if kind < 0.50:
            add_house(c, side, s, width, d + float(rng.choice([0.2, 3.0, 5.0, 8.0])))
        elif kind < 0.62:
            c.wall((s, s + width), side * (d + 0.1), (0.0, float(rng.uniform(1.2, 2.2))), "stone")
        elif kind < 0.76:
            c.wall(
                (s, s + width),
                side * (d + 0.1),
                (0.0, float(rng.uniform(1.0, 1.8))),
                "slats",
                (0.8, 0.8, float(rng.uniform(0.6, 1.2))),
            )
        if kind > 0.45:
            for _ in range(int(rng.integers(1, 4))):
                c.put(
                    tree(int(rng.integers(40))),
                    s + rng.uniform(1, width),
                    side * (d + rng.uniform(3, 14)),
                    0.1,
                    rng.uniform(0, 6),
                )
                c.put(
                    bush(int(rng.integers(20))),
                    s + rng.uniform(1, width),
                    side * (d + rng.uniform(1.2, 3)),
                    0.1,
                    rng.uniform(0, 6),
                )
        s += width


def add_house(
    c: Chunk, side: int, s: float, width: float, d: float, storeys: tuple[int, ...] = (1, 2, 2, 3, 4)
) -> None:
    """A house with its front `d` from the centre line, with a number of storeys drawn from the given ones."""
    rng = c.rng
    top, depth, gap = (
        3.0 * int(rng.choice(storeys)) + 0.6,
        float(rng.uniform(8, 12)),
        float(rng.choice([0.0, 0.0, 1.5])),
    )
    tone = rng.uniform(0.55, 1.35)
    tint = (
        float(tone * rng.uniform(0.9, 1.15)),
        float(tone * rng.uniform(0.9, 1.1)),
        float(tone * rng.uniform(0.75, 1.1)),
    )
    s1, near, far = s + width - gap, side * d, side * (d + depth)
    c.wall((s, s1), near, (0.0, top), "facade", tint)
    for end in (s, s1):
        face = np.array([[[end, near, 0.0], [end, far, 0.0], [end, far, top], [end, near, top]]])
        c.along.quads(face, "facade", tint, np.abs(face[..., 1:]))
    ridge = top + float(rng.uniform(0.3, 3.0))
    middle = (near + far) / 2
    for edge in (near, far):
        c.along.quads(
            np.array([[[s, edge, top], [s1, edge, top], [s1, middle, ridge], [s, middle, ridge]]]),
            "roof",
            tint,
        )
    for end in (s, s1):
        c.along.quads(
            np.array([[[end, near, top], [end, far, top], [end, middle, ridge], [end, middle, ridge]]]),
            "facade",
            tint,
        )


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
