"""Lane paint and other bright ground: reflectivity of the sweep against brightness of the image.

Ground fills most of both views, and its classes constrain the pose least. Paint returns more light than the
asphalt next to it, to a lidar and to a camera. Such lines constrain pitch, roll and yaw of sweeps with few
rows. Both sides are high-pass filters along the row, in units of their own spread, so gains, exposures and
scales do not matter.

Source: the reflectivity term of `pipeline/objective/camera_lidar`, on the network's grid.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.sample.layout import MARK_FLAT, MARK_LEAST_SHARE

__all__ = ["log_markings"]

# Of the image: narrower than the sweep's, for it is dense, and three rows high.
_WIDE, _HIGH = 25, 3
_FULL_SIGMAS = 2.0  # contrast that counts as paint for certain
_NO_MARKING = 0.1  # likelihood of bright ground where the image has no paint: wet patches, kerbs, snow
_LEAST_ROAD = 50.0  # cells; fewer show no line
_ROAD, _VERGE = 0, 1  # of GRID_CLASSES


def log_markings(
    camera: Float[Tensor, "B C H W"], likelihood: Float[Tensor, "B K H W"]
) -> tuple[Float[Tensor, "B 1 H W"], Float[Tensor, " B"]]:
    """Log-likelihood of bright ground in the image's cells, and 1 where there is enough road around.

    `camera` is red, green, blue and visibility; `likelihood` holds logarithms, of GRID_CLASSES.
    """
    road = torch.exp(likelihood[:, _ROAD : _VERGE + 1]).sum(1, keepdim=True).clamp(max=1.0) * camera[:, 3:4]
    above = _above_beside(camera[:, :3].mean(1, keepdim=True), road, (_HIGH, _WIDE))
    contrast = (above / _FULL_SIGMAS).clamp(0.0, 1.0)
    enough = ((road > 0.5).to(road.dtype).sum((1, 2, 3)) > _LEAST_ROAD).to(contrast.dtype)
    return torch.log(_NO_MARKING + (1 - _NO_MARKING) * contrast), enough


def _above_beside(values: Tensor, mask: Tensor, window: tuple[int, int]) -> Tensor:
    """Values minus the mean of the masked cells in a window, over their spread; 0 off the mask."""
    pad = (window[0] // 2, window[1] // 2)
    share = F.avg_pool2d(mask, window, 1, pad)
    beside = F.avg_pool2d(values * mask, window, 1, pad) / share.clamp(min=MARK_LEAST_SHARE)
    above = (values - beside) * mask
    spread = (above * above).sum((2, 3), keepdim=True) / mask.sum((2, 3), keepdim=True).clamp(min=1.0)
    return above / (torch.sqrt(spread) + MARK_FLAT)
