"""Wrong priors: mountings that edges contradict, and by how much all that rests on them would be off.

An edge far from the prior is left out of the adjustment, because it may be in a wrong minimum. But if it is right, the
prior of one of its sensors is wrong, and all that the day leaves to that prior errs with it, at the prior's small
sigma: on a van whose reference lidar was logged .3 m too far ahead, three radars without a measured position were
accepted half a degree off. Each of both sensors is suspected, unless another edge would show its error and does not.
What a suspicion means for an edge or a pose follows from the derivative of the adjusted poses by the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.calibrate.adjust.rig import AdjustedRig
from pipeline.calibrate.adjusted_day import SolvedEdge
from pipeline.calibrate.verify.day_checks import far_positions, own_positions
from pipeline.core.config import ChecksConfig
from pipeline.rig.changes import change_between, change_covariance, change_jacobian, changed
from pipeline.rig.checks import Check, change_of
from pipeline.rig.extrinsics import Extrinsics
from pipeline.rig.graph import Edge, Sensor
from pipeline.rig.se3 import inverse, log_se3

__all__ = ["WrongPrior", "wrong_priors"]

_FAULT = "prior"
_DENIES_SIGMAS = 3.0  # by which an edge's own change differs from the suspected one


@dataclass(frozen=True, eq=False)
class WrongPrior:
    """A sensor whose mounting an edge contradicts.

    Args:
        edge: shows it.
        shift: by which the prior's poses would be wrong (left perturbations, as in `Extrinsics`) [rad, m].
    """

    sensor: str
    edge: Edge
    shift: Float[np.ndarray, " P"]

    @property
    def sentence(self) -> str:
        """For what rests on it."""
        return f"it depends on the prior pose of {self.sensor}, which {self.edge.name} contradicts"

    def error(self, rig: AdjustedRig, a: str, b: str) -> Float[np.ndarray, " 6"]:
        """By how much T_a_b of the adjusted rig would be wrong, as left perturbation [rad, m]."""
        return np.asarray(rig.poses.jacobian_between(a, b) @ (rig.by_prior @ self.shift))

    def check(self, rig: AdjustedRig, edge: Edge) -> Check | None:
        """The check that an edge fails; None if it rests elsewhere: it would be off by less than a sigma."""
        a, b = (s.name for s in edge.sensors)
        T, covariance = rig.poses.between(a, b), rig.poses.covariance_between(a, b)
        error = change_jacobian(T) @ self.error(rig, a, b)
        if edge == self.edge or np.all(np.abs(error) <= np.sqrt(np.diag(change_covariance(T, covariance)))):
            return None
        return Check(self.sentence, _FAULT, error=change_of(error))


def wrong_priors(edges: Sequence[SolvedEdge], rig: AdjustedRig, limits: ChecksConfig) -> list[WrongPrior]:
    """Sensors whose prior an edge contradicts by many of its sigmas, and which no other edge acquits."""
    known = [e for e in edges if e.edge in rig.edges]
    found = []
    for accuser in known:
        if _FAULT not in accuser.judged.verdict.faults or accuser.own.disproved:
            continue
        T = _shown(accuser, rig.before, limits)
        for sensor in accuser.edge.sensors:
            shift = _shift(rig.before, accuser.edge, sensor, T)
            if not any(_denies(e, rig.before, shift, limits) for e in known if e is not accuser):
                found.append(WrongPrior(sensor.name, accuser.edge, shift))
    return found


def _shown(edge: SolvedEdge, before: Extrinsics, limits: ChecksConfig) -> Float[np.ndarray, "4 4"]:
    """The prior's transform, changed where the edge contradicts it."""
    T = before.between(*(s.name for s in edge.edge.sensors))
    step, far = change_between(T, edge.own.T), _far(edge.edge, before, limits)
    step = np.where(edge.own.observable & (np.abs(step) > far), step, 0.0)
    for k, shift in far_positions(edge.own, far / limits.max_move_prior_sigmas, limits).items():
        step[k] = shift
    return changed(T, step)


def _shift(
    before: Extrinsics, edge: Edge, sensor: Sensor, T: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " P"]:
    """By how much the prior's poses are wrong if the edge's transform is T and the sensor is mounted elsewhere."""
    parent, child = edge.sensors
    there = before.T[parent.name] @ T if sensor == child else before.T[child.name] @ inverse(T)
    xi, shift = log_se3(there @ inverse(before.T[sensor.name])), np.zeros(6 * len(before.order))
    if sensor == before.reference:  # all others are elsewhere to it
        return np.asarray(-np.tile(xi, len(before.order)))
    k = 6 * before.order.index(sensor.name)
    shift[k : k + 6] = xi
    return shift


def _denies(edge: SolvedEdge, before: Extrinsics, shift: np.ndarray, limits: ChecksConfig) -> bool:
    """Whether an edge would show so wrong a prior and does not."""
    a, b = (s.name for s in edge.edge.sensors)
    T = before.between(a, b)
    hidden = change_jacobian(T) @ before.jacobian_between(a, b) @ shift
    own, knows = change_between(T, edge.own.T), edge.own.observable.copy()
    sigma = np.sqrt(np.diag(change_covariance(edge.own.T, edge.own.covariance)))
    for k, (position, own_sigma) in own_positions(edge.own).items():
        own[k], sigma[k], knows[k] = position, own_sigma, True
    differs = np.abs(own - hidden) > np.maximum(0.5 * np.abs(hidden), _DENIES_SIGMAS * sigma)
    return bool(np.any(knows & differs & (np.abs(hidden) > _far(edge.edge, before, limits))))


def _far(edge: Edge, before: Extrinsics, limits: ChecksConfig) -> Float[np.ndarray, " 6"]:
    """Changes of an edge that contradict its prior."""
    a, b = (s.name for s in edge.sensors)
    covariance = change_covariance(before.between(a, b), before.covariance_between(a, b))
    return np.asarray(limits.max_move_prior_sigmas * np.sqrt(np.diag(covariance)))
