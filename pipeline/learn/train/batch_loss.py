"""The loss of one batch: random wrong guesses, and errors of the network's answers."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - the name that everybody uses

from pipeline.learn.batches.batch import TrainingBatch
from pipeline.learn.network.calibration_network import CalibrationNetwork
from pipeline.learn.network.outputs import Predictions
from pipeline.learn.network.views import NetworkInputs, crop, grid_cells, sensor_inputs, sphere
from pipeline.learn.sample.grid import PAIRS, Grid
from pipeline.learn.train.domain_randomisation import Guess, made_strange, mirrored, random_guess, turned_view
from pipeline.learn.train.frame_objective import FrameObjective, at_lag, twist_between, weighted
from pipeline.learn.train.paper_objective import PaperFrames
from pipeline.learn.train.settings import PAIRS_OF, TrainConfig
from pipeline.objective.differentiable.projection import GridProjection, pose, transform_points
from pipeline.objective.differentiable.terms import class_evidence_cost
from schemas.training import UNKNOWN_CLASS

__all__ = ["Passes", "batch_loss", "class_of_points", "semantics_loss", "uncertainty_loss"]

_DEG = 180.0 / torch.pi
_RADAR_WEIGHT = 0.2  # of semantics: a detection's features hardly determine its class
_LOG_VARIANCE = (-18.0, 2.0)  # sigmas of 0.1 mrad to 3 m: what lies beyond has no gradient


class Passes(nn.Module):
    """The network's passes as one forward call, which data parallelism wraps."""

    def __init__(self, network: CalibrationNetwork, iterations: int) -> None:
        super().__init__()
        self.network, self.iterations = network, iterations

    def forward(self, inputs: NetworkInputs) -> list[Predictions]:
        """All passes, the best answer last."""
        return self.network.refine(inputs, self.iterations)


