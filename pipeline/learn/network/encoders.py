"""Small convolutional encoders: camera and rendered lidar to class logits per cell, radar points to class logits."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.sample.grid import CAMERA_CHANNELS

__all__ = ["CameraEncoder", "LidarEncoder", "PointEncoder", "cell_values", "convolution", "standardised"]

_LEAST_LIKELIHOOD = 0.005  # a segmenter that is surer than one mistake in 200 cells is not believed


class _UNet(nn.Module):
    """Halves the grid per width and doubles it again, to 1/2; then logits for every cell by pixel shuffle."""

    def __init__(self, channels: int, classes: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.down = nn.ModuleList(_block(i, o, 2) for i, o in pairwise((channels, *widths)))
        self.up = nn.ModuleList(_block(i + o, o, 1) for o, i in reversed(list(pairwise(widths))))
        self.logits = nn.Conv2d(widths[0], 4 * classes, 1)

    def features(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B F h w"]:
        """Convolutional features, by squares of four cells, with skip connections."""
        skips = []
        for block in self.down:
            x = block(x)
            skips.append(x)
        for block, skip in zip(self.up, reversed(skips[:-1]), strict=True):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        return x


class CameraEncoder(_UNet):
    """A mini U-net: 1/2 to 1/16 of the grid and back.

    If the camera comes with classes, the output is added to their log-likelihood times a learned scale: a
    segmenter trained on photographs is right more often than a network trained on rendered images.
    """

    def __init__(self, classes: int, width: int, channels: int = CAMERA_CHANNELS) -> None:
        super().__init__(channels, classes, (width, 2 * width, 3 * width, 4 * width))
        self.trust = nn.Parameter(torch.ones(())) if channels > CAMERA_CHANNELS else None

    def forward(self, camera: Float[Tensor, "B C H W"]) -> Float[Tensor, "B K H W"]:
        """Logits per cell of the grid, whose sides are multiples of 16.

        Colours are standardised over the part of the grid that the image shows, so exposure, gain and black
        level of the camera do not matter.
        """
        x = standardised(camera[:, :CAMERA_CHANNELS])
        if self.trust is not None:
            x = torch.cat([x, camera[:, CAMERA_CHANNELS:]], 1)
        logits = F.pixel_shuffle(self.logits(self.features(x)), 2)
        if self.trust is None:
            return logits
        likelihood, known = camera[:, CAMERA_CHANNELS:-1], camera[:, -1:]
        return logits + self.trust * known * torch.log(likelihood.clamp(min=_LEAST_LIKELIHOOD))


class LidarEncoder(_UNet):
    """Convolutions on the rendered sweep."""

    def __init__(self, channels: int, classes: int, width: int) -> None:
        super().__init__(channels, classes, (width, 2 * width, 3 * width))
        # What a point is depends first of all on itself: its own height, echo and range, cell by cell.
        self.own = nn.Sequential(
            nn.Conv2d(channels, 2 * width, 1), nn.ReLU(), nn.Conv2d(2 * width, classes, 1)
        )

    def forward(self, rendered: Float[Tensor, "B C H W"]) -> Float[Tensor, "B K H W"]:
        """Logits per cell; meaningful where a point was rendered."""
        return self.logits_of(self.features(rendered), rendered)

    def logits_of(self, features: Tensor, rendered: Tensor) -> Float[Tensor, "B K H W"]:
        """The same from the sweep's features."""
        return F.pixel_shuffle(self.logits(features), 2) + self.own(rendered)

    def logits_at(
        self, features: Tensor, rendered: Tensor, row: Int64[Tensor, "B N"], column: Int64[Tensor, "B N"]
    ) -> Float[Tensor, "B N K"]:
        """Logits as of `forward`, at single cells (row, column), which are far fewer."""
        width = rendered.shape[-1]
        square = cell_values(features, row // 2 * (width // 2) + column // 2)
        four = F.linear(square, self.logits.weight[:, :, 0, 0], self.logits.bias)
        place = (row % 2) * 2 + column % 2
        mine = (place[..., None] == torch.arange(4, device=place.device)).to(four.dtype)
        x = cell_values(rendered, row * width + column)
        for layer in self.own:
            x = (
                F.linear(x, layer.weight[:, :, 0, 0], layer.bias)
                if isinstance(layer, nn.Conv2d)
                else layer(x)
            )
        return (four.reshape(*x.shape, 4) * mine[..., None, :]).sum(-1) + x


class PointEncoder(nn.Module):
    """Class logits of single points, for radar detections: range, Doppler, power."""

    def __init__(self, features: int, classes: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features + 1, 32), nn.ReLU(), nn.Linear(32, classes))

    def forward(
        self, features: Float[Tensor, "B N F"], range_m: Float[Tensor, "B N"]
    ) -> Float[Tensor, "B N K"]:
        """Logits of each point."""
        return self.layers(torch.cat([features, range_m[..., None] / 40.0], -1))


def cell_values(maps: Float[Tensor, "B K H W"], cell: Int64[Tensor, "B N"]) -> Float[Tensor, "B N K"]:
    """Values of single cells, counted row by row."""
    # Channels go last first: one contiguous row per lookup.
    table = maps.flatten(2).transpose(1, 2)
    frame = torch.arange(len(maps), device=maps.device)[:, None] * table.shape[1]
    return F.embedding(cell + frame, table.flatten(0, 1))


def standardised(camera: Float[Tensor, "B 4 H W"]) -> Float[Tensor, "B 4 H W"]:
    """Colours minus mean, over standard deviation, 0 where the camera sees nothing; the mask stays."""
    colours, seen = camera[:, :3], camera[:, 3:]
    count = seen.sum((2, 3), keepdim=True).clamp(min=1.0)
    mean = (colours * seen).sum((2, 3), keepdim=True) / count
    centred = (colours - mean) * seen
    variance = (centred * centred).sum((1, 2, 3), keepdim=True) / (3 * count)
    return torch.cat([centred / torch.sqrt(variance + 1e-6), seen], 1)


def _block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(*convolution(inputs, outputs, stride), *convolution(outputs, outputs, 1))


def convolution(inputs: int, outputs: int, stride: int) -> tuple[nn.Module, ...]:
    """Layers of a 3 x 3 convolution; group norm works at batch 1 and at any rig's statistics."""
    norm = nn.GroupNorm(max(1, outputs // 8), outputs)
    return nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), norm, nn.ReLU()
