"""Records of model lines with a known truth: what days show, with the prior and with errors that all sensors share."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.geometry.changes import change_between, change_jacobian, changed
from pipeline.geometry.se3 import from_rotation_translation, to_quaternion
from schemas.calibrations import CalibrationRecord
from tests.audit.fleet_records import T_CAMERA_LIDAR, T_LIDAR_RADAR

__all__ = ["DEG", "FIRST_DAY", "MadeLine", "line_records"]

DEG = np.pi / 180
FIRST_DAY = dt.date(2026, 3, 1)
_DRAWINGS = {
    "camera_lidar": T_CAMERA_LIDAR,
    "lidar_radar": T_LIDAR_RADAR,
    "radar_base": from_rotation_translation(np.eye(3), np.array([-3.5, 0.0, -0.6])),
}
# What one day of ten frames varies by, along axes of the parent; of a radar's x, and of height, it shows nothing.
_SIGMA = {
    "camera_lidar": np.array([0.12 * DEG, 0.12 * DEG, 0.2 * DEG, 0.03, 0.03, np.inf]),
    "lidar_radar": np.array([np.inf, 0.6 * DEG, 0.15 * DEG, 0.04, 0.04, np.inf]),
    "radar_base": np.array([np.inf, 0.4 * DEG, 0.1 * DEG, np.inf, np.inf, np.inf]),
}
_COMMON = {
    "camera_lidar": np.array([0.03 * DEG, 0.03 * DEG, 0.03 * DEG, 0.005, 0.005, 0.005]),
    "lidar_radar": np.array([0.1 * DEG, 0.2 * DEG, 0.05 * DEG, 0.02, 0.02, 0.02]),
    "radar_base": np.array([0.1 * DEG, 0.4 * DEG, 0.05 * DEG, 0.02, 0.02, 0.02]),
}
_PRIOR = np.array([2 * DEG] * 3 + [0.05] * 3)


@dataclass(frozen=True)
class MadeLine:
    """A line: how mounts scatter, what all sensors share, how days err.

    Args:
        scatter: of mounts about the drawing, by axis [rad, m].
        bias: by edge, the change that a shared error looks like.
        alike: autocorrelation of neighbouring days' errors.
        wider: factor by which days scatter more than their sigmas.
        freedom: of the t distribution of days' errors, scaled to their sigmas; None = Gaussian.
        motion: change of a vehicle's mount on a day: (vehicle number, day) -> by edge; none by default.
        prior: sigmas of each vehicle's prior about the drawing, by axis [rad, m].
    """

    vehicles: int
    days: int
    seed: int
    scatter: np.ndarray = field(default_factory=lambda: np.array([0.1 * DEG] * 3 + [0.005] * 3))
    bias: Mapping[str, np.ndarray] = field(default_factory=dict)
    alike: float = 0.0
    wider: float = 1.0
    freedom: float | None = None
    sigma: Mapping[str, np.ndarray] = field(default_factory=lambda: _SIGMA)
    motion: Callable[[int, int], Mapping[str, np.ndarray]] = lambda _vehicle, _day: {}
    name: str = "car"
    prior: np.ndarray = field(default_factory=lambda: _PRIOR)
    pairs: tuple[str, ...] = ("camera_lidar", "lidar_radar")

    def vehicle(self, number: int) -> str:
        """Name of a vehicle."""
        return f"{self.name}-{number:04d}"

    def mounts(self) -> dict[str, np.ndarray]:
        """Changes of the factory's mounts from the drawing, by edge and vehicle."""
        rng = np.random.default_rng([self.seed, 1])
        return {pair: self.scatter * rng.normal(size=(self.vehicles, 6)) for pair in self.pairs}


def line_records(line: MadeLine, first: int = 0) -> list[CalibrationRecord]:
    """Records of all vehicles, from the day numbered `first` on."""
    mounts, found = line.mounts(), []
    for pair in line.pairs:
        drawing = _DRAWINGS[pair]
        rng = np.random.default_rng([line.seed, 2, list(_DRAWINGS).index(pair)])
        sigma = line.sigma[pair]
        finite = np.isfinite(sigma)
        error = np.zeros((line.vehicles, 6))
        for day in range(line.days):
            new = _noise(rng, line, day, error)
            error = new
            for v in range(line.vehicles):
                true = mounts[pair][v] + line.motion(v, day).get(pair, np.zeros(6))
                seen = true + line.bias.get(pair, np.zeros(6))
                seen = seen + line.wider * np.where(finite, sigma, 0.0) * error[v]
                if day >= first:
                    found.append(_record(line, pair, drawing, v, day, seen, sigma))
    return found


def _noise(rng: np.random.Generator, line: MadeLine, day: int, before: np.ndarray) -> np.ndarray:
    if line.freedom is None:
        fresh = rng.normal(size=before.shape)
    else:
        fresh = rng.standard_t(line.freedom, size=before.shape) / np.sqrt(line.freedom / (line.freedom - 2))
    return fresh if day == 0 else line.alike * before + np.sqrt(1 - line.alike**2) * fresh


def _record(
    line: MadeLine, pair: str, drawing: np.ndarray, v: int, day: int, seen: np.ndarray, sigma: np.ndarray
) -> CalibrationRecord:
    """Posterior of what a day shows and the prior, which is the drawing."""
    finite = np.isfinite(sigma)
    information = np.where(finite, 1 / np.where(finite, sigma, 1.0) ** 2, 0.0)
    variance = 1 / (information + 1 / line.prior**2)
    T = changed(drawing, variance * information * seen)
    back = np.linalg.inv(change_jacobian(T))
    # As in records of the pipeline: the prior's error is common to all days, beside the floors.
    floors = back @ np.diag(_COMMON[pair] ** 2) @ back.T
    common = back @ np.diag(variance**2 / line.prior**2) @ back.T + floors
    covariance = back @ np.diag(variance) @ back.T + floors
    prior_back = np.linalg.inv(change_jacobian(drawing))
    parent, child = pair.split("_")
    name = line.vehicle(v)
    date = (FIRST_DAY + dt.timedelta(days=day)).isoformat()
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    pose = dict(zip(names, (*to_quaternion(T).tolist(), *T[:3, 3].tolist()), strict=True))
    prior = zip(names, (*to_quaternion(drawing).tolist(), *drawing[:3, 3].tolist()), strict=True)
    return CalibrationRecord(
        vehicle=name, day=date, method="joint", pair=pair, parent_frame=parent, child_frame=child, status="held",
        reason="elevation known to 0.12 deg (1 sigma), not within 0.2 deg", seed=0, code_version="0.12.0",
        work_key=f"{name}-{day}", **pose, covariance=covariance, common_covariance=common,
        **{f"prior_{n}": value for n, value in prior}, observable=finite.tolist(),
        prior_covariance=prior_back @ np.diag(line.prior**2) @ prior_back.T, diagnostics={"unsure_only": 1.0},
    )  # fmt: skip


def change_of(T: np.ndarray, pair: str) -> np.ndarray:
    """Change from the drawing to a pose of an edge."""
    return change_between(_DRAWINGS[pair], T)
