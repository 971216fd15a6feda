"""Variance of the slow motion of a sensor in its bracket, as with the seasons, without any fault.

The test of a step has two null hypotheses: a constant level, and a random walk. The walk's variance per day
comes from all charts of a fleet: the mean of recent days minus the mean of early days, in excess of the days'
scatter. A motion of a few vehicles is a change; a motion of all is a property of such mounts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.audit.charts import Charts, clipped
from pipeline.audit.noise import VEHICLES, Noise, older_days, winsorised_variance
from pipeline.audit.scan import errors_of, scan

__all__ = ["with_wander"]

_FEWEST = 14  # days of a chart, to estimate it
_SHARE = 1 / 3  # of a chart's days at either end, where no reference stands for the first of them
# Sigmas of a step, if nothing wandered, that is a change and no wandering: all vehicles of a fleet may do it at once.
_STEP = 4.0
# Of what matters, the most that is taken for wandering from a reference to tonight. More is to be found.
_MOST = 1 / 3


def with_wander(
    charts: Charts,
    noise: Noise,
    limit: Float[np.ndarray, " M"],
    shape: tuple[int, int, int],
    models: Sequence[str] = (),
) -> Noise:
    """The noise of all charts of a fleet, with the variance of their levels per day.

    Charts are in order of vehicle, edge and degree of freedom (`shape`); `limit` is the size of a change that matters
    [rad or m]; without `models`, all vehicles are of one model.
    """
    _, model_of = np.unique(list(models) or [""] * shape[0], return_inverse=True)
    less = noise.less_alike
    if less is not None:
        less = replace(less, wander=_wander(charts, less, limit, shape, model_of))
    return replace(noise, wander=_wander(charts, noise, limit, shape, model_of), less_alike=less)


def _wander(
    charts: Charts,
    noise: Noise,
    limit: Float[np.ndarray, " M"],
    shape: tuple[int, int, int],
    model_of: np.ndarray,
) -> Float[np.ndarray, " M"]:
    """Variance that a level gains per day."""
    off, chance, lever, step = (part.reshape(shape) for part in _then_and_now(charts, noise))
    most = (_MOST * limit.reshape(shape)) ** 2 / lever
    out = np.zeros(shape)
    for model in np.unique(model_of):
        own = model_of == model
        known = np.isfinite(off[own])
        all_moved = (step[own] >= _STEP).sum(axis=0) > known.sum(axis=0)
        found, seen = winsorised_variance(np.moveaxis(off[own] / np.sqrt(chance[own]), 0, -1))
        beyond = np.where(seen > 0, seen * (found - 1), 0.0).clip(min=1e-9) / (seen + VEHICLES)
        beyond = (beyond - 2 / (seen + VEHICLES) / beyond).clip(min=0)  # less what chance shows of it
        daily = np.where(known, beyond * chance[own] / lever[own], np.inf)
        out[own] = np.where((beyond > 0) & ~all_moved, np.minimum(daily, most[own]).min(axis=0), 0.0)
    return out.ravel()


def _then_and_now(charts: Charts, noise: Noise) -> tuple[np.ndarray, ...]:
    """For each chart: recent minus early days, the variance by chance, days between, the clearest step."""
    column, count = np.arange(charts.value.shape[1]), older_days(charts)
    part = np.where(charts.has_reference, 1, (_SHARE * count).astype(int))
    first = np.where(charts.has_reference, 1, count - part)
    h, own = errors_of(charts, noise.autocorrelation)
    weight = 1 / np.maximum(h**2 + own, 1e-300)
    then = np.where(column < part[:, None], weight, 0.0)
    now = np.where((column >= first[:, None]) & (column < count[:, None]), weight, 0.0)
    value, older = clipped(charts, noise.scale), replace(charts, count=count)
    step = np.abs(scan(older, value, noise.scale, noise.autocorrelation).z).max(axis=1, initial=0.0)
    told = (charts.count >= _FEWEST) & (step < _STEP)
    then, now = then[told], now[told]
    c = now / now.sum(axis=1, keepdims=True) - then / then.sum(axis=1, keepdims=True)
    off, chance, lever = np.full(len(told), np.nan), np.ones(len(told)), np.ones(len(told))
    off[told] = (c * value[told]).sum(axis=1)
    gap = np.diff(charts.day[told], axis=1)
    rho = noise.autocorrelation[told, None] ** gap
    chance[told] = noise.scale[told] ** 2 * ((c**2 * own[told]).sum(axis=1) + _ar1(c * h[told], rho))
    # What is left of the contrast after each day is what a step of the walk there adds to it.
    left = np.cumsum(c[:, ::-1], axis=1)[:, ::-1][:, 1:]
    lever[told] = (left**2 * gap).sum(axis=1)
    return off, chance, lever, np.where(charts.count >= _FEWEST, step, 0.0)


def _ar1(weight: Float[np.ndarray, "M N"], rho: Float[np.ndarray, "M S"]) -> Float[np.ndarray, " M"]:
    """Variance of a weighted sum of AR(1) days of variance 1."""
    before = np.zeros(len(weight))
    out = weight[:, 0] ** 2
    for t in range(1, weight.shape[1]):
        before = rho[:, t - 1] * (before + weight[:, t - 1])
        out = out + weight[:, t] * (weight[:, t] + 2 * before)
    return out
