"""Domain randomisation of sensor data, so that a network learns shapes and classes, not one renderer's look.

Wrong guesses, mirrored frames and turned camera views are random too: a network memorises neither a mounting nor a
side. A cloud moved by A and seen at T looks like the cloud seen at T A, so the guesses move instead of the clouds.
Lidar and radar move independently; the three guesses close the loop. Of two frames in a row the second is moved and
turned by the inverses of the first's, so that no mean of a batch can be learnt. A turned view is the same image on a
grid turned by R: poses into the turned camera are R T, and the losses, which keep the unturned maps, get R^-1 T.

Source: Tobin et al. 2017; paper section 4.5.4 (random rotation and translation of lidar and radar clouds); mirrors and
turned views are new here. Draws are the same on every device, because the generator is the CPU's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.network.views import SensorInputs
from pipeline.learn.sample.frame_sample import stored_grid
from pipeline.learn.sample.grid import CAMERA_CHANNELS, FEATURE_UNITS, LIDAR_FEATURES, grid_rays
from pipeline.learn.train.settings import AugmentConfig, StrangeConfig
from pipeline.objective.differentiable.projection import exp_so3, inverse, pose
from schemas.observations import EDGE_ABOVE, EDGE_BELOW, EDGE_LEFT, EDGE_RIGHT
from schemas.training import NO_EDGE, UNKNOWN_CLASS

__all__ = ["Guess", "made_strange", "mirrored", "random_guess", "turned_view"]

_DEG = 180.0 / torch.pi
_INTENSITY, _HEIGHT, _GROUND = (LIDAR_FEATURES.index(name) for name in ("intensity", "height", "ground"))
_FEWEST_POINTS = 300  # a sweep is not thinned below what makes a sample
# At strength 1; chosen by looking at a hundred frames, not by results.
_GAMMA, _MIX, _TINT, _TEXTURE, _LIGHT, _NOISE = 0.8, 0.25, 0.15, 0.12, 0.5, 0.08
_SHIFTED_CELLS, _GROWN, _DOUBT = 0.8, 0.6, 0.3
_CONFUSED = 1.0364  # sigmas, beyond which 15 % of an image lie
_HOLE = 2.0  # sigmas
# On a real car a third of the road's points were not flagged as ground, where simulated sweeps flag all but 1 %, leaves
# echoed half as strongly as simulated ones, and the road's heights scattered by 6 cm.
_SILENT, _LIFTED_M, _TILTED_RAD = 0.6, 0.06, 0.005
_NEARER = 1.0  # trees 15 m away were taken for lorries, as simulated trees stand 28 m away


def made_strange(sensors: SensorInputs, config: StrangeConfig, generator: torch.Generator) -> SensorInputs:
    """The sensors with all configured randomisations."""
    camera, classes = sensors.camera, sensors.classes
    draw = _Draw(generator, camera.device)
    if config.classes > 0:
        classes = _strange_classes(classes, config.classes, draw)
    if config.image > 0:
        camera = _strange_image(camera, sensors.classes, config.image, draw)
    without = draw.even(len(camera)) < config.no_classes
    classes = classes * (~without)[:, None, None, None]
    blank = (draw.even(len(camera)) < config.no_image) & ~without
    colours = camera[:, : CAMERA_CHANNELS - 1] * (~blank)[:, None, None, None]
    camera = torch.cat([colours, camera[:, CAMERA_CHANNELS - 1 :]], 1)
    sensors = replace(sensors, camera=camera, classes=classes)
    if config.lidar > 0 or config.fewer_rows > 0:
        sensors = _strange_lidar(sensors, config, draw)
    return sensors


def _strange_image(
    camera: Float[Tensor, "B 4 H W"], classes: Float[Tensor, "B C H W"], strength: float, draw: _Draw
) -> Float[Tensor, "B 4 H W"]:
    """Random light, colours per class, surfaces, lens and sensor."""
    count, _, height, width = camera.shape
    colours, seen = camera[:, :3], camera[:, 3:]
    size = strength * draw.even(count, 1, 1, 1)
    mix = torch.eye(3, device=camera.device) + _MIX * size[..., 0] * draw.normal(count, 3, 3)
    colours = torch.einsum("bij,bjhw->bihw", mix, colours)
    tint = _TINT * size[..., 0] * draw.normal(count, 3, classes.shape[1] - 1)
    colours = colours + torch.einsum("bck,bkhw->bchw", tint, classes[:, :-1])
    for cells in (3, 8, 24):
        grain = _TEXTURE * size * draw.even(count, 1, 1, 1)
        colours = colours + grain * draw.field(count, 1, height, width, cells)
    light = torch.exp(_LIGHT * size * draw.field(count, 1, height, width, 40))
    colours = (colours * light).clamp(1e-3, 1.0)
    colours = colours ** torch.exp(_GAMMA * size * (2 * draw.even(count, 1, 1, 1) - 1))
    blurred = F.avg_pool2d(F.pad(colours, (1, 1, 1, 1), mode="replicate"), 3, 1)
    # Negative shares sharpen, as cameras do.
    share = strength * (1.5 * draw.even(count, 1, 1, 1) - 0.5)
    colours = colours + share.clamp(-0.5, 1.0) * (blurred - colours)
    colours = colours + _NOISE * size * draw.even(count, 1, 1, 1) * draw.normal(count, 3, height, width)
    return torch.cat([colours.clamp(0.0, 1.0) * seen, seen], 1)


def _strange_classes(
    classes: Float[Tensor, "B C H W"], strength: float, draw: _Draw
) -> Float[Tensor, "B C H W"]:
    """Random segmenter: outlines wander, objects grow, patches are confused or missing, confidence varies."""
    count, channels, height, width = classes.shape
    # A quarter of the frames keeps the labels' own errors only.
    size = strength * draw.even(count, 1, 1, 1) * (draw.even(count, 1, 1, 1) > 0.25)
    moved = _displaced(classes, size * _SHIFTED_CELLS * draw.field(count, 2, height, width, 6))
    grown = F.max_pool2d(moved[:, :-1], 3, 1, 1)
    things = (draw.even(count, channels - 1, 1, 1) < 0.3).float()  # some classes swell, others not
    likelihood = moved[:, :-1] + size * _GROWN * things * (grown - moved[:, :-1])
    likelihood = likelihood / likelihood.sum(1, keepdim=True).clamp(min=1e-3)
    confused = draw.field(count, 1, height, width, 16) > _CONFUSED / size.clamp(min=0.01).sqrt()
    other = torch.stack([draw.permutation(channels - 1) for _ in range(count)])
    taken = likelihood.gather(1, other[..., None, None].expand_as(likelihood))
    likelihood = torch.where(confused, taken, likelihood)
    doubt = size * _DOUBT * draw.even(count, 1, 1, 1)
    likelihood = likelihood * (1 - doubt) + doubt / (channels - 1)
    hole = draw.field(count, 1, height, width, 24) > _HOLE / size.clamp(min=0.05)
    known = moved[:, -1:].round() * (~hole)
    return torch.cat([likelihood * known, known], 1)


def _strange_lidar(sensors: SensorInputs, config: StrangeConfig, draw: _Draw) -> SensorInputs:
    """Another lidar: echoes on another scale, a ground a little off and flagged in part, points missing, rows apart."""
    (count, points), strength = sensors.lidar_valid.shape, config.lidar
    features = sensors.lidar_features.clone()
    echo = features[..., _INTENSITY] ** torch.exp(strength * (2 * draw.even(count, 1) - 1))
    echo = echo + 0.1 * strength * draw.even(count, 1) * draw.normal(count, points)
    silent = draw.even(count, 1) < _SILENT * strength
    features[..., _INTENSITY] = torch.where(silent, torch.full_like(echo, 0.5), echo.clamp(0, 1))
    ahead = sensors.lidar_xyz_m[..., 0]
    lifted = _LIFTED_M * draw.normal(count, 1) + _TILTED_RAD * draw.normal(count, 1) * ahead
    lifted = lifted + 0.03 * draw.normal(count, points)
    features[..., _HEIGHT] = features[..., _HEIGHT] + strength * lifted / FEATURE_UNITS["height"]
    # Two frames of five keep the flags of the ground, one has none.
    flagged = (draw.even(count, points) > strength * (2.2 * draw.even(count, 1) - 0.8)).float()
    features[..., _GROUND] = features[..., _GROUND] * flagged
    kept = draw.even(count, points) > 0.4 * strength * draw.even(count, 1)
    thin = draw.even(count, 1) < config.fewer_rows
    kept = kept & (~thin | _on_far_rows(sensors.lidar_xyz_m, draw))
    valid = sensors.lidar_valid & kept
    valid = valid.where((valid.sum(1) >= _FEWEST_POINTS)[:, None], sensors.lidar_valid)
    # What stands near the road is not the same everywhere: frames look nearer or farther than they are.
    factor = torch.exp(strength * _NEARER * (2 * draw.even(count) - 1))
    return replace(sensors, lidar_features=features, lidar_valid=valid, nearness=factor)


def _on_far_rows(xyz_m: Float[Tensor, "B N 3"], draw: _Draw) -> Bool[Tensor, "B N"]:
    """Points on some of the rows: 0.3 deg thick, 1 to 2.2 deg apart, in the lidar's own elevation."""
    elevation = torch.atan2(xyz_m[..., 2], xyz_m[..., :2].norm(dim=-1)) * _DEG
    apart = 1.0 + 1.2 * draw.even(len(xyz_m), 1)
    phase = elevation / apart + draw.even(len(xyz_m), 1)
    return (phase - phase.round()).abs() * apart < 0.15


