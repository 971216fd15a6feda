"""A sensor on the vehicle frame: from changes of T_base_sensor to T_sensor_base, over halves and parts of a day."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.edges.robust_regression import Regression, Rows, regress
from pipeline.calibrate.numerics.change_point import parts_of_day
from pipeline.rig.changes import change_jacobian, changed
from pipeline.rig.estimates import DayParts
from pipeline.rig.evidence import OtherScenes
from pipeline.rig.se3 import adjoint, inverse

__all__ = ["Series", "changes_by_left", "first_and_last", "other_scenes"]

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
