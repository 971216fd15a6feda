"""`architecture = "matching"`: distilled classes, correlation, and learned residuals."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.network.class_matcher import FLOOR, NEUTRAL, ClassMatcher
from pipeline.learn.network.encoders import CameraEncoder, LidarEncoder, PointEncoder, cell_values
from pipeline.learn.network.least_squares import Match
from pipeline.learn.network.occupancy_matcher import OccupancyMatcher
from pipeline.learn.network.outputs import ClassEvidence, CoreOutputs, Heads, pose_of_twist
from pipeline.learn.network.views import RenderedView, grid_cells, sphere
from pipeline.learn.sample.grid import (
    CAMERA_CHANNELS,
    LIDAR_CHANNELS,
    LIDAR_FEATURES,
    MARK_FLAT,
    MARK_LEAST_SHARE,
    MARKED_POINTS,
    RADAR_FEATURES,
    NetworkConfig,
)
from schemas.training import GRID_CLASSES

__all__ = ["MatchingCore", "log_markings"]

_CLASSES = len(GRID_CLASSES)
# Of a point that the guess puts outside the image, against one inside: with true classes on 32 frames of a real car,
# started 2 deg off, 0.11 / 0.15 deg were left at 0.2, and 0.18 / 0.17 deg at 1.
_UNSEEN_WORTH = 0.2
# What a lidar's encoder confuses on a car it never saw. On 18 frames of the real car started 2 deg off, azimuth was
# 3.6 deg off on average without, for a few frames were 10 deg off, and 1.5 deg with (0.6, 0.3).
_ALIKE = (
    ("road", "verge"), ("building", "fence", "pole", "vegetation"), ("person", "vehicle", "two_wheeler"),
)  # fmt: skip
_SOLID = (*_ALIKE[1], *_ALIKE[2])
_CONFUSED_ALIKE, _CONFUSED_SOLID = 0.6, 0.3  # shares spread over classes of one kind, and of all objects
_NO_BOUNDARY = 0.1  # likelihood of an edge where the image has no boundary: branches, kerbs, what labels miss
_EDGE = 2 + LIDAR_FEATURES.index("edge")  # channel of the rendered sweep
_RESIDUAL_STD = 1e-3  # of the heads' weights: an untrained network answers as its matchers
# The camera's x, y, z look along the lidar's y, z, x; signs do not matter to variances.
_AXES_CAMERA_OF_LIDAR = (1, 2, 0)


class MatchingCore(nn.Module):
    """Network on one rendered view, with the matchers of its pairs."""

    confusions: Tensor | None

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.grid = grid = config.grid
        self.pairs = pairs = config.estimated
        width, hidden = config.width, config.hidden
        self.register_buffer("confusions", _confusions() if config.takes_classes else None, persistent=False)
        uses_camera = pairs != ("lidar_radar",)
        self.camera_encoder = CameraEncoder(_CLASSES, width, config.camera_channels) if uses_camera else None
        sizes = []
        if "camera_lidar" in pairs:
            self.lidar_encoder = LidarEncoder(LIDAR_CHANNELS, _CLASSES, width)
            self.lidar_matcher = ClassMatcher(grid)
            # exp: weight of an edge of the sweep on a boundary, relative to a point of one class.
            self.log_edge_worth = nn.Parameter(torch.zeros(())) if config.takes_classes else None
            # exp: weight of bright ground on paint, relative to a point of one class.
            self.log_mark_worth = nn.Parameter(torch.zeros(())) if config.marks else None
            sizes.append(self.lidar_matcher.surface_size + 12)
        if "lidar_radar" in pairs:
            self.radar_matcher = OccupancyMatcher(len(RADAR_FEATURES))
            sizes.append(self.radar_matcher.surface_size + 12)
        if pairs == ("camera_radar",):
            self.radar_encoder = PointEncoder(len(RADAR_FEATURES), _CLASSES)
            self.radar_class_matcher = ClassMatcher(grid)
            sizes.append(self.radar_class_matcher.surface_size + 12)
        self.summaries = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(size), nn.Linear(size, hidden), nn.ReLU()) for size in sizes
        )
        self.fusion = nn.Sequential(nn.Linear(hidden * len(sizes), 128), nn.ReLU())
        self.heads = Heads(128, pairs, _RESIDUAL_STD)

    def forward(self, view: RenderedView) -> CoreOutputs:
        """Corrections, log variances, and the evidence, whose gradient alone reaches the encoders."""
        camera_logits = self.camera_encoder(view.camera) if self.camera_encoder is not None else None
        likelihood = None if camera_logits is None else self.camera_log_likelihood(view.camera, camera_logits)
        return self.match(view, likelihood, camera_logits)

    def camera_log_likelihood(
        self, camera: Float[Tensor, "B C H W"], logits: Float[Tensor, "B K H W"]
    ) -> Float[Tensor, "B L H W"]:
        """Log-probability of classes, and behind them 1 where the camera sees the cell.

        Beyond the border the values at the border continue. If all classes were equal there, points would
        gain by leaving well-classified cells: a narrow image would push the sweep out.
        """
        # Classes last: runtimes are five times slower along another axis.
        probability = torch.softmax(logits.permute(0, 2, 3, 1), -1).clamp(min=float(np.exp(FLOOR)))
        if self.confusions is not None:
            probability = probability @ self.confusions
        log_probability = torch.log(probability).clamp(min=FLOOR).permute(0, 3, 1, 2)
        seen = camera[:, CAMERA_CHANNELS - 1 : CAMERA_CHANNELS]
        blind = 1 - seen.amax((2, 3), keepdim=True)
        continued = _continued_beyond(log_probability, seen) * (1 - blind) + NEUTRAL * blind
        return torch.cat([continued, seen], 1)

    def match(
        self, view: RenderedView, likelihood: Float[Tensor, "B L H W"] | None,
        camera_logits: Float[Tensor, "B K H W"] | None,
    ) -> CoreOutputs:  # fmt: skip
        """The part that depends on the guess: matchers, residuals, log variances."""
        bases: dict[str, Match] = {}
        lidar_logits = radar_logits = evidence = None
        if "camera_lidar" in self.pairs:
            assert likelihood is not None
            row, column, _ = self._cells(view.points_camera)
            lidar_logits, logits = self._lidar_logits(view.lidar_grid, row, column)
            probability = torch.softmax(logits, -1)
            weight = view.point_weight * self._worth(likelihood, view.points_camera)
            edge = cell_values(view.lidar_grid[:, _EDGE : _EDGE + 1], row * self.grid.width + column)
            maps, probability = self._with_edges(likelihood[:, :-1], probability, edge)
            points = view.points_camera
            if self.log_mark_worth is not None:
                marked = view.mark_weight * self._worth(likelihood, view.marks_camera)
                maps, probability = self._with_marks(view.camera, maps, probability)
                points, weight = torch.cat([points, view.marks_camera], 1), torch.cat([weight, marked], 1)
            evidence = ClassEvidence(maps, probability, weight, points)
            # Not through the search: it costs more than all else, and its answer is the evidence's maximum.
            bases["camera_lidar"] = self.lidar_matcher(
                maps.detach(), points, probability.detach(), weight.detach()
            )
        if "lidar_radar" in self.pairs:
            bases["lidar_radar"] = self.radar_matcher(
                view.radar_lidar, view.radar_features, view.radar_valid, view.radar_has_elevation,
                view.objects, view.object_weight,
            )  # fmt: skip
        if self.pairs == ("camera_radar",):
            assert likelihood is not None
            distance = view.radar_camera.norm(dim=-1)
            radar_logits = self.radar_encoder(view.radar_features, distance)
            probability = torch.softmax(radar_logits.detach(), -1)
            weight = view.radar_valid.to(probability.dtype) * self._worth(likelihood, view.radar_camera)
            bases["camera_radar"] = self.radar_class_matcher(
                likelihood[:, :-1].detach(), view.radar_camera, probability, weight
            )
        features = [_features(base) for base in bases.values()]
        fused = self.fusion(torch.cat([s(f) for s, f in zip(self.summaries, features, strict=True)], -1))
        found = {pair: pose_of_twist(base.twist) for pair, base in bases.items()}
        corrections, log_variance = self.heads(fused, found, self._log_variances(bases))
        logits_of = (camera_logits, lidar_logits, radar_logits)
        return CoreOutputs(corrections, log_variance, likelihood, *logits_of, evidence)

    def _with_edges(self, maps: Tensor, probability: Tensor, edge: Tensor) -> tuple[Tensor, Tensor]:
        """Boundaries as one more class, matched with the sweep's edges for any class of their points."""
        if self.log_edge_worth is None:
            return maps, probability
        worth = torch.exp(self.log_edge_worth) * edge
        return torch.cat([maps, _log_boundaries(maps)], 1), torch.cat([probability, worth], -1)

    def _with_marks(self, camera: Tensor, maps: Tensor, probability: Tensor) -> tuple[Tensor, Tensor]:
        """Paint as the last class, and behind the points MARKED_POINTS that have no other."""
        assert self.log_mark_worth is not None
        paint, enough = log_markings(camera, maps[:, :_CLASSES].detach())
        frames, points, classes = probability.shape
        worth = (torch.exp(self.log_mark_worth) * enough)[:, None, None].expand(frames, MARKED_POINTS, 1)
        of_marks = torch.cat([probability.new_zeros(frames, MARKED_POINTS, classes), worth], -1)
        of_points = torch.cat([probability, probability.new_zeros(frames, points, 1)], -1)
        return torch.cat([maps, paint], 1), torch.cat([of_points, of_marks], 1)

    def _lidar_logits(self, rendered: Tensor, row: Tensor, column: Tensor) -> tuple[Tensor, Tensor]:
        """Class logits of all cells, and of the points' cells, which are all that a graph without training needs."""
        if self.training:
            logits = self.lidar_encoder(rendered)
            return logits, cell_values(logits, row * self.grid.width + column)
        features = self.lidar_encoder.features(rendered)
        at_points = self.lidar_encoder.logits_at(features, rendered, row, column)
        return self.lidar_encoder.logits_of(features, rendered), at_points

    def _worth(self, likelihood: Tensor, points_camera: Tensor) -> Tensor:
        """B N: weight of a point at the guess, fixed before it moves, so that no motion can raise it."""
        row, column, inside = self._cells(points_camera)
        seen = cell_values(likelihood[:, -1:], row * self.grid.width + column)[..., 0]
        return _UNSEEN_WORTH + (1 - _UNSEEN_WORTH) * seen * inside.to(likelihood.dtype)

    def _cells(self, points_camera: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """B N each: row and column of the cell that a point falls into (or next to), and whether it falls into it."""
        row, column = grid_cells(sphere(points_camera), self.grid)
        height, width = self.grid.height, self.grid.width
        inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
        return row.long().clamp(0, height - 1), column.long().clamp(0, width - 1), inside

    def _log_variances(self, bases: dict[str, Match]) -> dict[str, Tensor]:
        """Of the matchers, and of camera-radar by the other two where it is their product."""
        variances = {pair: base.variance for pair, base in bases.items()}
        if "camera_radar" not in bases and "camera_radar" in self.pairs:
            lidar_radar = variances["lidar_radar"]
            turned = [lidar_radar[:, [a + o for a in _AXES_CAMERA_OF_LIDAR]] for o in (0, 3)]
            variances["camera_radar"] = variances["camera_lidar"] + torch.cat(turned, -1)
        return {pair: torch.log(variance) for pair, variance in variances.items()}


def _confusions() -> Float[Tensor, "K K"]:
    """Probability that a point on something of one class (row) is classified as another (column)."""
    found = torch.eye(_CLASSES)
    for kinds, share in (*((kind, _CONFUSED_ALIKE) for kind in _ALIKE), (_SOLID, _CONFUSED_SOLID)):
        rows = torch.tensor([GRID_CLASSES.index(name) for name in kinds])
        found[rows] = (1 - share) * found[rows] + share * found[rows].mean(0)
    return found


def _continued_beyond(
    maps: Float[Tensor, "B K H W"], seen: Float[Tensor, "B 1 H W"]
) -> Float[Tensor, "B K H W"]:
    """The maps, with the nearest seen cell's values in unseen cells: first vertically, then horizontally.

    Images are nearly convex on the grid: between two seen cells of a column all are seen.
    """
    height, width = maps.shape[2:]
    rows = torch.arange(height, device=maps.device)[None, :, None]
    columns = torch.arange(width, device=maps.device)[None]
    beyond = torch.where(seen[:, 0] > 0.5, 0.0, float(height + width))
    first = (beyond + rows).amin(1).long().clamp(max=height - 1)
    last = (rows - beyond).amax(1).long().clamp(min=0)
    empty = beyond.amin(1)
    left = (empty + columns).amin(1, keepdim=True).long().clamp(max=width - 1)
    right = (columns - empty).amax(1, keepdim=True).long().clamp(min=0)
    column = torch.minimum(torch.maximum(columns, left), right)
    first, last = (edge.gather(1, column)[:, None] for edge in (first, last))
    cell = torch.minimum(torch.maximum(rows, first), last) * width + column[:, None]
    return cell_values(maps, cell.flatten(1)).transpose(1, 2).reshape(maps.shape)


def _log_boundaries(maps: Float[Tensor, "B K H W"]) -> Float[Tensor, "B 1 H W"]:
    """Logarithm of how much the classes change along the row: rows of a sweep jump where objects end to the side."""
    beside = F.pad(torch.exp(maps), (1, 1, 0, 0), mode="replicate")
    change = 0.5 * (beside[..., 2:] - beside[..., :-2]).abs().sum(1, keepdim=True)
    return torch.log(_NO_BOUNDARY + (1 - _NO_BOUNDARY) * change.clamp(max=1.0))


def _features(found: Match) -> Tensor:
    """Surfaces, the base in cells and its log variance, all of the order of one to ten."""
    return torch.cat([found.surfaces.clamp(min=-12.0), found.twist * 100.0, torch.log(found.variance)], -1)


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
