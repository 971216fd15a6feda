"""A day with solved and judged pairs: input of its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pipeline.calibrate.judging import Judged, Judging
from pipeline.calibrate.select.frames import Selection
from pipeline.rig.checks import FailedCheck
from pipeline.rig.estimates import Prior, Solution
from schemas.observations import Observation

__all__ = ["SolvedDay"]


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
