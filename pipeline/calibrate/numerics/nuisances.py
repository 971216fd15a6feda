"""Errors that all frames of a day share and none shows: considered in a solution's covariance, not solved for.

Each is stated by how far it may have moved the solution (`Considered.rows`), and one formula adds all of them. They
are common to all days of a vehicle: its masks, borders and roads stay. NUISANCES has one row for each.

Source: Schmidt 1966 (considered parameters).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from pipeline.core.rigs import CameraPrior
from pipeline.rig.estimates import EDGE
from pipeline.rig.graph import Edge

__all__ = [
    "BORDER_SHARE", "BOX_ELEVATION_GATES_RAD", "BOX_ROLL_FLOOR_CAMERA_RAD", "CAMERA_LIDAR_BIAS",
    "CAMERA_LIDAR_DT_FLOOR_S", "CAMERA_RADAR_BIAS", "DAY_CENTRE_SIGMAS", "DAY_FOCAL_FLOOR",
    "DAY_FOCAL_SIGMAS", "DAY_TRACKS_SIGMAS", "EDGE_SIDE_ALONE", "EDGE_SIDE_MOST_OF_GAP", "EDGE_SIDE_MOST_PX",
    "FOCAL_SIGMA", "HELD_OUT_BIAS", "INTRINSICS_CONTRADICTION_SIGMAS", "INTRINSICS_HALF_SIGMAS", "LIDAR_RADAR_BIAS",
    "LIDAR_RADAR_DT_FLOOR_S", "NUISANCES", "OUTLIER_DENSITY", "PAPER_BIAS", "PRIOR_CONTRADICTION_SIGMAS",
    "RADAR_ELEVATION_BIAS_RAD", "RANGE_BIAS_SIGMA_M", "REGISTRATION_COMPARISON_SIGMA", "SWEEP_S",
    "TRACKING_BIAS_RAD", "TYPICAL_RANGE_M", "TYPICAL_SPEED_MPS", "TZ_COMMON_BIAS_M", "TZ_UNCHECKED_BIAS_M",
    "Considered", "Nuisance", "PartTurn", "by_sensor", "considered_covariance", "considered_numbers",
    "estimate_biases", "root_rows",
]  # fmt: skip


@dataclass(frozen=True)
class Nuisance:
    """Where an error comes from.

    Args:
        owner: kind of the sensor that brings it into all of its edges, or EDGE if it is of this pair alone.
        origin: its prior sigma and what showed it.
    """

    owner: str
    origin: str


NUISANCES: Final = {
    # camera-lidar
    "masks": Nuisance("camera", "CAMERA_LIDAR_BIAS: dilation of masks, focal length, rolling shutter"),
    "positions": Nuisance(EDGE, "CAMERA_LIDAR_BIAS: the same, as shifts"),
    "borders": Nuisance(EDGE, "BORDER_SHARE x scatter of the pulls of sides, ranges and halves of the image"),
    "along_paint": Nuisance(EDGE, "gradients along lines, which only run ahead"),
    "travel": Nuisance(EDGE, "CAMERA_LIDAR_DT_FLOOR_S x distance driven in it"),
    "traffic": Nuisance(EDGE, "the time offset, and the pose with it, without either half of the image"),
    "optical_axis": Nuisance(
        EDGE, "what edges and markings err by alike in tz: `profiles`, TZ_COMMON_BIAS_M"
    ),
    # lidar-radar
    "surfaces": Nuisance(EDGE, "LIDAR_RADAR_BIAS: radars see into objects, unobserved roll tilts azimuths"),
    "clock": Nuisance(
        EDGE, "LIDAR_RADAR_DT_FLOOR_S, and ten more steps of the time offset in its flat valley"
    ),
    "elevations": Nuisance(
        EDGE, "ElevationSpread, DOPPLER_PITCH_FLOOR_RAD, Heights.floor_rad: sources of pitch"
    ),
    "seen_low": Nuisance(EDGE, "SeenLow, TravelDirections.bias_rad: detections measured too low"),
    # camera-radar
    "boxes": Nuisance("radar", "CAMERA_RADAR_BIAS: how a radar sees cars, whichever camera has their boxes"),
    # lidar-lidar and edges to the vehicle frame
    "matching": Nuisance(EDGE, "floors of `edges/`: between halves and days of vehicles that did not change"),
    "stance": Nuisance("base", "edges.on_base.STANCE: load, springs and toe"),
    "hills": Nuisance("base", "edges.camera_base: roads that bend upward or downward within a turn"),
    "beams": Nuisance(EDGE, "edges.lidar_base: elevations of beams, where the road alone shows a tilt"),
    "ranges": Nuisance("lidar", "edges.lidar_base: ranges of the road"),
    "centre": Nuisance("camera", "edges.camera_base: principal point"),
    "aside": Nuisance(EDGE, "edges.camera_base: distortion and turn of a camera that does not look ahead"),
}


@dataclass(frozen=True, eq=False)
class Considered:
    """By how much an error may have moved a solution, one row for each independent part of it.

    Args:
        name: of NUISANCES.
        rows: one sigma each, of the solution's unknowns [rad, m, s].
        in_weights: the weights of the data count it already: it is part of the solution's scatter.
    """

    name: str
    rows: Float[np.ndarray, "K P"]
    in_weights: bool = False

    def __post_init__(self) -> None:
        assert self.name in NUISANCES, self.name

    @property
    def owner(self) -> str:
        """Kind of the sensor that brings it, or EDGE."""
        return NUISANCES[self.name].owner

    def of_pose(self, J: Float[np.ndarray, "6 6"]) -> Considered:
        """The same of a pose; J is its derivative by the first six unknowns."""
        return replace(self, rows=self.rows[:, :6] @ J.T)


def considered_covariance(errors: Iterable[Considered]) -> Float[np.ndarray, "P P"]:
    """Sum of their covariances: they are independent of each other."""
    rows = np.vstack([error.rows for error in errors])
    return rows.T @ rows


def estimate_biases(errors: Iterable[Considered], to_left: Float[np.ndarray, "6 6"]) -> dict[str, Any]:
    """`bias` and `bias_in_weights` of a `PairEstimate`.

    Args:
        to_left: derivative of the pose's left perturbation by the first six unknowns.
    """
    moved = [error.of_pose(to_left) for error in errors]
    within = [error for error in moved if error.in_weights]
    return {
        "bias": _by_owner(error for error in moved if not error.in_weights),
        "bias_in_weights": considered_covariance(within) if within else None,
    }


def by_sensor(errors: Iterable[Considered], edge: Edge) -> Mapping[str, Float[np.ndarray, "6 6"]]:
    """`bias` of an `EdgeEvidence`; the rows of each error are in axes of its owner."""
    names: dict[str, str] = {sensor.kind: sensor.name for sensor in edge.sensors}
    return {names.get(owner, owner): C for owner, C in _by_owner(errors).items()}


def _by_owner(errors: Iterable[Considered]) -> dict[str, Float[np.ndarray, "6 6"]]:
    errors = list(errors)
    owners = dict.fromkeys(error.owner for error in errors)
    return {owner: considered_covariance(e for e in errors if e.owner == owner) for owner in owners}


def root_rows(covariance: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """Rows of a covariance, one for each principal axis."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))).T


