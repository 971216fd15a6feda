"""The fleets of study `states`: twelve vehicles of a rig, what happens to each, where each day is driven, the truth."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from pipeline.rig.se3 import exp_so3, from_rotation_translation
from pipeline.simulate.faults import Fault
from pipeline.simulate.fleet import FleetSpec, mixed_fleet_toml, mounting_on
from pipeline.simulate.sensors.mounting import Mounting
from pipeline.simulate.sensors.rigs import rig_named
from pipeline.simulate.sensors.semantics import SemanticsSpec

__all__ = [
    "FIRST_DAY",
    "STORIES",
    "Story",
    "fleet_text",
    "logged_poses",
    "spec_of_day",
    "stories_of",
    "tomorrows_poses",
]

FIRST_DAY = "2026-03-02"
# In words: still, coarse (labels), SENSOR DEG [within: in the middle of its day], SENSOR drift DEG (a day); far: the
# prior is 5 deg and 8 cm off, else as the simulator mounts sensors, about 1 deg and 3 cm. The first few are a small
# fleet with the main cases.
STORIES = {
    "demo": (
        "still", "camera 1", "still far", "coarse", "radar 1 far", "lidar 1", "camera .3", "radar .3", "lidar .3 far",
        "camera drift .05", "still far", "camera .5 within",
    ),
    "duo": (
        "still", "front 1", "still far", "coarse", "nose 1 far", "top 1", "left 1 within", "corner_fl 1", "front .3",
        "front drift .05", "still far", "top .3 far",
    ),
}  # fmt: skip
_FAR_DEG, _FAR_M = 4.8, 0.08  # that a sensor of a far vehicle is off, beside what every mount is
# Sigmas [deg, m] of the prior in fleet.toml.
_PRIORS = {"": (2.0, 0.05), "-far": (5.0, 0.10)}
# Each vehicle has all of them within four days.
_PLACES = ("mixed", "urban", "highway", "world")
_OF_COARSE = ("mixed", "highway")  # where no day with coarse labels is accepted
_DRIVES = 2
_DAYS = 30  # at most, tomorrow included
# Outlines that wander by 2.6 label pixels of .25 deg, and objects that are too wide for most of their outline.
_COARSE = SemanticsSpec(boundary_px=2.6, swell=0.7)


@dataclass(frozen=True)
class Story:
    """What happens to one vehicle.

    Args:
        words: one of STORIES.
        sensor: that moves; empty = none.
        moved_on: number of the day (from 0) on which it moves, or begins to drift; -1 = never.
        faults: of the simulator, the far mount included.
    """

    vehicle: str
    words: str
    sensor: str = ""
    moved_on: int = -1
    faults: tuple[Fault, ...] = ()

    @property
    def is_far(self) -> bool:
        """The prior is 5 deg off."""
        return self.words.endswith("far")

    @property
    def is_knock(self) -> bool:
        """A sensor moves once, on one day."""
        return bool(self.sensor) and "drift" not in self.words


def stories_of(rig: str, seed: int, vehicles: int) -> list[Story]:
    """The first vehicles of a rig's fleet; axis, sign and day (the second to the fifth) of moves are drawn."""
    return [_story(rig, seed, v, words) for v, words in enumerate(STORIES[rig][:vehicles])]


def _story(rig: str, seed: int, number: int, words: str) -> Story:
    rng = np.random.default_rng([seed, number, 61])
    vehicle, parts = f"vehicle-{number + 1}", words.split()
    far = tuple(_far(vehicle, rig, rng)) if parts[-1] == "far" else ()
    if parts[0] in ("still", "coarse"):
        return Story(vehicle, words, faults=far)
    axis, sign = rng.choice(["yaw", "pitch", "roll"], p=[0.45, 0.4, 0.15]), rng.choice([-1.0, 1.0])
    day, after = int(rng.integers(1, 5)), 0.5 if parts[-1] == "within" else 0.0
    if parts[1] == "drift":
        day, axis = 1, "drift-pitch"
    amount = float(next(part for part in parts[1:] if part.replace(".", "").isdecimal()))
    fault = Fault(vehicle, day, parts[0], str(axis), sign * amount, after)
    return Story(vehicle, words, parts[0], day, (*far, fault))


