"""Objects along a road as meshes, made once: lights, signs, lamps, posts, trees; origin on the ground."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from pipeline.simulate.world.meshes import Mesh, MeshBuilder

__all__ = [
    "PANEL",
    "SIGN_COLOURS",
    "bollards",
    "bush",
    "delineator",
    "farm",
    "lamp",
    "litter_bin",
    "rail_post",
    "sign",
    "signal",
    "tree",
]

SIGN_COLOURS: Final = (
    (1.0, 1.0, 1.0),
    (1.0, 0.15, 0.12),
    (0.12, 0.25, 1.0),
    (1.0, 0.85, 0.1),
    (0.1, 0.5, 0.25),
)
PANEL: Final = dict.fromkeys(("front", "left", "right", "top", "bottom"), "sign_back") | {"rear": "sign_face"}


@lru_cache(maxsize=1)
def signal() -> Mesh:
    """Traffic light on its pole; it faces +x."""
    b = MeshBuilder()
    b.tube(np.array([0, 0, 0.0]), np.array([0, 0, 3.4]), 0.06, "metal_pole")
    b.box((0.05, 0, 2.9), (0.22, 0.30, 0.90), "signal_box")
    for z, tint in ((3.18, (1, 0.2, 0.2)), (2.90, (0.15, 0.3, 0.05)), (2.62, (0.05, 1.0, 0.8))):
        b.box((0.17, 0, z), (0.04, 0.2, 0.2), "signal_lamp", tint)
    return b.mesh()


@lru_cache(maxsize=32)
def sign(variant: int) -> Mesh:
    """Traffic sign; its face looks to -x."""
    rng = np.random.default_rng([63, variant])
    b = MeshBuilder()
    height, tint = rng.uniform(2.2, 2.6), SIGN_COLOURS[int(rng.integers(len(SIGN_COLOURS)))]
    b.tube(np.array([0, 0, 0.0]), np.array([0, 0, height + 0.6]), 0.04, "metal_pole", 5)
    w, h = (0.32, 0.32) if rng.random() < 0.7 else (0.5, 0.25)
    b.frustum((-0.06, -0.03, -w, w, height), (-0.06, -0.03, -w, w, height + 2 * h), PANEL, tint)
    return b.mesh()


@lru_cache(maxsize=2)
def lamp(reach_m: float) -> Mesh:
    """Street lamp whose arm reaches `reach_m` to the left."""
    b = MeshBuilder()
    b.tube(np.array([0, 0, 0.0]), np.array([0, 0, 7.0]), 0.08, "metal_pole", 7)
    b.tube(np.array([0, 0, 6.9]), np.array([0, reach_m, 7.3]), 0.045, "metal_pole", 5)
    b.box((0, reach_m, 7.25), (0.25, 0.6, 0.12), "metal_pole")
    return b.mesh()


@lru_cache(maxsize=1)
def bollards() -> Mesh:
    """Four bollards in a row along x."""
    b = MeshBuilder()
    for k in range(4):
        b.tube(np.array([1.5 * k, 0, 0.0]), np.array([1.5 * k, 0, 0.9]), 0.055, "metal_pole", 6)
    return b.mesh()


@lru_cache(maxsize=1)
def litter_bin() -> Mesh:
    """Litter bin."""
    b = MeshBuilder()
    b.frustum((-0.3, 0.3, -0.3, 0.3, 0.0), (-0.35, 0.35, -0.35, 0.35, 1.1), "slats", (0.25, 0.35, 0.25))
    return b.mesh()


@lru_cache(maxsize=1)
def delineator() -> Mesh:
    """Plastic marker post of a highway."""
    b = MeshBuilder()
    b.frustum((-0.06, 0.06, -0.06, 0.06, 0), (-0.05, 0.05, -0.05, 0.05, 1.0), "delineator")
    return b.mesh()


@lru_cache(maxsize=1)
def rail_post() -> Mesh:
    """Post of a guard rail."""
    b = MeshBuilder()
    b.box((0, 0, 0.36), (0.12, 0.08, 0.74), "rail")
    return b.mesh()


@lru_cache(maxsize=64)
def tree(variant: int) -> Mesh:
    """Tree; each variant is different."""
    rng = np.random.default_rng([61, variant])
    b = MeshBuilder()
    scale = rng.uniform(0.8, 1.6)
    trunk, tall = rng.uniform(1.8, 2.6) * scale, rng.uniform(4.0, 6.5) * scale
    green = (float(rng.uniform(0.7, 1.3)), float(rng.uniform(0.75, 1.2)), float(rng.uniform(0.6, 1.2)))
    b.tube(np.array([0, 0, 0.0]), np.array([0, 0, trunk + 0.6]), 0.13 * scale + 0.03, "bark", 7)
    for _ in range(7):
        p = np.array([*rng.uniform(-1.0, 1.0, 2) * scale, rng.uniform(trunk + 0.7, tall)])
        b.blob(p, rng.uniform(0.7, 1.25, 3) * scale, "foliage", rng, green)
    return b.mesh()


@lru_cache(maxsize=32)
def bush(variant: int) -> Mesh:
    """Bush."""
    rng = np.random.default_rng([62, variant])
    b = MeshBuilder()
    for _ in range(3):
        centre = np.array([*rng.uniform(-0.7, 0.7, 2), 0.45])
        b.blob(centre, rng.uniform([0.5, 0.5, 0.4], [0.9, 0.9, 0.9]), "foliage", rng, (0.9, 1, 0.8))
    return b.mesh()


def farm(rng: np.random.Generator) -> Mesh:
    """Building far from the road."""
    b = MeshBuilder()
    x, y, z = rng.uniform(6, 12), rng.uniform(4, 7), rng.uniform(4, 7)
    b.frustum((-x, x, -y, y, -1.0), (-x, x, -y, y, z), "facade")
    b.frustum((-x, x, -y, y, z), (-x, x, -0.1, 0.1, z + 3.0), "roof")
    return b.mesh()