def considered_numbers(errors: Iterable[Considered], *, of_camera: bool) -> dict[str, float]:
    """Sigma of the parent's pitch and yaw by each error, for the record [deg]; the parent is a camera or a lidar."""
    axes = {"pitch": 0, "yaw": 1} if of_camera else {"pitch": 1, "yaw": 2}
    return {
        f"{error.name}_{axis}_deg": float(np.degrees(np.linalg.norm(error.rows[:, k])))
        for error in errors
        for axis, k in axes.items()
    }


# --------------------------------------------------------------------------------------------------
# Bias floors: errors that no number of frames reduces, assumed of sensors and scenes, each with its origin.
#
# A bias floor is the standard deviation of an error common to all frames of a day, which resampling frames does
# not show; it is added to an estimate's covariance in quadrature. Order of six: rotation vector, then shift of
# the child's origin, both in the parent's axes [rad, m]; of eight: then time offset [s] and the pair's nuisance
# (focal scale, range bias [m]). Held-out frames err by the same as those of the fit (`HELD_OUT_BIAS`).

# -- camera-lidar ----------------------------------------------------------------------------------------------------

# Mask dilation, focal length off by 0.1 to 0.5 %, rolling shutter, as errors at known poses show them; y: what
# simulated days of seeds 110 to 145 err by.
CAMERA_LIDAR_BIAS = np.array([np.radians(0.03)] * 3 + [0.01, 0.006, 0.01])
CAMERA_LIDAR_DT_FLOOR_S = 0.004
# How far boundaries of one side (left, right, feet, tops) lie beside its jumps: labels are too wide, and edges anywhere
# between two beams. At most, on 34 good days of thirteen rigs: one label pixel and .4 of the angle between beams; what
# the sources of one day are compared with.
EDGE_SIDE_MOST_PX, EDGE_SIDE_MOST_OF_GAP = 1.0, 0.4
# Variance of the bias by borders, in units of the scatter of their pulls over sides, thirds of range and halves of the
# image: 66 days of drawn worlds, rows and rigs allow 3 to 6; days of clean labels alone would ask for none. On 63 fresh
# drawn worlds 5.8, with the floor of rotations at .01 deg for .03 and 1.25 of the variance by traffic, accepted 15
# camera-lidar records for 19, at a log score .06 to .09 nats an axis worse.
BORDER_SHARE = 3.0
# One side alone is off by at least this share of a label pixel and of the angle between beams, in quadrature: no other
# side takes back what its labels or the beams' gaps move it by (tops of one height, rows 1 deg apart: .5 deg).
EDGE_SIDE_ALONE = 0.3
# Relative sigma of the logged focal length. The solver leaves the focal length free within it, so that the position
# along the optical axis is no surer than the intrinsics.
FOCAL_SIGMA = CameraPrior.focal_sigma
# Focal length and principal point by the day alone, on 61 simulated days of seeds 110 to 199 (20 to 40 frames, 10 rigs,
# dusk and night among them): beside what its two starts leave open the focal length erred by 0.4 % RMS, hardly more
# where its formal sigma was 0.2 %, and the principal point by 3.3 formal sigmas.
DAY_FOCAL_FLOOR, DAY_FOCAL_SIGMAS, DAY_CENTRE_SIGMAS = 0.004, 2.0, 3.5
# ... by tracks by 2.1 formal sigmas (16 days of seeds 60 to 69, 112 to 117), 2.3 on cameras of four other cars.
DAY_TRACKS_SIGMAS = 2.5
# Beyond so many sigmas of day and CameraInfo together an intrinsic is contradicted: none of those days did.
INTRINSICS_CONTRADICTION_SIGMAS = 3.0
# ... and beyond so many of its own each half of the frames has to be: a whole at three is two halves at 2.1.
INTRINSICS_HALF_SIGMAS = 2.0
# Position along the optical axis: RMS distance of tz from the reference on halves of a real day (16 rings), where edges
# and markings do not check each other ...
TZ_UNCHECKED_BIAS_M = 0.18
# ... and what both err by alike: RMS error where they agreed, simulated days of seeds 110 to 125.
TZ_COMMON_BIAS_M = 0.05
SWEEP_S = 0.1  # rotating and scanning lidars alike run at 10 Hz
# Typical distance of what edges and markings lie on, and typical speed: steps in metres and seconds per step in pixels.
TYPICAL_RANGE_M, TYPICAL_SPEED_MPS = 12.0, 8.0

