"""Objects along a road as meshes, made once: lights, signs, lamps, posts, trees; origin on the ground."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Final

import numpy as np

from pipeline.simulate.world.meshes import Mesh, MeshBuilder, Number

__all__ = [
    "PANEL", "SIGN_COLOURS", "bollards", "bush", "delineator", "farm", "lamp", "litter_bin", "made_once",
    "rail_post", "sign", "signal", "tree",
]  # fmt: skip

SIGN_COLOURS: Final = (
    (1.0, 1.0, 1.0),
    (1.0, 0.15, 0.12),
    (0.12, 0.25, 1.0),
    (1.0, 0.85, 0.1),
    (0.1, 0.5, 0.25),
)
PANEL: Final = dict.fromkeys(("front", "left", "right", "top", "bottom"), "sign_back") | {"rear": "sign_face"}


def made_once(build: Callable[..., None]) -> Callable[..., Mesh]:
    """What a function adds to a new builder; the same arguments give the same mesh, made once."""

    @lru_cache(maxsize=64)
    @wraps(build)
    def made(*arguments: Number) -> Mesh:
        b = MeshBuilder()
        build(b, *arguments)
        return b.mesh()

    return made


@made_once
def signal(b: MeshBuilder) -> None:
    """Traffic light on its pole; it faces +x."""
    b.tube(np.zeros(3), np.array([0, 0, 3.4]), 0.06, "metal_pole")
    b.box((0.05, 0, 2.9), (0.22, 0.30, 0.90), "signal_box")
    for z, tint in ((3.18, (1, 0.2, 0.2)), (2.90, (0.15, 0.3, 0.05)), (2.62, (0.05, 1.0, 0.8))):
        b.box((0.17, 0, z), (0.04, 0.2, 0.2), "signal_lamp", tint)


@made_once
def sign(b: MeshBuilder, variant: int) -> None:
    """Traffic sign; its face looks to -x."""
    rng = np.random.default_rng([63, variant])
    height, tint = rng.uniform(2.2, 2.6), SIGN_COLOURS[int(rng.integers(len(SIGN_COLOURS)))]
    b.tube(np.zeros(3), np.array([0, 0, height + 0.6]), 0.04, "metal_pole", 5)
    w, h = (0.32, 0.32) if rng.random() < 0.7 else (0.5, 0.25)
    b.frustum((-0.06, -0.03, -w, w, height), (-0.06, -0.03, -w, w, height + 2 * h), PANEL, tint)


@made_once
def lamp(b: MeshBuilder, reach_m: Number) -> None:
    """Street lamp whose arm reaches `reach_m` to the left."""
    b.tube(np.zeros(3), np.array([0, 0, 7.0]), 0.08, "metal_pole", 7)
    b.tube(np.array([0, 0, 6.9]), np.array([0, reach_m, 7.3]), 0.045, "metal_pole", 5)
    b.box((0, reach_m, 7.25), (0.25, 0.6, 0.12), "metal_pole")


@made_once
def bollards(b: MeshBuilder) -> None:
    """Four bollards in a row along x."""
    for k in range(4):
        b.tube(np.array([1.5 * k, 0, 0.0]), np.array([1.5 * k, 0, 0.9]), 0.055, "metal_pole", 6)


@made_once
def litter_bin(b: MeshBuilder) -> None:
    """Litter bin."""
    b.frustum((-0.3, 0.3, -0.3, 0.3, 0.0), (-0.35, 0.35, -0.35, 0.35, 1.1), "slats", (0.25, 0.35, 0.25))


@made_once
def delineator(b: MeshBuilder) -> None:
    """Plastic marker post of a highway."""
    b.frustum((-0.06, 0.06, -0.06, 0.06, 0), (-0.05, 0.05, -0.05, 0.05, 1.0), "delineator")


@made_once
def rail_post(b: MeshBuilder) -> None:
    """Post of a guard rail."""
    b.box((0, 0, 0.36), (0.12, 0.08, 0.74), "rail")


@made_once
def tree(b: MeshBuilder, variant: int) -> None:
    """Tree; each variant is different."""
    rng = np.random.default_rng([61, variant])
    scale = rng.uniform(0.8, 1.6)
    trunk, tall = rng.uniform(1.8, 2.6) * scale, rng.uniform(4.0, 6.5) * scale
    green = (rng.uniform(0.7, 1.3), rng.uniform(0.75, 1.2), rng.uniform(0.6, 1.2))
    b.tube(np.zeros(3), np.array([0, 0, trunk + 0.6]), 0.13 * scale + 0.03, "bark", 7)
    for _ in range(7):
        p = np.array([*rng.uniform(-1.0, 1.0, 2) * scale, rng.uniform(trunk + 0.7, tall)])
        b.blob(p, rng.uniform(0.7, 1.25, 3) * scale, "foliage", rng, green)


@made_once
def bush(b: MeshBuilder, variant: int) -> None:
    """Bush."""
    rng = np.random.default_rng([62, variant])
    for _ in range(3):
        centre = np.array([*rng.uniform(-0.7, 0.7, 2), 0.45])
        b.blob(centre, rng.uniform([0.5, 0.5, 0.4], [0.9, 0.9, 0.9]), "foliage", rng, (0.9, 1, 0.8))


def farm(rng: np.random.Generator) -> Mesh:
    """Building far from the road."""
    b = MeshBuilder()
    x, y, z = rng.uniform(6, 12), rng.uniform(4, 7), rng.uniform(4, 7)
    b.frustum((-x, x, -y, y, -1.0), (-x, x, -y, y, z), "facade")
    b.frustum((-x, x, -y, y, z), (-x, x, -0.1, 0.1, z + 3.0), "roof")
    return b.mesh()
