"""Side of every frame by a plan, what is lost and why; and what other ways to split the same days would cost."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config import PrepareConfig
from pipeline.learn.prepare.split import SplitPlan
from pipeline.learn.prepare.survey import Survey, plan_days
from pipeline.learn.sample.frame_sample import SampleReason
from schemas.training import SPLITS

__all__ = ["Choice", "frame_sides", "price_choices"]

# What a question may need: nothing shared at all, or unseen vehicles, days, streets.
_CHOICES = (("vehicle", "day", "place"), ("vehicle", "place"), ("vehicle",), ("day",), ("place",))


@dataclass(frozen=True)
class Choice:
    """What a way to split costs: frames that each side gets, frames lost by reason, vehicle-days without a frame."""

    split_by: tuple[str, ...]
    frames: dict[str, int]
    lost: dict[str, int]
    empty_vehicle_days: int
    chosen: bool


def price_choices(surveys: Sequence[Survey], plan: SplitPlan, config: PrepareConfig) -> list[Choice]:
    """The plan at hand, then the other ways to split as if the table were made anew.

    A frame that no sample can be made of for what it shows (no prior, say) counts as kept here: nothing was read yet.
    """
    ways = [tuple(plan.by), *(c for c in _CHOICES if set(c) != set(plan.by))]
    out = []
    for way in ways:
        chosen = way == tuple(plan.by)
        settings = config if chosen else config.model_copy(update={"split_by": way})
        out.append(_price(surveys, plan if chosen else plan_days(surveys, settings, {}), settings, chosen))
    return out


def frame_sides(
    survey: Survey, plan: SplitPlan, config: PrepareConfig
) -> tuple[list[str | None], Counter[str]]:
    """Side of each frame, None where it is left out, and how many are left out by reason."""
    vehicle, day = survey.partition.vehicle, survey.partition.day
    sides = np.array([plan.side_of(vehicle, day, place) or "" for place in survey.place])
    reasons = np.full(len(sides), "", object)
    reasons[sides == ""] = SampleReason.SPLIT_CONFLICT.value
    reasons[(reasons == "") & _near_other_side(survey, sides, config.guard_s)] = (
        SampleReason.NEXT_TO_OTHER_SPLIT.value
    )
    reasons[~survey.moved] = SampleReason.HARDLY_MOVED.value
    reasons[~survey.perceived] = SampleReason.NOT_PERCEIVED.value
    kept = np.flatnonzero(reasons == "")
    if config.max_frames is not None and len(kept) > config.max_frames:
        spread = np.linspace(0, len(kept) - 1, config.max_frames).astype(int)
        reasons[np.setdiff1d(kept, kept[spread])] = SampleReason.NOT_NEEDED.value
    counts: Counter[str] = Counter(str(r) for r in reasons if r)
    return [str(s) if not r else None for s, r in zip(sides, reasons, strict=True)], counts


def _near_other_side(survey: Survey, sides: np.ndarray, guard_s: float) -> np.ndarray:
    """True where a frame of the same day on another side is nearer in time than the guard."""
    near = np.zeros(len(sides), bool)
    for i, j in itertools.pairwise(range(len(sides))):
        if sides[i] == sides[j]:
            continue
        border = (survey.stamp_s[i] + survey.stamp_s[j]) / 2
        near |= np.abs(survey.stamp_s - border) < guard_s / 2
    return near


def _price(surveys: Sequence[Survey], plan: SplitPlan, config: PrepareConfig, chosen: bool) -> Choice:
    frames, lost, empty = Counter(dict.fromkeys(SPLITS, 0)), Counter[str](), 0
    for survey in surveys:
        sides, rejected = frame_sides(survey, plan, config)
        kept = Counter(side for side in sides if side is not None)
        frames.update(kept)
        lost.update(rejected)
        empty += not kept
    return Choice(plan.by, dict(frames), dict(lost), empty, chosen)
