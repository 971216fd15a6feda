"""Where training's batches come from: the loader, and onto the device."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import TrainingLoader
from pipeline.learn.train.processes import Processes
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["BatchStream"]


class BatchStream:
    """Endless batches of split `train` for this process, prefetched on a GPU; else ContractError."""

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

    def batch(self) -> TrainingBatch:
        """The next step's batch, on the device."""
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
        """Release threads and memory."""
        if self._ahead is not None:
            self._ahead.shutdown(wait=True, cancel_futures=True)
        self._loader.close()

    def _fetch(self) -> tuple[TrainingBatch, dict[str, Any]]:
        batch = next(self._loader)
        place = self._loader.state_dict()
        return (batch.pin_memory() if self._device.type == "cuda" else batch), place
