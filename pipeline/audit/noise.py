"""Scatter of the days: its ratio to their sigmas, and the correlation of errors from day to day.

Both are learnt for each vehicle model, edge and degree of freedom, from differences between days. A few real changes
do not affect them: variances are winsorised, spans over a jump and the newest days are left out. What is assumed of an
unknown fleet is updated by the fleet's days, and this by a vehicle's own days. The spread between vehicles is learnt
too (Smyth 2004, Stat. Appl. Genet. Mol. Biol. 3(1), moments of log-variances). An outlying vehicle uses its own days
only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import digamma, polygamma

from pipeline.audit.charts import Charts

__all__ = ["VEHICLES", "Noise", "estimate_noise", "older_days", "winsorised_variance"]

# Before any day of a fleet: degrees of freedom of the chi-squared distribution of its vehicles' variances, relative to
# the squares of their sigmas (sigmas that are wrong by a log-normal factor of 0.25 have 1 / (2 0.25^2) = 8), the number
# of vehicles that this is worth, and the largest autocorrelation with its standard deviation over vehicles and fleets.
_FREEDOM, VEHICLES, _ALIKE, _ALIKE_SIGMA = 8.0, 8.0, 0.6, 0.15
# Of n differences of neighbouring days, degrees of freedom of their variance: they share days, and are winsorised.
_EFFICIENCY = 0.6
# Days that scatter more than this times their sigmas do not scatter: something moves, and is to be found. Four
# standard deviations of sigmas that are wrong by a log-normal factor of 0.25.
_MOST_SCALE = 3.0
_MOST_AUTOCORRELATION = 0.9
# One autocorrelation from n differences is known to 2.2 / sqrt(n), in variance: this over n.
_OF_ONE = 4.8
# Share of differences beyond three sigmas, three times that of normal days, from which on single days are often far
# off; and the sigmas that such a day may then bring that no day before showed: what dies away begins like a change.
_OFTEN, _REACH = 0.0085, 3.5
_AXES_DIFFER = 0.07  # autocorrelations of one edge's degrees of freedom
_FAR = 3.0  # sigmas from its fleet beyond which a vehicle is no member of it
_MOST_FREEDOM = 1000.0  # as good as known
WINSOR = 2.0  # sigmas beyond which a difference counts as one of that size: a step is one of them
_WINSORED = 0.9205  # of the variance of a normal distribution that is left by that
# The newest days of a chart, a quarter of them at most, are judged by what older ones show: what begins on all
# vehicles at once is no scatter.
_NEWEST, _OLDER = 6, 4
# Lags [days] of the autocorrelation, beside neighbours: a working week has them.
APART = 3
# Share of a normal distribution beyond three sigmas, and the differences that it is worth.
_NORMAL, _FAR_WORTH = 0.0027, 400.0
_JUMP = 4.0  # sigmas of a difference that is no scatter
_TAKEN_BACK = 0.25  # share of a day's error that the next day lacks, at least: days err alike by 0.6


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of days `lag` columns apart on a chart (nan: none), days between them, and their sigmas."""

    lag: int
    size: Float[np.ndarray, "V P D S"]
    gap: Int[np.ndarray, "V P D S"]
    square: Float[np.ndarray, "V P D S"]
    product: Float[np.ndarray, "V P D S"]

    @classmethod
    def of(cls, charts: Charts, lag: int, shape: tuple[int, int, int]) -> Differences:
        """Differences of all charts of a fleet by vehicle, edge and degree of freedom, without the newest days."""
        sigma = np.where(np.isfinite(charts.sigma), charts.sigma, 1.0)
        there = np.arange(lag, sigma.shape[1]) < older_days(charts)[:, None]
        there[:, :1] &= ~charts.has_reference[:, None]
        a, b = (slice(None), slice(lag, None)), (slice(None), slice(None, -lag))
        size = np.where(there, charts.value[a] - charts.value[b], np.nan)
        parts = (
            size,
            (charts.day[a] - charts.day[b]).clip(min=0),
            sigma[a] ** 2 + sigma[b] ** 2,
            sigma[a] * sigma[b],
        )
        return cls(lag, *(part.reshape(*shape, -1) for part in parts))

    def at(self, vehicles: np.ndarray) -> Differences:
        """Differences of some vehicles."""
        return Differences(
            self.lag, self.size[vehicles], self.gap[vehicles], self.square[vehicles], self.product[vehicles]
        )

    def in_sigmas(self, phi: np.ndarray | float) -> Float[np.ndarray, "V P D S"]:
        """Differences in units of their sigmas for days with autocorrelation phi."""
        rho = np.asarray(phi)[..., None] ** self.gap
        return self.size / np.sqrt(np.maximum(self.square - 2 * rho * self.product, 1e-12 * self.square))


