"""An edge's day estimates as numbers for charts, its fixed reference, and the charts of a whole fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.audit.charts import Charts, clipped
from pipeline.audit.scan import scan
from pipeline.rig.graph import Edge, edge_order
from pipeline.rig.se3 import change_between, change_jacobian, changed
from schemas.calibrations import DOF_NAMES

__all__ = [
    "DOFS", "FEWEST_DAYS", "PairDays", "Reference", "charted", "charts_of_fleet", "clipped_days",
    "edges_of_fleet", "pair_days", "reference_of", "with_reference",
]  # fmt: skip

DOFS = len(DOF_NAMES)
# Autocorrelation of days whose scatter nobody has seen yet: the most that the budget is proved for.
_ALIKE = 0.6
# Share of a day's variance that is never taken as common to all days: sigmas are estimates themselves.
_LEAST_VARYING = 0.01
# Sigmas of a step among the reference's own days, which then ends before it; days have no estimated scatter yet.
_MOVED_SIGMAS = 6.0
FEWEST_DAYS = 14  # of a window, however far back they lie


@dataclass(frozen=True, eq=False)
class PairDays:
    """Day estimates of one edge. Includes held days: a large knock makes the verdict hold the record.

    Args:
        change: from the origin to each estimate (rotation vector [rad], shift of the child's origin [m]).
        spread: part of the changes' covariance that varies from day to day, larger for held days;
            undetermined DoF have the prior's.
        observable: per day and DoF; undetermined DoF of a day are not on the charts.
        reference_days: number of days in the first one if that is a fixed reference, else 0.
    """

    day: Int[np.ndarray, " N"]
    T: Float[np.ndarray, "N 4 4"]
    change: Float[np.ndarray, "N 6"]
    spread: Float[np.ndarray, "N 6 6"]
    observable: Bool[np.ndarray, "N 6"]
    accepted: Bool[np.ndarray, " N"]
    origin: Float[np.ndarray, "4 4"]
    reference_days: int = 0

    @property
    def sigma(self) -> Float[np.ndarray, "N 6"]:
        """Sigma of each change."""
        return np.sqrt(np.einsum("nii->ni", self.spread))

    def between(self, first: int, last: int) -> PairDays:
        """The days from one ordinal to another, both included."""
        return self.at(slice(*np.searchsorted(self.day, (first, last + 1))))

    def at(self, rows: slice | np.ndarray) -> PairDays:
        """Some of the days; a reference among them stays one."""
        kept = np.zeros(len(self.day), bool)
        kept[rows] = True
        per_day = ("day", "T", "change", "spread", "observable", "accepted")
        own = {name: getattr(self, name)[rows] for name in per_day}
        return replace(self, **own, reference_days=self.reference_days if len(kept) and kept[0] else 0)


@dataclass(frozen=True, eq=False)
class Reference:
    """Mean pose of an edge's first accepted days since it was last known to be right.

    `spread` is the covariance of the mean for independent days, of changes; `observable` are DoF determined
    by at least one of them.
    """

    days: tuple[int, ...]
    T: Float[np.ndarray, "4 4"]
    spread: Float[np.ndarray, "6 6"]
    observable: Bool[np.ndarray, " 6"]


def pair_days(
    day: Int[np.ndarray, " N"], T: Float[np.ndarray, "N 4 4"], covariance: Float[np.ndarray, "N 6 6"],
    common: Float[np.ndarray, "N 6 6"], observable: Bool[np.ndarray, "N 6"], accepted: Bool[np.ndarray, " N"],
) -> PairDays:  # fmt: skip
    """Day estimates of an edge, with changes from the first.

    `common` is the part of `covariance` from errors common to all days, zero if a record does not have it.
    """
    J = change_jacobian(T)
    total = J @ covariance @ J.swapaxes(1, 2)
    spread = J @ (covariance - common) @ J.swapaxes(1, 2)
    varying, all_of_it = np.einsum("nii->ni", spread), np.einsum("nii->ni", total)
    # A DoF that the day does not determine has its total variance, hence no weight.
    missing = np.where(observable, np.maximum(_LEAST_VARYING * all_of_it - varying, 0.0), all_of_it)
    spread[:, np.arange(6), np.arange(6)] += missing
    return PairDays(day, T, change_between(T[0], T), spread, observable, accepted, T[0])


def reference_of(days: PairDays, count: int) -> Reference | None:
    """Mean of the first accepted days; None for fewer than two."""
    rows = np.flatnonzero(days.accepted)[:count]
    first = days.at(rows)
    first = first.at(slice(0, _step(first)))  # before something moved among these already
    if len(first.day) < 2:
        return None
    value, seen = _clipped(first), first.observable
    weight = 1 / np.where(seen, first.sigma, first.sigma.max(axis=0)) ** 2
    mean = (weight * value).sum(axis=0) / weight.sum(axis=0)
    information = np.linalg.inv(first.spread).sum(axis=0)
    spread = np.linalg.inv(information)
    return Reference(
        tuple(int(d) for d in first.day), changed(days.origin, mean), spread, np.asarray(seen.any(axis=0))
    )


def _step(days: PairDays) -> int | None:
    """Number of days before the clearest step; None if there is none."""
    if len(days.day) < 4:
        return None
    found = scan(_as_charts(days), _clipped(days).T, np.ones(DOFS), _ALIKE * np.ones(DOFS))
    z = np.abs(found.z).max(axis=0)
    return int(np.argmax(z)) + 1 if z.max() > _MOVED_SIGMAS else None


def _as_charts(days: PairDays) -> Charts:
    """All six DoF; an undetermined one has the prior's sigma."""
    N = len(days.day)
    return Charts(
        np.broadcast_to(days.day, (DOFS, N)), days.change.T.copy(), days.sigma.T.copy(),
        np.broadcast_to(days.accepted, (DOFS, N)), np.full(DOFS, days.reference_days), np.full(DOFS, N),
    )  # fmt: skip


def clipped_days(days: PairDays, scale: Float[np.ndarray, " 6"]) -> PairDays:
    """Days as used by the charts: clipped near their neighbours, with sigmas scaled to their scatter."""
    change = clipped(_as_charts(days), scale).T
    return replace(days, change=change, spread=days.spread * np.outer(scale, scale))


def _clipped(days: PairDays) -> Float[np.ndarray, "N 6"]:
    return clipped(_as_charts(days), np.ones(DOFS)).T


def charted(days: PairDays, first: int, last: int, reference: Reference | None) -> PairDays:
    """The days of a window, with the fixed reference if that is older.

    A vehicle that drives once a week has four days in a window of four weeks: its window is extended to
    earlier days. If it reaches into the reference, the reference's days replace its mean.
    """
    until = days.between(0, last)
    if len(until.day) <= FEWEST_DAYS:
        return until
    first = min(first, int(until.day[-FEWEST_DAYS]))
    if reference is None:
        return until.between(first, last)
    if reference.days[-1] >= first:
        return until.between(min(first, reference.days[0]), last)
    return with_reference(until.between(first, last), reference)


def with_reference(days: PairDays, reference: Reference) -> PairDays:
    """The days with the reference as first day, in place of the days that it averages; changes are relative to it."""
    own = days.at(~np.isin(days.day, reference.days))
    T = np.concatenate([reference.T[None], own.T])
    return PairDays(
        np.concatenate([[reference.days[-1]], own.day]), T, change_between(reference.T, T),
        np.concatenate([reference.spread[None], own.spread]),
        np.concatenate([reference.observable[None], own.observable]), np.concatenate([[True], own.accepted]),
        reference.T, reference_days=len(reference.days),
    )  # fmt: skip


def edges_of_fleet(fleet: Sequence[Mapping[Edge, PairDays]]) -> tuple[Edge, ...]:
    """Edges that any vehicle has days of, in order."""
    return tuple(sorted({edge for edges in fleet for edge in edges}, key=edge_order))


def charts_of_fleet(fleet: Sequence[Mapping[Edge, PairDays]], edges: Sequence[Edge]) -> Charts:
    """Charts of all vehicles, in order of vehicle, edge and DoF; one without days is empty."""
    longest = max((len(d.day) for own in fleet for d in own.values()), default=0)
    shape = (len(fleet), len(edges), DOFS, max(longest, 1))
    day, value = np.zeros(shape, np.int64), np.zeros(shape)
    sigma, accepted = np.full(shape, np.inf), np.ones(shape, bool)
    count, reference_days = np.zeros(shape[:3], np.int64), np.zeros(shape[:3], np.int64)
    dof, column = np.arange(DOFS)[:, None], np.arange(shape[3])
    for v, own in enumerate(fleet):
        for p, edge in enumerate(edges):
            days = own.get(edge)
            if days is None or not len(days.day):
                continue
            seen = days.observable.T
            rows = np.argsort(~seen, axis=1, kind="stable")  # days that determine the DoF first
            at, live = (v, p, slice(None), slice(len(days.day))), np.take_along_axis(seen, rows, axis=1)
            day[at], value[at] = (
                np.where(live, days.day[rows], 0),
                np.where(live, days.change[rows, dof], 0.0),
            )
            sigma[at], accepted[at] = (
                np.where(live, days.sigma[rows, dof], np.inf),
                days.accepted[rows] | ~live,
            )
            count[v, p], reference_days[v, p] = seen.sum(axis=1), days.reference_days * seen[:, 0]
    # Columns beyond a chart's days repeat its last day, so that no gap is negative.
    last = np.take_along_axis(day, np.maximum(count - 1, 0)[..., None], -1)
    day, flat = np.where(column >= count[..., None], last, day), (-1, shape[3])
    return Charts(
        day.reshape(flat), value.reshape(flat), sigma.reshape(flat), accepted.reshape(flat),
        reference_days.ravel(), count.ravel(),
    )  # fmt: skip
