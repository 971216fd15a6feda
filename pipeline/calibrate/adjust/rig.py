"""Adjustment of a rig: poses and clocks of all sensors over the evidence of its edges, and each edge's innovation."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh
from scipy.special import chdtrc, ndtr, ndtri, ndtri_exp

from pipeline.calibrate.adjust.equations import Equations, LinearEdge, Rig, equations_at
from pipeline.calibrate.numerics.covariance import OBSERVABLE, inverse_of_information
from pipeline.calibrate.reasons import because
from pipeline.rig.estimates import Check, EdgeEvidence, common_part
from pipeline.rig.graph import Edge, RigGraph, Sensor
from pipeline.rig.prior import Extrinsics
from pipeline.rig.se3 import change_jacobian

__all__ = ["AdjustedEdge", "AdjustedRig", "AdjustedSensor", "adjust"]

# --------------------------------------------------------------------------------------------------
# Result of the adjustment of a rig.


@dataclass(frozen=True, eq=False)
class AdjustedEdge:
    """An edge, compared with the adjusted rig.

    Args:
        innovation_sigmas: distance from the pose by all other edges in use; None = only the prior checks it.
        failed: reason for leaving it out; empty = it is used.
        doubts: edges of which one, unknown which, is wrong; all but one of them are used.
    """

    evidence: EdgeEvidence
    innovation_sigmas: float | None
    failed: tuple[Check, ...] = ()
    doubts: tuple[Edge, ...] = ()

    @property
    def used(self) -> bool:
        """Whether the rig uses it."""
        return not self.failed


@dataclass(frozen=True, eq=False)
class AdjustedSensor:
    """Uncertainty of a sensor's pose to the reference.

    Degrees of freedom: rotation vector about the reference's axes, then the sensor's origin in them.

    Args:
        determined: 6, bool; the other degrees of freedom depend on the prior.
        rests_on: edges that its pose depends on: without one of them, its covariance is larger.
        untied: reason why the day does not determine its pose to the reference; empty = it does.
        doubts: edges that it depends on, of which one, unknown which, is wrong.
    """

    observability: np.ndarray
    determined: np.ndarray
    rests_on: tuple[Edge, ...]
    untied: str
    doubts: tuple[Edge, ...]
    dt_sigma_s: float


@dataclass(frozen=True, eq=False)
class AdjustedRig:
    """Poses and clocks of all sensors, with the state of each edge and the uncertainty of each sensor.

    Args:
        poses: all poses, with their joint covariance.
        by_prior: derivative of all poses by those of the prior.
    """

    poses: Extrinsics
    by_prior: np.ndarray  # P P
    before: Extrinsics
    sensors: Mapping[str, AdjustedSensor]
    edges: Mapping[Edge, AdjustedEdge]

    def observability(self, a: str, b: str) -> Float[np.ndarray, " 6"]:
        """Share of each variance of T_a_b (rotation vector in a's axes, b's origin) that the day removed.

        For a rotation it is 1 - posterior/prior, with the other sensors at their poses, because a rotated
        reference gives no information on another sensor's rotation. For a position it is the share of the
        variance that is not the prior's error. So a position that only the prior determines, given the
        rotation, does not count as observed. A rotation may be found to a hundredth of the prior and depend
        on a position.
        """
        J = change_jacobian(self.poses.between(a, b)) @ self.poses.jacobian_between(a, b)
        variance = np.diag(J @ self.poses.covariance @ J.T)
        of_prior = self.by_prior @ self.before.covariance @ self.by_prior.T
        share = 1 - np.diag(J @ of_prior @ J.T) / variance
        share[:3] = 1 - variance[:3] / self._turns_before(a, b)
        return np.clip(share, 0.0, 1.0)

    def _turns_before(self, a: str, b: str) -> Float[np.ndarray, " 3"]:
        """Prior variances of the rotation between two sensors, with the others in place [rad^2]."""
        own = [6 * k + i for k, name in enumerate(self.before.order) if name in (a, b) for i in range(6)]
        information = inverse_of_information(self.before.covariance)
        given_others = inverse_of_information(information[np.ix_(own, own)])
        J = self.before.jacobian_between(a, b)[:3, own]
        return np.diag(J @ given_others @ J.T)

    @property
    def left_out(self) -> tuple[Edge, ...]:
        """Edges with evidence that the rig does not use."""
        return tuple(e for e, found in self.edges.items() if not found.used)


# --------------------------------------------------------------------------------------------------
# One solve over a rig: poses and clocks of all sensors, without edges that contradict the others.
#
# Edges that failed a check are left out first: within a cycle, an innovation shows that one edge is wrong, but
# rarely which one. Then the edge with the largest innovation beyond the limit is removed, and the rest is
# solved again. If several edges explain a contradiction about equally well, the one whose removal loses least
# information is removed, and all are listed.
#
# Innovation of each edge: its distance to all others, in sigmas.
#
# An edge without a second path between its sensors is compared with the prior. Directions that neither the edge
# nor the others know better than the prior are left out.


# Gauss-Newton of quadratic costs: four steps from a prior 5 deg away, to 1e-9 rad, m and s.
_MOST_STEPS, _STILL = 20, 1e-9
# Two edges are distinguished where the better explanation is twenty times as probable: what attribution asks for.
_CLEAR = 2 * np.log(20.0)
_MATTERS = 1.01  # a variance that grows by more than this share rests on the edge that was left out
# An edge five sigmas wrong draws a pose by one sigma that rests on it by a fifth, whose variance grows by a quarter.
_DRAWS = 1.25
# Information that stands in for none, as a share of the prior's: an edge is then so much less sure than the prior.
_NONE = 1e-6


def adjust(
    graph: RigGraph,
    prior: Extrinsics,
    evidence: Sequence[EdgeEvidence],
    clock_sigma_s: float,
    innovation_sigmas: float = 3.0,
) -> AdjustedRig:
    """Solve poses and clocks of all sensors.

    Args:
        prior: poses of all sensors, each once; its `common` is the part of the errors common to all days.
        evidence: evidence of edges of the graph, each once.
        clock_sigma_s: of each sensor's clock, before the day.
        innovation_sigmas: limit of an edge's innovation; it holds for a whole rig, however many edges it has.

    Raises:
        ValueError: an edge with evidence is not in the graph, or occurs twice; the prior has other sensors
            than the graph.
    """
    _check(graph, prior, evidence)
    failed = {e.edge: e.checks for e in evidence if e.checks}
    doubts: dict[Edge, tuple[Edge, ...]] = {}
    while True:
        used = [e for e in evidence if e.edge not in failed]
        rig, equations = _solved(Rig.at(prior, clock_sigma_s, evidence), used)
        found = _innovations(graph, rig, equations, [e for e in evidence if e.edge in failed])
        worst = _worst(graph, equations, found, innovation_sigmas)
        if worst is None:
            break
        wrong, rivals, sigmas = worst
        named = (wrong, *rivals) if rivals else ()
        failed[wrong] = (_contradiction(wrong, rivals, sigmas),)
        doubts |= {e: named for e in named if e not in doubts}
    edges = {
        e.edge: AdjustedEdge(
            e,
            found[e.edge][1] if e.edge in found else None,
            tuple(failed.get(e.edge, ())),
            doubts.get(e.edge, ()),
        )
        for e in evidence
    }
    return _concluded(graph, rig, equations, edges)


def _check(graph: RigGraph, prior: Extrinsics, evidence: Sequence[EdgeEvidence]) -> None:
    edges = [e.edge for e in evidence]
    wrong = [e.name for e in edges if e not in graph.edges or edges.count(e) > 1]
    if wrong:
        raise ValueError(f"evidence of edges that the rig lacks, or twice: {', '.join(sorted(set(wrong)))}")
    if prior.reference != graph.reference or set(prior.T) != {s.name for s in graph.sensors}:
        raise ValueError(
            f"a prior of {', '.join(prior.T)} for a rig of {', '.join(s.name for s in graph.sensors)}"
        )


def _solved(rig: Rig, evidence: Sequence[EdgeEvidence]) -> tuple[Rig, Equations]:
    """The rig at the optimum of prior and edges, and the equations there."""
    for _ in range(_MOST_STEPS):
        equations = equations_at(rig, evidence)
        step = inverse_of_information(equations.H) @ equations.g
        rig = rig.moved(step)
        if np.abs(step).max() < _STILL:
            break
    return rig, equations_at(rig, evidence)


def _innovations(
    graph: RigGraph, rig: Rig, equations: Equations, left_out: Sequence[EdgeEvidence]
) -> dict[Edge, tuple[float, float]]:
    """Chi-squared and sigmas of each edge against the edges in use, if these connect its sensors."""
    found = {}
    in_use = graph.with_edges([e.evidence.edge for e in equations.edges])
    apart = [(e, equations) for e in equations_at(rig, left_out).edges]
    for edge, others in [*((e, equations.without(e)) for e in equations.edges), *apart]:
        at = edge.evidence.edge
        value = innovation(edge, others, rig.prior_covariance)
        if value is not None and in_use.without([at]).path(*at.sensors) is not None:
            found[at] = value
    return found


def _worst(
    graph: RigGraph, equations: Equations, found: Mapping[Edge, tuple[float, float]], sigmas: float
) -> tuple[Edge, tuple[Edge, ...], float] | None:
    """Edge to leave out, equally suspect edges, and its sigmas; None if no edge contradicts the others."""
    tested = {e.evidence.edge: e for e in equations.edges if e.evidence.edge in found}
    if not tested:
        return None
    # One false alarm a rig, not an edge: the limit's probability is shared among the cycles, for the edges of one cycle
    # are all as far from the others.
    limit = float(-ndtri(ndtr(-sigmas) / max(len(graph.with_edges(tested).cycles()), 1)))
    beyond = {edge: found[edge][0] for edge in tested if found[edge][1] > limit}
    if not beyond:
        return None
    most = max(beyond.values())
    rivals = [edge for edge, square in beyond.items() if square > most - _CLEAR]
    goes = max(rivals, key=lambda edge: _left(equations, tested[edge]))
    return goes, tuple(e for e in rivals if e != goes), found[goes][1]


def _left(equations: Equations, edge: LinearEdge) -> float:
    """Logarithm of the remaining information without an edge."""
    return float(np.linalg.slogdet(equations.without(edge).H)[1])


def _contradiction(edge: Edge, rivals: Collection[Edge], sigmas: float) -> Check:
    others, reason = ", ".join(e.name for e in rivals), "contradicts, or" if rivals else "contradicts"
    return Check(because(reason, edge=edge.name, sigmas=sigmas, others=others), "witnesses_disagree")


def _concluded(
    graph: RigGraph, rig: Rig, equations: Equations, edges: Mapping[Edge, AdjustedEdge]
) -> AdjustedRig:
    """The rig with covariances and the state of each sensor."""
    n, order = 6 * len(rig.prior.order), rig.prior.order
    C = inverse_of_information(equations.H)
    follow = C[:n, :n] @ equations.prior_information[:n, :n]
    poses = replace(
        rig.poses, covariance=C[:n, :n], common=common_part(equations.common(C, rig)[:n, :n], C[:n, :n])
    )
    found = AdjustedRig(poses, follow, rig.prior, {}, edges)
    rests_on = _rests_on(equations, C, len(order))
    clock = np.sqrt(np.diag(C)[n : n + len(order)])
    used = [e.evidence.edge for e in equations.edges]
    sensors = {}
    for k, name in enumerate(order):
        observability = found.observability(graph.reference.name, name)
        untied = _untied(graph, graph[name], used)
        determined = (observability >= OBSERVABLE) & (not untied)
        rests = tuple(e for e, grown in rests_on[k].items() if grown > _MATTERS)
        doubts = tuple(
            dict.fromkeys(d for e, grown in rests_on[k].items() if grown > _DRAWS for d in edges[e].doubts)
        )
        sensors[name] = AdjustedSensor(observability, determined, rests, untied, doubts, float(clock[k]))
    return replace(found, sensors=sensors)


def _rests_on(equations: Equations, C: Float[np.ndarray, "N N"], sensors: int) -> list[dict[Edge, float]]:
    """For each sensor, the largest growth over all axes of its pose's variance without each edge."""
    found: list[dict[Edge, float]] = [{} for _ in range(sensors)]
    for edge in equations.edges:
        without = inverse_of_information(equations.without(edge).H)
        grown = np.diag(without)[: 6 * sensors] / np.diag(C)[: 6 * sensors]
        for k, share in enumerate(grown.reshape(sensors, 6).max(axis=1)):
            found[k][edge.evidence.edge] = float(share)
    return found


