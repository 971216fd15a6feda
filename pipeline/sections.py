"""Sections of fleet.toml beside fleet, rigs and vehicles: what each stage may be told, with physical defaults."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, Field, field_validator, model_validator

from pipeline.rigs import Positive, Section
from schemas.calibrations import METHODS

__all__ = [
    "TERMS",
    "AuditConfig",
    "IngestConfig",
    "LearnConfig",
    "PerceiveConfig",
    "PrepareConfig",
    "ReportConfig",
    "SelectConfig",
    "SolveConfig",
    "TriggerConfig",
    "VerifyConfig",
]

Fraction = Annotated[float, Field(ge=0, le=1)]
Term = Literal[
    "edges", "reflectivity", "static", "boxes", "moving", "doppler", "time_offsets", "translation_prior"
]
TERMS: tuple[Term, ...] = get_args(Term)


def _known_method(name: str) -> str:
    if name not in METHODS:
        raise ValueError(f"{name!r} does not exist; choose from {', '.join(METHODS)}")
    return name


MethodName = Annotated[str, AfterValidator(_known_method)]


class IngestConfig(Section):
    """Synchronisation and what to keep."""

    # Largest difference of raw stamps within a moment, 0.005 in the paper's section 4.5.1. None = by motion: how far
    # the car may drive and turn between the stamps, beyond the day's constant gaps. Odometry knows that to 2 to 5 %, so
    # these leave some 10 cm and 0.1 deg, of either sign.
    sync_gate_s: Positive | None = None
    sync_gate_m: Positive = 2.5  # 45 ms at 55 m/s; 55 ms, the most that 30, 10 and 13 Hz leave, at 45 m/s
    sync_gate_deg: Positive = 2.0  # 55 ms at 36 deg/s
    # Sweeps of a vehicle-day that are read, a longer one in bursts. A calibration takes 100 frames (`select.frames`)
    # and is judged by a fifth of the day; four times as many leave it a choice.
    read_sweeps: Annotated[int, Field(gt=0)] | Literal["all"] = 400
    max_frames: Annotated[int, Field(gt=0)] | None = None  # of those read, evenly spread; None = all
    min_lidar_points: Annotated[int, Field(ge=0)] = 500
    min_radar_points: Annotated[int, Field(ge=0)] = 1
    max_lidar_range_m: Positive = 120.0
    deskew: bool = True

    @property
    def read_budget(self) -> int | None:
        """`read_sweeps` as a number, None = no limit."""
        return None if self.read_sweeps == "all" else self.read_sweeps

    @property
    def wider(self) -> IngestConfig:
        """The same, with twice the sweeps."""
        return self.model_copy(
            update={"read_sweeps": "all" if self.read_sweeps == "all" else 2 * self.read_sweeps}
        )


class PerceiveConfig(Section):
    """Feature extraction."""

    label_scale: Annotated[float, Field(ge=0.05, le=1)] = 0.5  # below it nothing is left of a car's image
    voxel_m: Positive = 0.25
    cluster_eps_m: Positive = 0.7
    cluster_min_points: Annotated[int, Field(gt=1)] = 8
    ground_inlier_m: Positive = 0.15
    edge_jump_m: Positive = 0.8
    edge_jump_fraction: Fraction = 0.06
    radar_cluster_eps_m: Positive = 1.8
    static_gate_mps: Positive = 0.45
    detection_min_score: Fraction = 0.3
    # Where models run and how many images they are shown at once: no part of the work key.
    providers: tuple[Annotated[str, Field(pattern=r"^[A-Za-z]+ExecutionProvider$")], ...] = ()
    batch: Annotated[int, Field(ge=1, le=64)] = 1

    def keyed(self) -> dict[str, Any]:
        """What features depend on, for the work key."""
        return self.model_dump(mode="json", exclude={"providers", "batch"})


class SelectConfig(Section):
    """The paper's frame selection, section 4.5.1, and how many frames a calibration takes."""

    frames: Annotated[int, Field(gt=0)] = 100
    holdout_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    min_sky: Fraction = 0.20
    min_drivable: Fraction = 0.10
    min_road_users: Annotated[int, Field(ge=0)] = 3
    min_radar_clusters: Annotated[int, Field(ge=0)] = 3


