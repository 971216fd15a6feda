"""What of a night no retry can end: fleet.toml, or a file that it names, is to be mended."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.config import FleetConfig
from pipeline.fleet.nightly import DayOutcome

__all__ = ["night_statuses", "rigs_to_mend"]


def rigs_to_mend(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> dict[str, str]:
    """Rigs of which every day of the night was misconfigured, with the first one's reason."""
    of_rig: dict[str, list[DayOutcome]] = {}
    for outcome in outcomes:
        if fleet.knows(outcome.vehicle):
            of_rig.setdefault(fleet.vehicle(outcome.vehicle).rig, []).append(outcome)
    return {rig: own[0].reason for rig, own in of_rig.items() if all(o.misconfigured for o in own)}


def night_statuses(outcomes: Sequence[DayOutcome], fleet: FleetConfig) -> list[str]:
    """Status of each vehicle-day; "misconfigured" where a retry does not help.

    That is so where a day failed for its configuration. Of days that were refused for it, it takes all of the rig: one
    log without a topic says nothing of fleet.toml.
    """
    mend = rigs_to_mend(outcomes, fleet)
    return [
        "misconfigured"
        if o.misconfigured and (o.status == "failed" or fleet.vehicle(o.vehicle).rig in mend)
        else o.status
        for o in outcomes
    ]