@dataclass(frozen=True, eq=False)
class Noise:
    """For each chart: factor on its sigmas (>= 1), degrees of freedom of this factor, and the autocorrelation.

    Args:
        far: share of differences between days above three sigmas, without lasting changes; the largest of all
            edges.
        wander: variance that a level gains per day without a change.
        less_alike: the noise with the smallest autocorrelation that the days allow; None if it is the same.
    """

    scale: Float[np.ndarray, " M"]
    freedom: Float[np.ndarray, " M"]
    autocorrelation: Float[np.ndarray, " M"]
    far: Float[np.ndarray, " M"]
    wander: Float[np.ndarray, " M"]
    less_alike: Noise | None = None

    @property
    def heavy(self) -> Bool[np.ndarray, " M"]:
        """Charts of fleets whose single days are often outliers."""
        return self.far > _OFTEN

    @property
    def reach(self) -> Float[np.ndarray, " M"]:
        """Limit of a day's innovation in sigmas; infinite for normally distributed days."""
        return np.where(self.heavy, _REACH, np.inf)

    def at(self, rows: slice) -> Noise:
        """The noise of a selection of the charts."""
        other = None if self.less_alike is None else self.less_alike.at(rows)
        return Noise(
            self.scale[rows], self.freedom[rows], self.autocorrelation[rows], self.far[rows], self.wander[rows],
            other,
        )  # fmt: skip


def estimate_noise(charts: Charts, shape: tuple[int, int, int], models: Sequence[str] = ()) -> Noise:
    """Noise of all charts of a fleet.

    Args:
        charts: rows in order of vehicle, edge and degree of freedom; a chart without days has count 0.
        shape: their numbers; an edge has the same position on every vehicle of a model.
        models: model of each vehicle; none = all are of one model.
    """
    _, model_of = np.unique(list(models) or [""] * shape[0], return_inverse=True)
    out = np.zeros((2, 5, *shape))
    differences = [Differences.of(charts, lag, shape) for lag in (1, APART)]
    for model in np.unique(model_of):
        own = np.flatnonzero(model_of == model)
        near, far = (found.at(own) for found in differences)
        # An edge composed of two others is less often far off than they are, and errs with them.
        out[:, 3, own] = far_off(near.in_sigmas(0.0)).max()
        leave_out_steps(near, far)
        for k, most in enumerate((_ALIKE, 0.0)):
            phi = _autocorrelation(near, far, most)
            out[k, :2, own] = np.stack(_scatter(near, phi), axis=1)
            out[k, 2, own] = phi
    most_alike, least_alike = (Noise(*columns) for columns in out.reshape(2, 5, -1))
    return replace(most_alike, less_alike=least_alike)


