"""Materials of surfaces: label, colour, texture, lidar reflectivity, radar strength.

Labels are Cityscapes train ids. Reflectivity is the fraction of lidar light (905 nm) returned from a frontal
hit; retro-reflectors exceed 1 (asphalt 0.1-0.2, concrete 0.3, grass 0.4-0.6 in the near infrared).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, get_args

import numpy as np

from pipeline.core.rigs import StreetClass

__all__ = ["LABELS", "MATERIALS", "TABLE", "Material", "MaterialTable", "material"]

LABELS: Final[tuple[str, ...]] = get_args(StreetClass)
_PLAIN, _ASPHALT, _GRASS, _FOLIAGE, _FACADE, _PAVING, _SLATS, _CONCRETE, _WORN, _COBBLES, _WIRE = range(11)


@dataclass(frozen=True)
class Material:
    """One surface material.

    `radar_gain`: radar echo per solid angle; `glass`: share of light that it mirrors or transmits; `passes`:
    share of a lidar's beams transmitted, times the triangle's tint; `gloss`: lacquer, without echoes at
    grazing angles.
    """

    name: str
    label: str
    albedo: tuple[float, float, float]
    reflectivity: float
    radar_gain: float
    texture: int = _PLAIN
    glass: float = 0.0
    glow: float = 0.0
    passes: float = 0.0
    gloss: bool = False


MATERIALS: Final = (
    Material("asphalt", "road", (0.115, 0.115, 0.12), 0.10, 0.05, _ASPHALT),
    Material("asphalt_patch", "road", (0.075, 0.075, 0.08), 0.085, 0.05, _ASPHALT),
    Material("paint", "road", (0.62, 0.62, 0.6), 0.62, 0.05, _WORN),
    Material("paint_yellow", "road", (0.6, 0.45, 0.1), 0.5, 0.02, _WORN),
    Material("manhole", "road", (0.07, 0.065, 0.06), 0.16, 0.5, _CONCRETE),
    Material("paving", "sidewalk", (0.30, 0.29, 0.27), 0.27, 0.1, _PAVING),
    Material("kerb", "sidewalk", (0.38, 0.37, 0.35), 0.33, 1.5, _CONCRETE),
    Material("facade", "building", (0.42, 0.36, 0.30), 0.32, 1.2, _FACADE),
    Material("roof", "building", (0.28, 0.13, 0.09), 0.25, 0.3, _PAVING),
    Material("stone", "wall", (0.36, 0.34, 0.31), 0.32, 0.9, _CONCRETE),
    Material("noise_wall", "wall", (0.30, 0.33, 0.28), 0.33, 0.9, _SLATS),
    Material("slats", "fence", (0.27, 0.18, 0.11), 0.38, 0.6, _SLATS),
    Material("rail", "fence", (0.45, 0.46, 0.47), 0.40, 14.0, _CONCRETE),
    Material("metal_pole", "pole", (0.30, 0.31, 0.32), 0.32, 25.0, _CONCRETE),
    Material("delineator", "pole", (0.72, 0.72, 0.70), 0.75, 2.0),
    Material("signal_box", "traffic light", (0.05, 0.055, 0.05), 0.10, 8.0),
    Material("signal_lamp", "traffic light", (0.7, 0.1, 0.05), 0.3, 1.0, glow=0.9),
    Material("sign_face", "traffic sign", (0.7, 0.7, 0.7), 2.5, 8.0),
    Material("sign_back", "traffic sign", (0.33, 0.34, 0.35), 0.35, 8.0),
    Material("foliage", "vegetation", (0.10, 0.19, 0.05), 0.48, 0.35, _FOLIAGE),
    Material("bark", "vegetation", (0.17, 0.13, 0.09), 0.30, 1.0, _CONCRETE),
    Material("grass", "terrain", (0.15, 0.23, 0.07), 0.45, 0.18, _GRASS),
    Material("soil", "terrain", (0.24, 0.20, 0.13), 0.28, 0.15, _GRASS),
    Material("skin", "person", (0.45, 0.30, 0.22), 0.5, 1.0),
    Material("cloth", "person", (1.0, 1.0, 1.0), 0.40, 1.5),
    Material("rider_cloth", "rider", (1.0, 1.0, 1.0), 0.40, 1.5),
    Material("car_paint", "car", (1.0, 1.0, 1.0), 0.35, 12.0),
    Material("car_glass", "car", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75),
    Material("car_tyre", "car", (0.025, 0.025, 0.027), 0.05, 2.0),
    Material("car_rim", "car", (0.42, 0.42, 0.43), 0.35, 8.0),
    Material("car_lamp", "car", (0.75, 0.75, 0.72), 0.8, 3.0, glow=0.25),
    Material("car_tail", "car", (0.55, 0.03, 0.03), 1.4, 3.0, glow=0.3),
    Material("car_plate", "car", (0.75, 0.75, 0.72), 3.0, 3.0),
    Material("truck_paint", "truck", (1.0, 1.0, 1.0), 0.40, 14.0),
    Material("truck_glass", "truck", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75),
    Material("truck_tyre", "truck", (0.025, 0.025, 0.027), 0.05, 4.0),
    Material("truck_tail", "truck", (0.55, 0.04, 0.03), 1.6, 6.0, glow=0.3),
    Material("bus_paint", "bus", (1.0, 1.0, 1.0), 0.38, 14.0),
    Material("bus_glass", "bus", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75),
    Material("bus_tyre", "bus", (0.025, 0.025, 0.027), 0.05, 4.0),
    Material("bike_metal", "bicycle", (0.12, 0.12, 0.14), 0.25, 8.0),
    Material("bike_tyre", "bicycle", (0.03, 0.03, 0.03), 0.08, 1.0),
    # All paths in a trihedral are as long as the one to its apex: a beacon there replaces the plates' echo.
    Material("corner_reflector", "pole", (0.65, 0.65, 0.66), 0.85, 0.0),
    Material("tripod", "pole", (0.05, 0.05, 0.05), 0.12, 0.3),
    Material("car_window", "car", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75, passes=0.85),
    Material("truck_window", "truck", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75, passes=0.85),
    Material("bus_window", "bus", (0.03, 0.035, 0.04), 0.05, 2.0, glass=0.75, passes=0.85),
    Material("car_lacquer", "car", (1.0, 1.0, 1.0), 0.35, 12.0, gloss=True),
    Material("seat", "car", (0.05, 0.05, 0.055), 0.25, 0.5),
    Material("load", "truck", (0.40, 0.30, 0.18), 0.35, 3.0, _SLATS),
    Material("mesh", "fence", (0.20, 0.22, 0.20), 0.35, 1.0, _WIRE, passes=0.7),
    Material("cobbles", "road", (0.16, 0.155, 0.15), 0.16, 0.1, _COBBLES),
    Material("gravel", "road", (0.30, 0.27, 0.22), 0.24, 0.1, _GRASS),
    Material("concrete", "wall", (0.34, 0.34, 0.33), 0.30, 0.9, _CONCRETE),
    Material("ceiling", "building", (0.30, 0.30, 0.29), 0.30, 0.6, _CONCRETE),
    Material("ceiling_lamp", "building", (0.9, 0.9, 0.85), 0.4, 0.5, glow=0.9),
    Material("hedge", "vegetation", (0.08, 0.16, 0.05), 0.45, 0.3, _FOLIAGE, passes=0.35),
)  # fmt: skip
_INDEX = {m.name: i for i, m in enumerate(MATERIALS)}


class MaterialTable(NamedTuple):
    """MATERIALS as arrays, row = material index."""

    label: np.ndarray
    albedo: np.ndarray
    reflectivity: np.ndarray
    radar_gain: np.ndarray
    texture: np.ndarray
    glass: np.ndarray
    glow: np.ndarray
    passes: np.ndarray
    gloss: np.ndarray


def _column(name: str) -> np.ndarray:
    kind = {"texture": np.uint8, "gloss": np.bool_}.get(name, np.float32)
    return np.array([getattr(m, name) for m in MATERIALS], kind)


_LABEL = np.array([LABELS.index(m.label) for m in MATERIALS], np.uint8)
TABLE: Final = MaterialTable(_LABEL, *map(_column, MaterialTable._fields[1:]))


def material(name: str) -> int:
    """Index of a material; raises KeyError for an unknown name."""
    return _INDEX[name]
