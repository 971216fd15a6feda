"""Where training's batches come from: the loader, or a whole split held on the device."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, replace
from typing import Any, Protocol, runtime_checkable

import torch

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.batches.loader import TrainingLoader, load_split
from pipeline.learn.train.processes import Processes
from pipeline.learn.train.settings import TrainConfig
from pipeline.store.partitions import Lake

__all__ = ["BatchStream", "batch_stream", "frames_at"]


@runtime_checkable
class BatchStream(Protocol):
    """Batches without end, on the device, and the place in them."""

    @property
    def frames(self) -> int:
        """Frames of the split."""
        ...

    def batch(self, step: int) -> TrainingBatch:
        """The batch of a step; steps are asked for in order."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The place after the last batch."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on there."""
        ...

    def close(self) -> None:
        """Let go of threads and memory."""
        ...


def batch_stream(data: str, config: TrainConfig, processes: Processes, *, resident: bool) -> BatchStream:
    """Batches of the split `train` for this process.

    Raises:
        ContractError: there are none.
    """
    if resident:
        return _ResidentStream(data, config, processes)
    rank_of = (processes.rank, processes.count)
    loader = TrainingLoader(Lake.at(data), config.batch_size, seed=config.seed, rank_of=rank_of)
    return _LoaderStream(loader, processes.device)


def frames_at(batch: TrainingBatch, rows: torch.Tensor) -> TrainingBatch:
    """Some frames of a batch, in the order given."""
    rows = rows.to(batch.T_camera_lidar.device)
    values: dict[str, Any] = {f.name: getattr(batch, f.name) for f in fields(batch)}
    picked: dict[str, Any] = {n: v[rows] for n, v in values.items() if isinstance(v, torch.Tensor)}
    for name in ("vehicle", "day", "environment"):
        picked[name] = tuple(values[name][i] for i in rows.tolist())
    return replace(batch, **picked)


class _LoaderStream:
    """The loader's batches; on a GPU the next one is fetched while the current one is used."""

    def __init__(self, loader: TrainingLoader, device: torch.device) -> None:
        self._loader, self._device = loader, device
        self._ahead = ThreadPoolExecutor(1, "next-batch") if device.type == "cuda" else None
        self._next: Future[tuple[TrainingBatch, dict[str, Any]]] | None = None
        self._place = loader.state_dict()

    @property
    def frames(self) -> int:
        return self._loader.frames

    def batch(self, step: int) -> TrainingBatch:
        del step
        if self._ahead is None:
            batch, self._place = self._fetch()
            return batch
        future = self._next or self._ahead.submit(self._fetch)
        batch, self._place = future.result()
        self._next = self._ahead.submit(self._fetch)
        return batch.to(self._device, non_blocking=True)

    def state_dict(self) -> dict[str, Any]:
        return self._place

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._loader.load_state_dict(state)
        self._place = state

    def close(self) -> None:
        if self._ahead is not None:
            self._ahead.shutdown(wait=True, cancel_futures=True)
        self._loader.close()

    def _fetch(self) -> tuple[TrainingBatch, dict[str, Any]]:
        batch = next(self._loader)
        place = self._loader.state_dict()
        return (batch.pin_memory() if self._device.type == "cuda" else batch), place


class _ResidentStream:
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
        return frames_at(self._all, order[place * self._size : (place + 1) * self._size])

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        del state

    def close(self) -> None:
        return
