"""Sections of fleet.toml with the settings of each stage (all but fleet, rigs and vehicles)."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import AfterValidator, Field, field_validator, model_validator

from pipeline.core.rigs import Positive, Section
from schemas.calibrations import METHODS

__all__ = [
    "TERMS", "AuditConfig", "ChecksConfig", "IngestConfig", "LearnConfig", "PerceiveConfig", "PrepareConfig",
    "ReportConfig", "SearchRange", "SelectConfig", "SolveConfig", "TriggerConfig", "VerifyConfig",
]  # fmt: skip

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
    """Synchronisation of the sensors, and which data to keep."""

    # Largest difference of raw stamps within a moment; 0.005 in section 4.5.1 of the paper. None = limited by
    # motion: how far the car may drive and turn between the stamps, after the day's constant clock offsets
    # are removed. Odometry is accurate to 2 to 5 %, so the limits below leave errors of about 10 cm and 0.1
    # deg, of either sign.
    sync_gate_s: Positive | None = None
    # 45 ms at 55 m/s. Sensors of 30, 10 and 13 Hz are at most 55 ms apart, which is 2.5 m at 45 m/s.
    sync_gate_m: Positive = 2.5
    sync_gate_deg: Positive = 2.0  # 55 ms at 36 deg/s
    # Lidar sweeps read per vehicle-day; a longer day is read in bursts. A calibration takes 100 frames
    # (`select.frames`), and a fifth of the day is held out; four times as many frames leave enough to choose
    # from.
    read_sweeps: Annotated[int, Field(gt=0)] | Literal["all"] = 400
    max_frames: Annotated[int, Field(gt=0)] | None = None  # of the sweeps read, evenly spread; None = all
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
        """Copy with twice as many sweeps to read."""
        return self.model_copy(
            update={"read_sweeps": "all" if self.read_sweeps == "all" else 2 * self.read_sweeps}
        )


class PerceiveConfig(Section):
    """Feature extraction."""

    # at smaller scales the image of a car disappears
    label_scale: Annotated[float, Field(ge=0.05, le=1)] = 0.5
    voxel_m: Positive = 0.25
    cluster_eps_m: Positive = 0.7
    cluster_min_points: Annotated[int, Field(gt=1)] = 8
    ground_inlier_m: Positive = 0.15
    edge_jump_m: Positive = 0.8
    edge_jump_fraction: Fraction = 0.06
    radar_cluster_eps_m: Positive = 1.8
    static_gate_mps: Positive = 0.45
    detection_min_score: Fraction = 0.3
    # ONNX Runtime providers in order of preference, and images per run of a model; not in the work key.
    providers: tuple[Annotated[str, Field(pattern=r"^[A-Za-z]+ExecutionProvider$")], ...] = ()
    batch: Annotated[int, Field(ge=1, le=64)] = 1

    def keyed(self) -> dict[str, Any]:
        """Settings that features depend on, for the work key."""
        return self.model_dump(mode="json", exclude={"providers", "batch"})


class SelectConfig(Section):
    """Frame selection of section 4.5.1 of the paper, and the number of frames of a calibration."""

    frames: Annotated[int, Field(gt=0)] = 100
    holdout_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    min_sky: Fraction = 0.20
    min_drivable: Fraction = 0.10
    min_road_users: Annotated[int, Field(ge=0)] = 3
    min_radar_clusters: Annotated[int, Field(ge=0)] = 3


class TriggerConfig(Section):
    """Triggers of section 4.5.2 of the paper."""

    when: Literal["always", "triggered"] = "always"
    lidar_outside_fraction: Fraction = 0.01
    radar_outside_image: Annotated[int, Field(ge=0)] = 1
    radar_outside_lidar: Annotated[int, Field(ge=0)] = 1
    drivable_outside_fraction: Fraction = 0.01


# Half-width of the searched box per axis, in sigmas of the prior. Rotation: 95 % of the prior. Translation:
# half a metre changes the directions of most points by a degree or two only, which local refinement covers.
_SIGMAS_ROTATION, _SIGMAS_TRANSLATION = 2.0, 1.2


class SearchRange(NamedTuple):
    """Half-widths of the searched box per axis."""

    rotation_rad: float
    translation_m: float


class SolveConfig(Section):
    """Search range and effort; `paper_*` are for the paper's differential evolution and Nelder-Mead."""

    search_rotation_deg: Positive = 6.0
    search_translation_m: Positive = 0.3
    paper_population: Annotated[int, Field(gt=3)] = 90
    paper_generations: Annotated[int, Field(gt=0)] = 60
    # Method joint-optimisation, equation 2: divide each pair's loss by its pairwise minimum, or use the
    # equation exactly as printed.
    paper_loss_scale: Literal["pairwise_minimum", "none"] = "pairwise_minimum"
    bootstrap_blocks: Annotated[int, Field(gt=1)] = 24
    time_offset_sigma_s: Positive = 0.05
    terms: tuple[Term, ...] = (
        TERMS  # of method joint (`doppler`: of networks too); leave terms out to see how much they contribute
    )
    polish: bool = False  # of the SSL methods: method joint refines the network's answer
    seed: Annotated[int, Field(ge=0)] = 0

    def search_range(self, prior_sigmas: tuple[float, float]) -> SearchRange:
        """How far around a prior of these sigmas [rad, m] a solver must look: at least as far as configured."""
        rotation, translation = math.radians(self.search_rotation_deg), self.search_translation_m
        rotation = max(rotation, _SIGMAS_ROTATION * prior_sigmas[0])
        return SearchRange(min(rotation, math.pi), max(translation, _SIGMAS_TRANSLATION * prior_sigmas[1]))

    @model_validator(mode="after")
    def _terms_differ_and_show_the_lidar(self) -> SolveConfig:
        if len(set(self.terms)) < len(self.terms):
            raise ValueError(f"terms has an entry twice: {', '.join(self.terms)}")
        if not {"edges", "reflectivity"} & set(self.terms):
            raise ValueError("terms needs edges or reflectivity: no other term connects camera and lidar")
        if not {"static", "moving"} & set(self.terms):
            raise ValueError("terms needs static or moving: no other term connects lidar and radar")
        return self


