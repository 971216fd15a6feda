"""Sides that earlier runs gave, which stay: a frame that tested one network must not train the next."""

from __future__ import annotations

from pipeline.config import PrepareConfig, config_hash
from pipeline.store.partitions import Lake
from pipeline.store.tables import read_manifest
from schemas.training import TRAINING

__all__ = ["SPLIT_SETTINGS", "decided_sides", "split_rule"]

# By which places get their names and keys their sides.
SPLIT_SETTINGS = ("split_by", "val_fraction", "test_fraction", "positions", "place_m", "place_s", "seed")


def decided_sides(lake: Lake, config: PrepareConfig) -> dict[tuple[str, str], str]:
    """Sides of the vehicles, days and places in the lake's table `training`.

    Empty for a table split by other keys, shares or seed: it is made anew as a whole.
    """
    sides: dict[tuple[str, str], str] = {}
    for partition in lake.partitions(TRAINING.name):
        manifest = read_manifest(lake, TRAINING, partition)
        if manifest is None or manifest.extra.get("split_rule") != split_rule(config):
            continue
        sides |= {(kind, value): side for kind, value, side in manifest.extra.get("sides", [])}
    return sides


def split_rule(config: PrepareConfig) -> str:
    """A hash of the settings by which places get their names and keys their sides."""
    return config_hash({name: getattr(config, name) for name in SPLIT_SETTINGS})