def _far(vehicle: str, rig: str, rng: np.random.Generator) -> list[Fault]:
    """Turns and shifts, from the first day on, of all sensors but the reference lidar."""
    spec, faults = rig_named(rig), []
    for sensor in (s for s in spec.sensors if s != spec.reference):
        for kinds, size in ((("roll", "pitch", "yaw"), _FAR_DEG), (("x", "y", "z"), _FAR_M)):
            v = rng.normal(size=3)
            v *= size / np.linalg.norm(v)
            faults += [Fault(vehicle, 0, sensor.name, k, float(a)) for k, a in zip(kinds, v, strict=True)]
    return faults


def spec_of_day(rig: str, seed: int, stories: list[Story], frames: int, number: int, day: int) -> FleetSpec:
    """What the simulator is given for one vehicle-day: the place of that day, labels of that vehicle."""
    places = _OF_COARSE if stories[number].words == "coarse" else _PLACES
    place = places[(number + day) % len(places)]
    if place == "world":
        place = f"world-{100 * seed + 10 * number + day}"
    labels = _COARSE if stories[number].words == "coarse" else SemanticsSpec()
    return replace(_spec(rig, seed, stories), frames=frames, environments=place, semantics=labels)


def _spec(rig: str, seed: int, stories: list[Story]) -> FleetSpec:
    return FleetSpec(
        vehicles=len(stories), days=_DAYS, first_day=FIRST_DAY, drives=_DRIVES, rig=rig, seed=seed,
        faults=tuple(fault for story in stories for fault in story.faults),
    )  # fmt: skip


def fleet_text(rig: str, stories: list[Story]) -> str:
    """fleet.toml: far vehicles have a rig of their own whose prior has larger sigmas."""
    plain = rig_named(rig)
    rigs = {s.vehicle: replace(plain, name=rig + "-far" * s.is_far) for s in stories}
    text = mixed_fleet_toml("states", rigs)
    for ending, (turn, shift) in _PRIORS.items():
        section = rf"(\[rigs\.{rig}{ending}\.prior\]\nsource = .*\n)rotation.*\ntranslation.*\n"
        sigmas = f"rotation_sigma_deg = {turn}\ntranslation_sigma_m = {shift}\n"
        text = re.sub(section, rf"\g<1>{sigmas}", text)
    return text


def logged_poses(rig: str, seed: int, stories: list[Story], number: int) -> dict[str, np.ndarray]:
    """T_base_sensor by name as /tf_static has it."""
    mounting = mounting_on(_spec(rig, seed, stories), number, 0)
    return {"base": np.eye(4)} | {name: m.T_vehicle_nominal for name, m in mounting.sensors.items()}


def tomorrows_poses(
    rig: str, seed: int, stories: list[Story], number: int, night: int
) -> dict[str, np.ndarray]:
    """T_base_sensor by name at the first frame of the drive after a night, the mounts' daily scatter included.

    A knock that comes with that drive is left out, because nobody can foresee it; a drift that has begun goes on. A
    radar's pose is that of its detections, which a constant elevation error turns.
    """
    spec = _spec(rig, seed, stories)
    known = tuple(fault for fault in spec.faults if fault.day <= night)
    return _pointing(mounting_on(replace(spec, faults=known), number, night + 1))


def _pointing(mounting: Mounting) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {"base": np.eye(4)}
    for name, mounted in mounting.sensors.items():
        bias_rad = 0.0 if mounted.errors is None else mounted.errors.elevation_bias_rad
        down = from_rotation_translation(exp_so3(np.array([0.0, bias_rad, 0.0])), np.zeros(3))
        found[name] = mounted.T_vehicle @ down
    return found
