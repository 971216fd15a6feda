"""train.toml as frozen values; unknown keys and impossible values are errors.

The defaults are the paper's recipe where it gives one: Adam (0.9, 0.999), batch 4, cosine from 3e-4 to 3e-7.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipeline.core.config import read_toml, validated
from pipeline.learn.sample.grid import PAIRS, Grid, NetworkConfig

__all__ = [
    "PAIRS_OF", "AugmentConfig", "DescentConfig", "LossConfig", "StrangeConfig", "TrainConfig",
    "load_train_config",
]  # fmt: skip

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(gt=0)]

# Pairs whose terms a network is judged by; `joint` stands for the loop.
PAIRS_OF: dict[str, tuple[str, ...]] = {"joint": (*PAIRS, "joint"), **{pair: (pair,) for pair in PAIRS}}


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LossConfig(_Section):
    """Weights of the terms; angles count in degrees. 0 leaves a term out."""

    # "grid": this project's terms on the grid, weighted as below. "paper": the objective of `joint-optimisation`, L_P +
    # L_G, all weights one (those below count for nothing), from observations; and the paper's inputs, no more.
    definition: Literal["grid", "paper"] = "grid"
    edges: NotNegative = 1.0
    tracks_camera: NotNegative = 1.0
    static: NotNegative = 1.0
    tracks_lidar: NotNegative = 0.5
    loop: NotNegative = 1.0
    # Of the day's reference: holds what frames do not determine, and outweighs the biases of the other terms, which
    # on the real car have their minima 0.1 deg of yaw and 0.2 deg of pitch beside `joint`.
    prior: NotNegative = 0.5
    semantics: NotNegative = 1.0  # the encoders' cross-entropy to the precomputed classes
    evidence: NotNegative = 1.0  # of the day's reference, against poses around it


class AugmentConfig(_Section):
    """Sizes of the random errors of the guess and of the turned camera view in training, and mirrored frames.

    The paper moves the lidar's and the radar's clouds at random. Turning the camera's view as well keeps a
    network from memorising one viewpoint, mirrored frames from learning a side.
    """

    rotation_deg: NotNegative = 3.0  # per axis, even
    translation_m: NotNegative = 0.1  # per axis, even
    # Of the frames, moved by u^2 of that with u even in 0..1.
    small_share: Share = 0.5
    view_deg: NotNegative = 4.0  # per axis, even; the stored grid must be wider than the network's by as much
    mirror_share: Share = 0.5  # of the frames


class StrangeConfig(_Section):
    """Domain randomisation: nothing of one renderer, segmenter or lidar is to be learned.

    Inputs of the losses stay as they are. All off by default, for a fleet's own logs.
    """

    # Light, colour, texture, blur and noise; at 1 a road may be reddish or half in shadow.
    image: NotNegative = 0.0
    # Errors of the given classes, beyond those that the labels have; 1 = a weak segmenter.
    classes: NotNegative = 0.0
    no_classes: Share = 1 / 3  # of the frames: the image alone
    no_image: Share = 0.0  # of the frames with classes: the classes alone
    # Echoes, heights, missing points; at 1 about what lidars of two makers differ by.
    lidar: NotNegative = 0.0
    fewer_rows: Share = 0.0  # of the frames: rows of the sweep 1 to 2.2 deg apart


class DescentConfig(_Section):
    """Settings of the training loop for any network."""

    batch_size: Count = 4  # frames per process
    steps: Count | None = None
    learning_rate: Positive = 3e-4
    final_learning_rate: Positive = 3e-7
    adam_betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]] = (0.9, 0.999)
    gradient_norm: Positive = 10.0  # longer gradients are cut: single frames can be wild
    log_every: Count = 10  # steps
    checkpoint_minutes: Positive = 5.0
    diverged_factor: Annotated[float, Field(gt=1)] = 10.0  # times the smallest smoothed loss so far
    seed: int = 0

    @model_validator(mode="after")
    def _rates_fall(self) -> DescentConfig:
        if self.final_learning_rate > self.learning_rate:
            raise ValueError("final_learning_rate must not exceed learning_rate")
        return self


class TrainConfig(DescentConfig):
    """The whole of train.toml."""

    architecture: Literal["matching", "concat"] = "matching"
    pairs: Literal["joint", "camera_lidar", "camera_radar", "lidar_radar"] = "joint"
    # Of the network's grid; the data's must be the same.
    cell_deg: Annotated[float, Field(ge=0.1, le=0.5)] = 0.4
    width: Count = 16  # channels of the encoders' first stage
    hidden: Count = 192
    # Besides its image the camera shows what a segmenter makes of it, where there is one.
    takes_classes: bool = False
    marks: bool = False  # bright ground of the sweep is matched with paint in the image
    iterations: Annotated[int, Field(ge=1, le=5)] = 1  # passes per frame; losses of all passes are averaged
    epochs: Positive = 20.0  # where steps are not given
    # In place of epochs: the run ends, and the cosine, after so much time.
    budget_minutes: Positive | None = None
    # Of the likelihood of each frame's scatter about its day's reference, which teaches the log variances.
    uncertainty_weight: NotNegative = 0.01
    validate_every: Count = 500  # steps
    validation_frames: Count = 128
    loss: LossConfig = LossConfig()
    augment: AugmentConfig = AugmentConfig()
    strange: StrangeConfig = StrangeConfig()

    @property
    def needs_reference(self) -> bool:
        """Whether encoders learn classes of points, which only a day's record of `joint` carries to them unbiased."""
        return self.architecture == "matching" and self.pairs != "lidar_radar"

    @property
    def network(self) -> NetworkConfig:
        """Structure of the network that is trained."""
        return NetworkConfig(
            self.architecture, self.pairs, Grid(self.cell_deg), self.width, self.hidden, self.takes_classes,
            self.marks,
        )  # fmt: skip

    @model_validator(mode="after")
    def _fits_together(self) -> TrainConfig:
        try:
            Grid(self.cell_deg)
        except ValueError as err:
            raise ValueError(f"cell_deg = {self.cell_deg:g}: {err}") from err
        if self.takes_classes and not self.needs_reference:
            raise ValueError("takes_classes must be false where no classes are matched: concat, lidar_radar")
        view = self.augment.view_deg, self.augment.mirror_share
        own = (self.architecture, *view, self.takes_classes, self.strange)
        if self.loss.definition == "paper" and own != ("concat", 0.0, 0.0, False, StrangeConfig()):
            problem = (
                "augment.view_deg = 0, augment.mirror_share = 0, and neither takes_classes nor [strange]"
            )
            raise ValueError(f'loss.definition = "paper" needs architecture = "concat", {problem}')
        return self


def load_train_config(path: Path | None, overrides: Mapping[str, object]) -> TrainConfig:
    """Read and validate train.toml; `overrides` of the command line win, None means not given.

    Raises:
        ConfigError: missing file, no TOML, unknown key, impossible value; the message names the key.
    """
    name = "train" if path is None else str(path)
    raw = {} if path is None else read_toml(path)
    return validated(TrainConfig, raw | {k: v for k, v in overrides.items() if v is not None}, name)
