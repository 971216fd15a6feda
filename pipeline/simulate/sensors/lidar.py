"""Measurements of a scanner or of rotating prisms: each beam from the sensor's position at its own time.

Source of the rosette: Marshall 1999, "Risley prism scan patterns" (SPIE 3787): each prism adds a rotating
deflection, and their sum is periodic only if the ratio of their rates is one of small whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float, Float64

from pipeline.rig.se3 import from_spherical
from pipeline.simulate.sensors.rig_spec import LidarSpec
from pipeline.simulate.world.casting import Hits, Moment
from pipeline.simulate.world.drives import Motion
from pipeline.simulate.world.materials import LABELS, TABLE, material
from pipeline.simulate.world.textures import textures

__all__ = ["Sweep", "beams_of", "sweep_lidar"]

_VEGETATION: Final = LABELS.index("vegetation")
_ROAD: Final = LABELS.index("road")
# The infrared shows no markings or repairs: one reflectivity for the road, with stains at other places.
_UNTOLD: Final = 0.14
_STAINS: Final = TABLE.texture[material("asphalt")]
_ELSEWHERE_M: Final = 1000.0
# The echo of a frontal white wall at 100 m is 1; weaker echoes are lost (asphalt at about 50 m from 1.8 m
# height).
_FAINTEST: Final = 0.018
_MOST_PASSED: Final = 6  # maximum number of panes and leaves that one beam passes
_SKIN_M: Final = 0.01
_PRISMS_HZ: Final = (121.57, -77.73)  # Livox Mid-40: 7294 and -4664 turns per minute


@dataclass(frozen=True, eq=False)
class Sweep:
    """Points in the lidar frame at their own times; `label` is the truth for tests and is not logged.

    `ring` is the laser: the row of a scanner; rotating prisms have no rows.
    """

    xyz_m: np.ndarray
    intensity: np.ndarray
    ring: np.ndarray
    time_s: np.ndarray
    label: np.ndarray


def sweep_lidar(
    moment: Moment, ego: Motion, T_vehicle_lidar: Float[np.ndarray, "4 4"], spec: LidarSpec, end_s: float,
    rng: np.random.Generator,
) -> Sweep:  # fmt: skip
    """One sweep that ends at `end_s` of the drive."""
    angles, column_time = beams_of(spec, end_s), np.linspace(-spec.sweep_s, 0.0, spec.columns)
    T = ego.poses(end_s + column_time) @ T_vehicle_lidar
    origins = np.repeat(T[:, :3, 3] - moment.standing.origin, spec.rows, axis=0)
    delay = np.repeat(end_s + column_time - moment.t_s, spec.rows)
    parts = []
    # A beam has a footprint: a second ray in it finds edges where two surfaces share one beam.
    for spread in (0.0, np.radians(spec.divergence_deg)):
        a = angles + spread * rng.uniform(-1, 1, angles.shape) if spread else angles
        body = from_spherical(np.concatenate([a, np.ones((len(a), 1))], 1))
        body = body.reshape(spec.columns, spec.rows, 3)
        rays = np.einsum("cij,crj->cri", T[:, :3, :3], body).reshape(-1, 3)
        parts.append(_echo(moment, _met(moment, origins, rays, delay, rng), rays, spec, rng))
    (range_m, strength, label), seen = _mixed(parts[0], parts[1], rng)
    keep = seen & (rng.random(len(seen)) > 0.004)
    body = from_spherical(np.concatenate([angles[keep], range_m[keep, None]], 1))
    intensity = np.clip(
        strength[keep] * 100 * (1 + 0.08 * rng.standard_normal(keep.sum())) + rng.normal(0, 0.8, keep.sum()),
        0,
        255,
    )
    return Sweep(
        body.astype(np.float32),
        np.round(intensity).astype(np.float32),
        np.tile(np.arange(spec.rows, dtype=np.uint16), spec.columns)[keep],
        np.repeat(column_time, spec.rows)[keep].astype(np.float32),
        label[keep],
    )


def _met(
    moment: Moment, origins: np.ndarray, rays: np.ndarray, delay: np.ndarray, rng: np.random.Generator
) -> Hits:
    """Final hits of the rays: some pass windows, wire and leaves, fewer at grazing angles."""
    hits, on = moment.cast(origins, rays, delay), np.arange(len(rays))
    for _ in range(_MOST_PASSED):
        k = hits.triangle[on]
        passes = np.where(k < 0, 0.0, TABLE.passes[moment.mesh.material[k]] * moment.mesh.tint[k].mean(1))
        on, k, passes = on[passes > 0], k[passes > 0], passes[passes > 0]
        facing = np.abs(np.einsum("ij,ij->i", moment.normals[k], rays[on]))
        on = on[rng.random(on.size) < passes * (1 - (1 - facing) ** 4)]
        if not on.size:
            break
        behind = hits.range_m[on] + _SKIN_M
        beyond = moment.cast(origins[on] + behind[:, None] * rays[on], rays[on], delay[on])
        hits.range_m[on], hits.triangle[on] = behind + beyond.range_m, beyond.triangle
        hits.barycentric[on] = beyond.barycentric
    return hits


def _echo(
    moment: Moment, hits: Hits, rays: np.ndarray, spec: LidarSpec, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(range, measured reflectivity, label) per ray; infinite range without an echo."""
    found = np.flatnonzero(hits.triangle >= 0)
    k, r = hits.triangle[found], hits.range_m[found].astype(np.float64)
    m = moment.mesh.material[k]
    label = TABLE.label[m]
    cosine = np.abs(np.einsum("ij,ij->i", moment.normals[k], rays[found].astype(np.float32)))
    # Dark paint and cloth are dark to the lidar too, but less so.
    reflectivity = TABLE.reflectivity[m] * (0.25 + 0.75 * np.minimum(moment.mesh.tint[k].mean(1), 1.0))
    uv, (b, c) = moment.mesh.uv[k], hits.barycentric[found].T[..., None]
    at = uv[:, 0] * (1 - b - c) + uv[:, 1] * b + uv[:, 2] * c
    gain, glass = textures(TABLE.texture[m], at)
    if not moment.landscape.infrared:
        on_road = label == _ROAD
        reflectivity[on_road] = _UNTOLD
        gain[on_road] = textures(np.full(on_road.sum(), _STAINS), at[on_road] + _ELSEWHERE_M)[0]
    reflectivity = reflectivity * (0.4 + 0.6 * gain)  # visible wear is partly visible in the infrared
    pane = rng.random(len(k)) < np.maximum(TABLE.glass[m], glass)
    r = np.where(
        label == _VEGETATION, r + rng.exponential(0.15, len(k)), r
    ) + spec.range_sigma_m * rng.standard_normal(len(k))
    diffuse = np.where(TABLE.gloss[m], cosine**3, np.float32(1.0))
    echo = reflectivity * cosine * diffuse * (100.0 / np.maximum(r, 1.0)) ** 2
    lost = (
        (echo < _FAINTEST * rng.uniform(0.6, 1.6, len(k))) | (r > spec.max_range_m) | (r < spec.min_range_m)
    )
    lost |= pane | ((label == _VEGETATION) & (rng.random(len(k)) < 0.08))
    range_m, strength, labels = np.full(len(rays), np.inf), np.zeros(len(rays)), np.zeros(len(rays), np.uint8)
    back = found[~lost]
    range_m[back], labels[back] = r[~lost], label[~lost]
    strength[back] = (reflectivity * cosine**0.35)[~lost]
    return range_m, strength, labels


