"""The paper's network: three encoders, concatenation, fusion, three heads of Euler angles and translations.

Source: paper, figure 6 and "SSL-based method"; layer sizes are not given there and are chosen here.
"""

from __future__ import annotations

import torch
from torch import nn

from pipeline.learn.encoders import standardised
from pipeline.learn.outputs import PAIRS, CoreOutputs, Heads
from pipeline.learn.views import LIDAR_CHANNELS, RADAR_CHANNELS, RenderedView

__all__ = ["ConcatCore"]

_CHANNELS = {"camera": 4, "lidar": LIDAR_CHANNELS, "radar": RADAR_CHANNELS}
_STD = 1e-2  # heads start near no correction


class ConcatCore(nn.Module):
    """What is computed from one rendered view, for those sensors that the pairs need."""

    def __init__(self, pairs: tuple[str, ...], width: int, hidden: int) -> None:
        super().__init__()
        self.pairs = pairs
        self.composed = False
        channels = {name: _CHANNELS[name] for name in _CHANNELS if any(name in pair for pair in pairs)}
        self.encoders = nn.ModuleDict({name: _encoder(c, width) for name, c in channels.items()})
        self.fusion = nn.Sequential(
            nn.Conv2d(4 * width * len(channels), 6 * width, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(6 * width, 6 * width, 3, 2, 1),
            nn.ReLU(),
            # Where something is must survive: a small grid, not a mean.
            nn.AdaptiveAvgPool2d((2, 4)),
            nn.Flatten(),
            nn.Linear(6 * width * 8, hidden),
            nn.ReLU(),
        )

        self.heads = Heads(hidden, pairs, _STD)

    def forward(self, view: RenderedView) -> CoreOutputs:
        """Corrections and doubt from the sensors' grids at the current guess."""
        grids = {
            "camera": standardised(view.camera),
            "lidar": view.lidar_grid,
            "radar": view.radar_grid,
        }
        fused = self.fusion(torch.cat([encoder(grids[name]) for name, encoder in self.encoders.items()], 1))
        found = self.heads(fused)
        identity = torch.eye(4, device=fused.device).expand(len(fused), 4, 4)
        start = self.heads.start.expand(len(fused), 6)
        corrections = [found[pair][0] if pair in found else identity for pair in PAIRS]
        log_variance = [start + found[pair][1] if pair in found else start for pair in PAIRS]
        return CoreOutputs(torch.stack(corrections, 1), torch.stack(log_variance, 1))


def _encoder(channels: int, width: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    sizes = (channels, width, 2 * width, 3 * width, 4 * width)
    for inputs, outputs in zip(sizes, sizes[1:], strict=False):
        layers += [
            nn.Conv2d(inputs, outputs, 3, 2, 1, bias=False),
            nn.GroupNorm(max(1, outputs // 8), outputs),
            nn.ReLU(),
        ]
    return nn.Sequential(*layers)