def _autocorrelation(near: Differences, far: Differences, most: float) -> Float[np.ndarray, "V P D"]:
    """Autocorrelation phi by vehicle, edge and axis.

    Over three days, the variance of differences increases by 1 + phi + phi^2. Each value is shrunk towards
    that of its axis in the fleet, this towards that of its edge, and this towards `most`.
    """
    z = [np.where(d.gap == d.lag, d.size / np.sqrt(d.square), np.nan) for d in (near, far)]
    V, P, D, _ = near.size.shape
    by_axis = [np.moveaxis(part, 0, 2) for part in z]
    worth = _OF_ONE / _ALIKE_SIGMA**2
    of_edge = _drawn(_alike([part.reshape(P, -1) for part in by_axis]), np.full(P, most), worth)
    of_axes = np.broadcast_to(of_edge[:, None], (P, D))
    of_axis = _drawn(_alike([part.reshape(P, D, -1) for part in by_axis]), of_axes, _OF_ONE / _AXES_DIFFER**2)
    found, seen = _alike([part.reshape(V, P, -1) for part in z])
    known = np.isfinite(found) & (seen > 0)
    beyond = ((found - of_edge) ** 2 - _OF_ONE / np.maximum(seen, 1))[known]
    differ = VEHICLES * _ALIKE_SIGMA**2 + max(float(beyond.sum()), 0.0) / P
    worth = _OF_ONE / (differ / (VEHICLES + known.sum() / P))
    return _drawn((found[..., None], seen[..., None]), np.broadcast_to(of_axis, (V, P, D)), worth)


