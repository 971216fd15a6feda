"""The network: convolutions over the polar grid that see far along a direction, and little to its sides."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.geometry.radar_grid import CHANNELS

__all__ = ["DrivableNetwork", "build_drivable_network"]

_DILATIONS = ((1, 1), (1, 2), (2, 4), (2, 8), (1, 1))  # directions, ranges


class DrivableNetwork(nn.Module):
    """Features to the logit that a cell is drivable: 27 k parameters at width 24."""

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.first = nn.Conv2d(len(CHANNELS), width, 3, padding=1)
        self.blocks = nn.ModuleList(nn.Conv2d(width, width, 3, padding=d, dilation=d) for d in _DILATIONS)
        self.last = nn.Conv2d(width, 1, 1)

    def forward(self, features: Float[Tensor, "B C A R"]) -> Float[Tensor, "B A R"]:
        """Logits."""
        x = torch.relu(self.first(features))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        logits: Tensor = self.last(x)[:, 0]
        return logits


def build_drivable_network(width: int, seed: int) -> DrivableNetwork:
    """Fresh weights; the caller's random state stays as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return DrivableNetwork(width)