# -- lidar-radar -----------------------------------------------------------------------------------------------------

# A radar's own constant elevation error looks like pitch: a thirtieth of a car radar's resolution cell. For whoever
# uses its detections it is a turn of the radar, so the record's pitch is where detections point, and this widens
# nothing: the record's assumptions include it for the mounting.
RADAR_ELEVATION_BIAS_RAD = np.radians(0.2)
# Unobserved roll tilts azimuths; radars see into objects. Yaw, x and y: what the errors of 16 simulated days with known
# truth (40 frames; 0.021 deg, 0.029 m, 0.015 m) leave beyond resampling's 0.027 deg, 0.018 m and 0.010 m. Pitch: the
# RMS against where detections point of seeds 140 to 147 was 0.05 deg; what elevations and boxes have in common comes
# with them (`ElevationSpread`, the boxes' constants).
LIDAR_RADAR_BIAS = np.array([*np.radians([0.1, 0.05, 0.01]), 0.025, 0.013, 0.02])
LIDAR_RADAR_DT_FLOOR_S = 0.002  # halves of a real day differed by 3 ms where resampling gave 1
# Radars' own range bias, and what lies behind the surface that the lidar sees.
RANGE_BIAS_SIGMA_M = 0.05
# Density of stray static detections, in lidar points at distance 0: assigns about 40 % of a real radar's detections.
OUTLIER_DENSITY = 0.2
# Sigmas of azimuth [rad], elevation [rad] and range [m] at which poses are compared: wide in elevation, which is not
# what decides.
REGISTRATION_COMPARISON_SIGMA = np.array([np.radians(0.5), np.radians(6.0), 0.2])