def batch_loss(
    passes: nn.Module, batch: TrainingBatch, config: TrainConfig, generator: torch.Generator, *,
    paper: PaperFrames | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """The `loss` of one batch from random guesses, differentiable, and means to report, of the last pass.

    Args:
        passes: a `Passes` of the network, bare or wrapped for data parallelism.
        paper: if `loss.definition` is "paper": the inputs of its losses.
    """
    grid, augment = Grid(config.cell_deg), config.augment
    if augment.mirror_share > 0:
        rows = torch.rand(len(batch), generator=generator) < augment.mirror_share
        batch = mirrored(batch, rows.to(batch.image.device))
    guess = random_guess(batch, augment, generator)
    view = turned_view(batch, guess.R_turned_camera) if augment.view_deg > 0 else batch
    sensors = made_strange(sensor_inputs(view, grid), config.strange, generator)
    inputs = NetworkInputs(sensors, guess.T_camera_lidar, guess.T_camera_radar, guess.T_lidar_radar)
    answers: list[Predictions] = passes(inputs)
    turned = pose(guess.R_turned_camera, torch.zeros_like(guess.R_turned_camera[..., 0]))
    semantics = _semantics(answers, view, turned, grid)
    pairs = PAIRS_OF[config.pairs]
    total, terms = _alignment(answers, guess, batch, config, paper)
    evidence = _evidence(answers, batch, turned, grid, generator)
    last = answers[-1]
    camera = guess.unturned(last.T_camera_lidar), guess.unturned(last.T_camera_radar)
    found = torch.stack([*camera, last.T_lidar_radar], 1).detach()
    references = torch.stack([batch.T_camera_lidar, batch.T_camera_radar, batch.T_lidar_radar], 1)
    twist = twist_between(found, references)
    uncertainty = uncertainty_loss(last.log_variance, twist)
    judged = total + config.loss.evidence * evidence
    loss = judged + config.loss.semantics * semantics + config.uncertainty_weight * uncertainty
    report = {f"term/{name}": value.detach().mean() for name, value in terms.items()}
    report |= {"loss": loss, "alignment": total.detach(), "semantics": semantics.detach()}
    report |= {"uncertainty": uncertainty.detach(), "evidence": evidence.detach(), "judged": judged.detach()}
    for i, pair in enumerate(PAIRS):
        if pair in pairs:
            turns_deg = twist[:, i, :3] * _DEG
            report[f"scatter_deg/{pair}"] = turns_deg.square().sum(-1).mean().sqrt()
            report |= {f"mean_deg/{pair}/{a}": turns_deg[:, k].mean() for k, a in enumerate("xyz")}
    return report


def _alignment(
    answers: list[Predictions], guess: Guess, batch: TrainingBatch, config: TrainConfig,
    paper: PaperFrames | None,
) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Loss of the answers, mean over frames and passes, and the terms of the last pass."""
    objective, pairs = None if paper else FrameObjective(batch), PAIRS_OF[config.pairs]
    total = torch.zeros((), device=batch.T_camera_lidar.device)
    terms: dict[str, Tensor] = {}
    for answer in answers:
        T_camera_lidar, T_camera_radar = map(guess.unturned, (answer.T_camera_lidar, answer.T_camera_radar))
        poses = (T_camera_lidar, T_camera_radar, answer.T_lidar_radar)
        if objective is not None:
            terms = objective.terms(*poses, pairs)
            value = weighted(terms, config.loss)
        else:
            assert paper is not None
            terms = paper.terms(batch, *poses, pairs)
            value = torch.stack(list(terms.values())).sum(0)
        total = total + value.mean() / len(answers)
    return total, terms


def _semantics(answers: list[Predictions], view: TrainingBatch, turned: Tensor, grid: Grid) -> Tensor:
    """Cross-entropy of the encoders; the reference carries the classes to points as the image saw them."""
    grid_class = crop(view.grid_class, view.grid_step_deg, grid)
    lidar = transform_points(turned @ view.T_camera_lidar, at_lag(view, view.lidar_xyz_m, view.camera_lag_s))
    radar = transform_points(turned @ view.T_camera_radar, view.radar_xyz_m)
    clouds = ((lidar, view.lidar_valid), (radar, view.radar_valid))
    of_points = [class_of_points(grid_class, *cloud, grid) for cloud in clouds]
    # The camera's logits are the same in all passes; the lidar is rendered anew in each.
    return torch.stack([semantics_loss(a, grid_class, *of_points) for a in answers]).mean()


def _evidence(
    answers: list[Predictions], batch: TrainingBatch, turned: Tensor, grid: Grid, generator: torch.Generator
) -> Tensor:
    """Loss of the passes' evidence at the day's reference; 0 for networks without any."""
    total, T = torch.zeros((), device=batch.T_camera_lidar.device), turned @ batch.T_camera_lidar
    left, top, step = (math.radians(deg) for deg in (grid.left_deg, grid.top_deg, grid.cell_deg))
    projection = GridProjection(step / 2 - left, step / 2 - top, step)
    for e in (answer.evidence for answer in answers if answer.evidence is not None):
        points = transform_points(T, at_lag(batch, e.points_m, batch.camera_lag_s))
        cost = class_evidence_cost(projection, points, e.maps, e.probability, e.worth, generator)
        total = total + cost / len(answers)
    return total


def class_of_points(
    grid_class: UInt8[Tensor, "B H W"], points_camera: Float[Tensor, "B N 3"], valid: Bool[Tensor, "B N"],
    grid: Grid,
) -> Int64[Tensor, "B N"]:  # fmt: skip
    """Class of the cell that each point falls into; UNKNOWN_CLASS outside the grid."""
    row, column = grid_cells(sphere(points_camera), grid)
    inside = valid & (points_camera[..., 2] > 0.5) & (row >= 0) & (column >= 0)
    inside = inside & (row < grid.height) & (column < grid.width)
    cell = torch.where(inside, row.long() * grid.width + column.long(), 0)
    found = grid_class.flatten(1).long().gather(1, cell)
    return torch.where(inside, found, UNKNOWN_CLASS)


def semantics_loss(
    predictions: Predictions, grid_class: UInt8[Tensor, "B H W"], lidar_class: Int64[Tensor, "B N"],
    radar_class: Int64[Tensor, "B M"],
) -> Float[Tensor, ""]:  # fmt: skip
    """Cross-entropy of all encoders of one pass, 0 without any; `grid_class` is cropped as the image was."""
    loss = torch.zeros((), device=grid_class.device)
    if predictions.camera_logits is not None:
        loss = loss + _cross_entropy(predictions.camera_logits, grid_class.long())
    if predictions.lidar_logits is not None:
        # Each cell has the class of the point that it shows.
        index = predictions.lidar_index
        target = torch.where(index >= 0, lidar_class.gather(1, index.clamp(min=0)), UNKNOWN_CLASS)
        loss = loss + _cross_entropy(predictions.lidar_logits, target.reshape(grid_class.shape))
    if predictions.radar_logits is not None:
        radar = _cross_entropy(predictions.radar_logits.transpose(1, 2), radar_class)
        loss = loss + _RADAR_WEIGHT * radar
    return loss


def _cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    known = (target != UNKNOWN_CLASS).sum().clamp(min=1)
    return F.cross_entropy(logits.float(), target, ignore_index=UNKNOWN_CLASS, reduction="sum") / known


def uncertainty_loss(
    log_variance: Float[Tensor, "B 3 6"], scatter: Float[Tensor, "B 3 6"]
) -> Float[Tensor, ""]:
    """Negative log-likelihood of the scatter; only the variances learn from it, because the scatter has no gradient."""
    bounded = log_variance.clamp(*_LOG_VARIANCE)
    return 0.5 * (scatter.square() * torch.exp(-bounded) + bounded).mean()
