"""Study: how dirty are a radar's static detections? Statistics that need no truth, of real days and of simulated ones.

    python tests/benchmarks/studies/radar_dirt.py FOLDER...

A folder holds fleet.toml, a perceived day (lake) and, where it is known, truth (truth.json, or as the simulator writes
it); the logged calibration stands in. Heights are over the lidar's road, by a calibration good to half a degree.

- below: share of static detections more than .3 m below the road, by range over ground;
- height: median height over the height of what the lidar sees there, things of 1.2 to 5 m;
- noise: scatter of elevations of what is less than .5 m high, weakest to strongest third;
- alone: share of detections within 45 m near which the lidar sees nothing;
- Doppler: pitch of the car's way by plain least squares and by instruments (`travel.py`), and how far it moves where
  detections below the road are left out;
- repeats: correlation of elevation errors of the same things, a tenth of a second later.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.config import load_fleet
from pipeline.extrinsics.prior import read_prior
from pipeline.geometry.se3 import inverse, transform_points
from pipeline.geometry.spherical import to_spherical
from pipeline.objective.radar import travel
from pipeline.store.partitions import Lake, Partition
from pipeline.store.views import observations_of
from schemas.observations import Observation
from tests.benchmarks.studies.commits import commit_now

Array = NDArray[np.float64]
RANGES_M = (8.0, 15.0, 25.0, 40.0, 60.0)
BELOW_M = -0.3
_NEAR = np.array([np.radians(1.5), 0.9])  # azimuth and range within which lidar points are a detection's
_LEAST_SPEED_MPS, _FEWEST = 5.0, 25
_SOON_S, _SAME_M = 0.25, 0.5
# Of a detection: range over ground, height, lowest and highest lidar point near it (over the road), elevation error
# against their mean, power, place along and aside.
_RANGE, _HEIGHT, _LOW, _HIGH, _ERROR, _POWER, _X, _Y = range(8)


def main() -> None:
    """Print a row per day."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+")
    ranges = ", ".join(f"{a:.0f}-{b:.0f} m" for a, b in pairwise(RANGES_M))
    print(f"Measured by commit {commit_now()}\n")
    print(
        f"| day | static a scan | below by range ({ranges}) | height | noise [deg] | alone | "
        "Doppler plain, moved [deg] | Doppler by instruments, moved [deg] | repeats |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for folder in parser.parse_args().folders:
        print(_row(folder), flush=True)


def _row(folder: Path) -> str:
    rows, T, dt_s = _load(folder)
    use = [
        o
        for o in rows
        if o.radar_has_elevation and o.radar_velocity_mps is not None and o.ground_plane is not None
    ]
    tables = [_detections(o, T, dt_s) for o in use]
    every = np.concatenate(tables)
    ways = ", ".join(f"{a:+.2f}" for a in _ways(use, T, dt_s, by_instruments=False))
    better = ", ".join(f"{a:+.2f}" for a in _ways(use, T, dt_s, by_instruments=True))
    below = " ".join(
        f"{np.mean(every[(every[:, _RANGE] > a) & (every[:, _RANGE] < b), _HEIGHT] < BELOW_M):.3f}"
        for a, b in pairwise(RANGES_M)
    )
    high = every[(every[:, _HIGH] > 1.2) & (every[:, _HIGH] < 5.0)]
    alone = np.mean(np.isnan(every[every[:, _RANGE] < 45.0, _LOW]))
    return (
        f"| {folder.name} | {len(every) / len(use):.0f} | {below} | {np.median(high[:, _HEIGHT] / high[:, _HIGH]):.2f} "
        f"| {_noise(every)} | {alone:.2f} | {ways} | {better} | {_repeated(use, tables)} |"
    )


def _load(folder: Path) -> tuple[list[Observation], Array, float]:
    """Observations, T_lidar_radar and the time offset of a day."""
    place = next((folder / "lake" / "perceived").glob("vehicle=*/day=*"))
    day = Partition(place.parent.name.removeprefix("vehicle="), place.name.removeprefix("day="))
    rows = list(observations_of(Lake.at(folder / "lake"), day))
    known = [folder / "truth.json", folder / "truth" / day.vehicle / f"{day.day}.json"]
    truth = next((json.loads(p.read_text()) for p in known if p.exists()), {})
    logged = read_prior(rows, load_fleet(folder / "fleet.toml"), day.vehicle).T_lidar_radar
    return rows, np.array(truth.get("T_lidar_radar", logged)), truth.get("dt_lidar_radar_s", 0.0)


def _static(o: Observation) -> Array:
    return o.radar_xyz_m[o.radar_motion == 0].astype(np.float64)


def _in_lidar(o: Observation, T: Array, dt_s: float) -> Array:
    tau = (o.radar_stamp_ns - o.stamp_ns) * 1e-9 + dt_s
    assert o.radar_velocity_mps is not None
    return np.asarray(transform_points(T, _static(o) + o.radar_velocity_mps * tau))


def _over_road(o: Observation, points: Array) -> Array:
    assert o.ground_plane is not None
    return np.asarray(points @ o.ground_plane[:3] + o.ground_plane[3])


def _detections(o: Observation, T: Array, dt_s: float) -> Array:
    """A row of columns _RANGE to _Y per static detection; NaN where the lidar sees nothing that stands."""
    seen, lidar = _in_lidar(o, T, dt_s), o.lidar_map_xyz_m.astype(np.float64)
    over, stands = _over_road(o, lidar), ~o.lidar_map_is_ground.astype(bool)
    places = [to_spherical(transform_points(inverse(T), p))[:, [0, 2]] / _NEAR for p in (lidar, seen)]
    near = cKDTree(places[0]).query_ball_point(places[1], 1.0)
    range_m = np.hypot(seen[:, 0], seen[:, 1])
    out = np.full((len(seen), 8), np.nan)
    out[:, _RANGE], out[:, _HEIGHT], out[:, [_X, _Y]] = range_m, _over_road(o, seen), seen[:, :2]
    if o.radar_power_db is not None:
        out[:, _POWER] = o.radar_power_db[o.radar_motion == 0]
    for k, hits in enumerate(near):
        upright = over[hits][stands[hits]]
        if len(upright) > 1:
            out[k, [_LOW, _HIGH]] = upright.min(), upright.max()
            out[k, _ERROR] = np.degrees((out[k, _HEIGHT] - upright.mean()) / max(range_m[k], 1.0))
        elif len(hits):
            out[k, [_LOW, _HIGH]] = 0.0
    return out


def _noise(every: Array) -> str:
    flat = every[(every[:, _HIGH] < 0.5) & (every[:, _RANGE] > RANGES_M[0]) & np.isfinite(every[:, _POWER])]
    if len(flat) < 3 * _FEWEST:
        return "-"
    third = np.digitize(flat[:, _POWER], np.percentile(flat[:, _POWER], [33, 67]))
    angle = np.degrees(flat[:, _HEIGHT] / flat[:, _RANGE])
    return " ".join(f"{_spread(angle[third == k]):.1f}" for k in range(3))


def _spread(x: Array) -> float:
    return float(1.4826 * np.median(np.abs(x - np.median(x)))) if len(x) else float("nan")


def _ways(use: Sequence[Observation], T: Array, dt_s: float, *, by_instruments: bool) -> tuple[float, float]:
    """Median pitch of the velocity against the road, and its median change without detections below the road."""
    found = []
    for o in use:
        assert o.radar_velocity_mps is not None
        ahead = (T[:3, :3] @ o.radar_velocity_mps)[:2]
        road = travel._road(o, ahead / max(float(np.hypot(*ahead)), 1e-9))
        if road is None or np.hypot(*o.radar_velocity_mps[:2]) < _LEAST_SPEED_MPS:
            continue
        lidar_rad = travel._lidar_elevation(o, T, dt_s, _static(o))
        above = _over_road(o, _in_lidar(o, T, dt_s)) > BELOW_M
        pitches = [
            _pitch(o, T, np.isfinite(lidar_rad) & keep, lidar_rad if by_instruments else None)
            for keep in (np.ones_like(above), above)
        ]
        found.append((pitches[0] - np.degrees(np.arctan(road[1])), pitches[1] - pitches[0]))
    mean, moved = np.nanmedian(np.array(found), axis=0)
    return float(mean), float(moved)


def _pitch(o: Observation, T: Array, use: NDArray[np.bool_], lidar_rad: Array | None) -> float:
    """Elevation of the velocity in lidar axes [deg]; NaN where too few detections are left."""
    if use.sum() < _FEWEST:
        return float("nan")
    xyz, residual = _static(o)[use], o.radar_residual_mps[o.radar_motion == 0][use].astype(np.float64)
    u = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    Z = u
    if lidar_rad is not None:
        a, e = np.arctan2(xyz[:, 1], xyz[:, 0]), lidar_rad[use]
        Z = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1)
    v = T[:3, :3] @ (o.radar_velocity_mps - np.linalg.solve(Z.T @ u, Z.T @ residual))
    return float(np.degrees(np.arctan2(v[2], np.hypot(v[0], v[1]))))


def _repeated(use: Sequence[Observation], tables: Sequence[Array]) -> str:
    """Correlation of the elevation errors of things seen again soon after."""
    pairs = []
    for (o, now), (p, then) in pairwise(zip(use, tables, strict=True)):
        gap_s = (p.stamp_ns - o.stamp_ns) * 1e-9
        if p.drive != o.drive or not 0 < gap_s < _SOON_S or o.ego_speed_mps is None:
            continue
        known = [t[np.isfinite(t[:, _ERROR])] for t in (now, then)]
        moved = known[0][:, [_X, _Y]] - [o.ego_speed_mps * gap_s, 0.0]
        if all(map(len, known)):
            apart, at = cKDTree(known[1][:, [_X, _Y]]).query(moved)
            same = apart < _SAME_M
            pairs.append(np.stack([known[0][same, _ERROR], known[1][at[same], _ERROR]], 1))
    every = np.concatenate(pairs) if pairs else np.zeros((0, 2))
    return f"{np.corrcoef(every.T)[0, 1]:.2f} of {len(every)}" if len(every) > _FEWEST else "-"


if __name__ == "__main__":
    main()
