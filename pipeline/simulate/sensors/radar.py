"""FMCW radar: scatterers from cast rays, merged by resolution cell, with road reflections and aliasing.

Object and mirror image in the road share one range cell, and their amplitudes add: each is a sum of many
scatterers, hence complex normal, and at 77 GHz their paths differ by many wavelengths. The radar estimates
one elevation between the object and its image, weighted by amplitude, different in every scan. Echoes that
the image strengthens are detected more often than those it weakens, so the mean elevation is too low.

Source: Skolnik, Radar Handbook, ch. 2 (equation, fluctuation); Barton 1974, "Low-angle radar tracking"
(glint); Howard 1959, "Radar target angular scintillation".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, no_type_check

import numba
import numpy as np
from jaxtyping import Float

from pipeline.core.rows import join_rows, take_rows
from pipeline.rig.se3 import from_spherical, inverse, to_spherical, transform_points
from pipeline.simulate.sensors.rig_spec import RadarSpec
from pipeline.simulate.world.casting import Moment
from pipeline.simulate.world.drives import Motion
from pipeline.simulate.world.materials import LABELS, TABLE, material

__all__ = ["RadarErrors", "Scan", "scan_radar"]

_GROUND: Final = tuple(LABELS.index(n) for n in ("road", "sidewalk", "terrain"))
_PLANTS: Final = LABELS.index("vegetation")
_BODIES: Final = tuple(LABELS.index(n) for n in ("car", "truck", "bus"))
_SOFT: Final = tuple(LABELS.index(n) for n in ("person", "rider", "bicycle"))
_WHEELS: Final = tuple(material(n) for n in ("car_tyre", "car_rim", "truck_tyre", "bus_tyre", "bike_tyre"))
_THRESHOLD: Final = 12.0  # signal to noise, about 11 dB
_REFLECTION = 0.9  # amplitude reflected by asphalt at grazing angles
_LEAST_HEIGHT_M = 0.15  # below this height, an object and its image coincide


@dataclass(frozen=True)
class RadarErrors:
    """Constant errors of one radar."""

    range_bias_m: float = 0.0
    elevation_bias_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class Scan:
    """Detections in the radar frame; range rate positive = receding, quantised and aliased.

    `origin` is the truth and is not logged: 0 standing, 1 moving, 2 ghost, 3 clutter.
    """

    xyz_m: np.ndarray
    range_rate_mps: np.ndarray
    power_db: np.ndarray
    origin: np.ndarray


@dataclass(frozen=True, eq=False)
class _Cells:
    """Azimuth, elevation, range of echoes (radar frame), range rate, signal to noise, class, moving flag."""

    aer: np.ndarray
    rate: np.ndarray
    snr: np.ndarray
    ground: np.ndarray
    moving: np.ndarray


def scan_radar(
    moment: Moment, ego: Motion, T_vehicle_radar: Float[np.ndarray, "4 4"], spec: RadarSpec,
    errors: RadarErrors, rng: np.random.Generator, mirrors_m: tuple[float, ...] = (),
    beacons_map: Float[np.ndarray, "N 3"] | None = None,
) -> Scan:  # fmt: skip
    """One scan at the time of the moment.

    Args:
        mirrors_m: offsets to the left of the vehicle of long walls and rails that reflect targets.
        beacons_map: corner reflectors, strong enough to be detected in every scan.
    """
    T_map_vehicle = ego.poses(np.array([moment.t_s]))[0]
    T_map_radar = T_map_vehicle @ T_vehicle_radar
    velocity, omega = (v[0] for v in ego.velocities(np.array([moment.t_s])))
    velocity_radar = velocity + np.cross(omega, T_map_radar[:3, 3] - T_map_vehicle[:3, 3])
    echoes = _scatterers(moment, T_map_radar, velocity_radar, spec, rng)
    if beacons_map is not None:
        n, no = len(beacons_map), np.zeros(len(beacons_map), bool)
        aer = to_spherical(transform_points(inverse(T_map_radar), beacons_map))
        echoes = join_rows([echoes, _Cells(aer, np.zeros(n), np.full(n, 3e4), no, no)])
    cells = _merged(echoes, T_vehicle_radar, spec, rng)
    if not spec.road_mirror:
        cells = _bounced(cells, T_vehicle_radar, spec, rng)
    ghosts, clutter = _ghosts(cells, mirrors_m, T_vehicle_radar, rng), _clutter(spec, rng)
    origin = np.append(cells.moving, np.repeat([2, 3], [len(ghosts.snr), len(clutter.snr)]))
    seen = join_rows([cells, ghosts, clutter])
    aer, rate = _measured(seen, spec, errors, rng)
    a, e, r = aer.T
    inside = (np.abs(a) < np.radians(spec.azimuth_deg)) & (np.abs(e) < np.radians(spec.elevation_deg) * 1.1)
    inside &= (r > spec.min_range_m) & (r < spec.max_range_m)
    if not spec.has_elevation:
        aer[:, 1] = 0.0
    xyz = from_spherical(aer)[inside].astype(np.float32)
    return Scan(
        xyz,
        rate[inside].astype(np.float32),
        (30 + 10 * np.log10(seen.snr[inside])).astype(np.float32),
        origin[inside].astype(np.uint8),
    )


def _scatterers(
    moment: Moment,
    T_map_radar: np.ndarray,
    velocity_radar: np.ndarray,
    spec: RadarSpec,
    rng: np.random.Generator,
) -> _Cells:
    """Echoes of rays spread evenly over the field of view."""
    columns = round(np.sqrt(spec.rays * spec.azimuth_deg / spec.elevation_deg))
    rows = max(spec.rays // columns, 1)
    a, e = np.meshgrid((np.arange(columns) + 0.5) / columns * 2 - 1, (np.arange(rows) + 0.5) / rows * 2 - 1)
    a = np.radians(spec.azimuth_deg) * (a.ravel() + rng.uniform(-1, 1, a.size) / columns)
    e = np.radians(spec.elevation_deg) * (e.ravel() + rng.uniform(-1, 1, e.size) / rows)
    rays = from_spherical(np.stack([a, e, np.ones_like(a)], 1)) @ T_map_radar[:3, :3].T
    origin = T_map_radar[:3, 3] - moment.standing.origin
    hits = moment.cast(np.broadcast_to(origin, rays.shape), rays, np.zeros(len(rays)))
    near = np.flatnonzero((hits.triangle >= 0) & (hits.range_m < spec.max_range_m) & (hits.range_m > 1.5))
    k, r = hits.triangle[near], hits.range_m[near].astype(np.float64)
    m = moment.mesh.material[k]
    label = TABLE.label[m]
    cosine = np.abs(np.einsum("ij,ij->i", moment.normals[k], rays[near].astype(np.float32)))
    # Bodies have many corners: part of the echo is independent of the angle, part is specular.
    shape = np.where(np.isin(label, _GROUND), cosine**2, 0.2 + 0.8 * cosine**4)
    body = np.isin(label, _BODIES)
    inside = np.where(body & (rng.random(len(k)) < 0.45), rng.exponential(0.6, len(k)), 0.0)
    inside += np.where(label == _PLANTS, rng.exponential(0.7, len(k)), 0.0)
    v = moment.velocity_of_triangle[k].astype(np.float64)
    v = v * np.where(np.isin(m, _WHEELS), rng.uniform(0.3, 1.7, len(k)), 1.0)[:, None]
    v += np.where(np.isin(label, _SOFT), 0.2, 0.0)[:, None] * rng.standard_normal((len(k), 3))
    rate = np.einsum("ij,ij->i", v - velocity_radar, rays[near])
    # Power per ray: gain x solid angle / r^2; 9,000 rays of gain 1 at 120 m make a signal-to-noise ratio of 1
    # each.
    gain = TABLE.radar_gain[m] * shape * (120.0 / r) ** 2 * (9000 / len(rays))
    snr = gain * rng.exponential(1.0, len(k)) * np.exp(-inside / 2.0)
    aer = np.stack([a[near], e[near], r + inside], 1)
    moving = np.linalg.norm(moment.velocity_of_triangle[k], axis=1) > 0.1
    return _Cells(aer, rate, snr, np.isin(label, _GROUND), moving)


def _merged(echoes: _Cells, T_vehicle_radar: np.ndarray, spec: RadarSpec, rng: np.random.Generator) -> _Cells:
    """One detection per resolution cell with enough total power, at the power-weighted mean of its echoes."""
    index = np.floor(_in_cells(echoes, spec)).astype(np.int64)
    cells, cell = np.unique(index, axis=0, return_inverse=True)
    n, cell = len(cells), cell.ravel()
    total = np.bincount(cell, echoes.snr, n)
    mean = [
        np.bincount(cell, echoes.snr * c, n) / np.maximum(total, 1e-12)
        for c in (*echoes.aer.T, echoes.rate, echoes.ground, echoes.moving)
    ]
    aer = np.stack(mean[:3], 1)
    # Swerling I: the whole cell fades from scan to scan.
    if spec.road_mirror:
        height_m, image = _image_in_road(aer, T_vehicle_radar)
        fade, share = _faded_by_road(height_m, spec.road_mirror, rng)
        aer[:, 1] += share * (image[:, 1] - aer[:, 1])
    else:
        fade = rng.exponential(1.0, n)
    snr = total * fade + 1.0
    keep = snr > _THRESHOLD
    found = _Cells(aer[keep], mean[3][keep], snr[keep], mean[4][keep] > 0.5, mean[5][keep] > 0.5)
    # Local maxima: of two detections closer than the resolution in all four dimensions, the stronger one.
    strongest = np.argsort(-found.snr)
    return take_rows(found, strongest[_unsuppressed(_in_cells(found, spec)[strongest])])


def _in_cells(cells: _Cells, spec: RadarSpec) -> np.ndarray:
    """Azimuth, elevation, range and range rate in units of the resolution."""
    return np.concatenate([cells.aer / spec.cell, cells.rate[:, None] / spec.doppler_resolution_mps], 1)


@no_type_check
@numba.njit(cache=True)  # `no_type_check` keeps the tests' shape checks out of compiled code
def _unsuppressed(x: np.ndarray) -> np.ndarray:
    """Mask of echoes (strongest first) without a stronger kept one within a resolution cell in each axis."""
    keep = np.ones(len(x), np.bool_)
    for i in range(len(x)):
        if keep[i]:
            for j in range(i + 1, len(x)):
                k = 0  # np.all would make an array of each pair
                while k < x.shape[1] and abs(x[i, k] - x[j, k]) < 1.0:
                    k += 1
                if k == x.shape[1]:
                    keep[j] = False
    return keep


def _bounced(cells: _Cells, T_vehicle_radar: np.ndarray, spec: RadarSpec, rng: np.random.Generator) -> _Cells:
    """Road reflections: an unresolved image changes the elevation; a resolved one is a second detection."""
    height, aer_image = _image_in_road(cells.aer, T_vehicle_radar)
    radar_height, n = T_vehicle_radar[2, 3], len(cells.snr)
    has_image = ~cells.ground & (height > _LEAST_HEIGHT_M)
    mirror = 0.6 * rng.random(n) * np.exp(1j * rng.uniform(0, 2 * np.pi, n)) * has_image
    apart = aer_image[:, 1] - cells.aer[:, 1]
    resolved = np.abs(apart) > np.radians(spec.elevation_resolution_deg)
    bend = np.clip(np.real(mirror / (1 + mirror)), -1.0, 1.0) * apart
    aer = cells.aer.copy()
    # The path over the road is longer by about 2 h1 h2 / r; half of it adds to the range.
    longer = np.abs(mirror) ** 2 * np.maximum(height, 0) * radar_height / np.maximum(aer[:, 2], 5.0)
    aer[:, 1] += np.where(resolved, 0.0, bend)
    aer[:, 2] += np.where(resolved, 0.0, longer)
    aer_image[:, 2] = aer[:, 2] + 2 * height * radar_height / aer[:, 2]
    images = replace(cells, aer=aer_image, snr=np.abs(mirror) ** 4 * cells.snr)
    second = resolved & (images.snr > _THRESHOLD)
    return join_rows([replace(cells, aer=aer), take_rows(images, second)])


def _ghosts(
    cells: _Cells, mirrors_m: tuple[float, ...], T_vehicle_radar: np.ndarray, rng: np.random.Generator
) -> _Cells:
    """Mirror images behind rails and walls, and double reflections between a target and the ego vehicle."""
    strong = cells.moving & (cells.snr > 60)
    mirrored = take_rows(cells, strong & (rng.random(len(strong)) < (0.12 if mirrors_m else 0.0)))
    doubled = take_rows(cells, strong & (rng.random(len(strong)) < 0.03))
    side = mirrors_m[int(rng.integers(len(mirrors_m)))] if mirrors_m else 0.0
    image = transform_points(T_vehicle_radar, from_spherical(mirrored.aer))
    image[:, 1] = 2 * side - image[:, 1]
    first = to_spherical(transform_points(inverse(T_vehicle_radar), image))
    second = doubled.aer * [1.0, 1.0, 2.0]
    behind = replace(mirrored, aer=first, snr=mirrored.snr / 4)
    return join_rows([behind, replace(doubled, aer=second, rate=2 * doubled.rate, snr=doubled.snr / 5)])


def _clutter(spec: RadarSpec, rng: np.random.Generator) -> _Cells:
    """False alarms, uniform in the data cube."""
    n = int(rng.poisson(5))
    half = np.radians([spec.azimuth_deg, spec.elevation_deg])
    angles = [rng.uniform(-h, h, n) for h in half]
    aer = np.stack([*angles, rng.uniform(spec.min_range_m, spec.max_range_m, n)], 1)
    rate, snr, no = rng.uniform(-20, 20, n), _THRESHOLD * (1 + rng.exponential(0.3, n)), np.zeros(n, bool)
    return _Cells(aer, rate, snr, no, no)


def _measured(
    seen: _Cells, spec: RadarSpec, errors: RadarErrors, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Measured azimuth, elevation, range and range rate: noise, constant errors, grids, Doppler aliasing."""
    # Single-target accuracy: resolution / (1.6 sqrt(2 snr)) (Skolnik, ch. 9), at least a tenth of the
    # resolution, because of the array's calibration.
    sigma = spec.cell * np.maximum(1 / (1.6 * np.sqrt(2 * seen.snr)), 0.1)[:, None]
    sigma[:, 1] *= spec.elevation_noise
    bias = [0.0, errors.elevation_bias_rad, errors.range_bias_m]
    aer = seen.aer + sigma * rng.standard_normal(sigma.shape) + bias
    grid = spec.cell / 8
    aer = np.round(aer / grid) * grid
    rate = seen.rate + 0.35 * spec.doppler_resolution_mps * rng.standard_normal(len(sigma))
    if spec.doppler_period_mps is not None:
        half = spec.doppler_period_mps / 2
        rate = (rate + half) % spec.doppler_period_mps - half
    return aer, np.round(rate / spec.doppler_step_mps) * spec.doppler_step_mps


def _faded_by_road(
    height_m: Float[np.ndarray, " N"], mirrored: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Power of every echo relative to its mean, and its position between object (0) and mirror image (1).

    Only objects above the road (`height_m`) have an image. `mirrored` is the share of echoes with smooth,
    empty road at the reflection point; it varies from scan to scan by half.
    """
    direct, image = (rng.standard_normal((2, len(height_m), 2)) @ [1.0, 1j]) / np.sqrt(2.0)
    smooth = rng.random(len(height_m)) < mirrored * rng.uniform(0.5, 1.5)
    image = _REFLECTION * image * (smooth & (height_m > _LEAST_HEIGHT_M))
    both = direct + image
    return np.abs(both) ** 2, np.clip(np.real(image / both), 0.0, 1.0)


def _image_in_road(
    aer: Float[np.ndarray, "N 3"], T_vehicle_radar: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Height above the road [m], and mirror image as azimuth, elevation and range in the radar frame."""
    xyz_vehicle = transform_points(T_vehicle_radar, from_spherical(aer))
    image = xyz_vehicle * [1.0, 1.0, -1.0]
    return xyz_vehicle[:, 2], to_spherical(transform_points(inverse(T_vehicle_radar), image))
