"""Which frames of which vehicle-days go out and to which split; kept beside the export, so that later runs agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.config import PrepareConfig
from pipeline.errors import ConfigError
from pipeline.learn.frames.facts import to_json
from pipeline.learn.frames.frame import Place
from pipeline.learn.frames.output import Output
from pipeline.learn.prepare.sides import frame_sides
from pipeline.learn.prepare.stage import decided_sides
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.results import Progress
from pipeline.store.partitions import Lake, Partition
from schemas.training import SPLITS

__all__ = ["Planned", "plan_frames"]

_FILE = "plan.json"
Planned = dict[Partition, tuple[list[Place], Counter[str]]]  # wanted frames, and those left out by reason


def plan_frames(
    lake: Lake,
    days: Sequence[Partition],
    config: PrepareConfig,
    output: Output,
    settings: Mapping[str, Any],
    progress: Progress,
) -> Planned:
    """Divide the frames of all days as `[prepare]` says; what an earlier run of this export decided stays decided.

    Vehicles, days and places that the table `training` has given to a split keep it.

    Raises:
        ConfigError: the place holds an export with other settings, or a split that is wanted is empty.
    """
    before = output.read(_FILE)
    if before is not None and before["settings"] != settings:
        changed = [n for n in settings if before["settings"].get(n) != settings[n]]
        raise ConfigError("command line", "out", f"holds an export with another {', '.join(changed)}")
    decided, first = decided_sides(lake, config), {}
    if before is not None:
        decided = {(kind, value): side for kind, value, side in before["sides"]}
        first = before["first"]
    surveys = []
    for done, day in enumerate(days):
        progress(done, len(days), f"{day.vehicle} {day.day}")
        surveys.append(survey_day(day, lake, config))
    plan = plan_days(surveys, config, decided)
    following = max((number + count for number, count in first.values()), default=0)
    planned: Planned = {}
    for survey in surveys:
        sides, lost = frame_sides(survey, plan, config)
        wanted = [k for k, side in enumerate(sides) if side is not None]
        name = survey.partition.folder
        number, count = first.get(name, (following, 0))
        if count < len(wanted):
            number, first[name] = following, [following, len(wanted)]
            following += len(wanted)
        planned[survey.partition] = (
            [
                Place(k, number + n, sides[k] or "", survey.place[k], survey.environment[k])
                for n, k in enumerate(wanted)
            ],
            lost,
        )
    _require_splits(config, planned)
    all_sides = sorted([kind, value, side] for (kind, value), side in (decided | dict(plan.sides)).items())
    output.write(_FILE, to_json({"settings": dict(settings), "sides": all_sides, "first": first}))
    return planned


def _require_splits(config: PrepareConfig, planned: Planned) -> None:
    """Raise ConfigError where a split that is asked for has no frame."""
    counts = Counter(place.split for places, _ in planned.values() for place in places)
    shares = dict(zip(SPLITS, (1.0, config.val_fraction, config.test_fraction), strict=True))
    empty = [side for side, share in shares.items() if share > 0 and not counts[side]]
    if empty:
        problem = (
            f"no frames for {', '.join(empty)}: too few vehicles, days and places to keep splits apart by "
            f'{", ".join(config.split_by)}; set split_by = "place", or val_fraction and test_fraction to 0'
        )
        raise ConfigError("fleet.toml", "prepare.split_by", problem)
