"""Failures that no retry can fix: fleet.toml, or a file that it names, must be corrected."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.config import FleetConfig
from pipeline.fleet.nightly import DayOutcome

__all__ = ["night_statuses", "rigs_to_mend"]


def rigs_to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """Rigs whose days were all misconfigured in this night, with the reason of the first day."""
    of_rig: dict[str, list[DayOutcome]] = {}
    for outcome in outcomes:
        if fleet.knows(outcome.vehicle):
            of_rig.setdefault(fleet.vehicle(outcome.vehicle).rig, []).append(outcome)
    return {rig: own[0].reason for rig, own in of_rig.items() if all(o.misconfigured for o in own)}


def night_statuses(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> list[str]:
    """Status of each vehicle-day; "misconfigured" if a retry does not help.

    A day that failed because of its configuration is misconfigured. Refused days count only if all days of
    the rig were refused for it: a single log without a topic is no error of fleet.toml.
    """
    mend = rigs_to_mend(outcomes, fleet)
    return [
        "misconfigured"
        if o.misconfigured and (o.status == "failed" or fleet.vehicle(o.vehicle).rig in mend)
        else o.status
        for o in outcomes
    ]