class SplitConfig(Section):
    """How frames are split into training, validation and test, and when two of them are too much alike."""

    # What the splits must not share; in fleet.toml also one word: "vehicle", "day", "place", "all". Where it
    # is not set, jobs take the strictest keys that cost at most a fifth of the frames.
    by: tuple[Literal["vehicle", "day", "place"], ...] = ("vehicle", "day", "place")
    val_fraction: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    test_fraction: Annotated[float, Field(ge=0, le=0.4)] = 0.1
    positions: Literal["local", "map"] = "local"  # map: odometry of all logs is in one frame (GNSS, a map)
    place_m: Positive = 100.0  # side of the square cell that counts as one place
    place_s: Positive = 20.0  # part of a drive that counts as one place if the log has no positions
    # Frames of one drive that are closer in time than this to another split are left out.
    guard_s: Annotated[float, Field(ge=0)] = 3.0
    # Frames are left out that are nearer than half of this to a place of another split: what one sees, its
    # neighbour sees too. Half on each side, so that frames of two splits are about so far apart.
    guard_m: Annotated[float, Field(ge=0)] = 30.0
    # Two views are the same if fewer than this many of their 256 fingerprint bits differ.
    duplicate_bits: Annotated[int, Field(ge=0, le=128)] = 16

    @field_validator("by", mode="before")
    @classmethod
    def _one_word_will_do(cls, value: object) -> object:
        if value == "all":
            return ("vehicle", "day", "place")
        return (value,) if isinstance(value, str) else value

    @field_validator("by")
    @classmethod
    def _names_each_once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value or len(set(value)) != len(value):
            raise ValueError("must name at least one of vehicle, day, place, each once")
        return value


