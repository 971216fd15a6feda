"""Rows of table states from the estimates of accepted days."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import chi2

from pipeline.audit.estimates import Estimates, day_name, days_of
from pipeline.audit.state import DayEstimate, State, fuse
from pipeline.config import VerifyConfig
from pipeline.geometry.pose_columns import pose_columns
from pipeline.geometry.target_sigmas import target_sigmas
from pipeline.geometry.targets import DEFAULT_TARGETS
from schemas.calibrations import DOF_NAMES
from schemas.states import StateRow

__all__ = ["fused", "fused_as_they_differ", "with_state"]

# Of successive accepted days: the most that the charts' budget is proved for. A state promises no more than such days
# can give.
_AUTOCORRELATION = 0.6
_BY_CHANCE = 1e-3  # once in a thousand axes, days that differ by chance alone would count as too far apart
_OFTEN = 0.5  # share of a state's days: one day in 300 lies that far from the prior by chance


def fused(own: Estimates, scale: Float[np.ndarray, " 6"] | None) -> State | None:
    """Accepted records of one edge as one estimate; None without records. `scale` as in `state.fuse`."""
    days = [
        DayEstimate(day_name(day), T, covariance, common if has_common else None, observable)
        for day, T, covariance, common, has_common, observable in zip(
            own.day.tolist(), own.transforms(), own.covariance, own.common,
            own.has_common.tolist(), own.observable, strict=True,
        )
    ]  # fmt: skip
    return fuse(days, scale=scale, autocorrelation=_AUTOCORRELATION)


def fused_as_they_differ(own: Estimates, scale: Float[np.ndarray, " 6"]) -> tuple[State | None, str]:
    """Accepted records fused, with at least the sigma of their scatter, and a remark if that is larger."""
    found = fused(own, scale)
    if found is None or len(found.days) < 2:
        return found, ""
    kept = own.at(np.flatnonzero([day_name(day) in found.days for day in own.day.tolist()]))
    [days] = days_of(kept, 1.0).values()
    weight = np.where(days.observable, 1 / (scale * days.sigma) ** 2, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    off = days.change - (weight * days.change).sum(axis=0) / total
    square, freedom = (weight * off**2).sum(axis=0), np.maximum(days.observable.sum(axis=0) - 1, 1)
    wider = np.where(chi2.sf(square, freedom) < _BY_CHANCE, np.sqrt(square / freedom), 1.0)
    if (wider == 1.0).all():
        return found, ""
    axes = ", ".join(f"{dof} {by:.1f}" for dof, by in zip(DOF_NAMES, wider, strict=True) if by > 1)
    return fused(
        kept, scale * wider
    ), f"its days differ by more than their sigmas, so its sigma is increased: {axes} times"


def with_state(
    base: StateRow,
    found: State,
    records: Estimates,
    seen: tuple[str, Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]],
    verify: VerifyConfig,
) -> StateRow:
    """The row with its estimate.

    `seen` has the kinds of two sensors, as camera_lidar, and T of the second in the first with its
    covariance, for the sigmas of targets.
    """
    own = records.at(np.flatnonzero([day_name(day) in found.days for day in records.day.tolist()]))
    sigma = target_sigmas(*seen, _targets(own))
    has_radar = "radar" in (seen[0] if base.sensor is None else base.kind or "")
    azimuth, elevation = (
        (verify.radar_limit_deg, verify.radar_elevation_limit_deg)
        if has_radar
        else (verify.camera_lidar_limit_deg, verify.camera_lidar_limit_deg)
    )
    reach = float(ndtri(0.5 + verify.confidence / 2)) * np.degrees(sigma)
    names = ("azimuth", "elevation")
    left = f"left out, far from the others: {', '.join(found.left_out)}" if found.left_out else ""
    return replace(
        base,
        **pose_columns(found.T),
        status="current",
        reason="; ".join(text for text in (base.reason, left) if text),
        covariance=found.covariance,
        common_covariance=found.common,
        observable=[bool(v) for v in found.observable],
        determined=[n for n, r, limit in zip(names, reach, (azimuth, elevation), strict=True) if r <= limit],
        azimuth_sigma_rad=float(sigma[0]),
        elevation_sigma_rad=float(sigma[1]),
        days=list(found.days),
        unchecked=_unchecked(own),
        inputs=own.keys(),
    )


def _targets(days: Estimates) -> Float[np.ndarray, "N 3"]:
    """Targets of the last day that has them."""
    known = np.flatnonzero(np.isfinite(days.targets).all(axis=(1, 2)))
    return days.targets[known[-1]] if len(known) else DEFAULT_TARGETS


def _unchecked(days: Estimates) -> dict[str, float]:
    """Largest move [sigma] from the prior by DoF, of DoF that at least half of the days left unchecked."""
    often = np.mean(days.unchecked_sigmas > 0, axis=0) >= _OFTEN
    return {dof: float(days.unchecked_sigmas[:, k].max()) for k, dof in enumerate(DOF_NAMES) if often[k]}
