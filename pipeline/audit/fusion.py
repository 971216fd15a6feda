"""One sensor's pose for tomorrow's drive: its prior, and what each day since it last moved adds to it.

A day's pose combines the day's data and the prior. Averaged over days, the prior would count once a day, so it
is taken out of each day and enters once (as in `calibrate/adjust/equations.py`). With x the pose as a change from
some pose, and u the errors common to all days in units of their sigma, day i measures

    x + R_i u + n_i,    n_i ~ V_i + S

V_i is the part of the day's covariance that varies from day to day, R_i R_i' its common part, S the scatter of the
mount from day to day. Without wander this is one least squares problem in (x, u); with it, the level gains the
variance Q per day, a Kalman filter, in which recent days weigh more. Tomorrow's pose differs from the level by Q
and S once more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.audit.scan import alike
from pipeline.rig.se3 import change_between, change_jacobian, changed

__all__ = [
    "LEAST_SCATTER",
    "Fused",
    "Mount",
    "PoseDays",
    "after_a_move",
    "current_level",
    "fuse",
    "with_held_day",
]

_DOFS = 6
# Share of the prior's variance from which a direction counts as left at the prior: as an axis of a day's record.
_NOTHING, _LEAST_SHARE = 0.5, 1e-9
# Of a day's variance, what varies from day to day at least: sigmas are estimates themselves.
_LEAST_VARYING = 0.01
# Sigmas by which one axis of a day may lie from the later days: by chance once in a hundred days of six axes.
_APART_SIGMAS = 3.14
# A change on one day in a hundred, of half a degree and a centimetre: more often than fleets report, so that a state is
# not certified while its days are hard to believe as one level.
_KNOCKS_A_DAY, _KNOCK = 0.01, np.array([*np.radians([0.5] * 3), 0.01, 0.01, 0.01])
_NEW_DAYS = 3
# A mount's scatter from day to day before any day shows more: another simulator's mounts have .03 to .05 deg; load,
# temperature and tyres move a car's sensors to its road by as much.
LEAST_SCATTER = np.array([*np.radians([0.03] * 3), 0.003, 0.003, 0.003])
_DETERMINED = 0.5  # share of the prior's variance that an axis of a day lacks, to be compared between days


@dataclass(frozen=True, eq=False)
class PoseDays:
    """Poses of one sensor, a row per day, in order of day.

    Args:
        day: ordinals of the calendar.
        T: T_reference_sensor.
        covariance: of the left perturbation, prior included [rad, m].
        common: part of it from errors common to all days.
        T_prior: prior of each day.
        prior_covariance: of the left perturbation.
    """

    day: Int[np.ndarray, " N"]
    T: Float[np.ndarray, "N 4 4"]
    covariance: Float[np.ndarray, "N 6 6"]
    common: Float[np.ndarray, "N 6 6"]
    T_prior: Float[np.ndarray, "N 4 4"]
    prior_covariance: Float[np.ndarray, "N 6 6"]

    def at(self, rows: np.ndarray | slice) -> PoseDays:
        """Some of the days."""
        return PoseDays(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def change_per_day(self) -> Float[np.ndarray, " 6"]:
        """Size of the change from the first day to the last, by DoF [rad or m a day]; infinite for a single day."""
        if len(self.day) == 1:
            return np.full(_DOFS, np.inf)
        return np.asarray(np.abs(change_between(self.T[0], self.T[-1])) / (self.day[-1] - self.day[0]))


@dataclass(frozen=True, eq=False)
class Mount:
    """How a mount moves without a fault, by DoF of a change (rotation vector [rad], shift [m]).

    Args:
        scatter: standard deviation from day to day.
        wander: variance that its level gains per day.
        autocorrelation: of the errors of neighbouring days.
    """

    scatter: Float[np.ndarray, " 6"]
    wander: Float[np.ndarray, " 6"]
    autocorrelation: float


@dataclass(frozen=True, eq=False)
class Fused:
    """Pose for tomorrow.

    Args:
        covariance: of the left perturbation [rad, m], the mount's scatter included.
        common: part of it from errors common to all days, the prior's included.
        of_prior: part of it that is the prior's error.
        rows: days that it rests on.
        left_out: single days that lie apart from the later ones.
        moved_on: first day of the present level, if earlier days lie elsewhere; None = they do not.
    """

    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "6 6"]
    of_prior: Float[np.ndarray, "6 6"]
    rows: tuple[int, ...]
    left_out: tuple[int, ...]
    moved_on: int | None


def fuse(days: PoseDays, mount: Mount, tomorrow: int) -> Fused:
    """The pose for a day to come, from at least one day."""
    kept, left_out = current_level(days, mount)
    own = days.at(np.array(kept))
    origin, last = own.T[-1], slice(-1, None)
    prior, moment = _of_prior(own.at(last), origin)
    information = prior
    H, g, bias = _of_days(own, origin, mount)
    walk = np.diag(np.append(mount.wander, np.zeros(_DOFS)))
    for k, gap in enumerate(np.diff(own.day, append=tomorrow)):
        information, moment = information + H[k], moment + g[k]
        if walk.any():
            x = np.linalg.solve(information, moment)
            information = np.linalg.inv(np.linalg.inv(information) + gap * walk)
            moment = information @ x
    C = np.linalg.inv(information)
    x, level = (C @ moment)[:_DOFS], C[:_DOFS, :_DOFS]
    common = (C @ prior @ C)[:_DOFS, :_DOFS]
    of_prior = level @ prior[:_DOFS, :_DOFS] @ level
    T = changed(origin, x)
    K = np.linalg.inv(change_jacobian(T))
    earlier = [i for i in range(kept[0]) if i not in left_out]
    covariance = level + np.diag(_of_tomorrow(mount, bias) + _unclear_step(own, mount))
    parts = (covariance, common, of_prior)
    covariance, common, of_prior = (_symmetric(K @ part @ K.T) for part in parts)
    moved_on = int(days.day[kept[0]]) if earlier else None
    return Fused(T, covariance, common, of_prior, tuple(kept), tuple(left_out), moved_on)


def with_held_day(found: Fused, day: PoseDays, mount: Mount) -> Fused | None:
    """The pose with the step to a held day as a part of its sigma, if the day lies apart; None if it does not.

    A knock may make the verdict hold the day that first shows it: until a day counts, both poses are possible.
    """
    step = change_between(found.T, day.T[0])
    _, weight, variance = _compared(day, mount)
    [covariance] = _in_changes(found.T[None], found.covariance[None])
    z = np.abs(step) / np.sqrt(variance[0] + np.diag(covariance))
    apart = (weight[0] > 0) & (z > _APART_SIGMAS)
    if not apart.any():
        return None
    K = np.linalg.inv(change_jacobian(found.T))
    wider = _symmetric(K @ (covariance + np.diag(np.where(apart, step**2, 0.0))) @ K.T)
    return replace(found, covariance=wider)


def after_a_move(found: Fused) -> Fused:
    """The pose where the sensor moved since its last day, nobody knows how far: as far as knocks usually go."""
    K = np.linalg.inv(change_jacobian(found.T))
    return replace(found, covariance=_symmetric(found.covariance + K @ np.diag(_KNOCK**2) @ K.T))


def current_level(days: PoseDays, mount: Mount) -> tuple[list[int], list[int]]:
    """Rows of the days that lie where the last one lies, and rows of single days among them that do not.

    Going back from the last day, a day that lies apart from the later ones is left out if the day before it does not,
    and ends the level if it does: the sensor moved between them.
    """
    x, weight, variance = _compared(days, mount)
    kept, apart = [len(x) - 1], list[int]()
    for i in range(len(x) - 2, -1, -1):
        later = weight[kept]
        sure = later.sum(axis=0)
        both = (sure > 0) & (weight[i] > 0)
        mean = (later * x[kept]).sum(axis=0) / np.where(both, sure, 1.0)
        age = float(days.day[kept].mean() - days.day[i])
        spread = variance[i] + 1 / np.where(both, sure, 1.0) + age * mount.wander
        z = np.where(both, np.abs(x[i] - mean) / np.sqrt(spread), 0.0)
        if z.max() <= _APART_SIGMAS:
            kept.append(i)
        elif apart and apart[-1] == i + 1:
            break
        else:
            apart.append(i)
    return sorted(kept), sorted(i for i in apart if i > min(kept))


def _compared(
    days: PoseDays, mount: Mount
) -> tuple[Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"]]:
    """Changes from the last day, the weight of each axis (0 where a day does not determine it), and its variance."""
    total = np.einsum("nii->ni", _in_changes(days.T, days.covariance))
    varying = total - np.einsum("nii->ni", _in_changes(days.T, days.common))
    variance = np.maximum(varying, _LEAST_VARYING * total) + mount.scatter**2
    before = np.einsum("nii->ni", _in_changes(days.T_prior, days.prior_covariance))
    weight = np.where(total < (1 - _DETERMINED) * before, 1 / variance, 0.0)
    return change_between(days.T[-1], days.T), weight, variance


def _unclear_step(days: PoseDays, mount: Mount) -> Float[np.ndarray, " 6"]:
    """Variance by DoF of a step, or the begin of a drift, that the last days may show but do not prove.

    Of every split before one of them: the probability that the level changed there, times the square of what the mean
    of all days then lacks. The largest of them counts. Of older steps the charts decide.
    """
    x, weight, _ = _compared(days, mount)
    then, now = np.cumsum(weight, axis=0)[:-1], np.cumsum(weight[::-1], axis=0)[::-1][1:]
    first, last = np.cumsum(weight * x, axis=0)[:-1], np.cumsum((weight * x)[::-1], axis=0)[::-1][1:]
    both = (then > 0) & (now > 0)
    then, now = np.where(both, then, 1.0), np.where(both, now, 1.0)
    step = np.where(both, last / now - first / then, 0.0)
    age = np.array([days.day[k:].mean() - days.day[:k].mean() for k in range(1, len(x))])
    variance = 1 / then + 1 / now + age[:, None] * mount.wander
    share = _KNOCK**2 / (_KNOCK**2 + variance)  # of the step that a knock of that size explains
    odds = _KNOCKS_A_DAY * np.sqrt(1 - share) * np.exp(0.5 * share * step**2 / variance)
    lacks = share * step * then / (then + now)
    return np.asarray((odds / (1 + odds) * lacks**2)[-_NEW_DAYS:].max(axis=0, initial=0.0))


def _of_prior(
    last: PoseDays, origin: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "12 12"], Float[np.ndarray, " 12"]]:
    """Information and moment of the prior on (x, u)."""
    information = np.eye(2 * _DOFS)
    [before] = _in_changes(last.T_prior, last.prior_covariance)
    information[:_DOFS, :_DOFS] = np.linalg.inv(before)
    x0 = np.append(change_between(origin, last.T_prior[0]), np.zeros(_DOFS))
    return information, information @ x0


def _of_days(
    days: PoseDays, origin: Float[np.ndarray, "4 4"], mount: Mount
) -> tuple[Float[np.ndarray, "N 12 12"], Float[np.ndarray, "N 12"], Float[np.ndarray, " 6"]]:
    """Information and moment of each day's data on (x, u), and the variance by DoF that days are said to err by alike.

    With columns V so that V' P V = 1 and V' C V = diag(c) for the day's prior P and its result C, the data alone know
    V'x with variance c / (1 - c), as far beyond the result as the prior pulled it back.
    """
    C, B, P = (
        _in_changes(T, part)
        for T, part in (
            (days.T, days.covariance), (days.T, days.common), (days.T_prior, days.prior_covariance)
        )
    )  # fmt: skip
    L = np.linalg.cholesky(P)
    whitened = np.linalg.solve(L, np.linalg.solve(L, C).swapaxes(1, 2))
    c, U = np.linalg.eigh(_symmetric(whitened))
    V = np.linalg.solve(L.swapaxes(1, 2), U)
    Vt, back, shown = V.swapaxes(1, 2), P @ V, c < _NOTHING
    c = np.clip(c, _LEAST_SHARE, _NOTHING)
    ratio = c / (1 - c)
    scale = np.where(shown, np.sqrt(ratio), 0.0)
    # Of the result's common part, c^2 is the prior's error; the rest is the data's, in units of their own sigma.
    own = (Vt @ B @ V - c[:, :, None] ** 2 * np.eye(_DOFS)) / _outer((1 - c) * np.sqrt(ratio))
    own = _between(own * _outer(shown * 1.0), 0.0, 1 - _LEAST_VARYING)
    [more] = alike(np.array([len(days.day)]), np.array([mount.autocorrelation]))
    noise = more * (np.eye(_DOFS) - own) * _outer(scale) + Vt @ np.diag(mount.scatter**2) @ V
    noise = noise * _outer(shown * 1.0) + np.eye(_DOFS) * ~shown[:, None, :]
    W = np.linalg.inv(noise) * _outer(shown * 1.0)
    bias = back @ (own * _outer(scale)) @ back.swapaxes(1, 2)
    A = np.concatenate([Vt, Vt @ _root(bias)], axis=2)
    x, x0 = change_between(origin, days.T), change_between(origin, days.T_prior)
    v = np.einsum("nij,nj->ni", Vt, x) + ratio * np.einsum("nij,nj->ni", Vt, x - x0)
    AtW = A.swapaxes(1, 2) @ W
    return AtW @ A, np.einsum("nij,nj->ni", AtW, v), np.median(np.einsum("nii->ni", bias), axis=0)


def _of_tomorrow(mount: Mount, bias: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " 6"]:
    """Variance by DoF of tomorrow's mounting about its level.

    Where days scatter more than by their varying part, the mount moves, or less of their error is alike than was said.
    The sigma of the level counts all of that as alike; what scatters beyond it too is the mount's.
    """
    scatter = mount.scatter**2
    return np.minimum(scatter, np.maximum(scatter - bias, LEAST_SCATTER**2))


def _in_changes(
    T: Float[np.ndarray, "N 4 4"], covariance: Float[np.ndarray, "N 6 6"]
) -> Float[np.ndarray, "N 6 6"]:
    J = change_jacobian(T)
    return _symmetric(J @ covariance @ J.swapaxes(-1, -2))


def _outer(v: Float[np.ndarray, "N 6"]) -> Float[np.ndarray, "N 6 6"]:
    return v[:, :, None] * v[:, None, :]


def _symmetric(m: Float[np.ndarray, "*N D D"]) -> Float[np.ndarray, "*N D D"]:
    return 0.5 * (m + m.swapaxes(-1, -2))


def _between(m: Float[np.ndarray, "N D D"], least: float, most: float) -> Float[np.ndarray, "N D D"]:
    """Symmetric matrices with their eigenvalues limited."""
    values, vectors = np.linalg.eigh(_symmetric(m))
    return (vectors * np.clip(values, least, most)[:, None, :]) @ vectors.swapaxes(1, 2)


def _root(m: Float[np.ndarray, "N D D"]) -> Float[np.ndarray, "N D D"]:
    """Symmetric roots, so that common errors of days with different sizes stay fully correlated."""
    values, vectors = np.linalg.eigh(_symmetric(m))
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.swapaxes(1, 2)
