"""Counts of table `training` by side and environment, and similar frames of two sides.

The split separates vehicles, days and places. This module compares images, because a place can have two names.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.core.errors import ContractError
from pipeline.store.atomic_write import atomic_write
from pipeline.store.partitions import Lake, Partition
from pipeline.store.tables import read_columns, read_manifest
from schemas.training import SPLITS, TRAINING

__all__ = ["Inventory", "doubts", "read_leaks", "require_sides", "take_inventory", "write_inventory"]

_CHUNK = 4096
_COLUMNS = ("frame_index", "split", "environment", "fingerprint")


@dataclass(frozen=True)
class Inventory:
    """Counts of a whole table; `leaks` are frames of val and test that are similar to one of an earlier side."""

    frames: dict[str, int]
    environments: dict[str, dict[str, int]]
    vehicles: dict[str, list[str]]
    days: dict[str, list[str]]
    rejected: dict[str, int]
    leaks: list[tuple[str, str, int]] = field(default_factory=list)  # vehicle, day, frame_index


def take_inventory(lake: Lake, duplicate_bits: int) -> Inventory:
    """Inventory of all partitions; frames with fewer differing bits are similar (0 = not tested)."""
    rejected: Counter[str] = Counter()
    frames: dict[str, list[tuple[str, str, str, int]]] = {side: [] for side in SPLITS}  # environment first
    views: dict[str, list[np.ndarray]] = {side: [] for side in SPLITS}
    for partition in lake.partitions(TRAINING.name):
        manifest = read_manifest(lake, TRAINING, partition)
        rejected.update(manifest.rejected if manifest else {})
        light = read_columns(lake, TRAINING, partition, _COLUMNS)
        for index, side, environment, bits in zip(*(light[name] for name in _COLUMNS), strict=True):
            views[side].append(np.frombuffer(bits, np.uint8))
            frames[side].append((environment, partition.vehicle, partition.day, index))
    return Inventory(
        {side: len(frames[side]) for side in SPLITS},
        {side: dict(Counter(f[0] for f in frames[side])) for side in SPLITS},
        {side: sorted({f[1] for f in frames[side]}) for side in SPLITS},
        {side: sorted({f[2] for f in frames[side]}) for side in SPLITS},
        dict(rejected),
        _leaks(views, {side: [f[1:] for f in own] for side, own in frames.items()}, duplicate_bits),
    )


def _alike(
    views: UInt8[np.ndarray, "N 32"], others: UInt8[np.ndarray, "M 32"], bits: int
) -> Bool[np.ndarray, " N"]:
    """True for views that differ from one of the others in fewer than `bits` of 256 bits."""
    out = np.zeros(len(views), bool)
    for a in range(0, len(views), _CHUNK):
        mine = _signs(views[a : a + _CHUNK])
        for b in range(0, len(others), _CHUNK):
            # Bits as +-1: their product is 256 less twice the number that differ.
            differing = (256 - mine @ _signs(others[b : b + _CHUNK]).T) / 2
            out[a : a + _CHUNK] |= (differing < bits).any(axis=1)
    return out


def _path(lake: Lake) -> Path:
    return lake.local_root / TRAINING.name / "manifest.json"


def write_inventory(lake: Lake, inventory: Inventory, about: dict[str, Any]) -> Path:
    """Write `training/manifest.json` next to the partitions, with the run's facts in `about`."""
    path = _path(lake)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = about | inventory.__dict__
    with atomic_write(path) as stream:
        stream.write((json.dumps(content, indent=2, sort_keys=True) + "\n").encode())
    return path


def read_leaks(lake: Lake) -> dict[Partition, set[int]]:
    """Frames that must not be used, by partition; empty without an inventory."""
    out: dict[Partition, set[int]] = defaultdict(set)
    if (path := _path(lake)).exists():
        for vehicle, day, index in json.loads(path.read_text())["leaks"]:
            out[Partition(vehicle, day)].add(index)
    return out


def require_sides(lake: Lake) -> None:
    """Raise ContractError if the inventory has no training frame, or lacks requested validation frames."""
    if not (path := _path(lake)).exists():
        return
    told = json.loads(path.read_text())
    wanted = ["train", *(["val"] if told["settings"]["split"]["val_fraction"] > 0 else [])]
    if empty := [side for side in wanted if not told["frames"][side]]:
        problem = (
            f"no frames on side {', '.join(empty)}: run prepare again with more vehicle-days or another "
            "[prepare.split] by (`boresight prepare` names one); val_fraction = 0 trains without validation"
        )
        raise ContractError(str(path), problem)


def doubts(lake: Lake, *, referenced: bool) -> list[str]:
    """What a user should know of the frames before a network learns from them; `referenced` as of `TrainingLoader`."""
    drives, without = set(), []
    for day in lake.partitions(TRAINING.name):
        light = read_columns(lake, TRAINING, day, ("drive", "split", "reference"))
        if referenced and "prior" in light["reference"]:
            without.append(f"{day.vehicle} {day.day}")
        else:
            rows = zip(light["drive"], light["split"], strict=True)
            drives |= {(day, drive) for drive, side in rows if side == "train"}
    found = []
    if without:
        named = ", ".join(without[:5]) + (" ..." if len(without) > 5 else "")
        told = "run `boresight calibrate`, then `boresight prepare`"
        found.append(f"left out, because method joint has no usable record of them: {named}; {told}")
    if len(drives) == 1:
        found.append(
            "all frames of side train are of one drive: add drives, or the network learns that street only"
        )
    return found


def _leaks(
    views: dict[str, list[np.ndarray]], names: dict[str, list[tuple[str, str, int]]], bits: int
) -> list[tuple[str, str, int]]:
    found: list[tuple[str, str, int]] = []
    stacked = {side: np.array(v, np.uint8).reshape(-1, 32) for side, v in views.items()}
    # Test frames stay wherever they can: val gives way to test, both to train.
    for side, others in (("val", ("train", "test")), ("test", ("train",))):
        same = np.zeros(len(stacked[side]), bool)
        for other in others:
            same |= _alike(stacked[side], stacked[other], bits)
        found += [names[side][i] for i in np.flatnonzero(same)]
    return found


def _signs(views: np.ndarray) -> Float32[np.ndarray, "N 256"]:
    return np.unpackbits(views, axis=1).astype(np.float32) * 2 - 1
