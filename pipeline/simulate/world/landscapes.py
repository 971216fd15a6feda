"""Landscapes: named ones, and random ones between the limits of those."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from pipeline.core.errors import ConfigError

__all__ = ["LANDSCAPES", "WORLD", "Landscape", "landscape_named"]

WORLD: Final = "world-"  # prefix of landscapes drawn from a seed

Fence = Literal["none", "wall", "slats", "mesh", "hedge"]
Surface = Literal["asphalt", "cobbles", "gravel"]


@dataclass(frozen=True)
class Landscape:
    """Parameters of a landscape; everything else is random along the road.

    Args:
        fast: curves, speeds, traffic and banks of a motorway; else of a street.
        plain: the roadsides of `urban`.
        pace: factor of the usual speed.
        two_lanes: share of drives with two lanes in the ego direction.
        parking: share of drives with cars parked along the kerb.
        traffic: factor of the number of occupied places in a stream of road users.
        spacing: factor of the distance between these places.
        kinds: kinds of vehicles on the road; none = the usual ones.
        fences: weights of the kinds of boundaries of a plot.
        houses: share of plots with a house.
        setback_m: distances of a house from the pavement.
        storeys: numbers of storeys of houses.
        green: trees and bushes per plot.
        trees_m: distance between trees in a row along the road, 0 = no row.
        poles_m: distance between poles in a row along the road, 0 = no row.
        ceiling_m: height of a ceiling, 0 = the sky.
        inner_m: distance from the road's edge to the walls under the ceiling.
        columns_m: distance between the columns of the ceiling, 0 = none.
        infrared: whether lidar intensity shows markings and repairs; else it has an independent pattern.
        glass: windows, meshes and hedges transmit beams, and lorries have open loads.
        sun_deg: limits of the sun's elevation.
        side_light: the sun is to the left or the right of the road's initial direction.
    """

    name: str
    fast: bool = False
    plain: bool = False
    pace: float = 1.0
    lane_m: float = 3.3
    one_way: bool = False
    two_lanes: float = 0.35
    parking: float = 0.75
    traffic: float = 1.0
    spacing: float = 1.0
    kinds: tuple[str, ...] = ()
    walk_m: tuple[float, float] = (1.2, 3.0)
    fences: tuple[tuple[Fence, float], ...] = (("none", 1.0),)
    houses: float = 0.0
    setback_m: tuple[float, ...] = (3.0, 5.0, 8.0)
    storeys: tuple[int, ...] = (1, 2, 2, 3)
    green: float = 1.0
    trees_m: float = 0.0
    poles_m: float = 0.0
    ceiling_m: float = 0.0
    inner_m: float = 1.0
    columns_m: float = 0.0
    surface: Surface = "asphalt"
    markings: bool = True
    infrared: bool = True
    glass: bool = True
    sun_deg: tuple[float, float] = (22.0, 58.0)
    side_light: bool = False


_GARDENS: Final[tuple[tuple[Fence, float], ...]] = (
    ("hedge", 0.35), ("mesh", 0.2), ("slats", 0.15), ("wall", 0.1), ("none", 0.2),
)  # fmt: skip
_ALL: Final = (
    Landscape("urban", plain=True, glass=False),
    Landscape("highway", fast=True, plain=True, glass=False),
    # Like residential streets: gardens, cars on both sides, few lanes.
    Landscape("suburb", two_lanes=0.0, parking=1.0, traffic=0.8, fences=_GARDENS, houses=0.8, green=2.0, poles_m=30.0),
    # Cars and vans close ahead and beside, hardly moving, and little else: objects behind one another have
    # one label.
    Landscape(
        "jam", pace=0.08, two_lanes=1.0, parking=1.0, traffic=1.4, spacing=0.38,
        kinds=("car", "van", "car", "van", "van"), walk_m=(2.0, 4.0), houses=0.1,
        fences=(("none", 0.8), ("hedge", 0.1), ("mesh", 0.1)), green=0.3, poles_m=60.0,
    ),
    Landscape(
        "alley", pace=0.5, lane_m=3.6, one_way=True, two_lanes=0.0, parking=0.0, walk_m=(0.4, 1.0), houses=0.95,
        setback_m=(0.0, 0.0, 0.3), storeys=(3, 4, 4, 5), fences=(("none", 0.8), ("wall", 0.2)), green=0.1,
        surface="cobbles", markings=False,
    ),
    Landscape(
        "country", pace=1.8, two_lanes=0.0, parking=0.0, traffic=0.5, walk_m=(0.0, 0.0), houses=0.06,
        setback_m=(8.0, 15.0, 30.0), storeys=(1, 2), fences=(("none", 0.6), ("hedge", 0.15), ("mesh", 0.25)),
        green=0.4, trees_m=14.0, poles_m=45.0,
    ),
    Landscape(
        "deck", pace=0.4, lane_m=3.0, two_lanes=0.0, parking=0.0, traffic=0.15, walk_m=(0.0, 0.0), ceiling_m=3.8,
        inner_m=6.0, columns_m=7.5,
    ),
    Landscape("tunnel", fast=True, ceiling_m=6.0, inner_m=1.2),
)  # fmt: skip
LANDSCAPES: Final = {landscape.name: landscape for landscape in _ALL}
_SURFACES: Final[tuple[Surface, ...]] = ("asphalt", "asphalt", "cobbles", "gravel")
_DRAWN_FROM: Final = ("suburb", "jam", "alley", "country", "country", "deck", "tunnel", "highway")


def landscape_named(name: str) -> Landscape:
    """One of LANDSCAPES, or `world-SEED`; raises ConfigError if there is none."""
    seed = name.removeprefix(WORLD)
    found = _drawn(int(seed)) if seed != name and seed.isdecimal() else LANDSCAPES.get(name)
    if found is None:
        known = f"mixed, {', '.join(LANDSCAPES)}, {WORLD}SEED"
        raise ConfigError("simulate", "environments", f"{name!r} is not one of {known}")
    return found


def _drawn(seed: int) -> Landscape:
    """The landscape of a seed: a named one, with other rows, fences, surfaces, light and traffic."""
    rng = np.random.default_rng([seed, 62])
    base = LANDSCAPES[str(rng.choice(_DRAWN_FROM))]

    def often(share: float) -> bool:
        return bool(rng.random() < share)

    weights = rng.dirichlet(np.ones(len(_GARDENS)))
    gardens = tuple((kind, float(w)) for (kind, _), w in zip(_GARDENS, weights, strict=True))
    lowest = rng.uniform(4.0, 45.0)
    drawn = replace(
        base, name=f"{WORLD}{seed}", plain=False, pace=base.pace * rng.uniform(0.7, 1.2),
        parking=float(often(0.5)) if base.parking else 0.0, traffic=base.traffic * rng.uniform(0.3, 1.3),
        fences=gardens if base.houses else base.fences, houses=base.houses * rng.uniform(0.4, 1.0),
        green=base.green * rng.uniform(0.2, 2.0), trees_m=rng.uniform(5.0, 16.0) if often(0.4) else 0.0,
        poles_m=rng.uniform(4.0, 50.0) if often(0.6) else 0.0,
        surface=_SURFACES[int(rng.integers(len(_SURFACES)))], markings=often(0.6), infrared=often(0.6),
        glass=often(0.7), sun_deg=(lowest, lowest + 12.0), side_light=often(0.5),
    )  # fmt: skip
    if base.name == "alley" or base.ceiling_m:
        drawn = replace(drawn, trees_m=0.0)
    return replace(drawn, surface="asphalt") if base.fast else drawn