class GridConfig(Section):
    """Grid of the camera in training data: square cells about the optical axis."""

    step_deg: Annotated[float, Field(ge=0.1, le=0.5)] = 0.4
    # A lidar's 60 x 24 deg, plus 8 deg on each side for an error of the guess, plus 6 deg by which training
    # turns the camera.
    width_deg: Annotated[float, Field(ge=20, le=160)] = 89.6
    height_deg: Annotated[float, Field(ge=10, le=90)] = 51.2

    @field_validator("step_deg")
    @classmethod
    def _is_stored_exactly(cls, value: float) -> float:
        if abs(value * 10 - round(value * 10)) > 1e-9:
            raise ValueError("must be a multiple of 0.1: distances are stored in such steps")
        return value

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in cells, multiples of 16: networks halve them four times."""
        sides = (self.height_deg, self.width_deg)
        height, width = (16 * max(1, round(side / self.step_deg / 16)) for side in sides)
        return height, width


class ChecksConfig(Section):
    """Thresholds of the checks of a pair.

    They were chosen on simulated days (seeds 140 to 145, demo and paper rig, 40 frames; 24 good days and 28
    with faults), and on one real day, with results of methods that are wrong by 0.3 to 0.8 deg.
    `prior_sigmas` are sigmas of the prior, other `sigmas` are sigmas of the quantity itself; `z` is a
    one-sided normal deviate of the paired test on held-out frames.
    """

    # Largest move from the prior. It is exceeded once in 16,000 days if the prior's sigma is right.
    max_move_prior_sigmas: Positive = 4.0
    # The check fails if held-out frames align worse than at the prior by more than this z. One-sided 1 %: a
    # right result near a good prior can align worse by chance.
    worse_alignment_z: Positive = 2.33
    # Held-out frames align better than at the prior from this z on. One-sided 16 %: short days hold out about
    # ten frames, and 5 % would hold right results that moved by 10 cm.
    better_alignment_z: Positive = 1.0
    # A result within this many of its sigmas of the prior need not align better; for the largest of six
    # degrees of freedom.
    prior_agreement_sigmas: Positive = 4.0
    # Fewest frames of the fit; with fewer the record is refused (camera-lidar with 5 or more: held). Selection
    # refuses a pair with even fewer before that.
    min_fit_frames: Annotated[int, Field(ge=8)] = 8
    # Fewest held-out frames, and blocks of frames that share a scene; with fewer, held-out data decide
    # nothing.
    min_held_out_frames: Annotated[int, Field(ge=1)] = 3
    min_held_out_blocks: Annotated[int, Field(ge=2)] = 3
    # Held-out frames contradict a result if they would move it by more than this many sigmas of that move.
    held_out_contradiction_sigmas: Positive = 3.0


class PrepareConfig(Section):
    """Training data: points per cloud, frames per vehicle-day, the split, and the camera's grid."""

    lidar_points: Annotated[int, Field(ge=256)] = 8192
    edge_points: Annotated[int, Field(ge=64)] = 768
    max_frames: Annotated[int, Field(gt=0)] | None = None  # per vehicle-day, evenly spread; None = all
    # Shortest distance driven between frames: a frame from the same place adds nothing new.
    min_step_m: Annotated[float, Field(ge=0)] = 0.5
    seed: Annotated[int, Field(ge=0)] = 0
    split: SplitConfig = SplitConfig()
    grid: GridConfig = GridConfig()

    def split_with(self, **values: Any) -> PrepareConfig:
        """Copy with other values in [prepare.split]; they are not validated."""
        return self.model_copy(update={"split": self.split.model_copy(update=values)})


class VerifyConfig(Section):
    """Accuracy that an accepted calibration must have: errors of azimuth and elevation at 15 to 40 m."""

    camera_lidar_limit_deg: Positive = 0.2
    radar_limit_deg: Positive = 0.4
    # For the elevation of a radar, which is less accurate than its azimuth: its antenna is small in height.
    radar_elevation_limit_deg: Positive = 0.6
    # Smallest probability that an error is within its limit, for a direction to be certified.
    confidence: Annotated[float, Field(gt=0.5, lt=1)] = 0.995
    checks: ChecksConfig = ChecksConfig()

    def limits_rad(self, kind: str) -> tuple[float, float]:
        """Largest errors of azimuth and elevation that an edge of this kind may have."""
        camera_deg = self.camera_lidar_limit_deg
        radar_deg = self.radar_limit_deg, self.radar_elevation_limit_deg
        azimuth_deg, elevation_deg = radar_deg if "radar" in kind else (camera_deg, camera_deg)
        return math.radians(azimuth_deg), math.radians(elevation_deg)


class LearnConfig(Section):
    """Networks of the methods `joint-ssl` and `pairwise-ssl`; default: the networks of the package."""

    model: str | None = None  # ONNX file of the joint network, relative to fleet.toml
    pairwise_models: dict[Literal["camera_lidar", "camera_radar", "lidar_radar"], str] = Field(
        default_factory=dict
    )
    # passes per frame; each renders at the result of the previous pass
    iterations: Annotated[int, Field(ge=1, le=5)] = 3
    threads: Annotated[int, Field(ge=1)] = 1
    # Input of a network that takes classes, for frames with labels: image and classes, image only, or classes
    # only.
    camera: Literal["both", "image", "classes"] = "both"


class ReportConfig(Section):
    """Content of report pages."""

    # "hidden": pixelates people and vehicles that perception found, and so their faces and number plates.
    road_users: Literal["shown", "hidden"] = "shown"


class AuditConfig(Section):
    """Control charts and drift audit."""

    method: MethodName = "joint"
    false_alarms_per_1000_vehicle_days: Positive = 1.0
    # a chart gives no verdict until it has one day more than this
    baseline_days: Annotated[int, Field(gt=0)] = 2
    # Sigmas of held days are multiplied by this, because held-out frames did not confirm these days.
    held_sigma_factor: Annotated[float, Field(ge=1)] = 2.0
    # Tonight's state is compared with this many first accepted days; these reference days never change.
    reference_days: Annotated[int, Field(gt=1)] = 10
    # Number of days to audit if the command names no first day.
    window_days: Annotated[int, Field(gt=2, le=3660)] = 28
    camera_lidar_limit_deg: Positive = 0.1
    radar_limit_deg: Positive = 0.25
    translation_limit_m: Positive = 0.05
