"""Batches of table `training`: shuffled by row group, the same for the same seed, resumed to the frame.

The order of an epoch is decided before anything is read, so that a place in the stream is two numbers (epoch, frames
taken): row groups in random order, cut into windows, and the frames of each window in random order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from pipeline.core.errors import ContractError
from pipeline.learn.batches.batch import TrainingBatch, collate
from pipeline.learn.prepare.inventory import read_leaks
from pipeline.store.partitions import Lake
from pipeline.store.tables import RowGroup, read_columns, read_group, read_manifest, row_groups
from schemas.training import TRAINING, TrainingRow

__all__ = ["TrainingLoader", "load_split"]


class TrainingLoader:
    """Batches of side train, epoch after epoch without end.

    Args:
        seed: of the frames' order, the same on all ranks.
        rank_of: rank of this process and number of processes; each takes its own row groups.
        referenced: leave out days without a usable record of `joint`.
        window_groups: row groups that are mixed with each other and held in memory, twice (5-10 MB each).

    Raises:
        ContractError: there is no frame to train on, or fewer row groups than ranks.
    """

    def __init__(
        self, lake: Lake, batch_size: int, *, seed: int = 0, rank_of: tuple[int, int] = (0, 1),
        referenced: bool = False, window_groups: int = 16,
    ) -> None:  # fmt: skip
        self._lake, self._batch_size, self._seed = lake, batch_size, seed
        (self._rank, self._ranks), self._window = rank_of, window_groups
        self._chunks, self._data_key = _find_chunks(lake, "train", referenced)
        if len(self._chunks) < self._ranks:
            problem = f"train has {len(self._chunks)} row groups, not enough for {self._ranks} processes"
            raise ContractError(str(lake.root / TRAINING.name), problem)
        self._epoch, self._taken = 0, 0
        self._ordered_epoch = self._held_window = -1
        self._order: list[tuple[int, RowGroup, int]] = []  # window, group and row of each frame
        self._windows: list[list[RowGroup]] = []
        self._reader = ThreadPoolExecutor(1, "training-reader")
        self._held: dict[RowGroup, Future[list[TrainingRow]]] = {}

    @property
    def frames(self) -> int:
        """Frames of the split, on all ranks."""
        return sum(len(rows) for _, rows in self._chunks)

    def __iter__(self) -> Iterator[TrainingBatch]:
        return self

    def __next__(self) -> TrainingBatch:
        rows: list[TrainingRow] = []
        while len(rows) < self._batch_size:
            self._order_epoch()
            if self._taken == len(self._order):
                self._epoch, self._taken = self._epoch + 1, 0
                continue
            rows.append(self._row(self._taken))
            self._taken += 1
        return collate(rows)

    def state_dict(self) -> dict[str, Any]:
        """The place in the stream, after the last batch that was handed out."""
        order = [self._seed, True, self._rank, self._ranks, self._window]
        return {"epoch": self._epoch, "taken": self._taken, "data": self._data_key, "order": order}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue at a `state_dict`; raises ContractError if the table or the order differs."""
        here = self.state_dict()
        for name, what in (("data", "table training"), ("order", "seed or processes")):
            if list(state[name]) != list(here[name]):
                raise ContractError(str(self._lake.root / TRAINING.name), f"cannot resume: other {what}")
        self._epoch, self._taken = int(state["epoch"]), int(state["taken"])

    def close(self) -> None:
        """Stop reading ahead."""
        self._reader.shutdown(wait=True, cancel_futures=True)
        self._held.clear()

    def _order_epoch(self) -> None:
        """Decide the order of the current epoch, once."""
        if self._ordered_epoch == self._epoch:
            return
        rng = np.random.default_rng([self._seed, self._epoch])
        order = rng.permutation(len(self._chunks))
        mine = [self._chunks[i] for i in order[self._rank :: self._ranks]]
        # Every rank draws for itself; drawing more on one must not change another's order.
        rng = np.random.default_rng([self._seed, self._epoch, 1 + self._rank])
        self._order, self._windows = [], []
        for first in range(0, len(mine), self._window):
            window = mine[first : first + self._window]
            frames = [(len(self._windows), group, row) for group, rows in window for row in rows]
            self._order += [frames[i] for i in rng.permutation(len(frames))]
            self._windows.append([group for group, _ in window])
        self._ordered_epoch, self._held_window = self._epoch, -1

    def _row(self, position: int) -> TrainingRow:
        """A row of the current window, which is in memory with the next one; all others are dropped."""
        window, group, row = self._order[position]
        if window != self._held_window:
            held, self._held = self._held, {}
            for wanted in (g for groups in self._windows[window : window + 2] for g in groups):
                self._held[wanted] = held.get(wanted) or self._reader.submit(
                    read_group, self._lake, TRAINING, wanted, TrainingRow
                )
            self._held_window = window
        return self._held[group].result()[row]


def load_split(
    lake: Lake, split: str, *, limit: int | None = None, referenced: bool = False
) -> TrainingBatch:
    """All frames of a split (at most `limit`, evenly spread) as one batch; `referenced` as of `TrainingLoader`."""
    chunks, _ = _find_chunks(lake, split, referenced)
    frames = [(group, row) for group, own in chunks for row in own]
    if limit is not None and len(frames) > limit:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, limit).astype(int)]
    rows: list[TrainingRow] = []
    for group in dict.fromkeys(group for group, _ in frames):
        content = read_group(lake, TRAINING, group, TrainingRow)
        rows += [content[row] for g, row in frames if g == group]
    return collate(rows)


def _find_chunks(
    lake: Lake, split: str, referenced: bool
) -> tuple[list[tuple[RowGroup, tuple[int, ...]]], list[str]]:
    """Row groups with those of their rows that belong to the split, in order, and their work keys."""
    leaks = read_leaks(lake)
    chunks, keys = [], []
    for partition in lake.partitions(TRAINING.name):
        light = read_columns(lake, TRAINING, partition, ["frame_index", "split", "reference"])
        barred = leaks.get(partition, set())
        wanted = [
            side == split and index not in barred and (reference == "joint" or not referenced)
            for index, side, reference in zip(*light.values(), strict=True)
        ]
        first = 0
        for group in row_groups(lake, TRAINING, partition):
            rows = tuple(i for i in range(group.rows) if wanted[first + i])
            first += group.rows
            if rows:
                chunks.append((group, rows))
        manifest = read_manifest(lake, TRAINING, partition)
        keys.append(manifest.work_key if manifest else "")
    if not chunks:
        missing = "`boresight calibrate` (method joint) for its days, and then " if referenced else ""
        problem = f"no frames of split {split!r}: run {missing}`boresight prepare`"
        raise ContractError(str(lake.root / TRAINING.name), problem)
    barred_key = hashlib.sha256(repr(sorted((p, sorted(i)) for p, i in leaks.items())).encode()).hexdigest()
    return chunks, [split, barred_key[:16], *keys]