def _displaced(maps: Tensor, cells: Tensor) -> Tensor:
    """The maps looked up some cells away (columns, rows)."""
    count, _, height, width = maps.shape
    sides = (torch.linspace(-1, 1, side, device=maps.device) for side in (height, width))
    row, column = torch.meshgrid(*sides, indexing="ij")
    at = torch.stack([column, row], -1).expand(count, height, width, 2)
    step = maps.new_tensor([2 / (width - 1), 2 / (height - 1)])
    at = at + cells.permute(0, 2, 3, 1) * step
    return F.grid_sample(maps, at, mode="bilinear", padding_mode="border", align_corners=True)


class _Draw:
    """Random numbers of the CPU's generator on any device."""

    def __init__(self, generator: torch.Generator, device: torch.device) -> None:
        self._generator, self._device = generator, device

    def even(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self._generator).to(self._device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator).to(self._device)

    def permutation(self, count: int) -> Tensor:
        return torch.randperm(count, generator=self._generator).to(self._device)

    def field(self, count: int, channels: int, height: int, width: int, cells: int) -> Tensor:
        """Smooth fields of about unit variance whose features are some cells wide."""
        small = self.normal(count, channels, height // cells + 3, width // cells + 3)
        wide = F.interpolate(small, scale_factor=float(cells), mode="bicubic", align_corners=False)
        return wide[..., cells : cells + height, cells : cells + width] * 1.35


_RAD = torch.pi / 180.0
# Of the camera's frame (x right, y down, z ahead), and of those of lidar and radar (x ahead, y left, z up).
_CAMERA_MIRROR, _MIRROR = torch.tensor([-1.0, 1.0, 1.0, 1.0]), torch.tensor([1.0, -1.0, 1.0, 1.0])
_OTHER_SIDE = torch.tensor([EDGE_RIGHT, EDGE_LEFT, EDGE_ABOVE, EDGE_BELOW])  # by the sides' own numbers
_POINTS = ("lidar_xyz_m", "cluster_centre_m", "edge_xyz_m", "radar_xyz_m", "track_xyz_m", "ego_velocity_mps")


@dataclass(frozen=True, eq=False)
class Guess:
    """Where the network starts, seen from the turned camera, and how that camera is turned."""

    R_turned_camera: Float[Tensor, "B 3 3"]
    T_camera_lidar: Float[Tensor, "B 4 4"]
    T_camera_radar: Float[Tensor, "B 4 4"]
    T_lidar_radar: Float[Tensor, "B 4 4"]

    def unturned(self, T_turned: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 4 4"]:
        """A pose into the turned camera as one into the camera itself."""
        R = self.R_turned_camera.transpose(-1, -2)
        return pose(R, torch.zeros_like(R[..., 0])) @ T_turned


def random_guess(batch: TrainingBatch, config: AugmentConfig, generator: torch.Generator) -> Guess:
    """Guesses about the batch's reference poses; a generator of the CPU gives the same on every device."""
    device = batch.T_camera_lidar.device
    count = (len(batch) + 1) // 2  # of the pairs of frames

    def even(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    def both(T: Float[Tensor, "P 4 4"]) -> Float[Tensor, "B 4 4"]:
        return torch.stack([T, inverse(T)], 1).flatten(0, 1)[: len(batch)].to(device)

    small = torch.rand(count, generator=generator) < config.small_share
    scale = torch.where(small, torch.rand(count, generator=generator) ** 2, torch.ones(count))[:, None]
    turns = [exp_so3(even(count, 3) * scale * config.rotation_deg * _RAD) for _ in range(2)]
    shifts = [even(count, 3) * scale * config.translation_m for _ in range(2)]
    view = exp_so3(even(count, 3) * config.view_deg * _RAD)
    moved_lidar, moved_radar = (both(pose(R, t)) for R, t in zip(turns, shifts, strict=True))
    turned = both(pose(view, torch.zeros(count, 3)))
    T_lidar_radar = inverse(moved_lidar) @ batch.T_lidar_radar @ moved_radar
    T_camera_lidar = turned @ batch.T_camera_lidar @ moved_lidar
    return Guess(turned[:, :3, :3], T_camera_lidar, T_camera_lidar @ T_lidar_radar, T_lidar_radar)


def mirrored(batch: TrainingBatch, rows: Bool[Tensor, " B"]) -> TrainingBatch:
    """The batch with left and right exchanged in some frames: image, clouds, motion and poses together.

    A pose that is wrong by an angle to one side is wrong to the other side in the mirror: what a network learns from
    labels and references has no side. Every sensor's points are mirrored in its own frame, so poses stay rotations.
    """
    camera, other = (torch.diag(v).to(batch.T_camera_lidar) for v in (_CAMERA_MIRROR, _MIRROR))
    left, top, right, bottom = batch.detection_box_rad.unbind(-1)
    offset = batch.edge_offset[:, _OTHER_SIDE].flip(-1)
    sideways = offset[:, :2].where(offset[:, :2] == NO_EDGE, -offset[:, :2])
    found = {name: getattr(batch, name) @ other[:3, :3] for name in _POINTS} | {
        **{name: getattr(batch, name).flip(-1) for name in ("image", "grid_class", "grid_seen")},
        "edge_offset": torch.cat([sideways, offset[:, 2:]], 1),
        "edge_side": _OTHER_SIDE.to(batch.edge_side)[batch.edge_side.long()],
        "detection_box_rad": torch.stack([-right, top, -left, bottom], -1),
        "ground_plane": batch.ground_plane @ other,
        "ego_yaw_rate_radps": -batch.ego_yaw_rate_radps,
        "T_camera_lidar": camera @ batch.T_camera_lidar @ other,
        "T_lidar_radar": other @ batch.T_lidar_radar @ other,
    }
    frames = torch.arange(len(batch), device=rows.device) + len(batch) * rows
    taken: dict[str, Any] = {n: torch.cat([getattr(batch, n), v])[frames] for n, v in found.items()}
    return replace(batch, **taken)


def turned_view(batch: TrainingBatch, R_turned_camera: Float[Tensor, "B 3 3"]) -> TrainingBatch:
    """The batch with image, classes and visibility of a turned camera; other columns stay.

    Cells outside the stored grid are unseen and of unknown class.
    """
    height, width = batch.grid_seen.shape[1:]
    step = batch.grid_step_deg * _RAD
    cells = grid_rays(stored_grid((height, width), batch.grid_step_deg)).astype(np.float32)
    rays = torch.from_numpy(cells).to(R_turned_camera.device)
    # A ray of the turned grid comes from R^T ray of the stored one.
    source = torch.einsum("byx,hwy->bhwx", R_turned_camera, rays)
    azimuth = torch.atan2(-source[..., 0], source[..., 2])
    elevation = torch.atan2(-source[..., 1], torch.hypot(source[..., 0], source[..., 2]))
    u = (width - 1) / 2 - azimuth / step
    v = (height - 1) / 2 - elevation / step
    at = torch.stack([2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1], -1)
    image = _sampled(batch.image.float(), at, "bilinear")
    # 0 is left for "not there".
    classes = _sampled(batch.grid_class[:, None].float() + 1, at, "nearest")[:, 0]
    seen = _sampled(batch.grid_seen[:, None].float(), at, "bilinear")[:, 0] > 0.999
    label = torch.where((classes > 0) & seen, classes - 1, torch.full_like(classes, UNKNOWN_CLASS))
    image, label, seen = (maps.to(torch.uint8) for maps in ((image * seen[:, None]).round(), label, seen))
    return replace(batch, image=image, grid_class=label, grid_seen=seen)


def _sampled(maps: Tensor, at: Tensor, mode: str) -> Tensor:
    return F.grid_sample(maps, at, mode=mode, padding_mode="zeros", align_corners=True)