# -- camera-radar without the lidar ----------------------------------------------------------------------------------

# Boxes of cars seen from behind and from the side are not centred on where radars see them; constants of elevation.
CAMERA_RADAR_BIAS = np.array([np.radians(0.3), np.radians(0.25), np.radians(0.1), 0.0, 0.0, 0.0])
# Roll by vehicle boxes was 1.0 deg RMS off on nine simulated days whose boxes predicted 0.5. Which detections of a box
# are taken moved it by 0.5 deg on real logs.
BOX_ROLL_FLOOR_CAMERA_RAD = np.radians(1.2)

# How far a detection's elevation may lie from its box's: at the start, and once pitch and roll are about right.
BOX_ELEVATION_GATES_RAD = (np.radians(12.0), np.radians(7.0))

# -- both radar pairs ------------------------------------------------------------------------------------------------

# A prior that the data contradict by more sigmas than this loses weight: the scale of its Cauchy weight.
PRIOR_CONTRADICTION_SIGMAS = 2.5

# -- held-out frames -------------------------------------------------------------------------------------------------

# With the time offset's floor and none for the pair's nuisance, whose sigma is stated with the frames' score.
HELD_OUT_BIAS = {
    "camera_lidar": np.array([*CAMERA_LIDAR_BIAS, CAMERA_LIDAR_DT_FLOOR_S, 0.0]),
    "lidar_radar": np.array([*LIDAR_RADAR_BIAS, LIDAR_RADAR_DT_FLOOR_S, 0.0]),
    "camera_radar": np.array([*CAMERA_RADAR_BIAS, 0.0, 0.0]),
}

# -- baselines -------------------------------------------------------------------------------------------------------

# The paper's losses at their minimum, largest RMS over axes, 100 simulated frames a day, 4 days: rotation [rad],
# translation [m] of each pair.
PAPER_BIAS = {
    "camera_lidar": (np.radians(0.33), 0.06),
    "camera_radar": (np.radians(0.56), 0.11),
    "lidar_radar": (np.radians(0.88), 0.32),
}
# What all tracks have in common: the accuracy that the authors of `tracking` claim. Simulated days err by 0.1 to
# 0.2 deg at the targets; on the real logs (16 rings) camera elevation differs by 0.4 deg from the calibration given
# with them.
TRACKING_BIAS_RAD = np.radians([0.2, 0.2, 0.2])


@dataclass(frozen=True)
class PartTurn:
    """Rotation from the solution to the best one by a part alone, other unknowns at the solution or as they follow.

    Args:
        scatter_rad: of the offset, by the data.
        floor_rad: of what all scenes share: labels too wide, beams too far apart, a source's own bias.
        axis: of a camera 0 pitch, 1 yaw: about its x and y; of a radar 0, its pitch.
        part_of: the part of which this is a half: it contradicts the other half alone.
    """

    name: str
    offset_rad: float
    scatter_rad: float
    floor_rad: float = 0.0
    axis: int = 0
    part_of: str = ""

    @property
    def sigma_rad(self) -> float:
        """Sigma of the offset."""
        return float(np.hypot(self.scatter_rad, self.floor_rad))

    @property
    def sentence(self) -> str:
        """Name of the part and its rotation."""
        return f"{self.name} by {np.degrees(self.offset_rad):+.2f} +- {np.degrees(self.sigma_rad):.2f} deg"

    def wider(self, sigma_rad: float) -> PartTurn:
        """The turn with an error more that its scenes share."""
        floor_rad = float(np.hypot(self.floor_rad, sigma_rad))
        return PartTurn(self.name, self.offset_rad, self.scatter_rad, floor_rad, self.axis, self.part_of)
