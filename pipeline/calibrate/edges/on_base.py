"""What a day shows of the car, its sweeps and motion; robust regression of a sensor's turns on the vehicle frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.calibrate.numerics.frame_blocks import parts_of_day
from pipeline.calibrate.numerics.nuisances import Considered
from pipeline.calibrate.reasons import because
from pipeline.core.errors import SolveError
from pipeline.objective.ego_motion import DopplerMotion, EgoMotion, Odometry, ego_motion, motion_of
from pipeline.objective.ego_motion import backwards as sources_backwards
from pipeline.rig.day_prior import no_prior
from pipeline.rig.estimates import DayParts, OtherScenes
from pipeline.rig.graph import BASE
from pipeline.rig.prior import RigPrior
from pipeline.rig.se3 import adjoint, change_jacobian, changed, inverse
from pipeline.store.views import Chosen
from schemas.observations import Observation

__all__ = [
    "CHANGES", "STANCE", "DaySources", "Regression", "Rows", "Series", "changes_by_left", "first_and_last",
    "of_stance_and", "other_scenes", "regress",
]  # fmt: skip

_ODOMETRY = "odometry"


@dataclass(frozen=True)
class DaySources:
    """Data of a day that solvers of edges ask for (`EdgeKind.solver`).

    Args:
        road_z_m: where the road lies in axes of the base.
        heights: of lidars over the road by name, as somebody measured them, with sigmas [m].
        read: what a solver read already and needs again, by sensor.
    """

    prior: RigPrior
    lidars: tuple[str, ...]
    radars: tuple[str, ...]
    rows: Callable[[Chosen], list[Observation]]
    road_z_m: float = 0.0
    heights: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    read: dict[str, Any] = field(default_factory=dict)

    def sweeps(self, lidar: str) -> list[Observation]:
        """Moments of a lidar; raises SolveError if it is silent."""
        rows = self.rows({"lidar": lidar})
        if not rows:
            raise SolveError(because("silent", sensor=lidar, what="sweep"), "silent_sensor")
        return rows

    def on_base(self, name: str) -> Float[np.ndarray, "4 4"]:
        """T_base_sensor before the day; raises SolveError if it is unknown."""
        T = self.prior.between(BASE.name, name)
        if T is None:
            raise SolveError(no_prior(f"{BASE.name} and {name}"))
        return T

    @cached_property
    def dopplers(self) -> dict[str, dict[int, Observation]]:
        """Scans of each radar by moment."""
        return {name: {o.frame_index: o for o in self.rows({"radar": name})} for name in self.radars}

    def ego_at(self, rows: Sequence[Observation], without: str = "") -> EgoMotion:
        """Motion of the base at the rows' moments, by odometry and all radars but one."""
        radars = [name for name in self.radars if name not in (without, *self.backwards)]
        measured = [m for name in radars if (m := self.doppler(name, rows)) is not None]
        odometry = _odometry(rows)
        if _ODOMETRY in self.backwards:
            odometry = Odometry(odometry.speed_mps * np.nan, odometry.yaw_rate_radps * np.nan)
        return ego_motion(measured, odometry, heading=(0.0, 0.0))

    def odometry_mps(self, rows: Sequence[Observation]) -> Float[np.ndarray, " F"] | None:
        """Speed of the base at the rows' moments by odometry alone; None where none is logged, or it is backwards."""
        speed_mps = _odometry(rows).speed_mps
        return speed_mps if np.isfinite(speed_mps).any() and _ODOMETRY not in self.backwards else None

    def ego_by_cameras(self, radar: DopplerMotion, rows: Sequence[Observation]) -> EgoMotion:
        """Motion of the base at the rows' moments: turns by cameras, the radar's own speed, which shows no clock."""
        turns: dict[int, list[float]] = {}
        for name in (node.name for node in self.prior.nodes if node.kind == "camera"):
            z = self.on_base(name)[2, :3]
            for o in self.rows({"camera": name}):
                if o.motion_turn_rad is not None and o.motion_span_s is not None:
                    turns.setdefault(o.frame_index, []).append(float(z @ o.motion_turn_rad) / o.motion_span_s)
        yaw_rate = np.array([np.mean(turns.get(o.frame_index, [np.nan])) for o in rows])
        ahead, aside = radar.level()[0].T
        speed = np.where(np.isfinite(yaw_rate), np.copysign(np.hypot(ahead, aside), ahead), np.nan)
        return EgoMotion(np.stack([speed, 0.0 * speed], 1), yaw_rate, np.zeros((len(rows), 3, 3)))

    @cached_property
    def backwards(self) -> list[str]:
        """Sources of motion by which the car drives backwards, where others show that it does not."""
        rows = {name: list(self.dopplers[name].values()) for name in self.radars}
        measured = [m for name in self.radars if (m := self.doppler(name, rows[name])) is not None]
        odometry = [_odometry(of_radar).speed_mps for of_radar in rows.values() if of_radar]
        speeds = {m.name: m.level()[0][:, 0] for m in measured}
        return sources_backwards(speeds | {_ODOMETRY: np.concatenate(odometry)} if odometry else speeds)

    def doppler(self, name: str, rows: Sequence[Observation]) -> DopplerMotion | None:
        """A radar's velocities at the rows' moments; None if its pose on the vehicle is unknown."""
        T_base_radar = self.prior.between(BASE.name, name)
        if T_base_radar is None:
            return None
        scans = (self.dopplers[name].get(row.frame_index) for row in rows)
        known = [scan if scan is not None and scan.radar_velocity_mps is not None else None for scan in scans]
        velocity = [np.full(3, np.nan) if scan is None else scan.radar_velocity_mps for scan in known]
        covariance = [np.eye(3) if scan is None else scan.radar_velocity_cov for scan in known]
        return DopplerMotion(
            name, np.array(velocity, np.float64).reshape(-1, 3), np.array(covariance, np.float64).reshape(-1, 3, 3),
            T_base_radar, self.prior.sigmas_between(BASE.name, name)[0],
        )  # fmt: skip


