"""Road users at a moment: endless streams per lane, vehicles ahead in the ego lane, people on pavements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.simulate.world.actors import HOLLOW, VARIANTS
from pipeline.simulate.world.drives import Drive, RoadLayout

__all__ = ["Actor", "actors_at"]


@dataclass(frozen=True, eq=False)
class Actor:
    """One road user at one time; `key` stays the same over the drive."""

    key: int
    kind: str
    variant: int
    T_map_actor: np.ndarray
    velocity_map: np.ndarray

    def advanced(self, dt_s: float) -> Actor:
        """The actor some time later, at constant velocity."""
        T = self.T_map_actor.copy()
        T[:3, 3] += dt_s * self.velocity_map
        return replace(self, T_map_actor=T)


@dataclass(frozen=True)
class _Stream:
    """Road users in a line with a common speed; a place every `spacing_m`, which may be empty."""

    number: int
    offset_m: float
    speed_mps: float  # along the road, negative = oncoming
    spacing_m: float
    occupancy: float
    kinds: tuple[str, ...]
    height_m: float = 0.0


def actors_at(drive: Drive, t_s: float, within_m: tuple[float, float] = (45.0, 150.0)) -> list[Actor]:
    """Road users from `within_m[0]` behind the ego vehicle to `within_m[1]` ahead."""
    here = drive.ego.arc(t_s)
    actors = _leaders(drive, t_s, here, within_m)
    for stream in _streams(drive):
        actors += _members(drive, stream, t_s, here, within_m)
    if drive.landscape.glass:
        actors = [replace(a, variant=a.variant + HOLLOW) for a in actors]
    return _apart(actors, drive.ego.poses(np.array([t_s]))[0])


def _streams(drive: Drive) -> list[_Stream]:
    rng = np.random.default_rng([drive.seed, 21])
    landscape = drive.landscape
    streams = (_highway_streams if landscape.fast else _urban_streams)(drive.layout, rng)
    return [
        # Streams on the road have the landscape's density and speed; people on pavements do not change.
        s
        if s.height_m
        else replace(
            s,
            speed_mps=s.speed_mps * landscape.pace,
            spacing_m=s.spacing_m * landscape.spacing,
            occupancy=s.occupancy * landscape.traffic,
            kinds=landscape.kinds or s.kinds,
        )
        for s in streams
    ]


def _highway_streams(layout: RoadLayout, rng: np.random.Generator) -> list[_Stream]:
    streams = []
    for i, d in enumerate(layout.lanes_own[1:], 1):  # the ego lane has leading vehicles
        slow = d == min(layout.lanes_own)
        kinds = ("truck", "truck", "car", "van") if slow else ("car", "car", "car", "van")
        speed = rng.uniform(21, 25) if slow else rng.uniform(27, 36)
        streams.append(_Stream(i, d, speed, rng.uniform(24, 36), 0.75, kinds))
    oncoming = ("car", "car", "van", "truck")
    for i, d in enumerate(layout.lanes_oncoming):
        streams.append(_Stream(10 + i, d, -rng.uniform(24, 35), rng.uniform(26, 42), 0.65, oncoming))
    return streams


def _urban_streams(layout: RoadLayout, rng: np.random.Generator) -> list[_Stream]:
    streams = []
    own, oncoming = ("car", "car", "car", "van", "bus"), ("car", "car", "van", "truck", "bus")
    for i, d in enumerate(layout.lanes_own[1:], 1):  # the ego lane has leading vehicles
        streams.append(_Stream(i, d, rng.uniform(7, 13), rng.uniform(18, 28), 0.7, own))
    for i, d in enumerate(layout.lanes_oncoming):
        streams.append(_Stream(10 + i, d, -rng.uniform(7, 13), rng.uniform(20, 32), 0.7, oncoming))
    edge = layout.edge
    for i, (side, walk) in enumerate(((-1, 1.3), (-1, -1.2), (1, -1.4), (1, 1.1))):
        d, speed = side * (edge + 1.0 + 0.8 * (i % 2)), walk * rng.uniform(0.8, 1.2)
        streams.append(_Stream(20 + i, d, speed, rng.uniform(12, 22), 0.5, ("pedestrian",), 0.12))
    kerb = edge - layout.parking_m
    streams.append(_Stream(30, -(kerb - 0.45), rng.uniform(4.0, 5.5), 45.0, 0.55, ("cyclist",)))
    streams.append(_Stream(31, kerb - 0.45, -rng.uniform(4.0, 5.5), 55.0, 0.55, ("cyclist",)))
    return streams


def _members(
    drive: Drive, stream: _Stream, t_s: float, here_m: float, within_m: tuple[float, float]
) -> list[Actor]:
    """Road users of a stream; every place has its own draws."""
    behind, ahead = within_m
    base = here_m - stream.speed_mps * t_s
    first, last = int((base - behind) // stream.spacing_m) - 1, int((base + ahead) // stream.spacing_m) + 1
    actors = []
    for k in range(first, last + 1):
        rng = np.random.default_rng([drive.seed, 22, stream.number, k + 1_000_000])
        if rng.random() > stream.occupancy:
            continue
        kind = stream.kinds[int(rng.integers(len(stream.kinds)))]
        swing, rate, phase = rng.uniform(0.5, 2.5), rng.uniform(0.1, 0.35), rng.uniform(0, 2 * np.pi)
        swing = 0.2 if kind == "pedestrian" else swing
        jitter = rng.uniform(-0.2, 0.2) * stream.spacing_m
        s = k * stream.spacing_m + jitter + stream.speed_mps * t_s + swing * np.sin(rate * t_s + phase)
        if not -behind <= s - here_m <= ahead:
            continue
        d = stream.offset_m + rng.uniform(-0.25, 0.25)
        speed = stream.speed_mps + swing * rate * np.cos(rate * t_s + phase)
        variant = int(rng.integers(VARIANTS[kind]))
        if kind == "pedestrian":  # gait: the pose changes twice a second
            variant = variant // 4 * 4 + int(t_s * 2.2 + k) % 4
        key = 1 + ((stream.number + 1) * 100_003 + k * 7919) % 1_000_000
        yaw = 0.0 if stream.speed_mps > 0 else np.pi
        actors.append(_actor(drive, key, kind, variant, (s, d, stream.height_m), speed, yaw))
    return actors


def _leaders(drive: Drive, t_s: float, here_m: float, within_m: tuple[float, float]) -> list[Actor]:
    """Vehicles ahead (behind) in the ego lane repeat the ego motion some seconds earlier (later)."""
    rng = np.random.default_rng([drive.seed, 23])
    actors: list[Actor] = []
    for sign in (1, -1):
        headway, gap = 0.0, 0.0
        for i in range(5):
            headway += rng.uniform(1.1, 3.2)
            gap += rng.uniform(7.5, 10.0)
            kinds = drive.landscape.kinds or ("car", "car", "van", "truck", "car")
            kind = kinds[int(rng.integers(len(kinds)))]
            variant = int(rng.integers(VARIANTS[kind]))
            t = t_s + sign * headway
            s = drive.ego.arc(t) + sign * gap
            if -within_m[0] <= s - here_m <= within_m[1]:
                speed = (drive.ego.arc(t + 0.05) - drive.ego.arc(t - 0.05)) / 0.1
                d = drive.layout.lanes_own[0] + rng.uniform(-0.2, 0.2)
                key = 900_000 + 10 * (sign + 1) + i
                actors.append(_actor(drive, key, kind, variant, (s, d, 0.0), speed))
    return actors


def _actor(
    drive: Drive, key: int, kind: str, variant: int, s_d_h: tuple[float, float, float], speed_mps: float,
    yaw_rad: float = 0.0,
) -> Actor:  # fmt: skip
    """A road user at a place of the road; negative speed = oncoming."""
    before, after = drive.road.to_map(np.array(s_d_h) + [[-0.5, 0, 0], [0.5, 0, 0]])
    return Actor(key, kind, variant, drive.road.pose(*s_d_h, yaw_rad), speed_mps * (after - before))


def _apart(actors: list[Actor], T_map_vehicle: Float[np.ndarray, "4 4"]) -> list[Actor]:
    """Remove actors that overlap with another one or with the ego vehicle (streams are independent)."""
    kept: list[Actor] = []
    places = [(T_map_vehicle[:2, 3] + 1.3 * T_map_vehicle[:2, 0], T_map_vehicle[:2, 0], 3.5)]
    reach = {"car": 2.6, "van": 3.2, "truck": 7.4, "bus": 6.2, "cyclist": 1.0, "pedestrian": 0.4}
    for actor in actors:
        p, r = actor.T_map_actor[:2, 3], reach[actor.kind]
        if all(
            abs((p - q) @ axis) > r + other
            or abs((p - q) @ np.array([-axis[1], axis[0]])) > (2.2 if min(r, other) > 2 else 1.5)
            for q, axis, other in places
        ):
            kept.append(actor)
            places.append((p, actor.T_map_actor[:2, 0], r))
    return kept
