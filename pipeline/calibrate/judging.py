"""Verdict and evidence of each pair of a solved day: held-out frames, claim, failed checks.

Held-out frames at known rotations of the result: a test whether they would reject a prior rotated like this.

A record that lies many sigmas from its prior is held unless held-out frames align better at the result than at
the prior. To find the smallest error of the prior that would be detected, this test is made for errors that
the prior does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from pipeline.calibrate.adjust.rig import adjust
from pipeline.calibrate.numerics.frame_blocks import scene_blocks
from pipeline.calibrate.reasons import because
from pipeline.calibrate.select.frames import Selection
from pipeline.calibrate.verify.edge_result import EdgeResult, tilt_in_doubt
from pipeline.calibrate.verify.held_out import (
    HeldOutTest,
    HeldOutUpdate,
    found_elsewhere,
    held_out_place,
    held_out_update,
    paired_test,
)
from pipeline.calibrate.verify.held_out_score import held_out_score
from pipeline.calibrate.verify.target_accuracy import (
    DIRECTIONS,
    Claim,
    claims_of,
    mounting_covariance,
    seen_targets,
    targets_of,
    unseen_failure,
    views_of,
)
from pipeline.calibrate.verify.verdict import Evidence, Verdict, judge, matters
from pipeline.core.config import FleetConfig, VerifyConfig
from pipeline.core.stage_work import NO_PROBES, Probes
from pipeline.rig.estimates import Check, EdgeEvidence, PairEstimate, Prior
from pipeline.rig.graph import BASE, Edge, RigGraph
from pipeline.rig.kinds import KIND_OF_EDGE
from pipeline.rig.overlap import View
from pipeline.rig.prior import Extrinsics, RigPrior
from pipeline.rig.rig import sensor_turn
from pipeline.rig.se3 import change_covariance
from pipeline.rig.targets import DEFAULT_TARGETS
from schemas.calibrations import PROBE_Z
from schemas.observations import Observation

__all__ = ["EdgeJudging", "Judged", "Judging"]


@dataclass(frozen=True)
class Judged:
    """The verdict on one pair and the evidence behind it."""

    verdict: Verdict
    test: HeldOutTest | None
    claims: Mapping[str, Claim]
    mounting_covariance: np.ndarray | None = None  # 6 6; None if the camera's mounting is unknown
    targets: np.ndarray = field(default_factory=lambda: DEFAULT_TARGETS)  # 3 3, in the child's frame
    probes: Mapping[str, float] = field(default_factory=dict)  # of `probe_numbers`
    held_by: tuple[Check, ...] = ()  # of the checks of solver and day, those that matter
    # 6 6, left perturbation: what failed checks of an accepted pose leave open in a tilt that it does not certify.
    doubt: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True, eq=False)
class Judging:
    """Inputs of the verdicts of a day's pairs.

    Args:
        selection: frames that took no part in the fit.
        prior: what stays current.
        active: pairs that were to be calibrated.
        camera_turn_sigma_rad: of the camera's pitch and yaw, by its principal point.
        probe_deg: as `Task.probe_deg`.
    """

    observations: Sequence[Observation]
    selection: Selection
    prior: Prior
    fleet: FleetConfig
    active: Collection[str]
    camera_turn_sigma_rad: np.ndarray | None
    probe_deg: Probes = NO_PROBES

    @cached_property
    def _views(self) -> dict[str, View]:
        return views_of(self.observations)

    @cached_property
    def _place_by_held_out(self) -> np.ndarray | None:
        """T_camera_lidar by a search on held-out frames, if these are more than those of the fit."""
        held_out = self.selection.holdout["camera_lidar"]
        if len(held_out) <= len(self.selection.fit["camera_lidar"]):
            return None
        frames = [self.observations[i] for i in held_out]
        return held_out_place(frames, self.prior, self.fleet.solve)

    def pair(self, estimate: PairEstimate, failed: Sequence[Check], together: bool) -> Judged:
        """Judge one pair; `together` is true if other pairs take part in its pose (see `judge`)."""
        pair, limits = estimate.pair, self.fleet.verify.checks
        active = pair in self.active
        held_out = [self.observations[i] for i in self.selection.holdout[pair]] if active else []
        mounting = mounting_covariance(pair, estimate.T, estimate.covariance, self.camera_turn_sigma_rad)
        targets = seen_targets(pair, self.prior, self._views)
        unseen = [] if targets is not None else [unseen_failure(pair)]
        if active and not held_out:
            unseen.append(Check(because("none held out")))
        targets = DEFAULT_TARGETS if targets is None else targets
        test, claims, probes, elsewhere = self._held_out(estimate, held_out, mounting, targets)
        disproved = [Check(estimate.disproved, disproves=True)] if estimate.disproved else []
        prior_sigma = np.sqrt(np.diag(self.prior.covariance(pair)))
        search = self.fleet.solve.search_range(self.prior.sigmas)
        result = EdgeResult.of(estimate, self.prior.of(pair), prior_sigma, search, targets)
        verdict = judge(
            result,
            Evidence(test, claims, [*failed, *unseen, *elsewhere, *disproved]),
            limits,
            triggered=active,
            together=together,
        )
        held_by = tuple(check for check in (*failed, *disproved) if matters(check, result, claims))
        doubts = [tilt_in_doubt(result, check) for check in failed] if verdict.status == "accepted" else []
        doubt = sum((d for d in doubts if d is not None), np.zeros((6, 6)))
        return Judged(verdict, test, claims, mounting, targets, probes, held_by, doubt)

    def _held_out(
        self,
        estimate: PairEstimate,
        held_out: Sequence[Observation],
        mounting: np.ndarray | None,
        targets: np.ndarray,
    ) -> tuple[HeldOutTest | None, Mapping[str, Claim], dict[str, float], list[Check]]:
        """Held-out frames at the prior and at the result, the remaining claim, known turns, and a better place."""
        pair, verify, prior = estimate.pair, self.fleet.verify, self.prior
        limits = verify.checks
        test, update, probes, score = None, None, dict[str, float](), None
        if held_out:
            score = held_out_score(estimate, held_out, prior, self.fleet.solve)
            blocks = scene_blocks(held_out)
            test = paired_test(score.cost(prior.of(pair)), score.cost(estimate.T), blocks)
            probes = probe_numbers(pair, estimate.T, score.cost, blocks, self.probe_deg["radar" in pair])
            covariance = np.diag([*np.zeros(6), *score.extra_variance])
            covariance[:6, :6] = estimate.covariance
            update = held_out_update(score.derivatives, covariance, score.bias, blocks, limits)
        claims = _claims(estimate, update, verify, mounting, targets)
        place = self._place_by_held_out if pair == "camera_lidar" and score is not None else None
        if score is None or place is None:
            return test, claims, probes, []
        sigma_rad = np.array([claims[name].sigma_rad for name in DIRECTIONS])
        blocks, z = scene_blocks(held_out), limits.worse_alignment_z
        elsewhere = found_elsewhere(estimate, place, score.cost, sigma_rad, blocks, targets, z)
        return test, claims, probes, elsewhere


def _claims(
    estimate: PairEstimate,
    update: HeldOutUpdate | None,
    verify: VerifyConfig,
    mounting: np.ndarray | None,
    targets: np.ndarray,
) -> dict[str, Claim]:
    azimuth_rad, elevation_rad = verify.limits_rad(estimate.pair)
    return claims_of(
        estimate.pair, estimate.T, estimate.covariance, update, azimuth_rad, verify.confidence,
        verify.checks.held_out_contradiction_sigmas, elevation_rad, mounting, targets,
    )  # fmt: skip


def probe_numbers(
    pair: str,
    T: Float[np.ndarray, "4 4"],
    cost: Callable[[np.ndarray], np.ndarray],
    blocks: Int[np.ndarray, " F"],
    sizes_deg: Sequence[float],
) -> dict[str, float]:
    """Deviate z of the paired test by turn, negative = held-out frames prefer the result; for diagnostics.

    Args:
        pair: pair whose camera or radar is rotated.
        T: the result.
        cost: cost of each held-out frame at a pose of the pair.
        blocks: scene of each held-out frame.
        sizes_deg: sizes of the rotations; both signs are tested.
    """
    found, after = dict[str, float](), cost(T) if sizes_deg else np.zeros(0)
    for axis in KIND_OF_EDGE[pair].probed:
        for deg in (sign * size for size in sizes_deg for sign in (1.0, -1.0)):
            of_camera = pair == "camera_lidar"
            R = sensor_turn(axis, float(np.radians(deg)), of_camera=of_camera)
            test = paired_test(cost(np.linalg.inv(R) @ T if of_camera else T @ R), after, blocks)
            if test is not None:
                found[f"{PROBE_Z}{axis}_{deg:+g}"] = test.z
    return found


# -- edges of other kinds than camera, lidar and radar: no frame is held out, halves of the day judge each other ----


@dataclass(frozen=True, eq=False)
class EdgeJudging:
    """Inputs of the verdicts on an edge, and its estimate by its own data and its prior.

    Args:
        before: the prior of its two sensors alone.
        views: of each sensor, by name.
    """

    evidence: EdgeEvidence
    before: Extrinsics
    estimate: PairEstimate
    prior: RigPrior
    views: Mapping[str, View]
    fleet: FleetConfig

    @classmethod
    def of(
        cls, evidence: EdgeEvidence, prior: RigPrior, views: Mapping[str, View], fleet: FleetConfig
    ) -> EdgeJudging:
        """Combine an edge's own data with its prior alone."""
        edge, child = evidence.edge, evidence.edge.child.name
        free, clock_s = replace(evidence, checks=()), fleet.solve.time_offset_sigma_s
        alone = adjust(RigGraph(edge.sensors, (edge,), edge.parent), _prior_of(edge, prior), [free], clock_s)
        of_child, poses = alone.sensors[child], alone.poses
        estimate = PairEstimate(
            edge.kind, poses.T[child], poses.covariance, of_child.observability, of_child.determined,
            evidence.frames_used, dict(evidence.frames_rejected), diagnostics=dict(evidence.diagnostics),
            common_covariance=poses.common, parts=evidence.parts,
        )  # fmt: skip
        return cls(evidence, alone.before, estimate, prior, views, fleet)

    def edge(self, estimate: PairEstimate, failed: Sequence[Check], together: bool) -> Judged:
        """Judge it at an estimate; `together` is true if other edges take part in its pose (see `judge`)."""
        edge, checks = self.evidence.edge, self.fleet.verify.checks
        targets = targets_of(estimate.T, self.views.get(edge.parent.name), self.views.get(edge.child.name))
        targets = DEFAULT_TARGETS if targets is None else targets
        mounting = mounting_covariance(edge.kind, estimate.T, estimate.covariance, None)
        test, update = self._other_scenes(estimate)
        claims = _claims(estimate, update, self.fleet.verify, mounting, targets)
        sigmas = self.prior.sigmas_between(*(s.name for s in edge.sensors))
        before, before_sigma = self.before.T[edge.child.name], np.repeat(sigmas, 3)
        if edge.child != BASE:  # a parent that turns swings the child
            before_sigma = np.sqrt(np.diag(change_covariance(before, self.before.covariance)))
        result = EdgeResult.of(estimate, before, before_sigma, self.fleet.solve.search_range(sigmas), targets)
        verdict = judge(result, Evidence(test, claims, failed), checks, together=together)
        held_by = tuple(check for check in failed if matters(check, result, claims))
        return Judged(verdict, test, claims, mounting, targets, held_by=held_by)

    def _other_scenes(self, estimate: PairEstimate) -> tuple[HeldOutTest | None, HeldOutUpdate | None]:
        """By how much scenes that took no part would move the edge's own fit; its way to the rig is its innovation."""
        others = self.evidence.others
        if others is None:
            return None, None
        test = None if others.cost is None else paired_test(*others.cost)
        return test, HeldOutUpdate(others.shift, estimate.covariance, others.covariance, np.zeros((6, 6)))


def _prior_of(edge: Edge, prior: RigPrior) -> Extrinsics:
    parent, child = (s.name for s in edge.sensors)
    T = prior.between(parent, child)
    assert T is not None, "an edge whose ends nothing ties is refused before"
    rotation, translation = prior.sigmas_between(parent, child)
    covariance = np.diag([rotation**2] * 3 + [translation**2] * 3)
    return Extrinsics(edge.parent, {parent: np.eye(4), child: T}, (child,), covariance, covariance)
