"""One failed check of a calibration, passed from solvers and verification to the record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from schemas.faults import FAULTS

__all__ = ["FailedCheck", "faults_of"]


@dataclass(frozen=True)
class FailedCheck:
    """Sentence about a failed check, and its fault in `schemas.faults` if it has one."""

    sentence: str
    fault: str = ""  # key of FAULTS; empty if the check cannot name the cause
    disproves: bool = False  # the pose is certainly wrong and must not be used, not only unproved

    def __post_init__(self) -> None:
        assert not self.fault or self.fault in FAULTS, self.fault


def faults_of(checks: Iterable[FailedCheck]) -> list[str]:
    """Faults of the checks, each once, in order."""
    return list(dict.fromkeys(check.fault for check in checks if check.fault))