def _untied(graph: RigGraph, sensor: Sensor, used: Sequence[Edge]) -> str:
    """Reason why no edge connects a sensor to the reference; empty if an edge in use does."""
    in_use = graph.with_edges(used)
    if in_use.path(graph.reference, sensor) is not None:
        return ""
    with_it = [s.name for part in in_use.components() if sensor in part for s in part if s != sensor]
    if not with_it:
        lost = ", ".join(e.name for e in graph.edges_of(sensor))
        return because("none used", edges=lost) if lost else because("no edge")
    return because("untied", sensors=", ".join(with_it), reference=graph.reference.name)


def innovation(
    edge: LinearEdge, others: Equations, prior_covariance: Float[np.ndarray, "N N"]
) -> tuple[float, float] | None:
    """Chi-squared of the edge against others and prior, and the equivalent normal sigmas.

    None if edge and others together know no direction better than the prior.
    """
    C = inverse_of_information(others.H)
    before = edge.J @ prior_covariance @ edge.J.T
    of_edge = inverse_of_information(edge.W + _NONE * inverse_of_information(before))
    residual = of_edge @ edge.g - edge.x - edge.J @ (C @ others.g)
    covariance = of_edge + edge.J @ C @ edge.J.T
    values, vectors = eigh(covariance, before)
    known = values < 1.0
    if not known.any():
        return None
    square = float(np.sum((vectors[:, known].T @ residual) ** 2 / values[known]))
    return square, _sigmas(square, int(known.sum()))


def _sigmas(square: float, freedom: int) -> float:
    """Normal deviate of equal probability; the root of chi-squared if that is below the number range."""
    probability = float(chdtrc(freedom, square))
    return float(-ndtri_exp(np.log(probability) - np.log(2))) if probability else square**0.5
