"""One failed check of a calibration, as it travels from the solver or the judge into a record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from schemas.faults import FAULTS

__all__ = ["FailedCheck", "faults_of"]


@dataclass(frozen=True)
class FailedCheck:
    """What failed, in a sentence, and the fault of `schemas.faults` behind it where the check can name one."""

    sentence: str
    fault: str = ""  # key of FAULTS; empty where the check shows that something is wrong, but not what
    disproves: bool = False  # the pose is wrong, not only unproved: nobody should use it

    def __post_init__(self) -> None:
        assert not self.fault or self.fault in FAULTS, self.fault


def faults_of(checks: Iterable[FailedCheck]) -> list[str]:
    """Faults that the checks name, each once, in order."""
    return list(dict.fromkeys(check.fault for check in checks if check.fault))