def _odometry(rows: Sequence[Observation]) -> Odometry:
    _, odometry = motion_of(rows, np.eye(4), 1.0)
    return odometry


# --------------------------------------------------------------------------------------------------
# Robust linear regression with a covariance from the scatter of blocks of frames.


_PASSES = 20
_SCALES = 2.0  # of the Cauchy weight, in robust standard deviations
_LEAST = 1e-6
_FEW = 4


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of y = A x.

    Args:
        sigma: relative sigmas of the rows; their common scale is estimated.
        block: block of each row; errors within a block may be correlated.
        prior_sigmas: sigmas of coefficients about 0; infinite ones are free.
        share: weight of each row; the rows of one scene add up to one.
    """

    A: Float[np.ndarray, "N P"]
    y: Float[np.ndarray, " N"]
    sigma: Float[np.ndarray, " N"]
    block: Int[np.ndarray, " N"]
    prior_sigmas: Float[np.ndarray, " P"]
    share: Float[np.ndarray, " N"]

    def some(self, of: Bool[np.ndarray, " N"] | Int[np.ndarray, " M"]) -> Rows:
        """Some of the rows."""
        A, y, sigma, block, share = (a[of] for a in (self.A, self.y, self.sigma, self.block, self.share))
        return Rows(A, y, sigma, block, self.prior_sigmas, share)

    def residuals(self, x: Float[np.ndarray, " P"]) -> Float[np.ndarray, " N"]:
        """Of all rows, in sigmas of theirs."""
        return (self.y - self.A @ x) / self.sigma


@dataclass(frozen=True, eq=False)
class Regression:
    """Coefficients, their covariance, and the scatter of single rows (in units of their sigmas)."""

    value: np.ndarray  # P
    covariance: np.ndarray  # P P
    scatter: float
    halves: float  # half of what the first coefficient differs by between even and odd blocks; NaN of too few


def regress(rows: Rows) -> Regression | None:
    """Fit the rows.

    The covariance is, for each coefficient, the larger one of the sandwich estimate over blocks and that of
    independent rows. None for fewer than three blocks, or if there are no more rows than coefficients.
    """
    names = np.unique(rows.block)
    if len(names) < 3 or len(rows.y) <= rows.A.shape[1]:
        return None
    held, blocks, share = np.diag(1 / rows.prior_sigmas**2), rows.block, rows.share
    A_, y_ = rows.A / rows.sigma[:, None], rows.y / rows.sigma
    x, scale, weight = _fitted(A_, y_, held, share)
    H = (A_.T * weight) @ A_ / scale**2 + held
    scores = (A_ * (weight * (y_ - A_ @ x) / scale**2)[:, None]).astype(np.float64)
    of_blocks = np.stack([scores[blocks == b].sum(0) for b in names])
    spread = of_blocks.T @ of_blocks * _small_sample(len(names))
    H_inverse = np.linalg.inv(H)
    sandwich = H_inverse @ (spread + held) @ H_inverse
    widen = np.sqrt(np.maximum(np.diag(H_inverse) / np.maximum(np.diag(sandwich), 1e-300), 1.0))
    return Regression(x, sandwich * np.outer(widen, widen), scale, _halves(A_, y_, blocks, held, share))


def _small_sample(blocks: int) -> float:
    """Correction of a variance from few blocks: Student's t over the normal distribution, and the removed mean."""
    return blocks / (blocks - 1) * ((blocks - 1) / (blocks - 3) if blocks > _FEW else _FEW)


def _fitted(
    A: np.ndarray, y: np.ndarray, held: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray]:
    """Coefficients, robust scale and Cauchy weights for rows of unit sigma, starting from least absolute deviations."""
    weight, scale, x = share, 1.0, np.zeros(A.shape[1])
    for k in range(_PASSES):
        x = np.linalg.solve((A.T * weight) @ A / scale**2 + held, (A.T * weight) @ y / scale**2)
        r = np.abs(y - A @ x)
        scale = max(1.4826 * _median(r, share), _LEAST)
        far = r / scale
        weight = share / (1 + (far / _SCALES) ** 2) if k > _PASSES // 3 else share / np.maximum(far, 0.1)
    return x, scale, weight


