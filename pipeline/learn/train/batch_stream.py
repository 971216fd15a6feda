"""Where training's batches come from: the loader, or a whole split held on the device."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import TrainingLoader, load_split
from pipeline.learn.train.processes import Processes
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["BatchStream", "batch_stream"]


def batch_stream(data: str, config: TrainConfig, processes: Processes, *, resident: bool) -> BatchStream:
    """Batches of the split `train` for this process.

    Raises:
        ContractError: there are none.
    """
    kind = _ResidentStream if resident else BatchStream
    return kind(data, config, processes)


class BatchStream:
    """The loader's batches without end; on a GPU the next one is fetched while the current one is used."""

    def __init__(self, data: str, config: TrainConfig, processes: Processes) -> None:
        rank_of = (processes.rank, processes.count)
        self._loader = TrainingLoader(Lake.at(data), config.batch_size, seed=config.seed, rank_of=rank_of)
        self._device, self._place = processes.device, self._loader.state_dict()
        self._ahead = ThreadPoolExecutor(1, "next-batch") if self._device.type == "cuda" else None
        self._next: Future[tuple[TrainingBatch, dict[str, Any]]] | None = None

    @property
    def frames(self) -> int:
        """Frames of the split."""
        return self._loader.frames

    def batch(self, step: int) -> TrainingBatch:
        """The batch of a step, on the device; steps are asked for in order."""
        del step
        if self._ahead is None:
            batch, self._place = self._fetch()
            return batch
        future = self._next or self._ahead.submit(self._fetch)
        batch, self._place = future.result()
        self._next = self._ahead.submit(self._fetch)
        return batch.to(self._device, non_blocking=True)

    def state_dict(self) -> dict[str, Any]:
        """The place after the last batch."""
        return self._place

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on there."""
        self._loader.load_state_dict(state)
        self._place = state

    def close(self) -> None:
        """Let go of threads and memory."""
        if self._ahead is not None:
            self._ahead.shutdown(wait=True, cancel_futures=True)
        self._loader.close()

    def _fetch(self) -> tuple[TrainingBatch, dict[str, Any]]:
        batch = next(self._loader)
        place = self._loader.state_dict()
        return (batch.pin_memory() if self._device.type == "cuda" else batch), place


class _ResidentStream(BatchStream):
    """All frames on the device; a step's frames are drawn from (seed, step, rank)."""

    def __init__(self, data: str, config: TrainConfig, processes: Processes) -> None:
        self._all = load_split(Lake.at(data), "train").to(processes.device)
        self._size, self._seed, self._processes = config.batch_size, config.seed, processes

    @property
    def frames(self) -> int:
        return len(self._all)

    def batch(self, step: int) -> TrainingBatch:
        count = self._processes.count
        position = step * count + self._processes.rank  # batches of all processes, one after another
        per_epoch = max(1, len(self._all) // self._size)
        epoch, place = divmod(position, per_epoch)
        generator = torch.Generator().manual_seed(hash((self._seed, epoch)) % 2**63)
        order = torch.randperm(len(self._all), generator=generator)
        rows = order[place * self._size : (place + 1) * self._size]
        return self._all.take(rows.to(self._processes.device))

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        del state

    def close(self) -> None:
        return
