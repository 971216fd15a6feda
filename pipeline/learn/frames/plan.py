"""Frames of an export by vehicle-day and split, stored with the export so that later runs agree."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.core.config import PrepareConfig
from pipeline.core.errors import ConfigError
from pipeline.core.results import Progress
from pipeline.learn.frames.frame import Place, to_json
from pipeline.learn.frames.output import Output
from pipeline.learn.prepare.sides import decided_sides, frame_sides, settled_keys, split_settings
from pipeline.learn.prepare.survey import plan_days, survey_day
from pipeline.store.partitions import Lake, Partition
from schemas.training import SPLITS

__all__ = ["Planned", "plan_frames"]

_FILE = "plan.json"
_KEYS = {"split_by": "[prepare.split] by", "seed": "[prepare] seed"}  # in fleet.toml, of `split_settings`
Planned = dict[Partition, tuple[list[Place], Counter[str]]]  # wanted frames, and those left out by reason


def plan_frames(
    lake: Lake,
    days: Sequence[Partition],
    config: PrepareConfig,
    output: Output,
    settings: Mapping[str, Any],
    progress: Progress,
) -> tuple[Planned, dict[str, Any]]:
    """Divide the frames of all days by `[prepare]`; splits of earlier runs and of table `training` stay.

    Returns the frames, and the settings of the export with those of its splits.

    Raises:
        ConfigError: the export was begun with other settings, or a requested split is empty.
    """
    before = output.read(_FILE)
    if before is not None:
        config = _as_begun(config, settings, before["settings"])
    surveys = []
    for done, day in enumerate(days):
        progress(done, len(days), f"{day.vehicle} {day.day}")
        surveys.append(survey_day(day, lake, config))
    decided = {}
    if before is not None:
        decided = {(kind, value): side for kind, value, side in before["sides"]}
    else:
        config = config.split_with(by=settled_keys(surveys, config, lake))
        decided = decided_sides(lake, config)
    plan = plan_days(surveys, config, decided)
    planned: Planned = {}
    for survey in surveys:
        sides, lost = frame_sides(survey, plan, config)
        wanted = [k for k, side in enumerate(sides) if side is not None]
        places = [Place(k, sides[k] or "", survey.place[k], survey.environment[k]) for k in wanted]
        planned[survey.partition] = places, lost
    _require_splits(config, planned)
    all_sides = sorted([kind, value, side] for (kind, value), side in (decided | dict(plan.sides)).items())
    whole = _with_split(settings, config)
    output.write(_FILE, to_json({"settings": whole, "sides": all_sides}))
    return planned, whole


def _as_begun(config: PrepareConfig, settings: Mapping[str, Any], begun: Mapping[str, Any]) -> PrepareConfig:
    """The configuration with the keys of the export that was begun; ConfigError if anything else differs."""
    if "by" not in config.split.model_fields_set:
        config = config.split_with(by=tuple(begun["split"]["split_by"]))
    now = _with_split(settings, config)
    changed = [n for n in settings if begun.get(n) != now[n]]
    changed += [
        _KEYS.get(n, f"[prepare.split] {n}")
        for n, value in now["split"].items()
        if begun["split"][n] != value
    ]
    if changed:
        raise ConfigError("command line", "out", f"holds an export with another {', '.join(changed)}")
    return config


def _with_split(settings: Mapping[str, Any], config: PrepareConfig) -> dict[str, Any]:
    """The settings, and those that name places, because different places with the same name would leak."""
    whole: dict[str, Any] = json.loads(to_json({**settings, "split": split_settings(config)}))
    return whole


def _require_splits(config: PrepareConfig, planned: Planned) -> None:
    """Raise ConfigError if a requested split has no frame."""
    counts = Counter(place.split for places, _ in planned.values() for place in places)
    shares = dict(zip(SPLITS, (1.0, config.split.val_fraction, config.split.test_fraction), strict=True))
    empty = [side for side, share in shares.items() if share > 0 and not counts[side]]
    if empty:
        problem = (
            f"no frames for {', '.join(empty)}: too few vehicles, days and places to keep splits apart by "
            f'{", ".join(config.split.by)}; set by = "place", or export with --unsplit: all into train'
        )
        raise ConfigError("fleet.toml", "prepare.split.by", problem)
