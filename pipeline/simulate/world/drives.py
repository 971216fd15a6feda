"""One drive: road, motion of the vehicle, and traffic.

Everything is a function of time and of the drive's seed. A drive of any length needs no memory, and
consecutive frames show the same world.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from pipeline.rig.se3 import from_rotation_translation
from pipeline.simulate.world.landscapes import Landscape, landscape_named

__all__ = ["Drive", "EgoMotion", "Motion", "Parked", "Road", "RoadLayout", "layout_of", "rotation"]

_STEP_M: Final = 1.0
_STEP_S: Final = 0.02


@dataclass(frozen=True)
class RoadLayout:
    """Cross-section of a road; d is the lateral offset from its centre line, positive to the left [m]."""

    landscape: Landscape
    lane_m: float
    lanes_own: tuple[float, ...]  # lane centres in our direction, ours first
    lanes_oncoming: tuple[float, ...]
    edge: float  # of the asphalt on the left; on the right it is as far away
    parking_m: float  # width of the parking strip inside each edge, 0 = none


def layout_of(landscape: Landscape, seed: int) -> RoadLayout:
    """Layout of a road; right-hand traffic."""
    rng = np.random.default_rng([seed, 11])
    if landscape.fast:
        lanes = 3 if rng.random() < 0.6 else 2
        own = tuple(-2.4 - 3.7 * (lanes - 1 - i) for i in range(lanes))
        order = own[1:] + own[:1] if lanes == 3 else own
        edge = 2.4 + 3.7 * (lanes - 0.5) + 2.6
        return RoadLayout(landscape, 3.7, order, tuple(-d for d in own), edge, 0.0)
    parking = 2.3 if rng.random() < landscape.parking else 0.0
    lanes = 2 if rng.random() < landscape.two_lanes else 1
    lane = landscape.lane_m
    if landscape.one_way:
        edge = lane / 2 + parking
        return RoadLayout(landscape, lane, (0.0,), (), edge, parking)
    first = lane / 2 + 0.05
    own = tuple(-first - lane * (lanes - 1 - i) for i in range(lanes))
    edge = first + lane * (lanes - 0.5) + 0.15 + parking
    return RoadLayout(landscape, lane, own, tuple(-d for d in own), edge, parking)


def _summed(s: np.ndarray, waves: Iterable[tuple[float, float]], rng: np.random.Generator) -> np.ndarray:
    """Sum of sines (period, amplitude) with drawn phases and periods near the given ones."""
    total = np.zeros_like(s)
    for period, amplitude in waves:
        total += amplitude * np.sin(
            2 * np.pi * s / (period * rng.uniform(0.8, 1.3)) + rng.uniform(0, 2 * np.pi)
        )
    return total


@dataclass(frozen=True)
class Road:
    """Endless smooth centre line in the map: x, y, z and heading over arc length."""

    seed: int
    fast: bool
    length_m: float

    @cached_property
    def _table(self) -> tuple[np.ndarray, ...]:
        rng = np.random.default_rng([self.seed, 12])
        s = np.arange(-200.0, self.length_m + 400.0, _STEP_M)
        waves = ((600.0, 0.0009), (350.0, 0.0006)) if self.fast else ((170.0, 0.0045), (90.0, 0.0030))
        hills = ((900.0, 5.0), (400.0, 1.2)) if self.fast else ((420.0, 1.6), (150.0, 0.35))
        heading = np.cumsum(_summed(s, waves, rng)) * _STEP_M
        heading -= heading[200]
        x, y = np.cumsum(np.cos(heading)) * _STEP_M, np.cumsum(np.sin(heading)) * _STEP_M
        return s, x, y, _summed(s, hills, rng), heading

    def centre(self, s_m: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, " 4 *batch"]:
        """x, y, z [m] and heading [rad] at arc lengths."""
        s, *columns = self._table
        return np.stack([np.interp(s_m, s, column) for column in columns])

    def to_map(self, s_d_h: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map coordinates of points (arc length, offset to the left, height above the centre line)."""
        x, y, z, heading = self.centre(s_d_h[..., 0])
        d = s_d_h[..., 1]
        return np.stack([x - d * np.sin(heading), y + d * np.cos(heading), z + s_d_h[..., 2]], -1)

    def pose(
        self, s_m: float, d_m: float, h_m: float = 0.0, yaw_rad: float = 0.0
    ) -> Float[np.ndarray, "4 4"]:
        """T_map_thing of an object on the road, rotated by yaw relative to its direction."""
        p = self.to_map(np.array([[s_m - 1.0, d_m, h_m], [s_m, d_m, h_m], [s_m + 1.0, d_m, h_m]]))
        grade = np.arctan2(p[2, 2] - p[0, 2], 2.0) * np.cos(yaw_rad)
        heading = float(self.centre(np.array([s_m]))[3][0]) + yaw_rad
        return from_rotation_translation(rotation(np.array(heading), np.array(-grade), np.array(0.0)), p[1])


