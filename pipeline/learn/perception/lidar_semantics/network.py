"""The network: a few convolutions over the range image, wide along the rings."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pipeline.learn.perception.lidar_semantics.labels import LABELS

__all__ = ["SweepNetwork", "build_sweep_network"]

_CHANNELS = 5
_DILATIONS = ((1, 1), (1, 2), (2, 4), (1, 1))  # rows, columns


class SweepNetwork(nn.Module):
    """Normalised range image to logits of the 20 labels: 60 k parameters at width 16. Even numbers of columns."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.first = nn.Conv2d(_CHANNELS, width, 3, padding=1)
        self.down = nn.Conv2d(width, 2 * width, 3, stride=(1, 2), padding=1)
        self.blocks = nn.ModuleList(
            nn.Conv2d(2 * width, 2 * width, 3, padding=d, dilation=d) for d in _DILATIONS
        )
        self.up = nn.Conv2d(3 * width, width, 3, padding=1)
        self.last = nn.Conv2d(width, len(LABELS), 1)

    def forward(self, image: Float[Tensor, "B 5 H W"]) -> Float[Tensor, "B L H W"]:
        """Logits."""
        fine = torch.relu(self.first(image))
        x = torch.relu(self.down(fine))
        for block in self.blocks:
            x = x + torch.relu(block(x))
        x = functional.interpolate(x, scale_factor=(1.0, 2.0), mode="nearest")
        logits: Tensor = self.last(torch.relu(self.up(torch.cat([fine, x], dim=1))))
        return logits


def build_sweep_network(width: int, seed: int) -> SweepNetwork:
    """Fresh weights; the caller's random state stays as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SweepNetwork(width)
