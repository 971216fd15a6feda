"""One training process or several: rank, device, and the decisions that all must take together."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import distributed

from pipeline.core.errors import ConfigError

__all__ = ["ALONE", "Processes", "joined"]


@dataclass(frozen=True)
class Processes:
    """This process among those that train together."""

    rank: int
    count: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """True for the one that writes."""
        return self.rank == 0

    def any(self, flags: list[bool]) -> list[bool]:
        """Each flag: true on all as soon as it is true on one, so that all stop after the same step."""
        if self.count == 1:
            return flags
        told = torch.tensor([float(f) for f in flags], device=self.device)
        distributed.all_reduce(told, op=distributed.ReduceOp.MAX)
        return [value > 0 for value in told.tolist()]

    def gather(self, value: Any) -> list[Any]:
        """Everyone's value, by rank; every process must call."""
        if self.count == 1:
            return [value]
        everyone: list[Any] = [None] * self.count
        distributed.all_gather_object(everyone, value)
        return everyone

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Mean over the processes."""
        if self.count > 1:
            distributed.all_reduce(values)
            values = values / self.count
        return values


ALONE = Processes(0, 1, torch.device("cpu"))


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """Join the process group that torchrun described in the environment, or train alone.

    `device` is cpu, cuda (the GPU of this process) or auto; ConfigError if there is none.
    """
    rank, count = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    chosen = _device(device, int(os.environ.get("LOCAL_RANK", "0")))
    if count > 1:
        distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Processes(rank, count, chosen)
    finally:
        if count > 1:
            distributed.destroy_process_group()


def _device(name: str, local_rank: int) -> torch.device:
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise ConfigError("train", "device", "no CUDA device here; use cpu")
    device = torch.device("cuda", local_rank)
    torch.cuda.set_device(device)
    return device