def _alike(z: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Autocorrelation of neighbouring and more distant days, and the number of differences."""
    (near, seen), (far, fewer) = (winsorised_variance(part) for part in z)
    with np.errstate(invalid="ignore", divide="ignore"):
        return 0.5 * (np.sqrt(np.maximum(4 * far / near - 3, 0)) - 1), np.minimum(seen, fewer)


def _drawn(alike: tuple[np.ndarray, np.ndarray], towards: np.ndarray, worth: float) -> np.ndarray:
    found, seen = alike
    found = np.where(np.isfinite(found), found, towards)
    return np.asarray(np.clip((seen * found + worth * towards) / (seen + worth), 0, _MOST_AUTOCORRELATION))


def _scatter(
    near: Differences, phi: np.ndarray
) -> tuple[Float[np.ndarray, "V P D"], Float[np.ndarray, "V P D"]]:
    """Ratio of the days' scatter to their sigmas, and the degrees of freedom of its estimate."""
    z = near.in_sigmas(phi)
    V, P, D, S = z.shape
    found, seen = winsorised_variance(np.moveaxis(z, 0, 2).reshape(P, D, V * S))
    worth, most = _EFFICIENCY * seen, _MOST_SCALE**2
    found = np.where(seen > 0, np.minimum(found, most), 0.0)
    of_fleet = np.maximum((_FREEDOM + worth * found) / (_FREEDOM + worth), 1.0)
    relative = z / np.sqrt(of_fleet)[None, :, :, None]
    found, seen = winsorised_variance(relative.reshape(V, P, D * S))
    freedom = _EFFICIENCY * seen * _independent(z)[None] / D
    vehicle = _drawn_to_fleet(np.minimum(found, most / of_fleet.max(axis=1)), freedom, 1.0)
    own, seen = winsorised_variance(relative)
    own = np.minimum(own, most / of_fleet)
    variance, freedom = _drawn_to_fleet(own, _EFFICIENCY * seen, vehicle[0][..., None])
    scale = np.sqrt(np.clip(of_fleet[None] * variance, 1.0, _MOST_SCALE**2))
    # The autocorrelation is uncertain with few days, and the scatter depends on it.
    alike = _OF_ONE / (worth / _EFFICIENCY + _OF_ONE / _AXES_DIFFER**2) / (2 * (1 - phi) ** 2)
    known = 1 / (1 / freedom + 1 / vehicle[1][..., None] + alike)
    return scale, np.minimum(known, _MOST_FREEDOM)


def _drawn_to_fleet(
    found: np.ndarray, freedom: np.ndarray, fleet: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Variances shrunk towards the fleet's, more so if vehicles differ little, and their degrees of freedom."""
    known = (freedom > 1) & (found > 0)
    d = np.where(known, freedom, 1.0)
    off = np.log(np.where(known, found / fleet, 1.0)) - digamma(d / 2) + np.log(d / 2)
    chance, count = polygamma(1, d / 2), int(known.sum())
    differ = polygamma(1, _FREEDOM / 2)
    middle = 0.0
    if count:
        middle = float(np.median(off[known]))
        beyond = (1.4826 * np.median(np.abs(off[known] - middle))) ** 2 - chance[known].mean()
        differ = (VEHICLES * differ + count * max(beyond, 0.0)) / (VEHICLES + count)
    # trigamma(x) is 1 / x + 1 / (2 x^2), to a hundredth where x is 1 and more
    like = (1 + np.sqrt(1 + 2 * differ)) / differ
    away = (off - middle) ** 2 / (differ + chance)
    like = like * np.where(known, np.minimum(1.0, _FAR**2 / np.maximum(away, 1e-9)), 1.0)
    worth = np.where(known, freedom, 0.0)
    return (like * fleet + worth * np.where(known, found, 0.0)) / (like + worth), like + worth


def _independent(z: Float[np.ndarray, "V P D S"]) -> Float[np.ndarray, " P"]:
    """Effective number of independent degrees of freedom of an edge, because those of a day share its scenes."""
    rows = np.moveaxis(np.clip(np.nan_to_num(z), -WINSOR, WINSOR), 2, -1).swapaxes(0, 1)
    rows = rows.reshape(z.shape[1], -1, z.shape[2])
    square = np.einsum("pna,pnb->pab", rows, rows)
    size = np.sqrt(np.maximum(np.einsum("paa->pa", square), 1e-12))
    correlation = square / size[:, :, None] / size[:, None, :]
    return np.asarray(z.shape[2] ** 2 / np.maximum((correlation**2).sum(axis=(1, 2)), z.shape[2]))


def older_days(charts: Charts) -> Int[np.ndarray, " M"]:
    """Number of older days of each chart.

    Their scatter is used to judge the newest days.
    """
    return np.asarray(charts.count - np.minimum(charts.count // _OLDER, _NEWEST))


def leave_out_steps(near: Differences, far: Differences) -> None:
    """Leave out spans over a jump: it is not scatter, and would increase the autocorrelation."""
    z = near.in_sigmas(0.0)
    sigma = np.sqrt(winsorised_variance(np.moveaxis(z, 0, 2).reshape(*z.shape[1:3], -1))[0])
    with np.errstate(invalid="ignore"):
        jump = np.abs(z) > _JUMP * sigma[None, :, :, None]
    near.size[jump] = np.nan
    spans = far.size.shape[-1]
    for k in range(APART):
        far.size[jump[..., k : k + spans]] = np.nan


def far_off(z: Float[np.ndarray, "V P D S"]) -> Float[np.ndarray, " P"]:
    """Share of an edge's differences beyond three sigmas, shrunk towards that of the normal distribution.

    A difference without an opposite neighbouring difference is a lasting change, not an outlying day.
    """
    sigma = np.sqrt(winsorised_variance(np.moveaxis(z, 0, 2).reshape(*z.shape[1:3], -1))[0])
    beside = np.pad(z, ((0, 0),) * 3 + ((1, 1),), constant_values=np.nan)
    with np.errstate(invalid="ignore"):
        taken = np.minimum(beside[..., :-2] * np.sign(z), beside[..., 2:] * np.sign(z))
        stays = taken > -_TAKEN_BACK * np.abs(z)  # not where there is none beside
        far = (~stays & (np.abs(z) > 3 * sigma[None, :, :, None])).sum(axis=(0, 2, 3))
    return np.asarray((far + _NORMAL * _FAR_WORTH) / (np.isfinite(z).sum(axis=(0, 2, 3)) + _FAR_WORTH))


def winsorised_variance(values: Float[np.ndarray, "*rows N"]) -> tuple[np.ndarray, np.ndarray]:
    """Winsorised variance about zero along the last axis (nan if empty), and the number of values."""
    size = np.abs(values)
    ordered = np.sort(size, axis=-1)  # nan comes last
    count = np.isfinite(values).sum(axis=-1)
    if ordered.shape[-1] == 0:
        return np.full(values.shape[:-1], np.nan), count
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], -1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, ordered.shape[-1] - 1)[..., None], -1)
    reach = WINSOR * 0.5 * (low + high) / 0.6745
    total = np.nansum(np.minimum(size, reach) ** 2, axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1) / _WINSORED, np.nan), count