def _median(values: np.ndarray, share: np.ndarray) -> float:
    order = np.argsort(values)
    below = np.cumsum(share[order])
    return float(values[order][np.searchsorted(below, 0.5 * below[-1])])


def _halves(A: np.ndarray, y: np.ndarray, blocks: np.ndarray, held: np.ndarray, share: np.ndarray) -> float:
    """Difference between the first coefficient of even blocks and the mean of even and odd blocks; NaN for too few."""
    even = np.unique(blocks, return_inverse=True)[1] % 2 == 0
    if min(even.sum(), (~even).sum()) <= 2 * A.shape[1]:
        return float("nan")
    one, other = (_fitted(A[half], y[half], held, share[half])[0][0] for half in (even, ~even))
    return float(abs(one - other) / 2)


# --------------------------------------------------------------------------------------------------
# A sensor on the vehicle frame: from changes of T_base_sensor to T_sensor_base, over halves and parts of a day.


# What all days of a car err by alike, as one sigma of roll, pitch, yaw and height of the base. Roads fall by about 2 %
# to the side that is driven on, so bodies that lean by some 5 deg/g and rear axles that slip by some 3 deg/g (Gillespie
# 1992, Fundamentals of vehicle dynamics) stand 0.1 deg off, on part of the roads. Tyres settle by a centimetre.
STANCE = np.array([*np.radians([0.05, 0.05, 0.05]), 0.01])
CHANGES = (0, 1, 2, 5)  # these of a change of T_base_sensor
_UNKNOWN_RAD = np.pi  # sigma of a part of the day that determines nothing


@dataclass(frozen=True, eq=False)
class Series:
    """Measured turns of a sensor about one axis of the base, in order of time.

    Args:
        axis: 0, 1, 2 = roll, pitch, yaw: the first coefficient of the rows.
        stance_rad: by which the car itself stands otherwise from scene to scene (1 sigma).
    """

    axis: int
    rows: Rows
    scene: Int[np.ndarray, " N"]
    stamp_ns: Int[np.ndarray, " N"]
    stance_rad: float


def changes_by_left(T_base_sensor: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Derivative of the change of T_base_sensor by the left perturbation xi of T_sensor_base.

    exp(xi) T_sensor_base is the inverse of exp(-Ad(T_base_sensor) xi) T_base_sensor.
    """
    return np.asarray(-change_jacobian(T_base_sensor) @ adjoint(T_base_sensor))


def of_stance_and(
    T_base_sensor: Float[np.ndarray, "4 4"], **changes: Float[np.ndarray, "_ 6"]
) -> list[Considered]:
    """The car's stance, and nuisances stated as changes of T_base_sensor, each in axes of its owner."""
    to_left = np.linalg.inv(changes_by_left(T_base_sensor))
    of_edge = [Considered(name, rows).of_pose(to_left) for name, rows in changes.items()]
    return [Considered("stance", np.diag(STANCE) @ np.eye(6)[list(CHANGES)]), *of_edge]


def other_scenes(
    T_base_sensor: Float[np.ndarray, "4 4"], fits: Sequence[tuple[int, Regression | None, float]]
) -> OtherScenes:
    """What halves of the scenes show of each other's fits.

    Args:
        fits: index of the change (roll, pitch, yaw, x, y, z) that is the first coefficient, the fit, and by how much
            the car itself stands otherwise (1 sigma) [rad, m].
    """
    shift, variance = np.zeros(6), np.zeros(6)
    for axis, fit, stance in fits:
        if fit is not None and np.isfinite(fit.halves):
            shift[axis], variance[axis] = fit.halves, fit.covariance[0, 0] + stance**2
    to_left = np.linalg.inv(changes_by_left(T_base_sensor))
    return OtherScenes(to_left @ shift, to_left @ np.diag(variance) @ to_left.T)


def first_and_last(T: Float[np.ndarray, "4 4"], series: Series) -> DayParts | None:
    """First and last part of the day of a sensor at T = T_base_sensor; None if it is too short."""
    whole = regress(series.rows)
    if whole is None:
        return None
    axis = T[series.axis, :3]  # of the base in the sensor's axes

    def solve(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        fit = regress(series.rows.some(rows))
        value, variance = (whole.value, _UNKNOWN_RAD**2) if fit is None else (fit.value, fit.covariance[0, 0])
        turn = np.zeros(6)
        turn[series.axis] = value[0]
        return value, inverse(changed(T, turn)), np.outer(axis, axis) * (variance + series.stance_rad**2)

    def scale(value: np.ndarray) -> np.ndarray:
        return np.asarray((series.rows.residuals(value) / (2 * whole.scatter)) ** 2)

    r = series.rows.residuals(whole.value)
    return parts_of_day(
        (series.rows.share * r / (1 + scale(whole.value)))[:, None],
        series.stamp_ns.tolist(),
        solve,
        lambda value: -series.rows.share * np.log1p(scale(value)),
        (int(np.argmax(np.abs(axis))),),
        series.scene,
    )