def rotation(
    yaw: Float[np.ndarray, "*batch"], pitch: Float[np.ndarray, "*batch"], roll: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch 3 3"]:
    """R = Rz(yaw) Ry(pitch) Rx(roll); positive pitch points down (x forward, z up)."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    rows = [
        np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], -1),
        np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], -1),
        np.stack([-sp, cp * sr, cp * cr], -1),
    ]
    return np.stack(rows, -2)


@runtime_checkable
class Motion(Protocol):
    """Interface for the motion of a vehicle."""

    def poses(self, t_s: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 4 4"]:
        """T_map_vehicle at times."""
        ...

    def velocities(
        self, t_s: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """Linear velocity of the vehicle's origin, angular velocity, both in the map [m/s, rad/s]."""
        ...


@dataclass(frozen=True)
class Parked:
    """A vehicle standing at the map's origin."""

    def poses(self, t_s: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 4 4"]:
        """T_map_vehicle: always the identity."""
        return np.tile(np.eye(4), (len(t_s), 1, 1))

    def velocities(
        self, t_s: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """Always zero."""
        return np.zeros((len(t_s), 3)), np.zeros((len(t_s), 3))


class _Profile(NamedTuple):
    """Arc length, lateral offset and slope dd/ds of the ego vehicle's path over time."""

    t_s: np.ndarray
    s_m: np.ndarray
    d_m: np.ndarray
    slope: np.ndarray


def _smoothed(values: np.ndarray, half: int) -> np.ndarray:
    """Moving average of 2 half + 1 values with a Hann window; the ends are held."""
    window = np.hanning(2 * half + 1)
    return np.convolve(np.pad(values, half, mode="edge"), window / window.sum(), mode="valid")


@dataclass(frozen=True)
class EgoMotion:
    """Motion of the ego vehicle along its road, from time 0 to `duration_s`."""

    road: Road
    layout: RoadLayout
    seed: int
    duration_s: float

    @cached_property
    def _profile(self) -> _Profile:
        rng = np.random.default_rng([self.seed, 13])
        t = np.arange(-10.0, self.duration_s + 10.0, _STEP_S)
        s = np.cumsum(self._speed(t, rng)) * _STEP_S
        s += 30.0 - np.interp(0.0, t, s)
        d = self._offset(s, rng)
        ds, dd = np.gradient(s), np.gradient(d)
        rolling = ds > 0.3 * _STEP_S  # at lower speed, the wheels keep their direction
        slope = np.interp(t, t[rolling], dd[rolling] / ds[rolling])
        return _Profile(t, s, d, _smoothed(slope, 25))

    def _speed(self, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Speed [m/s] at times."""
        urban, pace = not self.layout.landscape.fast, self.layout.landscape.pace
        mean, swing = (10.0 * pace, 2.6 * pace) if urban else (27.0 * pace, 3.0 * pace)
        speed = np.full_like(t, mean * rng.uniform(0.85, 1.15))
        for period in (23.0, 11.0):
            size, longer, begin = rng.uniform(0.4, 0.9), rng.uniform(0.8, 1.3), rng.uniform(0, 6.28)
            speed += swing * size * np.sin(2 * np.pi * t / (period * longer) + begin)
        if urban:  # a red light now and then: brake, stand, start
            period = rng.uniform(45, 70)
            phase = (t + rng.uniform(0, period)) % period / period
            speed *= np.clip(np.abs(phase - 0.5) * 12 - 0.75, 0.0, 1.0) ** 0.8
        return _smoothed(np.maximum(speed, 0.0), 50)

    def _offset(self, s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Lateral offset [m] at arc lengths: the car wanders in its lane and sometimes changes it."""
        lanes = self.layout.lanes_own
        d = np.full_like(s, lanes[0])
        for period in (17.0, 7.0):
            d += 0.16 * rng.uniform(0.3, 1) * np.sin(2 * np.pi * s / (period * 12) + rng.uniform(0, 6.28))
        if len(lanes) > 1:  # one lane change and back per cycle
            shift = lanes[1] - lanes[0]
            cycle = (s / rng.uniform(500, 900) + rng.uniform()) % 1.0
            there, back = (np.clip((cycle - at) / 0.08, 0, 1) for at in (0.45, 0.85))
            d += shift * (there - back) * (rng.random() < 0.5)
        return _smoothed(d, 100)

    def arc(self, t_s: float) -> float:
        """Arc length [m] at a time."""
        return float(self._arcs(np.array([t_s]))[0])

    def _arcs(self, t_s: np.ndarray) -> np.ndarray:
        return np.interp(t_s, self._profile.t_s, self._profile.s_m)

    def poses(self, t_s: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 4 4"]:
        """T_map_vehicle at times; the body pitches and rolls on its springs."""
        path, s = self._profile, self._arcs(t_s)
        here = self.road.to_map(np.stack([s, np.interp(t_s, path.t_s, path.d_m), np.zeros_like(s)], -1))
        slope = np.interp(t_s, path.t_s, path.slope)
        heading = self.road.centre(s)[3] + np.arctan(slope)
        z = self.road.centre(np.stack([s - 1.3, s + 1.3]))[2]
        grade = np.arctan2(z[1] - z[0], 2.6)
        rough = 0.0018 if self.layout.landscape.fast else 0.0035
        pitch = -grade + rough * (
            np.sin(0.9 * s / 2.1) * np.sin(0.11 * s) + 0.4 * np.sin(1.7 * s / 2.1 + 1.0)
        )
        roll = rough * (np.sin(0.7 * s / 2.3 + 2.0) * np.cos(0.07 * s))
        return from_rotation_translation(rotation(heading, pitch, roll), here)

    def velocities(
        self, t_s: Float[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
        """As `Motion.velocities`."""
        h = 0.01
        before, after = self.poses(t_s - h), self.poses(t_s + h)
        change = (after - before) / (2 * h)
        spin = change[:, :3, :3] @ np.swapaxes(self.poses(t_s)[:, :3, :3], 1, 2)
        return change[:, :3, 3], (spin - spin.swapaxes(1, 2))[:, [2, 0, 1], [1, 2, 0]] / 2


@dataclass(frozen=True)
class Drive:
    """A stretch of driving: place, time and light."""

    seed: int
    environment: str
    duration_s: float
    start_ns: int
    night: bool = False

    @cached_property
    def landscape(self) -> Landscape:
        """The landscape along the road."""
        return landscape_named(self.environment)

    @cached_property
    def layout(self) -> RoadLayout:
        """Cross-section of the road."""
        return layout_of(self.landscape, self.seed)

    @cached_property
    def road(self) -> Road:
        """The road."""
        fastest_mps = (42.0 if self.landscape.fast else 18.0) * max(self.landscape.pace, 1.0)
        return Road(self.seed, self.landscape.fast, self.duration_s * fastest_mps + 100.0)

    @cached_property
    def ego(self) -> EgoMotion:
        """Ego motion on the road."""
        return EgoMotion(self.road, self.layout, self.seed, self.duration_s)

    @cached_property
    def sun(self) -> Float[np.ndarray, " 3"]:
        """Direction to the sun in the map."""
        rng = np.random.default_rng([self.seed, 14])
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*self.landscape.sun_deg))
        if self.landscape.side_light:  # within 30 deg of straight to the side
            azimuth = (azimuth % np.pi) / 3 + np.pi / 3 + (np.pi if azimuth > np.pi else 0.0)
        return np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