class TriggerConfig(Section):
    """The paper's triggers, section 4.5.2."""

    when: Literal["always", "triggered"] = "always"
    lidar_outside_fraction: Fraction = 0.01
    radar_outside_image: Annotated[int, Field(ge=0)] = 1
    radar_outside_lidar: Annotated[int, Field(ge=0)] = 1
    drivable_outside_fraction: Fraction = 0.01


class SolveConfig(Section):
    """Search range and effort; `paper_*` steer the paper's DE and Nelder-Mead."""

    search_rotation_deg: Positive = 6.0
    search_translation_m: Positive = 0.3
    paper_population: Annotated[int, Field(gt=3)] = 90
    paper_generations: Annotated[int, Field(gt=0)] = 60
    # of joint-optimisation, in equation 2: each pair's loss over its pairwise minimum, or to the letter
    paper_loss_scale: Literal["pairwise_minimum", "none"] = "pairwise_minimum"
    bootstrap_blocks: Annotated[int, Field(gt=1)] = 24
    time_offset_sigma_s: Positive = 0.05
    terms: tuple[Term, ...] = (
        TERMS  # of method joint (`doppler`: of networks too); leave some out to see what they are worth
    )
    polish: bool = False  # of the SSL methods: let method joint finish from the network's answer
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _terms_differ_and_show_the_lidar(self) -> SolveConfig:
        if len(set(self.terms)) < len(self.terms):
            raise ValueError(f"terms names one twice: {', '.join(self.terms)}")
        if not {"edges", "reflectivity"} & set(self.terms):
            raise ValueError(
                "terms needs edges or reflectivity: nothing else brings camera and lidar together"
            )
        if not {"static", "moving"} & set(self.terms):
            raise ValueError("terms needs static or moving: nothing else brings lidar and radar together")
        return self


