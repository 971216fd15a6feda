"""Side of every frame by a plan, frames lost with reasons, and the cost of other splits of the same days."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.core.config import PrepareConfig, config_hash
from pipeline.learn.prepare.split import SplitPlan
from pipeline.learn.prepare.survey import Survey, plan_days
from pipeline.learn.sample.frame_sample import SampleReason
from pipeline.store.partitions import Lake
from pipeline.store.tables import read_manifest
from schemas.training import SPLITS, TRAINING

__all__ = [
    "Choice", "decided_sides", "frame_sides", "price_choices", "settled_keys", "split_rule", "split_settings",
]  # fmt: skip

Key = Literal["vehicle", "day", "place"]
_FEW = 0.2  # of the frames
_BETWEEN = (SampleReason.SPLIT_CONFLICT, SampleReason.NEXT_TO_OTHER_SPLIT)
# What a question may need: nothing shared at all, or unseen vehicles, days, streets.
_CHOICES: tuple[tuple[Key, ...], ...] = (
    ("vehicle", "day", "place"), ("vehicle", "place"), ("vehicle",), ("day",), ("place",),
)  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """Cost of a split: frames of each side, frames lost by reason, vehicle-days without a frame."""

    split_by: tuple[str, ...]
    frames: dict[str, int]
    lost: dict[str, int]
    empty_vehicle_days: int
    chosen: bool


def price_choices(surveys: Sequence[Survey], plan: SplitPlan, config: PrepareConfig) -> list[Choice]:
    """The current plan, then the alternatives for a new table.

    Frames without a sample (without a prior, for example) count as kept, because nothing has been read yet.
    """
    others = [config.split_with(by=keys) for keys in _CHOICES if set(keys) != set(plan.by)]
    return [
        _price(surveys, plan, config, chosen=True),
        *(_price(surveys, plan_days(surveys, settings, {}), settings) for settings in others),
    ]


def settled_keys(surveys: Sequence[Survey], config: PrepareConfig, lake: Lake) -> tuple[Key, ...]:
    """Keys to split by: as set, else those of table `training`, else the strictest keys that lose few frames.

    That is: no side is empty, and at most a fifth of the usable frames is lost between the sides. If no
    choice meets this, the keys are vehicle, day and place.
    """
    if "by" in config.split.model_fields_set:
        return config.split.by
    ways = {way: config.split_with(by=way) for way in _CHOICES}
    for way, settings in ways.items():
        if decided_sides(lake, settings):
            return way
    shares = (1, config.split.val_fraction, config.split.test_fraction)
    wanted = [side for side, share in zip(SPLITS, shares, strict=True) if share > 0]
    for way, settings in ways.items():
        price = _price(surveys, plan_days(surveys, settings, {}), settings)
        cut = sum(price.lost.get(reason.value, 0) for reason in _BETWEEN)
        if all(price.frames[s] for s in wanted) and cut <= _FEW * (sum(price.frames.values()) + cut):
            return way
    return _CHOICES[0]


def frame_sides(
    survey: Survey, plan: SplitPlan, config: PrepareConfig
) -> tuple[list[str | None], Counter[str]]:
    """Side of each frame (None = left out), and the number left out by reason."""
    vehicle, day = survey.partition.vehicle, survey.partition.day
    sides = np.array([plan.side_of(vehicle, day, place) or "" for place in survey.place])
    reasons = np.full(len(sides), "", object)
    reasons[sides == ""] = SampleReason.SPLIT_CONFLICT.value
    near = _near_other_side(survey, sides, config.split.guard_s)
    near |= _near_other_place(survey, sides, plan, config)
    reasons[(reasons == "") & near] = SampleReason.NEXT_TO_OTHER_SPLIT.value
    reasons[~survey.moved] = SampleReason.HARDLY_MOVED.value
    reasons[~survey.perceived] = SampleReason.NOT_PERCEIVED.value
    kept = np.flatnonzero(reasons == "")
    if config.max_frames is not None and len(kept) > config.max_frames:
        spread = np.linspace(0, len(kept) - 1, config.max_frames).astype(int)
        reasons[np.setdiff1d(kept, kept[spread])] = SampleReason.NOT_NEEDED.value
    counts: Counter[str] = Counter(str(r) for r in reasons if r)
    return [str(s) if not r else None for s, r in zip(sides, reasons, strict=True)], counts


def _near_other_side(survey: Survey, sides: np.ndarray, guard_s: float) -> np.ndarray:
    """True for frames with a frame of the same day on another side nearer in time than the guard."""
    near = np.zeros(len(sides), bool)
    for i, j in itertools.pairwise(np.flatnonzero(sides != "")):  # what no side has is near to none
        if sides[i] == sides[j]:
            continue
        border = (survey.stamp_s[i] + survey.stamp_s[j]) / 2
        near |= np.abs(survey.stamp_s - border) < guard_s / 2
    return near


def _near_other_place(
    survey: Survey, sides: np.ndarray, plan: SplitPlan, config: PrepareConfig
) -> np.ndarray:
    """True for frames with a cell of another side, also of another pass, within a square of `guard_m`."""
    near = np.zeros(len(sides), bool)
    if "place" not in plan.by or not config.split.guard_m:
        return near
    for i in np.flatnonzero(sides != ""):
        beside = {plan.sides.get(("place", place), sides[i]) for place in survey.reached(int(i), config)}
        near[i] = beside != {sides[i]}
    return near


def _price(
    surveys: Sequence[Survey], plan: SplitPlan, config: PrepareConfig, *, chosen: bool = False
) -> Choice:
    frames, lost, empty = Counter(dict.fromkeys(SPLITS, 0)), Counter[str](), 0
    for survey in surveys:
        sides, rejected = frame_sides(survey, plan, config)
        kept = Counter(side for side in sides if side is not None)
        frames.update(kept)
        lost.update(rejected)
        empty += not kept
    return Choice(plan.by, dict(frames), dict(lost), empty, chosen)


_OF_SPLIT = ("val_fraction", "test_fraction", "positions", "place_m", "place_s")


def decided_sides(lake: Lake, config: PrepareConfig) -> dict[tuple[str, str], str]:
    """Sides of the vehicles, days and places in the lake's table `training`.

    Empty for a table split by other keys, shares or seed, which is made again as a whole.
    """
    sides: dict[tuple[str, str], str] = {}
    for partition in lake.partitions(TRAINING.name):
        manifest = read_manifest(lake, TRAINING, partition)
        if manifest is None or manifest.extra.get("split_rule") != split_rule(config):
            continue
        sides |= {(kind, value): side for kind, value, side in manifest.extra.get("sides", [])}
    return sides


def split_rule(config: PrepareConfig) -> str:
    """Hash of `split_settings`."""
    return config_hash(split_settings(config))


def split_settings(config: PrepareConfig) -> dict[str, Any]:
    """Settings that determine the names of places and the sides of keys, by the names that lakes store."""
    split = {name: getattr(config.split, name) for name in _OF_SPLIT}
    return {"split_by": config.split.by, **split, "seed": config.seed}
