"""The paper's network: three encoders, concatenation, fusion, three heads of Euler angles and translations.

Source: paper, figure 6 and "SSL-based method"; layer sizes are not given there and are chosen here.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn

from pipeline.learn.network.encoders import standardised
from pipeline.learn.network.outputs import CoreOutputs, Heads
from pipeline.learn.network.views import RenderedView
from pipeline.learn.sample.layout import CAMERA_CHANNELS, LIDAR_CHANNELS, PAIRS, RADAR_CHANNELS, NetworkConfig

__all__ = ["ConcatCore"]

_CHANNELS = {"camera": CAMERA_CHANNELS, "lidar": LIDAR_CHANNELS, "radar": RADAR_CHANNELS}
_STD = 1e-2  # heads start near no correction


class ConcatCore(nn.Module):
    """Network on one rendered view, for the sensors of its pairs."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        grid, pairs, width = config.grid, config.estimated, config.width
        channels = {name: _CHANNELS[name] for name in _CHANNELS if any(name in pair for pair in pairs)}
        self.encoders = nn.ModuleDict({name: _encoder(c, width) for name, c in channels.items()})
        self.fusion = nn.Sequential(
            nn.Conv2d(4 * width * len(channels), 6 * width, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(6 * width, 6 * width, 3, 2, 1),
            nn.ReLU(),
        )
        # Where something is must survive: averages over 2 x 4 regions, as a product that every exporter knows.
        rows, columns = -(-grid.height // 64), -(-grid.width // 64)
        one_hot = torch.eye(rows * columns).reshape(-1, 1, rows, columns)
        regions = nn.functional.adaptive_avg_pool2d(one_hot, (2, 4)).flatten(1)
        self.register_buffer("regions", regions, persistent=False)
        self.last = nn.Sequential(nn.Linear(6 * width * 8, config.hidden), nn.ReLU())
        self.heads = Heads(config.hidden, pairs, _STD)

    def forward(self, view: RenderedView) -> CoreOutputs:
        """Corrections and log variances from the sensors' grids at the current guess."""
        grids = {"camera": standardised(view.camera), "lidar": view.lidar_grid, "radar": view.radar_grid}
        maps = self.fusion(torch.cat([encoder(grids[name]) for name, encoder in self.encoders.items()], 1))
        fused = self.last((maps.flatten(2) @ self.regions).flatten(1))
        found = self.heads(fused)
        identity = torch.eye(4, device=fused.device).expand(len(fused), 4, 4)
        start = self.heads.start.expand(len(fused), 6)
        corrections = [found[pair][0] if pair in found else identity for pair in PAIRS]
        log_variance = [start + found[pair][1] if pair in found else start for pair in PAIRS]
        return CoreOutputs(torch.stack(corrections, 1), torch.stack(log_variance, 1))


def _encoder(channels: int, width: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    sizes = (channels, width, 2 * width, 3 * width, 4 * width)
    for inputs, outputs in pairwise(sizes):
        layers += [
            nn.Conv2d(inputs, outputs, 3, 2, 1, bias=False),
            nn.GroupNorm(max(1, outputs // 8), outputs),
            nn.ReLU(),
        ]
    return nn.Sequential(*layers)