class PrepareConfig(Section):
    """Training data: the camera's grid, how much of each cloud, and how frames are split."""

    grid_step_deg: Annotated[float, Field(ge=0.1, le=0.5)] = 0.4
    # A lidar's 60 x 24 deg, 8 deg about it for the guess to be wrong, 6 deg to turn the camera by in training.
    grid_width_deg: Annotated[float, Field(ge=20, le=160)] = 89.6
    grid_height_deg: Annotated[float, Field(ge=10, le=90)] = 51.2
    lidar_points: Annotated[int, Field(ge=256)] = 8192
    cluster_points: Annotated[int, Field(ge=64)] = 1024
    edge_points: Annotated[int, Field(ge=64)] = 768
    max_frames: Annotated[int, Field(gt=0)] | None = None  # per vehicle-day, evenly spread; None = all
    # A frame that the vehicle hardly moved for says nothing new.
    min_step_m: Annotated[float, Field(ge=0)] = 0.5
    # What no two sides share; in fleet.toml also one word: "vehicle", "day", "place" or "all".
    split_by: tuple[Literal["vehicle", "day", "place"], ...] = ("vehicle", "day", "place")
    val_fraction: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    test_fraction: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    positions: Literal["local", "map"] = "local"  # map: odometry of all logs is in one frame (GNSS, a map)
    place_m: Positive = 100.0  # side of a place's cell
    place_s: Positive = 20.0  # stretch of a drive that counts as a place where the log has no positions
    # Frames of one drive this near to another split are left out.
    guard_s: Annotated[float, Field(ge=0)] = 3.0
    # Of 256 fingerprint bits: fewer differ = same view.
    duplicate_bits: Annotated[int, Field(ge=0, le=128)] = 16
    seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("split_by", mode="before")
    @classmethod
    def _one_word_will_do(cls, value: object) -> object:
        if value == "all":
            return ("vehicle", "day", "place")
        return (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _splits_make_sense(self) -> PrepareConfig:
        if not self.split_by or len(set(self.split_by)) != len(self.split_by):
            raise ValueError("split_by must name at least one of vehicle, day, place, each once")
        if abs(self.grid_step_deg * 10 - round(self.grid_step_deg * 10)) > 1e-9:
            raise ValueError("grid_step_deg must be a multiple of 0.1: distances are stored in such steps")
        return self

    @property
    def grid_shape(self) -> tuple[int, int]:
        """(height, width) in cells, whole multiples of 16: networks halve them four times."""
        sides = (self.grid_height_deg, self.grid_width_deg)
        height, width = (16 * max(1, round(side / self.grid_step_deg / 16)) for side in sides)
        return height, width


class VerifyConfig(Section):
    """What an accepted calibration must be good for, and from where on a check of a pair fails.

    Limits are of the errors of azimuth and elevation at targets 15 to 40 m away. The thresholds below them were chosen
    on simulated days (seeds 140 to 145, demo and paper rig, 40 frames; 24 good days and 28 with faults), and on the
    real day for the question what methods that are 0.3 to 0.8 deg off look like. `prior_sigmas` are sigmas of the
    prior, other `sigmas` those of the quantity itself; `z` is a one-sided normal deviate of the paired test on
    held-out frames.
    """

    camera_lidar_limit_deg: Positive = 0.2
    radar_limit_deg: Positive = 0.4
    # Of a radar's elevation, the coarser of its two angles: aperture is scarce upwards.
    radar_elevation_limit_deg: Positive = 0.6
    # Probability that an error stays within the limit, before a direction is certified.
    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.995
    # A move this large happens once in 16,000 days if the prior's sigma is right.
    max_move_prior_sigmas: Positive = 4.0
    # z above which held-out frames align worse than at the prior. One-sided 1 %: a right result near a good prior
    # aligns worse by chance.
    worse_alignment_z: Positive = 2.33
    # -z from which they align better. One-sided 16 %: short days hold out some ten frames, and 5 % would hold right
    # results that moved by 10 cm.
    better_alignment_z: Positive = 1.0
    # A result within so many of its sigmas of the prior need not align better; the largest of six degrees of freedom.
    prior_agreement_sigmas: Positive = 4.0
    # Frames of the fit: with fewer the record is refused, camera-lidar of 5 or more held. Selection refuses a pair with
    # fewer before that.
    min_fit_frames: Annotated[int, Field(ge=8)] = 8
    # Frames, and blocks of frames that share a scene, without which held-out data decide nothing.
    min_held_out_frames: Annotated[int, Field(ge=1)] = 3
    min_held_out_blocks: Annotated[int, Field(ge=2)] = 3
    # Held-out frames that would move the result by more of that move's sigmas contradict it.
    held_out_contradiction_sigmas: Positive = 3.0
    # An open loop of three independent estimates is an error of one of them beyond so many sigmas of the loop.
    max_loop_sigmas: Positive = 3.0
    # Camera-lidar was solved along the prior's heading: beyond so many of its sigmas that heading was wrong ...
    heading_change_prior_sigmas: Positive = 3.0
    # ... and the record is held where this costs more than this share of `camera_lidar_limit_deg`.
    max_heading_error_share: Fraction = 0.25


class LearnConfig(Section):
    """Networks of the methods `joint-ssl` and `pairwise-ssl`; left out: those that come with Boresight."""

    model: str | None = None  # ONNX file of the joint network, relative to fleet.toml
    pairwise_models: dict[Literal["camera_lidar", "camera_radar", "lidar_radar"], str] = Field(
        default_factory=dict
    )
    iterations: Annotated[int, Field(ge=1, le=5)] = 3  # passes per frame, each rendered at the one before
    threads: Annotated[int, Field(ge=1)] = 1
    # What a network that takes classes is shown of a frame with labels: both, its image alone, or its classes alone.
    camera: Literal["both", "image", "classes"] = "both"


class ReportConfig(Section):
    """What pages show."""

    # "hidden": people and vehicles in mosaic, as far as perception found them, faces and number plates with them.
    road_users: Literal["shown", "hidden"] = "shown"


class AuditConfig(Section):
    """Control charts."""

    method: MethodName = "joint"
    false_alarms_per_1000_vehicle_days: Positive = 1.0
    baseline_days: Annotated[int, Field(gt=0)] = 2  # a chart says nothing until it has one day more than this
    # Held days weigh less: held-out frames did not confirm them.
    held_sigma_factor: Annotated[float, Field(ge=1)] = 2.0
    # First accepted days that tonight is held against, for good.
    reference_days: Annotated[int, Field(gt=1)] = 10
    # Audited days where the command names no first day.
    window_days: Annotated[int, Field(gt=2, le=3660)] = 28
    camera_lidar_limit_deg: Positive = 0.1
    radar_limit_deg: Positive = 0.25
    translation_limit_m: Positive = 0.05
