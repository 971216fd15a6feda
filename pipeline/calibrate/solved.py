"""A day with solved and judged pairs, and an edge of any kind between its own solution and its record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

from pipeline.calibrate.judging import Judged, Judging
from pipeline.calibrate.select.frames import Selection
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import PairEstimate, Prior, Solution
from pipeline.rig.evidence import EdgeEvidence
from pipeline.rig.graph import Edge
from schemas.calibrations import CalibrationRecord
from schemas.observations import Observation

__all__ = ["SolvedDay", "SolvedEdge"]


@dataclass(frozen=True, eq=False)
class SolvedDay:
    """A day's inputs, results and verdicts.

    Args:
        solution: solution of the pairs that were not refused.
        judging: data that verdicts depend on.
        trigger_sample: frames for the trigger metrics; empty for methods other than the paper's, unless
            `trigger.when` needs them.
        trigger_before: metrics of each pair at the prior.
        triggered: by pair, whether one of the metrics exceeds its threshold.
        numbers: numbers of checks of the day, for every record.
    """

    observations: Sequence[Observation]
    selection: Selection
    prior: Prior
    solution: Solution
    judged: Mapping[str, Judged]
    failed: Mapping[str, Sequence[FailedCheck]]
    judging: Judging
    trigger_sample: Sequence[Observation]
    trigger_before: Mapping[str, Mapping[str, float]]
    triggered: Mapping[str, bool]
    numbers: Mapping[str, float] = field(default_factory=dict)


@runtime_checkable
class Judge(Protocol):
    """Verdict on an estimate of an edge; `together`: other edges take part in it."""

    def __call__(
        self, estimate: PairEstimate, failed: Sequence[FailedCheck], *, together: bool
    ) -> Judged: ...


@dataclass(frozen=True, eq=False)
class SolvedEdge:
    """An edge that was solved and judged by its own data: one form for every kind.

    Args:
        own: estimate by its own data and its prior.
        judged: the verdict on it.
        evidence: without the prior, and the reason why the rig must not use it, if there is one.
        failed: failed checks, for every verdict on it.
        judge: how it is judged at another estimate.
        record: its record, from an estimate with its verdict.
        is_active: False for a pair that no trigger asked for, which keeps the prior.
    """

    edge: Edge
    own: PairEstimate
    judged: Judged
    evidence: EdgeEvidence
    failed: Sequence[FailedCheck]
    judge: Judge
    record: Callable[[PairEstimate, Judged], CalibrationRecord]
    is_active: bool = True

    def with_checks(self, checks: Sequence[FailedCheck]) -> SolvedEdge:
        """The edge, judged with failed checks of the whole rig besides."""
        failed = (*self.failed, *checks)
        judged = self.judge(self.own, failed, together=False)
        evidence = replace(self.evidence, checks=judged.verdict.against)
        return replace(self, failed=failed, judged=judged, evidence=evidence)
