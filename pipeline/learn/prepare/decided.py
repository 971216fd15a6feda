"""Sides from earlier runs, which are kept, because a frame that tested one network must not train the next."""

from __future__ import annotations

from typing import Any

from pipeline.core.config import PrepareConfig, config_hash
from pipeline.store.partitions import Lake
from pipeline.store.tables import read_manifest
from schemas.training import TRAINING

__all__ = ["decided_sides", "split_rule", "split_settings"]

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