def _mixed(
    one: tuple[np.ndarray, np.ndarray, np.ndarray],
    two: tuple[np.ndarray, np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """One return per beam from two parts of its footprint."""
    n = len(one[0])
    first = np.where(np.isfinite(one[0]), one[0], two[0])
    other = np.where(np.isfinite(two[0]), two[0], one[0])
    seen = np.isfinite(one[0]) | (np.isfinite(two[0]) & (rng.random(n) < 0.5))
    gap = np.abs(np.where(seen, first, 0.0) - np.where(np.isfinite(other), other, 0.0))
    # Echoes closer than the pulse length merge; of echoes farther apart, one is chosen.
    blend = (gap > 0.15) & (gap < 1.3) & (rng.random(n) < 0.6)
    switch = (gap >= 1.3) & (rng.random(n) < 0.35) & np.isfinite(two[0])
    w = rng.random(n)
    with np.errstate(invalid="ignore"):
        range_m = np.where(blend, w * first + (1 - w) * other, np.where(switch, other, first))
    use_two = switch | ~np.isfinite(one[0])
    return (range_m, np.where(use_two, two[1], one[1]), np.where(use_two, two[2], one[2])), seen


def beams_of(spec: LidarSpec, end_s: float) -> Float64[np.ndarray, "N 2"]:
    """Azimuth, elevation [rad] of the beams of a sweep that ends at `end_s`: firing by firing, laser by laser.

    A scanner has the same in every sweep.
    """
    return _scanned(spec) if spec.pattern == "rows" else _rosette(spec, end_s)


@lru_cache(maxsize=8)
def _scanned(spec: LidarSpec) -> np.ndarray:
    azimuth = np.radians(np.linspace(spec.azimuth_deg[1], spec.azimuth_deg[0], spec.columns, endpoint=False))
    elevation = np.radians(spec.row_elevation_deg or np.linspace(*spec.elevation_deg, spec.rows))
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    return np.stack([a.ravel(), e.ravel()], 1)


def _rosette(spec: LidarSpec, end_s: float) -> np.ndarray:
    """An ellipse that fills the field of view; every laser has its own phase."""
    t = end_s + np.linspace(-spec.sweep_s, 0.0, spec.columns)
    phase = np.arange(spec.rows) / spec.rows * 2 * np.pi
    first, second = (
        2 * np.pi * f * t[:, None] + sign * phase for f, sign in zip(_PRISMS_HZ, (1, 2), strict=True)
    )
    along, up = (np.cos(first) + np.cos(second)) / 2, (np.sin(first) + np.sin(second)) / 2
    angles = [
        np.radians((low + high) / 2 + (high - low) / 2 * share)
        for (low, high), share in ((spec.azimuth_deg, along), (spec.elevation_deg, up))
    ]
    return np.stack([a.ravel() for a in angles], 1)
