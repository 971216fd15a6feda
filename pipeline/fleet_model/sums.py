"""Sums over a vehicle's days of what they show of one edge: a night adds its day and reads no other.

Evidence is information without the prior, so that a direction which days leave open stays open. Old days count less
and less, as a mount may creep; a day far from the others is left out, as in a vehicle's state.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.fleet_model.evidence import shifts_in_sigmas
from pipeline.geometry.changes import change_between, change_covariance

__all__ = ["DayEvidence", "DaySums", "day_evidence", "packed", "unpacked"]

# After so many days a day counts half: a state rests on 60 days, whose mean age is the same.
_HALF_LIFE_DAYS, _RECENT_HALF_LIFE_DAYS = 30.0, 4.0
_FAR_SIGMAS = 4.5  # of a day from the others along an axis: with it or beyond, the day is left out
_RESTART = 3  # days in a row that are far from the others: the sensor lies elsewhere now
_LEAST = 0.1  # of the prior's information: a day that adds less along a direction adds nothing
# Share of a day's variance that is never taken as common to all days, as on charts.
_LEAST_VARYING = 0.01


@dataclass(frozen=True, eq=False)
class DayEvidence:
    """A day of N vehicles, as changes (rotation vector [rad], shift of the child's origin [m]) from a drawing.

    Args:
        information: of what varies from day to day, without the prior.
        pull: information times the change that the data alone show.
        common: covariance of what all days have in common, without the prior's error.
        own_prior: change from the drawing to the vehicle's prior.
        prior: covariance of that prior.
    """

    information: Float[np.ndarray, "N 6 6"]
    pull: Float[np.ndarray, "N 6"]
    common: Float[np.ndarray, "N 6 6"]
    own_prior: Float[np.ndarray, "N 6"]
    prior: Float[np.ndarray, "N 6 6"]


def day_evidence(
    drawing: Float[np.ndarray, "4 4"],
    estimates: tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "N 6 6"], Float[np.ndarray, "N 6 6"]],
    priors: tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "N 6 6"]],
) -> DayEvidence:
    """What estimates show without their priors.

    Args:
        drawing: T_parent_child from which changes count.
        estimates: T_parent_child, covariances (left perturbation) and their common parts.
        priors: T_parent_child and covariances (left perturbation) that the estimates were made with.
    """
    T, total, common = estimates
    x, own_prior = change_between(drawing, T), change_between(drawing, priors[0])
    total, common, P = change_covariance(T, total), change_covariance(T, common), change_covariance(*priors)
    root = np.linalg.cholesky(P)
    # In units of the prior's sigmas: its own information is one along each direction.
    size, whole, U = _by_data_and_prior(_in_units(root, total), _in_units(root, common))
    added = 1 / np.maximum(size, 1e-12) - 1
    told = added > _LEAST
    to_change = np.linalg.solve(root.swapaxes(1, 2), U)  # columns: directions of the information
    information = (to_change * np.where(told, added, 0.0)[:, None, :]) @ to_change.swapaxes(1, 2)
    along, prior_along = (np.einsum("nki,nk->ni", to_change, change) for change in (x, own_prior))
    pull = np.where(told, (added + 1) * along - prior_along, 0.0)
    of_floors = root @ U
    floors = (of_floors * (whole - size)[:, None, :]) @ of_floors.swapaxes(1, 2)
    return DayEvidence(information, np.einsum("nki,ni->nk", to_change, pull), floors, own_prior, P)


def _in_units(
    root: Float[np.ndarray, "N 6 6"], covariance: Float[np.ndarray, "N 6 6"]
) -> Float[np.ndarray, "N 6 6"]:
    white = np.linalg.solve(root, np.linalg.solve(root, covariance).swapaxes(1, 2))
    return np.asarray(0.5 * (white + white.swapaxes(1, 2)))


def _by_data_and_prior(
    total: Float[np.ndarray, "N 6 6"], common: Float[np.ndarray, "N 6 6"]
) -> tuple[Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6 6"]]:
    """Variances by data and prior alone, stated variances, and their directions (columns); in the prior's units.

    Records count the prior's error as common, beside floors B: total = S + B and common = S^2 + B. So total - common is
    S - S^2, of which total tells the root: a direction that is left at the prior has S = 1.
    """
    stated, U = np.linalg.eigh(total)
    varying = np.einsum("nik,nij,njk->nk", U, total - common, U, optimize=True)
    half = 0.5 * np.sqrt(1 - 4 * np.clip(varying, 0.0, 0.25))
    size = np.where(stated >= 0.5 + half, 0.5 + half, 0.5 - half)
    return np.clip(size, _LEAST_VARYING * stated, stated), stated, U


@dataclass(frozen=True, eq=False)
class DaySums:
    """Sums over the days of N vehicles since each last changed.

    Args:
        information: and `pull` of all days, older ones counted less.
        days: number of them, counted likewise.
        recent_information: and `recent_pull`, of the last days.
        day_information: and `day_pull`, of the last day alone.
        common: mean covariance of what all days have in common.
        own_prior: change from the drawing to the last day's prior.
        prior: covariance of that prior.
        first, last: ordinals of the first and the last day; 0 without a day.
        away: days in a row that were left out.
    """

    information: Float[np.ndarray, "N 6 6"]
    pull: Float[np.ndarray, "N 6"]
    days: Float[np.ndarray, " N"]
    recent_information: Float[np.ndarray, "N 6 6"]
    recent_pull: Float[np.ndarray, "N 6"]
    recent_days: Float[np.ndarray, " N"]
    day_information: Float[np.ndarray, "N 6 6"]
    day_pull: Float[np.ndarray, "N 6"]
    common: Float[np.ndarray, "N 6 6"]
    own_prior: Float[np.ndarray, "N 6"]
    prior: Float[np.ndarray, "N 6 6"]
    first: Int[np.ndarray, " N"]
    last: Int[np.ndarray, " N"]
    away: Int[np.ndarray, " N"]

    @classmethod
    def empty(cls, vehicles: int) -> DaySums:
        """No day of any vehicle."""
        sizes = ((6, 6), (6,), ()) * 2 + ((6, 6), (6,)) * 2 + ((6, 6),)
        when = (np.zeros(vehicles, np.int64) for _ in range(3))
        return cls(*(np.zeros((vehicles, *size)) for size in sizes), *when)

    def at(self, rows: np.ndarray) -> DaySums:
        """Sums of some of the vehicles."""
        return DaySums(*(getattr(self, f.name)[rows] for f in fields(self)))

    def replaced(self, rows: np.ndarray, new: DaySums) -> DaySums:
        """These sums, with others for some vehicles."""
        out = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name, values in out.items():
            values[rows] = getattr(new, name)
        return DaySums(**out)

    def put(self, rows: np.ndarray, new: DaySums) -> None:
        """Set the sums of some vehicles, in place."""
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(new, f.name)

    def with_day(self, day: DayEvidence, ordinal: int, scale: Float[np.ndarray, "N 6"]) -> DaySums:
        """The sums with a later day of each vehicle.

        Args:
            day: of the same vehicles.
            ordinal: of the day in the calendar.
            scale: ratio of the days' scatter to their sigmas, by axis.
        """
        far = (self.days > 0) & (self._distance(day, scale) > _FAR_SIGMAS)
        away = np.where(far, self.away + 1, 0)
        restart = away >= _RESTART
        kept = self.replaced(np.flatnonzero(restart), DaySums.empty(int(restart.sum())))
        gap = np.where(kept.last > 0, ordinal - kept.last, 0)
        old, recent = 0.5 ** (gap / _HALF_LIFE_DAYS), 0.5 ** (gap / _RECENT_HALF_LIFE_DAYS)
        counted = kept.days + 1
        added = replace(
            kept,
            information=old[:, None, None] * kept.information + day.information,
            pull=old[:, None] * kept.pull + day.pull,
            days=old * kept.days + 1,
            recent_information=recent[:, None, None] * kept.recent_information + day.information,
            recent_pull=recent[:, None] * kept.recent_pull + day.pull,
            recent_days=recent * kept.recent_days + 1,
            day_information=day.information,
            day_pull=day.pull,
            common=kept.common + (day.common - kept.common) / counted[:, None, None],
            own_prior=day.own_prior,
            prior=day.prior,
            first=np.where(kept.first > 0, kept.first, ordinal),
            last=np.full(len(gap), ordinal),
            away=np.zeros(len(gap), np.int64),
        )
        left_out = np.flatnonzero(far & ~restart)
        same = replace(
            self.at(left_out),
            away=away[left_out],
            last=np.full(len(left_out), ordinal),
            day_information=day.information[left_out],
            day_pull=day.pull[left_out],
        )
        return added.replaced(left_out, same)

    def _distance(self, day: DayEvidence, scale: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, " N"]:
        """Largest shift along an axis of a day from the days before, in sigmas."""
        weak = np.linalg.inv(day.prior)
        mine = np.linalg.inv(self.information + weak)
        before = np.einsum("nij,nj->ni", mine, self.pull)
        W = np.linalg.solve(np.eye(6) + day.information @ mine, day.information)
        own = np.einsum("nij,nj->ni", np.linalg.inv(day.information + weak), day.pull)
        unit = np.sqrt(np.einsum("nii->ni", day.prior))
        z = shifts_in_sigmas(W, own - before, np.eye(6), unit) / scale
        return np.asarray(np.abs(z).max(axis=1, initial=0.0))


_AT = np.tril_indices(6)


def packed(sums: DaySums) -> Float[np.ndarray, "N 5 27"]:
    """Matrices and vectors of sums in a thousand bytes a vehicle."""
    pairs = (
        (sums.information, sums.pull),
        (sums.recent_information, sums.recent_pull),
        (sums.day_information, sums.day_pull),
        (sums.common, sums.own_prior),
        (sums.prior, np.zeros_like(sums.own_prior)),
    )
    return np.stack([np.concatenate([m[:, *_AT], v], axis=1) for m, v in pairs], axis=1)


def unpacked(
    values: Float[np.ndarray, "N 5 27"],
    days: Float[np.ndarray, "N 2"],
    when: Int[np.ndarray, "N 3"],
) -> DaySums:
    """Sums from their packed matrices, the numbers of days (all, recent), and (first, last, away)."""
    whole = np.asarray(values, np.float64)
    matrix = np.zeros((len(whole), 5, 6, 6))
    matrix[:, :, _AT[0], _AT[1]] = matrix[:, :, _AT[1], _AT[0]] = whole[:, :, :21]
    m, v = matrix.swapaxes(0, 1), whole[:, :, 21:].swapaxes(0, 1)
    return DaySums(
        m[0], v[0], days[:, 0], m[1], v[1], days[:, 1], m[2], v[2], m[3], v[3], m[4],
        when[:, 0], when[:, 1], when[:, 2],
    )  # fmt: skip
